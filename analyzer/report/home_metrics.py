"""What was heard in a home, by all its microphones together."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import numpy as np

from hearthlog.analyzer.accuracy.checked_minutes import CheckedMinutes
from hearthlog.analyzer.accuracy.event_counts import CheckedRates, events_of
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, joined, one, without
from hearthlog.analyzer.report.home_minutes import HomeMinutes, checked_rates_of, home_minutes
from hearthlog.analyzer.report.read_home import HomeData
from hearthlog.analyzer.routine.day_profile import HomeSegments
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Int64


@dataclass(frozen=True)
class HomeMetrics:
    """What was heard in a home, by all its microphones together."""

    classes: list[str]
    coverage: Spans  # when at least one of them heard
    listened: dict[str, Spans]  # by class: when at least one of them heard whose model knows it
    sound: Spans  # when at least one of them heard something else than silence
    spans: dict[str, Spans]  # by class: when at least one of them heard it
    # by class, but silence: when events began; spans with no more than ten seconds between them are
    # one event, and so are those of two microphones at one time
    events: dict[str, Int64]
    minutes: HomeMinutes
    rates: dict[str, CheckedRates]  # by class, of the minutes that were checked

    def between(self, start: int, end: int) -> "HomeMetrics":
        """Return what was heard in a span of time.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC; an event belongs to the span that it begins in.
        """
        return HomeMetrics(
            self.classes,
            cut(self.coverage, start, end),
            {name: cut(spans, start, end) for name, spans in self.listened.items()},
            cut(self.sound, start, end),
            {name: cut(spans, start, end) for name, spans in self.spans.items()},
            {name: self.events_in(name, one(start, end)) for name in self.events},
            self.minutes.between(one(start, end)),
            self.rates,
        )

    def events_in(self, name: str, span: Spans) -> Int64:
        """Return when the events of a class began in a span of time.

        Parameters
        ----------
        name : str
            Of the class; one without events, such as silence, has none.

        Returns
        -------
        np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        """
        starts = self.events.get(name, NONE.starts)
        return starts[(starts >= span.starts[0]) & (starts < span.ends[0])]


def whole_home(data: HomeData, checks: CheckedMinutes | None = None) -> HomeMetrics:
    """Put together what the microphones of a home heard.

    Parameters
    ----------
    data : HomeData
        With the segments and classes of at least one microphone.
    checks : CheckedMinutes, optional
        Minutes of the home that were drawn at random, and checked.

    Returns
    -------
    HomeMetrics
        A span is silent where no microphone heard anything else; segments of a class that are at
        most ten seconds apart, of whichever microphones, are one event.
    """
    labels = _together(data.segments.values())
    everything = joined(labels.starts, labels.ends)
    loud = labels.labels != SILENCE
    sound = joined(labels.starts[loud], labels.ends[loud])
    classes = list(dict.fromkeys(chain.from_iterable(data.classes.values())))
    listened, spans, events = {}, {}, {}
    for name in classes:
        own = labels.labels == name
        knowing = [part for source, part in data.segments.items() if name in data.classes[source]]
        listened[name] = _spans(_together(knowing))
        spans[name] = joined(labels.starts[own], labels.ends[own])
        events[name] = events_of(labels, name).starts
    if SILENCE in spans:
        spans[SILENCE] = without(spans[SILENCE], sound)  # another microphone heard something
        del events[SILENCE]
    gone_through = [data.gone_through.get(source, NONE) for source in data.segments]
    labelled = _together(data.labelled.values())
    minutes = home_minutes(labelled, gone_through, everything, events)
    rates = {} if checks is None else checked_rates_of(minutes, checks)
    return HomeMetrics(classes, everything, listened, sound, spans, events, minutes, rates)


def home_sound(data: HomeData, metrics: HomeMetrics) -> HomeSegments:
    """Return what routines are learned from: the labels of all microphones."""
    return HomeSegments(_together(data.segments.values()), metrics.listened)


def _together(parts: Iterable[Labelling]) -> Labelling:
    """Put labels of microphones in the order of time; they may overlap."""
    parts = list(parts)
    starts, ends, labels = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("starts", "ends", "labels")
    )
    order = np.argsort(starts, kind="stable")
    return Labelling(starts[order], ends[order], labels[order])


def _spans(labels: Labelling) -> Spans:
    return joined(labels.starts, labels.ends)
