"""Tables on standard output: no wider than the terminal; plain text where there is none."""

import shutil
import sys
from collections.abc import Iterable, Sequence

from hearthlog.schemas.errors import printable, shortened

NAME_WIDTH = 18  # of a class in a table of figures
_PLAIN_WIDTH = 160
_GAP = 2
_MANY = 1000  # rows, of which Rich would make a table for minutes


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> None:
    """Print rows of text below their heads.

    Parameters
    ----------
    head : sequence of str
        Empty for a table without heads.
    words : int
        Number of columns, from the left, that are words. The others are figures: aligned to the
        right, and wrapped only after the words.
    """
    from rich.console import Console
    from rich.table import Table

    cells = [[printable(cell) for cell in row] for row in rows]
    if not cells:
        return
    if len(cells) > _MANY:
        _print_plainly([list(head)] * bool(head) + cells, words)
        return
    table = Table(box=None, pad_edge=False, show_header=bool(head))
    for place in range(len(cells[0])):
        least = max(len(row[place]) for row in cells) if place >= words else None
        table.add_column(
            head[place] if head else "",
            justify="left" if place < words else "right",
            min_width=least,
            overflow="fold",
        )
    for row in cells:
        table.add_row(*row)
    console = Console(highlight=False, markup=False, emoji=False, width=_width())
    with console.capture() as text:
        console.print(table)
    print(*(line.rstrip() for line in text.get().splitlines()), sep="\n")


def _print_plainly(rows: Sequence[Sequence[str]], words: int) -> None:
    """Print rows of text in columns as wide as they need."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row[:words], widths, strict=False)]
        figures = zip(row[words:], widths[words:], strict=True)
        cells += [cell.rjust(width) for cell, width in figures]
        print((" " * _GAP).join(cells).rstrip())


def print_confusion(classes: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> None:
    """Print a confusion matrix, if it is not too wide."""
    widths = [max(map(len, column)) + _GAP for column in zip(*rows, strict=True)]
    if NAME_WIDTH + sum(widths) > _width():
        print("confusion: too many classes for a table; --json has it")
        return
    print(title)
    named = zip(classes, rows, strict=True)
    print_table((), [(shortened(name, NAME_WIDTH), *row) for name, row in named])


def _width() -> int:
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else _PLAIN_WIDTH
