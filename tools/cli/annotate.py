"""`hearthlog annotate` and `enrol`: import of label files, and recordings to train on."""

import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.analyzer.marks.formats import PATTERNS, find_format
from hearthlog.schemas.errors import HearthlogError, listed, shortened
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import check_new
from hearthlog.tools.cli.options import (
    End,
    LocalLog,
    Microphone,
    Start,
    logs_folder,
    parse_span,
    reviewer_name,
)
from hearthlog.tools.cli.terminal import (
    NAME_WIDTH,
    end_with_warnings,
    number,
    print_notice,
    print_table,
    suggest_training,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.layers import Coverage
    from hearthlog.analyzer.marks.enrol import Enrolled
    from hearthlog.analyzer.marks.formats.labels import SkippedLabels
    from hearthlog.analyzer.marks.label_files import Folded
    from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan


_SCENARIO = "Scenario of the marks, by name; without it the marks are of the sounds of the home."
_SHOWN = 10  # names or kinds of labels per message

annotate = typer.Typer(
    no_args_is_help=True,
    help="Take marks from the label files of other programs, or write them to such files.",
)


@annotate.command("import")
def import_labels(
    log: LocalLog,
    labels: Annotated[
        Path | None,
        typer.Argument(help=f"Labels: {PATTERNS}; alone, of the logs in logs.", show_default=False),
    ] = None,
    *,
    class_map: Annotated[
        Path | None,
        typer.Option("--map", help='Classes of labels, as TOML: "Tap Water" = "tap_water".'),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Accept Tap Water as tap_water without asking.")
    ] = False,
    tier: Annotated[
        list[str] | None, typer.Option(help="ELAN tier to read; may be repeated.")
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            help="Column of a table, such as label=Species, or start=1 in a table without "
            "names; may be repeated."
        ),
    ] = None,
    microphone: Annotated[
        str | None, typer.Option(help="Microphone of all labels; overrides the file.")
    ] = None,
    reviewer: Annotated[
        str | None,
        typer.Option(help="Name of the annotator, if the file has none.", show_default="you"),
    ] = None,
    scenario: Annotated[str, typer.Option(help=_SCENARIO, show_default="none")] = "",
    strict: Annotated[
        bool, typer.Option("--strict", help="Import nothing unless every label can be imported.")
    ] = False,
) -> None:
    """Import labels from files as marks in the review layers of the logs.

    Imported labels replace older marks that they overlap; labels that exist already change
    nothing. For a file of `hearthlog review --queue --save`, the spans that still have a
    label count as reviewed. Exit status 3: some labels were left out.
    """
    from hearthlog.analyzer.logs.layers import find_coverage
    from hearthlog.analyzer.marks.formats.labels import Choice
    from hearthlog.analyzer.marks.label_files import ImportOptions, read_class_map
    from hearthlog.analyzer.marks.label_files import import_labels as read_labels
    from hearthlog.analyzer.marks.marks import (
        RANDOM,
        new_marks,
        read_marks,
        read_reviewed,
        write_marks,
    )
    from hearthlog.analyzer.review.review_list import (
        check_scenario,
        outside_requests,
        queue_file,
        read_spans,
        reviewed_spans,
    )

    if labels is None:  # a single argument is the labels
        log, labels = Path(logs_folder()), log
    _check_use(labels, scenario)
    name, now = reviewer_name(reviewer), time.time_ns()
    choice = Choice(tier or (), _columns(column or []))
    names = None if class_map is None else read_class_map(class_map)
    coverage = find_coverage(log)
    _check_microphone(log, coverage, microphone)
    options = ImportOptions(microphone, names, choice, strict)
    queue = queue_file(labels)
    spans = read_spans(queue) if queue.exists() else []
    check_scenario(queue, spans, scenario, "--scenario")
    by_log, left_out, moved = read_labels(
        labels, coverage, options, lambda folded: _agree(labels, folded, yes=yes)
    )
    for other, count in moved.items():
        print_notice(
            f"{number(count, 'label')} of {other}, by the file, are taken as of {microphone}"
        )
    losses = list(_losses(left_out))
    if not by_log:
        print_notice(*losses)
        raise typer.Exit(1)
    every_mark = [mark for marks in by_log.values() for mark in marks]
    reviewed_by_log = reviewed_spans(spans, every_mark, coverage, name, now)
    taken: list[Mark] = []
    seen: list[ReviewedSpan] = []
    for path in sorted(by_log.keys() | reviewed_by_log.keys()):
        new = [
            mark._replace(reviewer=mark.reviewer or name, made=mark.made or now)
            for mark in new_marks(by_log.get(path, []), read_marks(path, scenario))
        ]
        before = {span._replace(reviewer="", made=0) for span in read_reviewed(path, scenario)}
        reviewed = [
            span
            for span in reviewed_by_log.get(path, [])
            if span._replace(reviewer="", made=0) not in before
        ]
        if new or reviewed:
            print(write_marks(path, new, reviewed=reviewed, scenario=scenario))
        taken += new
        seen += reviewed
    _print_amounts(taken)
    existing = sum(map(len, by_log.values())) - len(taken)
    if existing:
        print_notice(f"{number(existing, 'mark')} existed already")
    if queue.exists():
        minutes = sum(span.chosen == RANDOM for span in seen)
        print_notice(
            f"looked at, by {queue}: {number(len(seen) - minutes, 'span')} of the queue, "
            f"{number(minutes, 'minute')} drawn at random"
        )
        if others := outside_requests(spans, taken):
            print_notice(
                f"{number(len(others), 'mark')} outside the spans of {queue}: your own choice"
            )
    if taken:
        suggest_training([log], scenario, "these")
    end_with_warnings(losses)


