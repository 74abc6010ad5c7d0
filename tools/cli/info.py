"""`hearthlog info`: what is in a log, or in a folder of logs."""

import json
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.text import printable
from hearthlog.tools.cli.selection import log_location
from hearthlog.tools.cli.text import PLAIN_WIDTH, first_of, moment, number, tell

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.summary import Summary

_LEVELS = ("ok", "warning", "error", "stale")  # of a diagnostic_msgs/DiagnosticStatus


def info(
    path: Annotated[
        Path,
        typer.Argument(
            help="A log, or a folder of logs, or a URL such as s3://bucket/home.",
            parser=log_location,
        ),
    ],
    *,
    catalog: Annotated[
        bool,
        typer.Option(
            "--catalog",
            help="Write FOLDER/catalog.parquet, a row a file, and show the homes in the folder. "
            "Files that are as it says already are not read again.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show what is in a log: span, topics, rates, gaps, labels, model, sizes.

    Exit status 3: a file is unfinished or damaged, or (without --catalog) sound is missing.
    """
    if catalog:
        from hearthlog.tools.cli.catalog import make_catalog

        make_catalog(path, as_json=as_json)
        return
    from hearthlog.analyzer.logs.summary import summarise
    from hearthlog.schemas.logs.files import find_logs
    from hearthlog.tools.cli.progress import track

    summary = summarise(track(find_logs(path), "reading logs"))
    for error in summary.damaged.values():
        tell(error)
    if not summary.files:
        raise typer.Exit(1)
    if as_json:
        print(json.dumps(_as_json(summary), indent=2))
    else:
        _print(summary)
    if summary.unfinished or summary.damaged or summary.gaps:
        raise typer.Exit(3)


def _as_json(summary: "Summary") -> dict[str, Any]:
    first, last = summary.span or (None, None)
    return {
        "files": [str(path) for path in summary.files],
        "unfinished": [str(path) for path in summary.unfinished],
        "layers": [str(path) for path in summary.layers],
        "damaged": {str(path): error for path, error in summary.damaged.items()},
        "size_bytes": summary.size,
        "chunks": summary.chunks,
        "compression_ratio": summary.compression_ratio,
        "profiles": sorted(summary.profiles),
        "libraries": sorted(summary.libraries),
        "start": moment(first),
        "end": moment(last),
        "seconds": summary.seconds,
        "streams": summary.streams,
        "topics": {
            name: {
                "type": topic.type,
                "encoding": topic.encoding,
                "messages": topic.messages,
                "rate_hz": topic.rate,
                "bytes": topic.bytes,
            }
            for name, topic in summary.topics.items()
        },
        "labels": {
            microphone: {label: seconds / 60 for label, seconds in labels.most_common()}
            for microphone, labels in summary.label_seconds.items()
        },
        "segments": {
            microphone: dict(labels.most_common())
            for microphone, labels in summary.segments.items()
        },
        "gaps": [asdict(gap) | {"start": moment(gap.start)} for gap in summary.gaps],
        "gap_seconds": summary.gap_seconds,
        "health": _health(summary),
        "attachments": sorted(summary.attachments),
        "metadata": sorted(summary.metadata),
        "schema_versions": sorted(summary.schema_versions),
    }


def _health(summary: "Summary") -> dict[str, str] | None:
    health = summary.health
    if health is None:
        return None
    level = _LEVELS[min(health.level, len(_LEVELS) - 1)]
    return {
        "level": level,
        "name": health.name,
        "message": health.message,
        "time": str(moment(health.time)),
    }


def _print(summary: "Summary") -> None:
    from rich.console import Console
    from rich.table import Table

    width = None if sys.stdout.isatty() else PLAIN_WIDTH
    console = Console(highlight=False, markup=False, emoji=False, soft_wrap=True, width=width)

    def show(table: Table) -> None:
        if table.rows:
            console.print(table, soft_wrap=False)

    for line in _lines(summary):
        console.print(printable(line))
    topics = Table("topic", "type", "messages", "per second", "MB raw", box=None)
    for name, topic in sorted(summary.topics.items()):
        encoding = "" if topic.encoding == "cdr" else f" ({topic.encoding})"
        size = "-" if topic.bytes is None else f"{topic.bytes / 1e6:.2f}"
        count, rate = str(topic.messages), f"{topic.rate:.3g}"
        topics.add_row(printable(name), printable(topic.type + encoding), count, rate, size)
    show(topics)
    labels = Table("microphone", "label", "minutes", "segments", box=None)
    for microphone, label, seconds, segments in _label_rows(summary):
        minutes = f"{seconds / 60:.2f}"
        labels.add_row(printable(microphone), printable(label), minutes, str(segments))
    show(labels)
    for line in _gap_lines(summary):
        console.print(printable(line))


def _lines(summary: "Summary") -> Iterator[str]:
    """Say what the files are, and what they say of themselves."""
    chunks = f", {number(summary.chunks, 'chunk')}" if summary.chunks else ""
    ratio = summary.compression_ratio
    packed = f", compressed {ratio:.2f} to 1" if ratio else ""
    yield f"{number(len(summary.files), 'file')}, {summary.size / 1e6:.1f} MB{chunks}{packed}"
    if summary.span is None:
        yield "no messages"
    else:
        start, end = map(moment, summary.span)
        yield f"{start} to {end} ({_duration(summary.seconds)})"
    about = {
        "written by": summary.libraries,
        "profile": summary.profiles,
        "metadata": summary.metadata,
        "schema version": summary.schema_versions,
        "attachments": summary.attachments,
    }
    yield "; ".join(f"{what} {', '.join(sorted(names))}" for what, names in about.items() if names)
    yield from first_of("unfinished", [str(path) for path in summary.unfinished])
    yield from first_of("layer", [str(path) for path in summary.layers])
    for stream in summary.streams:
        model = f"{stream['model']} ({stream['model_sha256'][:12]})" if stream["model"] else "none"
        yield (
            f"{stream['microphone']}: {stream['device']}, features {stream['feature_set']}, "
            f"model {model}"
        )
    health = _health(summary)
    if health is not None:
        yield f"health: {health['level']}, {health['time']} {health['name']}: {health['message']}"


def _gap_lines(summary: "Summary") -> Iterator[str]:
    if summary.gaps:
        yield f"{number(len(summary.gaps), 'gap')}, together {summary.gap_seconds:.3f} s"
    lines = [
        f"{gap.microphone} {moment(gap.start)} {gap.seconds:.3f} s, "
        f"{number(gap.frames_lost, 'frame')}: {gap.reason}"
        for gap in summary.gaps
    ]
    yield from first_of("gap", lines)


def _label_rows(summary: "Summary") -> Iterator[tuple[str, str, float, int]]:
    for microphone in dict.fromkeys([*summary.label_seconds, *summary.segments]):
        seconds = summary.label_seconds.get(microphone, Counter())
        segments = summary.segments.get(microphone, Counter())
        for label in dict.fromkeys([*(name for name, _ in seconds.most_common()), *segments]):
            yield microphone, label, seconds[label], segments[label]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
