"""The minutes of a home, and the events in each: what a count and its range are made of."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hearthlog.analyzer.accuracy.checked_minutes import CheckedMinutes
from hearthlog.analyzer.accuracy.count_range import CheckedRates, strata_of
from hearthlog.analyzer.accuracy.events import (
    MINUTE,
    SET_APART,
    events_by_minute,
    events_of,
    sounding_minutes,
    television_minutes,
)
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import Spans, lengths
from hearthlog.analyzer.report.values import Count
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
    labelled, corrected : dict of str to np.ndarray [shape=(n,)], int64
        By class but silence, the events that begin in each minute: as labelled, and with what a
        person says in the place of labels.
    """

    starts: Int64
    sounding: Bool
    television: Bool
    gone_through: Bool
    labelled: dict[str, Int64]
    corrected: dict[str, Int64]

    def between(self, spans: Spans) -> "HomeMinutes":
        """Return the minutes that begin in some spans of time.

        Parameters
        ----------
        spans : Spans
            In nanoseconds of UTC.
        """
        of = np.searchsorted(spans.starts, self.starts, side="right") - 1
        return self.rows((of >= 0) & (self.starts < spans.ends[of]))

    def count(self, name: str, rates: CheckedRates | None) -> Count:
        """Count the events of a class; those of `SET_APART` only where no television sounds.

        Parameters
        ----------
        name : str
            Of the class.
        rates : CheckedRates or None
            Of the class.
        """
        own = self.rows(~self.television) if name in SET_APART else self
        if name not in own.labelled:
            return Count(rates=rates)
        certain, rest = own.gone_through, ~own.gone_through
        return Count(
            int(own.corrected[name].sum()),
            int(own.corrected[name][certain].sum()),
            strata_of(own.labelled[name][rest], own.sounding[rest]),
            rates,
        )

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
        )


def home_minutes(
    labels: Labelling, gone_through: Sequence[Spans], coverage: Spans, events: Mapping[str, Int64]
) -> HomeMinutes:
    """Count what begins in each minute that was heard, at least in part.

    Parameters
    ----------
    labels : Labelling
        Of all microphones, in the order of time, as labelled.
    gone_through : sequence of Spans
        By microphone, what a person has gone through.
    coverage : Spans
        When at least one of them heard.
    events : mapping of str to np.ndarray [shape=(n,)], int64
        By class but silence, when events began, with what a person says in the place of labels.
    """
    first, last = int(coverage.starts[0]) // MINUTE, -(-int(coverage.ends[-1]) // MINUTE)
    edges = np.arange(first, last + 1) * MINUTE
    whole = [lengths(spans, edges) == MINUTE for spans in gone_through]
    minutes = HomeMinutes(
        edges[:-1],
        sounding_minutes(labels, edges),
        television_minutes(labels, edges),
        np.logical_and.reduce(whole),
        {name: events_by_minute(events_of(labels, name), edges) for name in events},
        {name: np.diff(np.searchsorted(starts, edges)) for name, starts in events.items()},
    )
    return minutes.rows(lengths(coverage, edges) > 0)


def checked_rates_of(minutes: HomeMinutes, checks: CheckedMinutes) -> dict[str, CheckedRates]:
    """Return the rates of the classes of which enough minutes were checked.

    Parameters
    ----------
    minutes : HomeMinutes
        Which tell how often each class is labelled.
    checks : CheckedMinutes
    """
    amounts = {name: int(counts.sum()) + 1 for name, counts in minutes.labelled.items()}
    whole = sum(amounts.values())
    fewest = 1 / max(len(amounts), 1)  # a class that labels hardly name may be missed all the more
    drawn = {
        name: checks.rates(name, max(amount / whole, fewest)) for name, amount in amounts.items()
    }
    return {name: rates for name, rates in drawn.items() if rates is not None}