@annotate.command("export")
def export_labels(
    log: LocalLog,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help=f"File to make: {PATTERNS}.")],
    microphone: Microphone = None,
    scenario: Annotated[str, typer.Option(help=_SCENARIO, show_default="none")] = "",
) -> None:
    """Write the marks of review layers to a label file."""
    from hearthlog.analyzer.logs.layers import find_coverage
    from hearthlog.analyzer.marks.label_files import write_labels
    from hearthlog.analyzer.marks.marks import read_marks

    _check_use(output, scenario)
    check_new(output)
    coverage = find_coverage(log)
    _check_microphone(log, coverage, microphone)
    marks = {
        mark
        for name, one in coverage.items()
        for path in one.logs
        for mark in read_marks(path, scenario)
        if mark.microphone == name and microphone in {None, name}
    }
    write_labels(output, sorted(marks, key=lambda mark: (mark.start, mark)), coverage)
    print(output)


def _check_use(path: Path, scenario: str) -> None:
    from hearthlog.schemas.messages.topics import check_scenario_name

    if find_format(path) is None:
        wrong_use(f"{path}: a label file is {PATTERNS}")
    if scenario:
        check_scenario_name(scenario)


def _check_microphone(
    log: Path, coverage: "Mapping[str, Coverage]", microphone: str | None
) -> None:
    from hearthlog.analyzer.errors import DataError

    if microphone is not None and microphone not in coverage:
        names = ", ".join(sorted(coverage))
        raise DataError(f"{log}: no microphone {microphone!r}; there is {names}")


def _columns(given: Sequence[str]) -> dict[str, str]:
    """Parse the options --column."""
    from hearthlog.analyzer.marks.formats.tables import COLUMNS

    pairs = [text.partition("=")[::2] for text in given]
    for text, (field, name) in zip(given, pairs, strict=True):
        if field not in COLUMNS or not name:
            wrong_use(f"--column {text}: write {listed(COLUMNS)}, and the column: label=Species")
    return dict(pairs)


def _agree(labels: Path, folded: "Sequence[Folded]", *, yes: bool) -> None:
    """Ask for confirmation of labels matched to similarly spelt names."""
    from hearthlog.analyzer.errors import DataError
    from hearthlog.models.classes import find_class

    texts = [
        f"{shortened(label, NAME_WIDTH)!r} as {name} ({number(count, 'label')}"
        f"{'' if find_class(name) else ', a class of your own'})"
        for label, name, count in folded
    ]
    more = [f"{len(texts) - _SHOWN} more"] if len(texts) > _SHOWN else []
    text = listed([*texts[:_SHOWN], *more], "and")
    if yes:
        print_notice(f"taken: {text}")
    elif not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise DataError(
            f"{labels}: not spelled like a class: {text}; --yes accepts these classes, --map "
            "names others"
        )
    else:
        print_notice(f"{labels}: not spelled like a class: {text}")
        if not typer.confirm("Import them as these classes?", err=True):
            print_notice("nothing was imported; --map names their classes")
            raise typer.Exit(1)


