"""What was heard in a span of time, from the logs of one recorder."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from hearthlog.analyzer.bridge.alerts.gathering import SEGMENT_FIELDS, Gathered
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.listeners import listener_of
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.selection import Described, array_names, select
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import labelling_topic, parse_topic

_LATE = 12 * 3600 * NANOSECONDS  # a segment is in the log when it has ended, a long silence late


def read_heard(  # noqa: PLR0913, PLR0917
    logs: HomeLogs,
    node: str,
    start: int,
    end: int,
    lose: Callable[[str], None],
    progress: Progress = ignore_progress,
    others: Sequence[tuple[str, int, int, str, float]] = (),
) -> HomeHeard:
    """Read what was heard in a span of time.

    Parameters
    ----------
    start, end : int
        In nanoseconds of UTC; of what ends later, the beginning is there, too.
    progress : callable, optional
        Told the share of the logs that is read, 0 to 1.
    others : sequence of (str, int, int, str, float), optional
        Segments that go on and are in no log yet, as `Gathered.heard` takes them.
    """
    gathered = Gathered()
    entries = [entry.path for entry in logs.between(start, end + _LATE) if entry.node == node]
    for number, path in enumerate(entries, 1):
        try:
            _add_log(gathered, path, start, end + _LATE, lose)
        except LogError as error:
            lose(str(error))
        progress(number / len(entries))
    return gathered.heard(others)


def _add_log(
    gathered: Gathered, path: Path, start: int, end: int, lose: Callable[[str], None]
) -> None:
    with LogFile(path) as file:
        for first, last in zip(
            file.chunks["start"].tolist(), file.chunks["end"].tolist(), strict=True
        ):
            gathered.add_written_span(first, last)
    selection = select([path])
    if selection.unfinished:
        lose(f"unfinished, read up to the last whole chunk: {path}")
    listeners = {}
    for topic in selection.topics_of(message_types.SEGMENT, set(SEGMENT_FIELDS)):
        name = parse_topic(topic)
        listener = None if name is None else listener_of(name)
        if name is not None and listener is not None:
            listeners[topic] = listener
            labels = labelling_topic(name.microphone, name.labelling, "label")
            _add_classes(gathered, listener, selection.channels.get(labels, ()))
    segments = read_columns([path], list(listeners), start, end, SEGMENT_FIELDS)
    for topic, columns in segments.items():
        gathered.add_segments(listeners[topic], columns)


def _add_classes(gathered: Gathered, listener: str, channels: Sequence[Described]) -> None:
    for channel, _ in channels:
        gathered.add_classes(listener, array_names(channel.metadata, "probabilities"))


def nodes_of(logs: HomeLogs) -> list[str]:
    """List the names of the recorders of some logs."""
    entries: Sequence[str] = [entry.node for entry in logs.entries if not entry.layer]
    return sorted(set(entries))


def span_of(logs: HomeLogs, node: str) -> tuple[int, int]:
    """Return when the logs of a recorder begin and end, in nanoseconds of UTC.

    Raise `LogError` if none of them has a message that can be read.
    """
    own = [entry.path for entry in logs.entries if entry.node == node and not entry.layer]
    first, last = _first_span(own), _first_span(reversed(own))
    if first is None or last is None:
        raise LogError(f"the logs of {node} have no message that can be read")
    return first[0], last[1]


def _first_span(paths: Iterable[Path]) -> tuple[int, int] | None:
    for path in paths:
        with suppress(LogError):
            span = time_span(path)
            if span is not None:
                return span
    return None
