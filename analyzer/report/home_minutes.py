"""The minutes of a home, and the events in each: what a count and its range are made of."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from hearthlog.analyzer.accuracy.checked_minutes import CheckedMinutes
from hearthlog.analyzer.accuracy.event_counts import (
    MINUTE,
    SET_APART,
    CheckedRates,
    events_of,
    sounding_minutes,
    strata_of,
    television_minutes,
)
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import Spans, common, lengths, rows_at
from hearthlog.analyzer.report.values import Count
from hearthlog.models.classes import UNKNOWN, class_name
from hearthlog.schemas.arrays import Bool, Int64


@dataclass(frozen=True)
class HomeMinutes:
    """The minutes in which at least one microphone heard.

    Attributes
    ----------
    starts : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    sounding, television, gone_through : np.ndarray [shape=(n,)], bool
        Whether anything sounds, and like a television, by the labels; whether a person has gone
        through all of the minute.
    labelled, corrected, certain : dict of str to np.ndarray [shape=(n,)], int64
        By class but silence, the events that begin in each minute: labelled ones where no one has
        gone through; all, with what a person says in the place of labels; those of them that begin
        where a person has gone through.
    """

    starts: Int64
    sounding: Bool
    television: Bool
    gone_through: Bool
    labelled: dict[str, Int64]
    corrected: dict[str, Int64]
    certain: dict[str, Int64]

    def between(self, spans: Spans) -> "HomeMinutes":
        """Return the minutes that begin in some spans of time."""
        of = np.searchsorted(spans.starts, self.starts, side="right") - 1
        return self.rows((of >= 0) & (self.starts < spans.ends[of]))

    def count(self, name: str, rates: CheckedRates | None) -> Count:
        """Count the events of a class; those of `SET_APART` only where no television sounds."""
        own = self.rows(~self.television) if name in SET_APART else self
        if name not in own.labelled:
            return Count(rates=rates)
        rest = ~own.gone_through
        return Count(
            int(own.corrected[name].sum()),
            int(own.certain[name].sum()),
            strata_of(own.labelled[name][rest], own.sounding[rest]),
            rates,
        )

    def counted(self, name: str, starts: Int64) -> Int64:
        """Return those of the events of a class that `count` counts.

        Parameters
        ----------
        starts : np.ndarray [shape=(n,)], int64
            When they began, within these minutes.
        """
        if name not in SET_APART:
            return starts
        television = self.starts[self.television]
        return starts[~np.isin(starts // MINUTE * MINUTE, television)]

    def beside_television(self, name: str) -> int:
        """Count the labelled events of a class where something sounds like a television.

        Parameters
        ----------
        name : str
            Of the class; 0 for one that is not set apart.
        """
        if name not in SET_APART or name not in self.labelled:
            return 0
        return int(self.corrected[name][self.television].sum())

    def rows(self, rows: Bool) -> "HomeMinutes":
        """Return some of the minutes.

        Parameters
        ----------
        rows : np.ndarray [shape=(n,)], bool
        """
        return HomeMinutes(
            self.starts[rows],
            self.sounding[rows],
            self.television[rows],
            self.gone_through[rows],
            {name: counts[rows] for name, counts in self.labelled.items()},
            {name: counts[rows] for name, counts in self.corrected.items()},
            {name: counts[rows] for name, counts in self.certain.items()},
        )


def home_minutes(
    labels: Labelling, gone_through: Sequence[Spans], coverage: Spans, events: Mapping[str, Int64]
) -> HomeMinutes:
    """Count what begins in each minute that was heard, at least in part.

    Parameters
    ----------
    coverage : Spans
        When at least one of them heard.
    events : mapping of str to np.ndarray [shape=(n,)], int64
        By class but silence, when events began, with what a person says in the place of labels.
    """
    first, last = int(coverage.starts[0]) // MINUTE, -(-int(coverage.ends[-1]) // MINUTE)
    edges = np.arange(first, last + 1) * MINUTE
    known = reduce(common, gone_through)

    def begun(starts: Int64) -> Int64:
        return np.diff(np.searchsorted(starts, edges))

    def unknown(name: str) -> Int64:
        starts = events_of(labels, name).starts
        return starts[rows_at(known, starts) < 0]

    minutes = HomeMinutes(
        edges[:-1],
        sounding_minutes(labels, edges),
        television_minutes(labels, edges),
        lengths(known, edges) == MINUTE,
        {name: begun(unknown(name)) for name in events},
        {name: begun(starts) for name, starts in events.items()},
        {name: begun(starts[rows_at(known, starts) >= 0]) for name, starts in events.items()},
    )
    return minutes.rows(lengths(coverage, edges) > 0)


def checked_rates_of(minutes: HomeMinutes, checks: CheckedMinutes) -> dict[str, CheckedRates]:
    """Return the rates of the classes of which enough minutes were checked."""
    amounts = {
        name: int(counts.sum()) + 1
        for name, counts in minutes.labelled.items()
        if class_name(name) != UNKNOWN  # which nothing is truly
    }
    whole = sum(amounts.values())
    fewest = 1 / max(len(amounts), 1)  # a class that labels hardly name may be missed all the more
    drawn = {
        name: checks.rates(name, max(amount / whole, fewest)) for name, amount in amounts.items()
    }
    return {name: rates for name, rates in drawn.items() if rates is not None}
