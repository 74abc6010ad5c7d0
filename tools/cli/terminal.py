"""Terminal output: lines, tables, progress, keys, and pages opened in a browser."""

import io
import json
import os
import re
import shlex
import shutil
import signal
import stat
import sys
import textwrap
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TextIO

import typer

from hearthlog.schemas.errors import HearthlogError, Progress, printable
from hearthlog.schemas.frames import millisecond_text

if TYPE_CHECKING:
    from queue import SimpleQueue


JUDGED_BY = "keep recording: the check needs ten minutes that it was not trained on"
_SHOWN = 10  # list items
_MOST_SHOWN = 100  # recent texts kept


def print_lines(lines: Iterable[str]) -> None:
    """Print lines with texts from untrusted files, wrapped by words on a terminal."""
    for line in lines:
        print(wrapped(printable(line), sys.stdout))


def print_json(result: dict[str, Any]) -> None:
    """Print a result as JSON."""
    print(json.dumps(result, allow_nan=False))


def print_notice(*texts: str) -> None:
    """Write a line for each text to standard error, for anything but results."""
    for text in texts:
        print(wrapped(f"hearthlog: {printable(text)}", sys.stderr), file=sys.stderr)


_WORD = re.compile(r"\s*(?:`[^`]*`\S*|\S+)")  # a command in backticks is never broken
_NARROWEST = 20  # columns to wrap at


def wrapped(text: str, stream: TextIO) -> str:
    """Break a line between words at the width of a terminal; unchanged without a terminal."""
    if not stream.isatty():
        return text
    from rich.cells import cell_len

    width = max(terminal_width(), _NARROWEST)
    lines, used = [""], 0
    for word in _WORD.findall(text):
        if used and used + cell_len(word) > width:
            lines.append("")
            used, word = 0, f"  {word.lstrip()}"  # noqa: PLW2901
        lines[-1] += word
        used += cell_len(word)
    return "\n".join(lines)


def cropped(line: str) -> str:
    """Crop a line to the width of the terminal."""
    from rich.cells import cell_len, set_cell_size

    width = terminal_width()
    return set_cell_size(line, width - 1) if cell_len(line) >= width else line


_BLOCKS = "▁▂▃▄▅▆▇█"


def bar_of(share: float) -> str:
    """Return a block whose height is a share, 0 to 1."""
    place = round(min(max(share, 0.0), 1.0) * (len(_BLOCKS) - 1))
    return _BLOCKS[place] if _prints(_BLOCKS) else str(place + 1)


