"""`hearthlog info`: what is in a log, or in a folder of logs."""

import json
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from analyzer.summary import Summary

_PLAIN_WIDTH = 160  # where there is no terminal to say how wide it is


def info(
    path: Annotated[Path, typer.Argument(help="A log, or a folder of logs.")],
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show what is in a log: span, topics, rates, gaps, labels, model, sizes.

    Exit status 3: a file is unfinished, or sound is missing.
    """
    from analyzer.summary import summarise
    from schemas.files import find_logs
    from tools.cli.progress import track

    summary = summarise(track(find_logs(path), "reading logs"))
    if as_json:
        print(json.dumps(_as_json(summary), indent=2))
    else:
        _print(summary)
    if summary.unfinished or summary.gaps:
        raise typer.Exit(3)


def _as_json(summary: "Summary") -> dict[str, Any]:
    return {
        "files": [str(path) for path in summary.files],
        "unfinished": [str(path) for path in summary.unfinished],
        "size_bytes": summary.size,
        "start": _time(summary.start),
        "end": _time(summary.end),
        "seconds": summary.seconds,
        "streams": summary.streams,
        "topics": {
            name: {
                "type": topic.type,
                "messages": topic.messages,
                "rate_hz": topic.rate,
                "bytes": topic.bytes,
            }
            for name, topic in summary.topics.items()
        },
        "labels": {
            microphone: {label: seconds / 60 for label, seconds in labels.items()}
            for microphone, labels in summary.label_seconds.items()
        },
        "gaps": [asdict(gap) | {"start": _time(gap.start)} for gap in summary.gaps],
    }


def _print(summary: "Summary") -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, width=None if sys.stdout.isatty() else _PLAIN_WIDTH)
    console.print(
        f"{len(summary.files)} files, {summary.size / 1e6:.1f} MB, "
        f"{_time(summary.start)} to {_time(summary.end)} ({_duration(summary.seconds)})"
    )
    for path in summary.unfinished:
        console.print(f"unfinished: {path}")
    for stream in summary.streams:
        model = f"{stream['model']} ({stream['model_sha256'][:12]})" if stream["model"] else "none"
        console.print(
            f"{stream['microphone']}: {stream['device']}, features {stream['feature_set']}, "
            f"model {model}",
            markup=False,
        )
    topics = Table("topic", "type", "messages", "per second", "MB raw", box=None)
    for name, topic in sorted(summary.topics.items()):
        rate, size = f"{topic.rate:.3g}", f"{topic.bytes / 1e6:.2f}"
        topics.add_row(name, topic.type, str(topic.messages), rate, size)
    console.print(topics)
    labels = Table("microphone", "label", "minutes", box=None)
    for microphone, found in summary.label_seconds.items():
        for label, seconds in found.items():
            labels.add_row(microphone, label, f"{seconds / 60:.2f}")
    if labels.rows:
        console.print(labels)
    for gap in summary.gaps:
        console.print(
            f"gap: {gap.microphone} {_time(gap.start)} {gap.seconds:.3f} s, "
            f"{gap.frames_lost} frames: {gap.reason}",
            markup=False,
        )


def _time(stamp: int) -> str:
    moment = datetime.fromtimestamp(stamp / 1e9, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
