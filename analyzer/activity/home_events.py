"""Events of a home in a time span: what a report counts, one by one."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import date, tzinfo
from functools import reduce
from itertools import chain
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.daily_metrics import HomeMetrics, metrics_of_home
from hearthlog.analyzer.activity.home_data import HomeData, read_home
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.labelling import in_order
from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.analyzer.logs.spans import (
    EVENT_PAUSE,
    NONE,
    Spans,
    common,
    first_of_groups,
    lengths,
    rows_at,
)
from hearthlog.models.classes import SILENCE, TELEVISION, UNKNOWN, ordered
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE

_NO_EVENTS = {SILENCE, TELEVISION, UNKNOWN}
_BEFORE = 3600 * NANOSECONDS  # an event that goes on at midnight, and a television, begin earlier


class HomeEvent(NamedTuple):
    """Segments of one class, from any microphones, with at most ten seconds between them."""

    label: str
    start: int  # in nanoseconds of UTC
    end: int  # likewise
    seconds: float  # total length of the segments
    confidence: float  # highest of the segments; 1 for a class that a person marked
    microphones: tuple[str, ...]  # with a segment, sorted
    reviewed: bool  # whether a person reviewed its start, at all microphones
    television: bool  # beside something like a television; no report counts it


class EventTotal(NamedTuple):
    """Events of a class that a report counts, and those beside something like a television."""

    counted: int
    television: int


def event_totals(metrics: HomeMetrics, start: int, end: int) -> dict[str, EventTotal]:
    """Count the events of each class that begin in a time span, in nanoseconds of UTC."""
    own = metrics.between(start, end)
    totals = {}
    for name in own.classes:
        starts = own.events.get(name, NONE.starts)
        counted = len(own.minutes.counted(name, starts))
        if len(starts):
            totals[name] = EventTotal(counted, len(starts) - counted)
    return totals


def read_day_totals(logs: HomeLogs, day: date, zone: tzinfo) -> dict[str, EventTotal]:
    """Read the logs of a local day, and count its events as a report does.

    Raise `DataError` without labels, `LogError` if segments are invalid.
    """
    start, end = day_span(day, zone)
    data = read_home(logs, LIVE, start - _BEFORE, (start, end))
    return event_totals(metrics_of_home(data), start, end)


def marked_classes(data: HomeData) -> list[str]:
    """Return the classes that have marks of people only, because the model does not know them.

    A report has no row for them, because they are not complete.
    """
    marked = {name for own in data.segments.values() for name in np.unique(own.labels).tolist()}
    labelled = set(chain.from_iterable(data.classes.values()))
    return ordered(marked - labelled - data.hidden - _NO_EVENTS)


def home_events(
    data: HomeData, metrics: HomeMetrics, classes: Sequence[str], start: int, end: int
) -> list[HomeEvent]:
    """List the events of classes except silence that begin in a span, end exclusive, by start.

    Times are nanoseconds of UTC. Of each class, there are as many as the count of a report and
    those beside a television together.
    """
    found = [
        event
        for name in classes
        if name != SILENCE
        for event in _events_of(data, metrics, name, start, end)
    ]
    return sorted(found, key=lambda event: (event.start, event.label))


def _events_of(
    data: HomeData, metrics: HomeMetrics, name: str, start: int, end: int
) -> Iterator[HomeEvent]:
    parts = []
    for (_, microphone), labels in data.segments.items():
        own = labels.rows(labels.labels == name)
        parts.append(replace(own, labels=np.full(len(own), microphone, object)))
    segments = in_order(parts)  # labelled with their microphones
    firsts = first_of_groups(segments.starts, segments.ends, EVENT_PAUSE)
    begin, stop = np.searchsorted(segments.starts[firsts], [start, end])
    if begin == stop:
        return
    events = Spans(segments.starts[firsts], np.maximum.reduceat(segments.ends, firsts))
    edges = np.append(events.starts, events.ends[-1])
    seconds = lengths(segments.spans(), edges) / NANOSECONDS
    highest = np.maximum.reduceat(segments.confidences, firsts)
    counted = np.isin(events.starts, metrics.minutes.counted(name, events.starts))
    through = reduce(common, [data.gone_through.get(source, NONE) for source in data.segments])
    reviewed = rows_at(through, events.starts) >= 0
    microphones = np.split(segments.labels, firsts[1:])
    for row in range(begin, stop):
        yield HomeEvent(
            name,
            int(events.starts[row]),
            int(events.ends[row]),
            float(seconds[row]),
            float(highest[row]),
            tuple(sorted(set(microphones[row].tolist()))),
            bool(reviewed[row]),
            not counted[row],
        )
