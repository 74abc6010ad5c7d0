"""`hearthlog diff`: two labellings of the same logs, and what to review next."""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.selection import End, Start, log_location, wrong_use
from hearthlog.tools.cli.text import tell
from hearthlog.tools.cli.times import parse_span

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.labellings import Side, Sources
    from hearthlog.analyzer.review.queue.review_list import ReviewSpan

_SHOWN, _QUEUED = 10, 60


def diff(
    log: Annotated[
        Path,
        typer.Argument(
            help="A log, or a folder of logs, or a URL such as s3://bucket/home.",
            parser=log_location,
        ),
    ],
    a: Annotated[
        str, typer.Argument(help="A labelling: live, review, or the model of a relabel layer.")
    ],
    b: Annotated[str | None, typer.Argument(help="Another one; --queue needs none.")] = None,
    *,
    queue: Annotated[
        bool,
        typer.Option("--queue", help="Choose spans of a to review: unsure, differing, novel."),
    ] = False,
    spans: Annotated[
        int | None,
        typer.Option(min=1, help=f"How many to show ({_SHOWN}), or to queue ({_QUEUED})."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--list", help="File to make, *.csv: the queue, or all disagreements."),
    ] = None,
    microphone: Annotated[
        str | None, typer.Option(help="Its name, where there are several.")
    ] = None,
    start: Start = None,
    end: End = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare two labellings of some logs, or choose what to review next.

    Exit status 3: a log is damaged or unfinished; the others, or what is there, were used.
    """
    from hearthlog.analyzer.logs.labellings import find_sources
    from hearthlog.schemas.messages.topics import labelling_topic

    if b is None and not queue:
        wrong_use(f"{a} and what else? name two labellings, or ask for --queue")
    _check_list(output)
    limits = parse_span(start, end)
    sources = find_sources(log)
    name = sources.microphone(microphone)
    chosen = [sources.find(name, wanted) for wanted in (a, b) if wanted is not None]
    if len(set(chosen)) < len(chosen):
        wrong_use(f"{a} and {b} are the same; there is {', '.join(sources.names(name))}")
    with share_done("reading segments") as progress:
        sides = [sources.read(name, each, *limits, progress) for each in chosen]
    if queue:
        result = _queue(sources, name, sides, limits, spans or _QUEUED)
    else:
        result = _difference(name, sides, spans or _SHOWN)
    if output is not None:
        _write_list(output, result.spans())
    if as_json:
        spans_as_text = [span.as_text() for span in result.spans()]
        print(json.dumps({**result.about, "spans": spans_as_text}, allow_nan=False))
    else:
        print(*result.table, sep="\n")
    _report_losses(sources, [labelling_topic(name, each, "segment") for each in chosen])


class _Result(NamedTuple):
    about: dict[str, Any]
    spans: "Callable[[], list[ReviewSpan]]"
    table: Iterable[str]


def _difference(microphone: str, sides: "list[Side]", shown: int) -> _Result:
    from hearthlog.analyzer.evaluation.difference import compare_sides
    from hearthlog.analyzer.evaluation.difference_table import difference_table
    from hearthlog.analyzer.review.queue.review_list import disagreements

    found = compare_sides(*sides)
    about = {"microphone": microphone, **asdict(found)}
    about["disagreements"] = len(found.disagreements.starts)
    spans = partial(disagreements, found, microphone)  # there may be a hundred thousand
    return _Result(about, spans, difference_table(found, shown))


def _queue(
    sources: "Sources",
    microphone: str,
    sides: "list[Side]",
    limits: tuple[int | None, int | None],
    count: int,
) -> _Result:
    from hearthlog.analyzer.review.queue.queue_table import queue_table
    from hearthlog.analyzer.review.queue.ranking import make_queue
    from hearthlog.analyzer.review.queue.review_list import queued
    from hearthlog.schemas.messages.topics import REVIEW

    names = [side.name for side in sides]
    if REVIEW in names:
        wrong_use("a queue is of what is not reviewed yet: compare other labellings")
    with share_done("reading labels") as progress:
        found = make_queue(
            sources,
            microphone,
            sides[0],
            other=sides[1] if len(sides) > 1 else None,
            marks=sources.marks(microphone, *limits),
            count=count,
            progress=progress,
        )
    if not found.sure:
        typer.echo(
            f"hearthlog: {names[0]}: no labels with probabilities, so how sure the model was is "
            "no part of the score",
            err=True,
        )
    about = {"microphone": microphone, "labelling": names[0], "candidates": found.candidates}
    return _Result(about, partial(queued, found, microphone, *names), queue_table(found))


def _write_list(path: Path, spans: "list[ReviewSpan]") -> None:
    from hearthlog.analyzer.review.queue.review_list import write_list

    write_list(path, spans)
    typer.echo(f"hearthlog: {len(spans)} spans are listed in {path}", err=True)


def _report_losses(sources: "Sources", topics: list[str]) -> None:
    lines = list(sources.losses)
    unfinished = sources.unfinished(topics)
    if unfinished:
        names = ", ".join(map(str, unfinished))
        lines.append(f"unfinished, read up to the last whole chunk: {names}")
    for line in lines:
        tell(line)
    if lines:
        raise typer.Exit(3)


def _check_list(path: Path | None) -> None:
    from hearthlog.schemas.storage.new_files import check_new

    if path is None:
        return
    if path.suffix != ".csv":
        wrong_use(f"--list {path}: a list of spans is named *.csv")
    check_new(path)
