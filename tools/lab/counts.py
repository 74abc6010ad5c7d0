"""`python -m hearthlog.tools.lab.counts`: how often the ranges of a report hold.

Minutes of some days of a simulated home are drawn at random and checked by its truth; the ranges
are those of another day.
"""

import sys
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.activity.checked_minutes import CheckedMinutes
from hearthlog.analyzer.activity.daily_metrics import RANGED_AT_NIGHT
from hearthlog.analyzer.activity.event_counts import (
    MINUTE,
    events_of,
    sounding_minutes,
    strata_of,
    television_minutes,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labelling import Labelling, find_labellings, unified
from hearthlog.analyzer.logs.spans import joined, lengths
from hearthlog.analyzer.review.candidates import RecordedMinutes, draw_minutes
from hearthlog.models.classes import ON_TELEVISION, SILENCE, UNKNOWN
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.home.person import read_truth

_DAY, _EVENING, _NIGHT = 1440, 22 * 60, 9 * 60  # minutes
_CHECKED = (5, 10, 30)
_DRAWS = 4  # of minutes, for each day and number


_Row = tuple[str, float, float, float, float, int]


class Home(NamedTuple):
    """The labelled minutes of a home, by its labels and by its truth.

    Attributes
    ----------
    starts : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    day : np.ndarray [shape=(n,)], int64
        Number of the 24 hours to 22:00 that each is of, from 0 on.
    night : np.ndarray [shape=(n,)], bool
        Whether each is of 22:00 to 07:00.
    labelled, true : dict of str to np.ndarray [shape=(n,)], int64
        By class: events that begin in each minute.
    sounding, television : np.ndarray [shape=(n,)], bool
    """

    starts: Int64
    day: Int64
    night: Bool
    labelled: dict[str, Int64]
    true: dict[str, Int64]
    sounding: Bool
    television: Bool


class Checked(NamedTuple):
    """The range of one count.

    Attributes
    ----------
    home, name, part : str
        `part` is of the day: all, night or day.
    minutes : int
        That were checked.
    labelled, true, low, high : int
    """

    home: str
    name: str
    part: str
    minutes: int
    labelled: int
    true: int
    low: int
    high: int

    @property
    def holds(self) -> bool:
        """Whether the range has the true count in it."""
        return self.low <= self.true <= self.high


def read_simulated(folder: Path) -> Home:
    """Read what `python -m hearthlog.tools.lab.home DAYS -o FOLDER --model MODEL` has made.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    LogError
        If there are no labels.
    DataError
        If there are no two whole days.
    OSError
        If there is no truth.
    """
    sources = find_labellings(folder / "logs")
    named = sources.read(sources.microphone(None), LIVE)
    labels = unified(named.labelling)
    start = int(labels.starts[0]) // (_DAY * MINUTE) * (_DAY * MINUTE)
    truth = unified(read_truth(folder, start))
    days = round((int(labels.ends[-1]) - start) / (_DAY * MINUTE))
    if days < 2:
        raise DataError(f"{folder}: has no two whole days, one to check and one to count")
    edges = start + np.arange(days * _DAY + 1) * MINUTE
    names = [name for name in dict.fromkeys(named.classes) if name not in {SILENCE, UNKNOWN}]

    heard = lengths(joined(labels.starts, labels.ends), edges) > 0

    def counts(source: Labelling) -> dict[str, Int64]:
        events = {name: events_of(source, name).starts for name in names}
        return {name: np.diff(np.searchsorted(own, edges))[heard] for name, own in events.items()}

    since_evening = np.flatnonzero(heard) + _DAY - _EVENING
    return Home(
        edges[:-1][heard],
        since_evening // _DAY,
        since_evening % _DAY < _NIGHT,
        counts(labels),
        counts(truth),
        sounding_minutes(labels, edges)[heard],
        television_minutes(labels, edges)[heard],
    )


def check_counts(home: Home, name: str) -> Iterator[Checked]:
    """Compare ranges with true counts, for each day with minutes of the others.

    Parameters
    ----------
    home : Home
    name : str
        Of the home.

    Yields
    ------
    Checked
    """
    whole = sum(int(events.sum()) + 1 for events in home.labelled.values())
    has_sound = home.sounding & ~home.television  # as in the queue of a review
    for day in range(int(home.day[-1])):  # the last one ends at its second hour
        others = np.flatnonzero(home.day != day)
        for number in _CHECKED:
            for draw in range(_DRAWS):
                shift = np.roll(others, 7919 * draw)  # other minutes for the same draw
                minutes = RecordedMinutes(home.starts[: len(others)], has_sound[shift])
                rows = shift[np.searchsorted(minutes.starts, draw_minutes(minutes, number))]
                checks = _checks(home, rows)
                for one in home.labelled:
                    share = max((int(home.labelled[one].sum()) + 1) / whole, 1 / len(home.labelled))
                    yield from _range(home, checks, (name, one, day), number, share)


def _checks(home: Home, rows: Int64) -> CheckedMinutes:
    none = np.zeros(len(rows), np.int64)
    return CheckedMinutes(
        {
            name: np.array([events[rows], none, home.true[name][rows], none])
            for name, events in home.labelled.items()
        },
        home.sounding[rows],
        home.television[rows],
        [""] * len(rows),
    )


def _range(
    home: Home, checks: CheckedMinutes, which: tuple[str, str, int], number: int, share: float
) -> Iterator[Checked]:
    folder, name, day = which
    rates = checks.rates(name, share)
    if rates is None:
        return
    counted = home.day == day
    if name in ON_TELEVISION:
        counted &= ~home.television
    parts = {"all": counted, "day": ~home.night, "night": home.night}
    if name not in RANGED_AT_NIGHT:
        del parts["night"]  # as labelled in a report
    for part, of_part in parts.items():
        here = counted & of_part
        low, high = rates.range_of(strata_of(home.labelled[name][here], home.sounding[here]))
        labelled, true = int(home.labelled[name][here].sum()), int(home.true[name][here].sum())
        yield Checked(folder, name, part, number, labelled, true, low, high)


def summary(checked: list[Checked]) -> Iterator[tuple[str, list[_Row]]]:
    """Sum up how often ranges hold: by the number of minutes, by home and by class.

    Parameters
    ----------
    checked : list of Checked

    Yields
    ------
    what : str
        It is grouped by.
    rows : list of tuple
        Group, share of the ranges that hold, medians of width, true and labelled count, and number.
    """
    for what, key in (
        ("minutes checked", attrgetter("minutes")),
        ("home", attrgetter("home")),
        ("class", attrgetter("name")),
        ("part of the day", attrgetter("part")),
    ):
        rows: list[_Row] = []
        for group in dict.fromkeys(map(key, checked)):
            own = [one for one in checked if key(one) == group]
            holds = float(np.mean([one.holds for one in own]))
            width = float(np.median([one.high - one.low for one in own]))
            true = float(np.median([one.true for one in own]))
            labelled = float(np.median([one.labelled for one in own]))
            rows.append((f"{group}", holds, width, true, labelled, len(own)))
        yield what, rows


def main(
    homes: Annotated[list[Path], typer.Argument(help="Folders that the simulated home made.")],
) -> None:
    """Print how often the ranges hold that nine of ten should."""
    checked: list[Checked] = []
    for folder in homes:
        checked += check_counts(read_simulated(folder), folder.name)
    for what, rows in summary(checked):
        print(f"\n{what:20} holds  width  true  labelled  ranges")
        for group, holds, width, true, labelled, number in rows:
            print(f"{group:20} {holds:5.2f} {width:6.1f} {true:5.1f} {labelled:9.1f} {number:7}")


if __name__ == "__main__":
    try:
        run(main)
    except (HearthlogError, OSError) as error:
        sys.exit(f"hearthlog: {error}")
