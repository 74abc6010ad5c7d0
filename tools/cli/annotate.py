"""`hearthlog annotate`: marks of a reviewer, from and to the files of others."""

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.reviewer import reviewer_name
from hearthlog.tools.cli.selection import wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.marks.marks import Mark

annotate = typer.Typer(
    no_args_is_help=True,
    help="Marks of what was heard, from and to label files of others.",
)
_FORMS = (
    "*.txt (Audacity), *.selections.txt (Raven), *.csv, *.eaf (ELAN), *.json (Label Studio) "
    "or *.rttm"
)
_Log = Annotated[Path, typer.Argument(help="A log, or a folder of logs.")]
_Microphone = Annotated[str | None, typer.Option(help="Its name, where there are several.")]


@annotate.command("import")
def import_labels(
    log: _Log,
    labels: Annotated[Path, typer.Argument(help=f"Labels: {_FORMS}.")],
    *,
    microphone: _Microphone = None,
    reviewer: Annotated[
        str | None,
        typer.Option(help="Who labelled, where the file does not say.", show_default="you"),
    ] = None,
) -> None:
    """Take the labels of a file as marks into review layers, one beside each log.

    Where they overlap older marks, they win; what stands there already stays as it is.
    """
    from hearthlog.analyzer.logs.coverage import find_coverage
    from hearthlog.analyzer.marks.formats import new_marks, read_labels
    from hearthlog.analyzer.marks.marks import read_marks, write_marks

    _check_suffix(labels)
    name, now = reviewer_name(reviewer), time.time_ns()
    by_log = read_labels(labels, find_coverage(log), microphone)
    taken: list[Mark] = []
    for path, marks in sorted(by_log.items()):
        new = [
            mark._replace(reviewer=mark.reviewer or name, made=mark.made or now)
            for mark in new_marks(marks, read_marks(path))
        ]
        if new:
            print(write_marks(path, new))
        taken += new
    _print_amounts(taken)
    there = sum(map(len, by_log.values())) - len(taken)
    if there:
        typer.echo(f"hearthlog: {_marks_text(there)} stood there already", err=True)


@annotate.command("export")
def export_labels(
    log: _Log,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help=f"File to make: {_FORMS}.")],
    microphone: _Microphone = None,
) -> None:
    """Write the marks of review layers to a label file."""
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.coverage import find_coverage
    from hearthlog.analyzer.marks.formats import write_labels
    from hearthlog.analyzer.marks.marks import read_marks
    from hearthlog.schemas.storage.new_files import check_new

    _check_suffix(output)
    check_new(output)
    heard = find_coverage(log)
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
    from hearthlog.analyzer.marks.formats import SUFFIXES

    if path.suffix not in SUFFIXES:
        wrong_use(f"{path}: a label file is {_FORMS}")


def _print_amounts(marks: "Sequence[Mark]") -> None:
    counts: Counter[str] = Counter()
    lengths: Counter[str] = Counter()
    for mark in marks:
        counts[mark.label] += 1
        lengths[mark.label] += mark.end - mark.start
    width = max(map(len, counts), default=0)
    for label, count in sorted(counts.items()):
        print(f"{label:{width}}  {_marks_text(count)}, {lengths[label] / 1e9:.2f} s")


def _marks_text(count: int) -> str:
    return "1 mark" if count == 1 else f"{count} marks"
