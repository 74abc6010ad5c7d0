"""Events of a home: their list, and the totals of a day."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import date, tzinfo
from functools import reduce
from typing import NamedTuple, Self

import numpy as np

from hearthlog.analyzer.activity.checked_minutes import unsure_below
from hearthlog.analyzer.activity.daily_metrics import (
    DayMetrics,
    HomeMetrics,
    day_of,
    metrics_of_home,
)
from hearthlog.analyzer.activity.doubtful_sounds import without_too_doubtful
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.home_data import HomeData, read_home
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.labelling import in_order
from hearthlog.analyzer.logs.local_time import awake_span, night_span
from hearthlog.analyzer.logs.spans import (
    EVENT_PAUSE,
    NONE,
    Spans,
    first_of_groups,
    intersection,
    lengths,
    rows_at,
    single_span,
)
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE

_BEFORE = 3600 * NANOSECONDS  # an event that goes on at its start, and a television, begin earlier


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

    @property
    def is_unsure(self) -> bool:
        """Whether the model is not sure of it, and nobody reviewed it."""
        return self.confidence < unsure_below(self.label) and not self.reviewed


class EventTotal(NamedTuple):
    """Events of a class that a report counts, and those beside something like a television."""

    counted: int
    television: int
    unsure: int = 0  # counted, but the model is not sure, and nobody reviewed them


NO_EVENTS = EventTotal(0, 0)


def event_totals(metrics: HomeMetrics, start: int, end: int) -> dict[str, EventTotal]:
    """Count the events of each class that begin in a time span, in nanoseconds of UTC."""
    own = metrics.between(start, end)
    totals = {}
    for name in own.classes:
        starts = own.events.get(name, NONE.starts)
        counted = len(own.minutes.counted(name, starts))
        if len(starts):
            unsure = own.minutes.count(name, None).unsure
            totals[name] = EventTotal(counted, len(starts) - counted, unsure)
    return totals


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
    through = reduce(
        intersection, [data.gone_through.get(source, NONE) for source in data.segments]
    )
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


class DaySounds(NamedTuple):
    """Sounds of a day, or of another span, as a report counts them."""

    day: date
    span: tuple[int, int]  # in nanoseconds of UTC
    totals: Mapping[str, EventTotal]  # of classes that occurred
    minutes: Mapping[str, float]  # counted, of classes that have any
    uncounted: Mapping[str, float]  # minutes beside something like a television, likewise

    def of_classes(self, names: Collection[str]) -> Self:
        """Return only the sounds of some classes."""
        return self._replace(
            totals={name: own for name, own in self.totals.items() if name in names},
            minutes={name: own for name, own in self.minutes.items() if name in names},
            uncounted={name: own for name, own in self.uncounted.items() if name in names},
        )

    def with_marked(self, events: Sequence[HomeEvent]) -> Self:
        """Return the sounds together with events of classes that only people marked."""
        totals = Counter(event.label for event in events)
        minutes = {
            name: sum(event.seconds for event in events if event.label == name) / 60
            for name in totals
        }
        own = {name: EventTotal(count, 0) for name, count in totals.items()}
        return self._replace(totals={**self.totals, **own}, minutes={**self.minutes, **minutes})

    def as_json(self) -> dict[str, object]:
        """Return the sounds as a JSON object."""
        return {
            "date": self.day.isoformat(),
            "counts": {name: total._asdict() for name, total in self.totals.items()},
            "minutes": dict(self.minutes),
            "television_minutes": dict(self.uncounted),
        }


def sounds_of_day(day: DayMetrics) -> DaySounds:
    """Return the sounds of the 24 hours to 22:00 of a day."""
    return _sounds_of_span(day.to_evening)


def sounds_between(
    metrics: HomeMetrics, day: date, zone: tzinfo, start: int, end: int
) -> DaySounds:
    """Return the sounds of a span, in nanoseconds of UTC, that belongs to a day."""
    own = day_of(metrics, day, zone)
    return _sounds_of_span(replace(own, home=metrics, span=single_span(start, end)))


def _sounds_of_span(day: DayMetrics) -> DaySounds:
    start, end = int(day.span.starts[0]), int(day.span.ends[0])
    names = [name for name in day.home.classes if name != SILENCE]
    minutes = {name: day.spans_of(name).length / MINUTE for name in names}
    apart = {name: day.uncounted_minutes(name) for name in names}
    return DaySounds(
        day.day,
        (start, end),
        event_totals(day.home, start, end),
        {name: length for name, length in minutes.items() if length},
        {name: length for name, length in apart.items() if length},
    )


def read_day_sounds(logs: HomeLogs, day: date, zone: tzinfo) -> DaySounds:
    """Read the sounds of the 24 hours to 22:00 of a day.

    Raise `DataError` without labels, `LogError` if segments are invalid.
    """
    start, end = night_span(day, zone)[0], awake_span(day, zone)[1]
    data = read_home(logs, LIVE, start - _BEFORE, (start, end))
    return sounds_of_day(day_of(metrics_of_home(data), day, zone))


def perhaps_of(data: HomeData, events: Sequence[HomeEvent]) -> list[str]:
    """Return the class that each event might be of, though it is called `unknown`; else nothing."""
    parts = []
    for source, labels in data.labelled.items():
        rest = without_too_doubtful(labels, data.gone_through.get(source, NONE))
        parts.append(labels.rows(labels.labels != rest.labels))
    if not parts:
        return [""] * len(events)
    doubted = in_order(parts)
    found = []
    for event in events:
        own = []
        if event.label == UNKNOWN:
            is_common = (doubted.starts < event.end) & (doubted.ends > event.start)
            own = doubted.labels[is_common].tolist()
        found.append(own[0] if own else "")
    return found