def long_bar(share: float, width: int) -> str:
    """Return a bar of a share, 0 to 1, of a width; something above 0 is at least a thin block."""
    least = 1 if share > 0 else 0
    eighths = max(round(min(share, 1.0) * width * 8), least)
    if not _prints(_FULL + _EIGHTHS):
        return "#" * -(-eighths // 8)
    return _FULL * (eighths // 8) + (_EIGHTHS[eighths % 8 - 1] if eighths % 8 else "")


_FULL, _EIGHTHS, _PALE = "█", "▏▎▍▌▋▊▉", "░"


def two_part_bar(first: float, second: float, width: int) -> tuple[str, str]:
    """Return the parts of a bar of two shares, 0 to 1 together; the second is of pale blocks."""
    if not second:
        return long_bar(first, width), ""
    bar = long_bar(first, width)[: width - 1]  # whatever there is has a block
    pale = max(round((first + second) * width) - len(bar), 1)
    return bar, pale_block() * pale


def pale_block() -> str:
    """Return the block of the second part of a bar."""
    return _PALE if _prints(_PALE) else "."


def dim(text: str) -> str:
    """Return a text in pale colour, where the terminal has colours and they are wanted."""
    from rich.console import Console

    console = Console()
    wanted = bool(text) and console.color_system is not None and not console.no_color
    return f"\x1b[2m{text}\x1b[0m" if wanted else text


def _prints(characters: str) -> bool:
    """Whether standard output has characters in its encoding."""
    try:
        characters.encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def terminal_width() -> int:
    """Return the columns of the terminal, or of COLUMNS; 160 if neither is known."""
    return shutil.get_terminal_size((_PLAIN_WIDTH, 24)).columns


def stopped_by(*numbers: int) -> threading.Event:
    """Return an event that signals set from now on."""
    stop = threading.Event()
    for number in numbers:
        signal.signal(number, lambda *_: stop.set())
    return stop


class ReportOnce:
    """Writes repeated messages once per text."""

    def __init__(self) -> None:
        self._shown: deque[str] = deque(maxlen=_MOST_SHOWN)

    def __call__(self, what: object) -> None:
        """Write a message unless written recently."""
        if str(what) not in self._shown:
            self._shown.append(str(what))
            print_notice(str(what))

    def __bool__(self) -> bool:
        return bool(self._shown)


def wrong_use(message: str) -> NoReturn:
    """End with one line, and the exit status of wrong use."""
    print_notice(message)
    raise typer.Exit(2)


def unfinished_lines(paths: Sequence[Path]) -> list[str]:
    """Return a line that lists incomplete logs, if any."""
    names = ", ".join(map(str, paths))
    return [f"unfinished, read up to the last whole chunk: {names}"] if names else []


def end_with_warnings(lines: Sequence[str]) -> None:
    """Write each line to standard error; end with exit status 3 if there are any."""
    print_notice(*lines)
    if lines:
        raise typer.Exit(3)


def number(count: int, what: str) -> str:
    """Format a count with its noun."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def suggest_training(logs: Sequence[Path], scenario: str, marks: str) -> None:
    """Print how to train a model on marks of logs, for a scenario, or else for the home."""
    what = f"scenario {scenario}" if scenario else "this home"
    judged = "" if scenario else f" ({JUDGED_BY})"
    words = [word for log in logs for word in ("--home", str(log))]
    words += ["--scenario", scenario] if scenario else []
    train = f"hearthlog train {shlex.join(words)}"
    print_notice(f"next: a model of {what}, from {marks}{judged}: {train}")


def moment(stamp: int | None) -> str | None:
    """Format a time (ns of UTC) to the millisecond; None stays None."""
    return None if stamp is None else millisecond_text(stamp)


def first_of(what: str, lines: Sequence[str]) -> Iterator[str]:
    """Yield the first lines of a list, and the number of the rest."""
    for line in lines[:_SHOWN]:
        yield f"{what}: {line}"
    if len(lines) > _SHOWN:
        yield f"{what}: and {len(lines) - _SHOWN} more (--json lists all)"


NAME_WIDTH = 18  # class column of a table of figures
_PLAIN_WIDTH = 160
GAP = 2
_MANY = 1000  # rows; a Rich table of more takes minutes


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> None:
    """Print rows of text below their heads.

    Parameters
    ----------
    head : sequence of str
        Empty for a table without heads.
    rows : iterable of sequence of str
        One with a single cell is a title, as wide as the table.
    words : int
        Number of text columns, from the left. The others are figures: aligned to the right, and
        wrapped only after the text columns.
    """
    from rich.console import Console
    from rich.table import Table

    cells = [[printable(cell) for cell in row] for row in rows]
    if not cells:
        return
    if len(cells) > _MANY:
        _print_plainly([list(head)] * bool(head) + cells, words)
        return
    columns = max(map(len, [head, *cells]))
    widths, gap = _fitted(head, [row for row in cells if not _is_title(row, columns)], words)
    if not widths:
        _print_records(head, cells)
        return
    # A terminal narrower than a table without heads breaks its lines.
    total_width = max(terminal_width(), sum(widths) + gap * len(widths))
    console = Console(highlight=False, markup=False, emoji=False, width=total_width)

    def print_rows(rows: Iterable[Sequence[str]], heads: Sequence[str] = ()) -> None:
        table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0), show_header=bool(heads))
        for place, width in enumerate(widths):
            side: Literal["left", "right"] = "left" if place < words else "right"
            table.add_column(
                heads[place] if heads else "", justify=side, width=width, overflow="fold"
            )
        for row in rows:
            table.add_row(*row)
        with console.capture() as text:
            console.print(table)
        print(*(line.rstrip() for line in text.get().splitlines()), sep="\n")

    if head:
        print_rows([], head)
    for are_titles, rows_or_titles in groupby(cells, lambda row: _is_title(row, columns)):
        if are_titles:
            print(*(wrapped(title, sys.stdout) for (title,) in rows_or_titles), sep="\n")
        else:
            print_rows(rows_or_titles)


def _is_title(row: Sequence[str], columns: int) -> bool:
    return len(row) == 1 < columns


_LONGEST_WORD = 36  # of a text column that is not broken
_RECORD_INDENT = "    "


def _fitted(
    head: Sequence[str], cells: Sequence[Sequence[str]], words: int
) -> tuple[list[int], int]:
    """Return the widths and the gap of columns that break no word; no widths if none fit."""
    from rich.cells import cell_len

    def longest_word(texts: Iterable[str]) -> int:
        return max((cell_len(word) for text in texts for word in text.split()), default=1)

    columns = list(zip(*cells, strict=True))
    heads = list(head) or [""] * len(columns)
    widths, least = [], []
    for place, (title, column) in enumerate(zip(heads, columns, strict=True)):
        widest = max(cell_len(cell) for cell in column)
        widths.append(max(widest, cell_len(title), 1))
        kept = widest if place >= words else min(longest_word(column), _LONGEST_WORD)
        least.append(max(kept, longest_word([title])))
    for gap in (GAP, 1):
        room = terminal_width() - gap * (len(widths) - 1)
        if sum(least) <= room or not head:
            break
    else:
        return [], 0
    order = [range(words), range(words, len(widths))]  # figures are wrapped last
    while sum(widths) > room:
        wide = [[i for i in places if widths[i] > least[i]] for places in order]
        if not any(wide):
            break
        widths[max(wide[0] or wide[1], key=widths.__getitem__)] -= 1
    return widths, gap


def _print_records(head: Sequence[str], cells: Iterable[Sequence[str]]) -> None:
    """Print each row as its first cell, and below it the others with their heads."""
    for first, *rest in cells:
        print(first)
        named = [f"{name} {cell}" for name, cell in zip(head[1:], rest, strict=True) if cell]
        for line in textwrap.wrap(
            ", ".join(named),
            max(terminal_width(), 2 * len(_RECORD_INDENT)),
            initial_indent=_RECORD_INDENT,
            subsequent_indent=_RECORD_INDENT,
            break_long_words=False,
            break_on_hyphens=False,
        ):
            print(line)


def _print_plainly(rows: Sequence[Sequence[str]], words: int) -> None:
    """Print rows of text in columns of the required width."""
    columns = max(map(len, rows))
    full = [row for row in rows if not _is_title(row, columns)]
    widths = [max(map(len, column)) for column in zip(*full, strict=True)]
    for row in rows:
        if _is_title(row, columns):
            print(*row)
            continue
        cells = [cell.ljust(width) for cell, width in zip(row[:words], widths, strict=False)]
        figures = zip(row[words:], widths[words:], strict=True)
        cells += [cell.rjust(width) for cell, width in figures]
        print((" " * GAP).join(cells).rstrip())


class OutputClosedError(Exception):
    """The reader of standard output is gone."""


@contextmanager
def checked_output() -> Iterator[None]:
    """Turn output failures in the block into hearthlog errors.

    Printing and flushing `sys.stdout` raise OutputClosedError if the reader is gone, and
    HearthlogError if writing fails; later output is discarded.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the parent process
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
    plain = sys.stdout
    binary = io.BufferedWriter(_Output(plain.fileno(), "wb", closefd=False))
    sys.stdout = io.TextIOWrapper(
        binary, plain.encoding, plain.errors, line_buffering=plain.isatty()
    )
    try:
        yield
    finally:
        sys.stdout = plain


class _Output(io.FileIO):
    """A file that raises hearthlog errors."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError as error:
            self._throw_away()
            raise OutputClosedError from error
        except OSError as error:
            self._throw_away()
            raise HearthlogError(
                f"standard output: cannot be written ({error.strerror})"
            ) from error

    def _throw_away(self) -> None:
        """Discard the pending output, since Python would write it again at exit."""
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, self.fileno())
        os.close(nothing)


_SPEED_SECONDS = 1800.0  # averaging time of the speed for the time left: steps may be long
_LINE_SECONDS = 60.0  # between two lines


@contextmanager
def share_done(what: str, *, announce: bool = False) -> Iterator[Progress]:
    """Show the share, 0 to 1, that the block reports, and the time left.

    If standard error is no terminal, `announce` prints the task at its start, and a task of more
    than a minute prints a line a minute.
    """
    if not sys.stderr.isatty():
        if announce:
            print_notice(what)
        yield _lines(what)
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(
        console=Console(stderr=True), transient=True, speed_estimate_period=_SPEED_SECONDS
    ) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def _lines(what: str) -> Progress:
    last = time.monotonic()

    def report(share: float) -> None:
        nonlocal last
        if time.monotonic() - last >= _LINE_SECONDS:
            last = time.monotonic()
            print_notice(f"{what}: {share:.1%}")

    return report


@contextmanager
def read_keys(keys: "SimpleQueue[str]") -> Iterator[threading.Event]:
    """Put pressed keys into a queue; the end of the input is `q`, and sets the event.

    The end of /dev/null is ignored: programs started from a desktop have no other input, and have
    a window.
    """
    ended = threading.Event()
    if not sys.stdin.isatty():
        threading.Thread(target=_read_lines, args=[keys, ended], daemon=True).start()
        yield ended
        return
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        threading.Thread(target=_read_terminal, args=[keys], daemon=True).start()
        yield ended
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _read_terminal(keys: "SimpleQueue[str]") -> None:
    while key := sys.stdin.read(1):
        keys.put("q" if key == "\x04" else key)


def _read_lines(keys: "SimpleQueue[str]", ended: threading.Event) -> None:
    for line in sys.stdin:
        for key in line.strip():
            keys.put(key)
    if not stat.S_ISCHR(os.fstat(sys.stdin.fileno()).st_mode):
        keys.put("q")
        ended.set()


def print_recording(path: Path) -> None:
    """Print the name of a Rerun recording, and how to open it."""
    from hearthlog.analyzer.review.viewer.process import hidden_options

    print(path)
    print(f"open it with: rerun {hidden_options()} {shlex.quote(str(path))}")
    print_notice("by --bind and --port no web page finds what Rerun shows")


def show_page(address: str) -> None:
    """Print the address of a page, and open it if there is a display; no address prints nothing."""
    if not address:
        return
    from hearthlog.analyzer.review.viewer.process import has_display

    print_notice(f"open {address}")
    if has_display():  # otherwise a text browser would take over the terminal
        import webbrowser

        webbrowser.open(address)