def _losses(left_out: "SkippedLabels") -> Iterator[str]:
    """Yield a line per kind of skipped label: the count, and the first one."""
    kinds = list(left_out.kinds())
    for count, first in kinds[:_SHOWN]:
        yield f"{number(count, first.kind)} left out{'' if count == 1 else ', the first'}: {first}"
    if len(kinds) > _SHOWN:
        rest = sum(count for count, _ in kinds[_SHOWN:])
        kinds_more = number(len(kinds) - _SHOWN, "kind")
        yield f"{number(rest, 'label')} more left out, of {kinds_more}"


def _print_amounts(marks: "Sequence[Mark]") -> None:
    counts = Counter(mark.label for mark in marks)
    lengths: Counter[str] = Counter()
    for mark in marks:
        lengths[mark.label] += mark.end - mark.start
    rows = [
        (label, f"{number(count, 'mark')}, {lengths[label] / NANOSECONDS:.2f} s")
        for label, count in sorted(counts.items())
    ]
    print_table((), rows, words=2)


def enrol(
    label: Annotated[str, typer.Argument(metavar="CLASS", help="What is heard.")],
    *,
    home: Annotated[Path, typer.Option(help="Folder of the training set of the home.")],
    file: Annotated[
        list[Path] | None, typer.Option(help="Audio file to enrol; may be repeated.")
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="Log, or folder of logs, to enrol a span of.", readable=False),
    ] = None,
    start: Start = None,
    end: End = None,
    microphone: Annotated[
        str | None, typer.Option(help="Microphone to listen to, as `hearthlog devices` lists it.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Seconds of the file (default: all) or of the microphone (default: 5)."),
    ] = None,
) -> None:
    """Enrol seconds of a sound from a file, a log or a microphone for training.

    Only features are kept, not the sound: as a fully marked log in the folder `enrolled` of
    the home. Exit status 3: a file was damaged, or some of several files could not be
    enrolled.
    """
    from hearthlog.analyzer.marks import enrol as enrolment

    least, most = enrolment.LEAST_SECONDS, enrolment.MOST_SECONDS
    if sum(given not in {None, ()} for given in (tuple(file or ()), log, microphone)) != 1:
        wrong_use("enrol one of --file, --log with --start and --end, or --microphone")
    if seconds is not None and not least <= seconds <= most:
        wrong_use(f"--seconds {seconds}: enrol from {least:.0f} to {most:.0f} s")
    if log is None and (start, end) != (None, None):
        wrong_use("--start and --end go with --log")
    first, last = parse_span(start, end)
    refused: list[str] = []
    if file:
        done = _enrol_files(home, label, file, seconds, refused)
    elif log is None:
        seconds = seconds or enrolment.SECONDS
        listening = partial(print_notice, f"listening for {seconds:g} s")
        done = enrolment.enrol_microphone(home, label, microphone or "", seconds, listening)
    elif first is None or last is None or seconds is not None:
        wrong_use("--log needs --start and --end, and takes no --seconds")
    else:
        done = [enrolment.enrol_log(home, label, log, first, last)]
    for enrolled in done:
        print(f"{enrolled.log}: {enrolled.seconds:.2f} s of {label}")
    end_with_warnings([*refused, *dict.fromkeys(each.warning for each in done if each.warning)])


def _enrol_files(
    home: Path, label: str, files: list[Path], seconds: float | None, refused: list[str]
) -> "list[Enrolled]":
    """Enrol several files; report the files that fail, or raise if all fail."""
    from hearthlog.analyzer.marks.enrol import enrol_file

    done: list[Enrolled] = []
    for path in files:
        try:
            done += enrol_file(home, label, path, seconds)
        except HearthlogError as error:
            if len(files) == 1:
                raise
            text = str(error)
            refused.append(text if str(path) in text else f"{path}: {text}")
    if not done:
        raise HearthlogError("; ".join(refused))
    return done
