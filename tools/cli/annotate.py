"""`hearthlog annotate`: marks of a reviewer, from and to the label files of other programs."""

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.analyzer.marks.formats.formats import PATTERNS, find_format
from hearthlog.schemas.times import NANOSECONDS
from hearthlog.tools.cli.options import LocalLog, Microphone, reviewer_name
from hearthlog.tools.cli.table import print_table
from hearthlog.tools.cli.text import number, tell, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan

annotate = typer.Typer(
    no_args_is_help=True,
    help="Take marks from the label files of other programs, or write them to such files.",
)


@annotate.command("import")
def import_labels(
    log: LocalLog,
    labels: Annotated[Path, typer.Argument(help=f"Labels: {PATTERNS}.")],
    *,
    microphone: Microphone = None,
    reviewer: Annotated[
        str | None,
        typer.Option(help="Who labelled, where the file does not say.", show_default="you"),
    ] = None,
) -> None:
    """Add the labels of a file as marks to review layers, one beside each log.

    Where they overlap older marks, they win; labels that stand there already change nothing. If
    `hearthlog review --queue --save` made the file, spans that still have a label were looked at.
    """
    from hearthlog.analyzer.logs.coverage import find_coverage
    from hearthlog.analyzer.marks.formats.label_files import read_labels
    from hearthlog.analyzer.marks.marks import RANDOM, read_marks, read_reviewed, write_marks
    from hearthlog.analyzer.marks.merge_marks import new_marks
    from hearthlog.analyzer.review.queue.asked import asked_path, looked_at
    from hearthlog.analyzer.review.queue.review_list import read_list

    _check_suffix(labels)
    name, now = reviewer_name(reviewer), time.time_ns()
    coverage = find_coverage(log)
    by_log = read_labels(labels, coverage, microphone)
    asked = asked_path(labels)
    spans = read_list(asked) if asked.exists() else []
    said = [mark for marks in by_log.values() for mark in marks]
    looked = looked_at(spans, said, coverage, name, now)
    taken: list[Mark] = []
    seen: list[ReviewedSpan] = []
    for path in sorted(by_log.keys() | looked.keys()):
        new = [
            mark._replace(reviewer=mark.reviewer or name, made=mark.made or now)
            for mark in new_marks(by_log.get(path, []), read_marks(path))
        ]
        known = {span._replace(reviewer="", made=0) for span in read_reviewed(path)}
        reviewed = [
            span for span in looked.get(path, []) if span._replace(reviewer="", made=0) not in known
        ]
        if new or reviewed:
            print(write_marks(path, new, reviewed=reviewed))
        taken += new
        seen += reviewed
    _print_amounts(taken)
    existing = sum(map(len, by_log.values())) - len(taken)
    if existing:
        tell(f"{number(existing, 'mark')} stood there already")
    if asked.exists():
        minutes = sum(span.chosen == RANDOM for span in seen)
        tell(
            f"looked at, by {asked}: {number(len(seen) - minutes, 'span')} of the queue, "
            f"{number(minutes, 'minute')} drawn at random"
        )
    if taken:
        tell(f"next: a model of this home, from these: hearthlog train --home {quote(str(log))}")


@annotate.command("export")
def export_labels(
    log: LocalLog,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help=f"File to make: {PATTERNS}.")],
    microphone: Microphone = None,
) -> None:
    """Write the marks of review layers to a label file."""
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.coverage import find_coverage
    from hearthlog.analyzer.marks.formats.label_files import write_labels
    from hearthlog.analyzer.marks.marks import read_marks
    from hearthlog.schemas.storage.new_files import check_new

    _check_suffix(output)
    check_new(output)
    coverage = find_coverage(log)
    if microphone is not None and microphone not in coverage:
        names = ", ".join(sorted(coverage))
        raise DataError(f"{log}: no microphone {microphone!r}; there is {names}")
    marks = {
        mark
        for name, one in coverage.items()
        for path in one.logs
        for mark in read_marks(path)
        if mark.microphone == name and microphone in {None, name}
    }
    write_labels(output, sorted(marks, key=lambda mark: (mark.start, mark)), coverage)
    print(output)


def _check_suffix(path: Path) -> None:
    if find_format(path) is None:
        wrong_use(f"{path}: a label file is {PATTERNS}")


def _print_amounts(marks: "Sequence[Mark]") -> None:
    counts: Counter[str] = Counter()
    lengths: Counter[str] = Counter()
    for mark in marks:
        counts[mark.label] += 1
        lengths[mark.label] += mark.end - mark.start
    rows = [
        (label, f"{number(count, 'mark')}, {lengths[label] / NANOSECONDS:.2f} s")
        for label, count in sorted(counts.items())
    ]
    print_table((), rows, words=2)
