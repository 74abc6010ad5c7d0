"""`hearthlog annotate`: marks of a reviewer, from and to the files of others."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tools.cli.selection import wrong_use

if TYPE_CHECKING:
    from analyzer.marks import Mark

annotate = typer.Typer(
    no_args_is_help=True,
    help="Marks of what was heard, from and to label files (Audacity, CSV).",
)
_Log = Annotated[Path, typer.Argument(help="A log, or a folder of logs.")]
_Microphone = Annotated[str | None, typer.Option(help="Its name, where there are several.")]


@annotate.command("import")
def import_labels(
    log: _Log,
    labels: Annotated[Path, typer.Argument(help="Labels: *.txt (Audacity) or *.csv.")],
    *,
    microphone: _Microphone = None,
) -> None:
    """Take the labels of a file as marks into review layers, one beside each log.

    Where they overlap older marks, they win.
    """
    from analyzer.exchange import read_labels
    from analyzer.heard import find_heard
    from analyzer.marks import write_marks

    _check_suffix(labels)
    by_log = read_labels(labels, find_heard(log), microphone)
    for path, marks in sorted(by_log.items()):
        print(write_marks(path, marks))
    _print_amounts(mark for marks in by_log.values() for mark in marks)


@annotate.command("export")
def export_labels(
    log: _Log,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="File to make, *.txt or *.csv.")],
    microphone: _Microphone = None,
) -> None:
    """Write the marks of review layers to a label file."""
    from analyzer.errors import DataError
    from analyzer.exchange import write_labels
    from analyzer.heard import find_heard
    from analyzer.marks import read_marks
    from schemas.files import check_new

    _check_suffix(output)
    check_new(output)
    heard = find_heard(log)
    if microphone is not None and microphone not in heard:
        raise DataError(f"{log}: no microphone {microphone!r}; there is {', '.join(sorted(heard))}")
    marks = {
        mark
        for name, one in heard.items()
        for path in one.logs
        for mark in read_marks(path)
        if mark.microphone == name and microphone in {None, name}
    }
    write_labels(output, sorted(marks, key=lambda mark: (mark.start, mark)), heard)
    print(output)


def _check_suffix(path: Path) -> None:
    from analyzer.exchange import SUFFIXES

    if path.suffix not in SUFFIXES:
        wrong_use(f"{path}: a label file is *.txt (Audacity) or *.csv")


def _print_amounts(marks: "Iterable[Mark]") -> None:
    counts: Counter[str] = Counter()
    lengths: Counter[str] = Counter()
    for mark in marks:
        counts[mark.label] += 1
        lengths[mark.label] += mark.end - mark.start
    width = max(map(len, counts))
    for label, count in sorted(counts.items()):
        marks_text = "1 mark" if count == 1 else f"{count} marks"
        print(f"{label:{width}}  {marks_text}, {lengths[label] / 1e9:.2f} s")
