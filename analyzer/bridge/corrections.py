"""What people say of an event becomes marks in the review layers of its logs."""

import time
from itertools import pairwise
from pathlib import Path

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, log_name, time_span
from hearthlog.schemas.messages.topics import LIVE, labelling_topic

_LATER = 60 * NANOSECONDS  # than its end a segment is written at most
_FIELDS = "header.stamp", "duration", "label"


def correct_event(folder: Path, node: str, event: Event, label: str, reviewer: str) -> list[Path]:
    """Mark the segments of an event with another class, in the name of who says so.

    Raise `BridgeError` if no log has the event any more, or a layer cannot be written.
    """
    try:
        logs = _logs_of(folder, node, event)
        spans = _segments(list(logs), event)
        made = time.time_ns()
        layers = []
        for log, (first, end) in logs.items():
            pieces = ((max(a, first), min(b, end)) for a, b in spans)
            marks = [
                Mark(event.microphone, a, b, label, reviewer, made, LIVE)
                for a, b in pieces
                if a < b
            ]
            if marks:
                layers.append(write_marks(log, marks))
    except (HearthlogError, OSError) as error:
        raise BridgeError(f"{event.id}: cannot be marked ({error})") from error
    if not layers:
        raise BridgeError(f"{event.id}: no log in {folder} has this event")
    return layers


def _logs_of(folder: Path, node: str, event: Event) -> dict[Path, tuple[int, int]]:
    """Return the logs of the time of an event, and which part of that time each has."""
    begins = {}
    for log in reversed(find_logs(folder)):
        name = log_name(log)
        span = time_span(log) if name.node == node and not name.layer else None
        if span is None or span[0] > event.end:
            continue
        if span[1] < event.start:
            break
        begins[log] = span[0]
    logs = sorted(begins)
    edges = [event.start, *(begins[log] for log in logs[1:]), event.end]
    return dict(zip(logs, pairwise(edges), strict=True)) if logs else {}


def _segments(logs: list[Path], event: Event) -> list[tuple[int, int]]:
    """Return when the segments of an event begin and end."""
    if not logs:
        return []
    segments = labelling_topic(event.microphone, LIVE, "segment")
    columns = read_columns(logs, [segments], event.start, event.end + _LATER, _FIELDS)
    if segments not in columns:
        return [(event.start, event.end)]
    starts, durations, labels = (columns[segments][name].tolist() for name in _FIELDS)
    return [
        (start, start + duration)
        for start, duration, label in zip(starts, durations, labels, strict=True)
        if label == event.label and event.start <= start and start + duration <= event.end
    ]
