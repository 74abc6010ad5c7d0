"""Months of simulated homes as recognisers would have labelled them, without any sound.

The plan of a simulated home is made less regular, changes are thrown in, and each sound is labelled
as often rightly and wrongly as such sounds were in a home that was composed and recorded.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from datetime import date, timedelta
from functools import partial

import numpy as np

from hearthlog.analyzer.activity.day_profile import HomeSegments
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import Spans, difference, joined
from hearthlog.models.classes import (
    COUGHING,
    FLUSHING_WATER,
    OBJECTS_ACTIVITY,
    SHOWER,
    SILENCE,
    TAP_WATER,
)
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.routine import BATHROOM, LIVING_ROOM, RADIO, TELEVISION
from hearthlog.tools.lab.home.days import Habits, plan_days
from hearthlog.tools.lab.routine_hearing import Hearing, Names

FIRST = date(2026, 1, 5)  # a Monday
_START = 1_767_571_200  # its midnight, in seconds of UTC
_HOUR, _DAY = 3600.0, 86_400.0
_WATER = (TAP_WATER, FLUSHING_WATER, SHOWER)
_MEALS = ("breakfast", "lunch", "supper")
_JOINED = NANOSECONDS  # between segments of one label
_FALSE_A_DAY = 2.0  # labels of each microphone where nothing sounds
_RESTLESS = 0.02  # of the nights, that are as bad as those that are thrown in
Rng = np.random.Generator


@dataclass(frozen=True)
class Sounds:
    """Sounds of a home, in the order of time.

    Attributes
    ----------
    starts, lengths : np.ndarray [shape=(n,)], float64
        In seconds from the first midnight on.
    labels, places, activities : np.ndarray [shape=(n,)] of str
        What each is, where it sounds, and what it is part of.
    """

    starts: Float64
    lengths: Float64
    labels: Names
    places: Names
    activities: Names

    def rows(self, rows: Bool | Int64) -> "Sounds":
        """Return some of the sounds.

        Parameters
        ----------
        rows : np.ndarray
            A mask, or numbers of rows.
        """
        return Sounds(*(getattr(self, each.name)[rows] for each in fields(self)))

    def moved(self, seconds: Float64 | float) -> "Sounds":
        """Return the sounds so much later.

        Parameters
        ----------
        seconds : np.ndarray [shape=(n,)] or float
        """
        starts = self.starts + seconds
        later = Sounds(starts, self.lengths, self.labels, self.places, self.activities)
        return later.rows(np.argsort(starts, kind="stable"))

    def combined_with(self, other: "Sounds") -> "Sounds":
        """Return these sounds and others.

        Parameters
        ----------
        other : Sounds
        """
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        return Sounds(*(np.concatenate(pair) for pair in pairs)).moved(0.0)

    def within(self, first: int, last: int) -> Bool:
        """Tell which sounds are of some days.

        Parameters
        ----------
        first, last : int
            Numbers of days, from 0; the last one is not included.
        """
        return (self.starts >= first * _DAY) & (self.starts < last * _DAY)

    @property
    def hours(self) -> Float64:
        """Of the clock."""
        return self.starts % _DAY / _HOUR


def day_number(number: int) -> date:
    """Return a day of the months, from 0 on."""
    return FIRST + timedelta(days=number)


def planned(seed: int, days: int, library: ClipLibrary) -> Sounds:
    """Return the sounds of a plan, which knows no outing and no late evening.

    Parameters
    ----------
    seed : int
    days : int
    library : ClipLibrary
    """
    rows = plan_days(days, library, Habits(seed, FIRST.weekday())).sounds
    places = [row.origin if row.origin in {TELEVISION, RADIO} else row.room for row in rows]
    return Sounds(
        np.array([row.start for row in rows]) * FRAME_SECONDS,
        np.array([row.frames for row in rows]) * FRAME_SECONDS,
        np.array([row.clip.label for row in rows], object),
        np.array(places, object),
        np.array([row.activity for row in rows], object),
    ).moved(0.0)


def lived(sounds: Sounds, days: int, rng: Rng) -> Sounds:
    """Make the days of a home less regular than their plan.

    A home has its own hours, which drift by an hour or so in three months and vary from day to day
    by 6 to 24 minutes beside what the plan varies; on 15 to 50 % of the days somebody is out for
    one to six hours, 2 to 8 % of the meals are missed, 2 to 10 % of the evenings are long, somebody
    is up to 0.6 times more a night, and one night in fifty is as bad as those that are thrown in.

    Parameters
    ----------
    sounds : Sounds
        As of `planned`.
    days : int
    rng : numpy.random.Generator
    """
    shifts = _shifts(days, rng)
    day = np.minimum((sounds.starts / _DAY).astype(np.int64), days - 1)
    sounds = sounds.moved(shifts[day] * _HOUR)
    outings, skipped, late = rng.uniform((0.15, 0.02, 0.02), (0.5, 0.08, 0.1))
    longest, up = rng.uniform(2.0, 6.0), rng.uniform(0.0, 0.6)
    kept, delays, times = np.ones(len(sounds.starts), bool), np.zeros(len(sounds.starts)), []
    for number in range(days):
        here = sounds.within(number, number + 1)
        if rng.random() < outings:
            begin, length = rng.uniform(9.0, 19.0), rng.uniform(1.0, longest)
            kept &= ~(here & (sounds.hours > begin) & (sounds.hours < begin + length))
        for meal in _MEALS:
            if rng.random() < skipped:
                kept &= ~(here & (sounds.activities == meal))
        if rng.random() < late:
            delays[here & (sounds.hours > 18.0)] = rng.uniform(1.0, 2.5) * _HOUR
        count = rng.poisson(up) + 3 * int(rng.random() < _RESTLESS)
        times += (number * _DAY + rng.uniform(0.0, 5.5, count) * _HOUR).tolist()
    sounds = Sounds(*(getattr(sounds, each.name)[kept] for each in fields(sounds)))
    return sounds.moved(delays[kept]).combined_with(_times_up(np.array(times), rng))


def _shifts(days: int, rng: Rng) -> Float64:
    """Return by how many hours each day is later than planned."""
    own, drift, spread = rng.normal(0.0, 0.7), rng.normal(0.0, 1.0), rng.uniform(0.1, 0.4)
    shifts: Float64 = own + drift * np.arange(days) / 90 + spread * rng.standard_normal(days)
    return shifts


def _times_up(seconds: Float64, rng: Rng) -> Sounds:
    """Return the sounds of somebody who gets up, at some times: five each."""
    count = len(seconds)
    labels = [FLUSHING_WATER, TAP_WATER, *[OBJECTS_ACTIVITY] * 3]
    lengths = rng.uniform((8.0, 4.0, 2.0, 2.0, 2.0), (13.0, 15.0, 8.0, 8.0, 8.0), (count, 5))
    return Sounds(
        (seconds[:, np.newaxis] + (30.0, 45.0, 62.0, 75.0, 90.0)).ravel(),
        lengths.ravel(),
        np.array(labels * count, object),
        np.array([BATHROOM, BATHROOM, *[LIVING_ROOM] * 3] * count, object),
        np.array(["night"] * (5 * count), object),
    )


Change = Callable[[Sounds, int, int, Rng], Sounds]


def nothing(sounds: Sounds, first: int, last: int, rng: Rng) -> Sounds:
    """Change nothing: what is noticed then is so by chance."""
    del first, last, rng
    return sounds


def bad_nights(sounds: Sounds, first: int, last: int, rng: Rng) -> Sounds:
    """Let somebody get up three times more in the nights after some days."""
    nights = np.arange(first + 1, last + 1).repeat(3) * _DAY
    return sounds.combined_with(_times_up(nights + rng.uniform(0.0, 5.5, len(nights)) * _HOUR, rng))


def meals_missed(
    sounds: Sounds, first: int, last: int, rng: Rng, *, meals: Sequence[str]
) -> Sounds:
    """Leave out the sounds of meals on some days."""
    del rng
    return sounds.rows(~(sounds.within(first, last) & np.isin(sounds.activities, meals)))


def up_later(sounds: Sounds, first: int, last: int, rng: Rng) -> Sounds:
    """Let the mornings of some days be two hours later."""
    del rng
    morning = sounds.within(first, last) & (sounds.hours > 5.0) & (sounds.hours < 11.5)
    return sounds.moved(np.where(morning, 2 * _HOUR, 0.0))


def more_coughs(sounds: Sounds, first: int, last: int, rng: Rng) -> Sounds:
    """Let there be three times as much coughing on some days and in the nights after them."""
    own = sounds.rows(sounds.within(first, last + 1) & (sounds.labels == COUGHING))
    for _ in range(2):
        sounds = sounds.combined_with(own.moved(rng.uniform(-1.0, 1.0, len(own.starts)) * _HOUR))
    return sounds


def no_water(sounds: Sounds, first: int, last: int, rng: Rng) -> Sounds:
    """Leave out all water on some days."""
    del rng
    return sounds.rows(~(sounds.within(first, last) & np.isin(sounds.labels, _WATER)))


# What is thrown in, and for how many days.
CHANGES: dict[str, tuple[Change, int]] = {
    "nothing": (nothing, 3),
    "up 3 times more a night": (bad_nights, 7),
    "lunch and supper missed": (partial(meals_missed, meals=_MEALS[1:]), 3),
    "no meal at all": (partial(meals_missed, meals=_MEALS), 3),
    "up 2 h later": (up_later, 3),
    "3 times the coughing": (more_coughs, 7),
    "no water": (no_water, 3),
}


def gaps(days: int, rng: Rng) -> Spans:
    """Draw when nothing was heard: one day in a hundred, and some hours on one in thirty.

    Parameters
    ----------
    days : int
    rng : numpy.random.Generator
    """
    spans = []
    for number in range(days):
        kind = rng.random()
        if kind < 0.01:
            spans.append((number * _DAY, (number + 1) * _DAY))
        elif kind < 0.045:
            begin = number * _DAY + rng.uniform(0.0, 18.0) * _HOUR
            spans.append((begin, begin + rng.uniform(1.0, 6.0) * _HOUR))
    seconds = np.array(spans).reshape(-1, 2)
    return joined(_time(seconds[:, 0]), _time(seconds[:, 1]))


def heard(
    sounds: Sounds, days: tuple[int, int], hearing: Hearing, missing: Spans, rng: Rng
) -> HomeSegments:
    """Label the sounds of some days.

    Parameters
    ----------
    sounds : Sounds
    days : (int, int)
        The first one, and the one after the last.
    hearing : Hearing
    missing : Spans
        When nothing was heard.
    rng : numpy.random.Generator
    """
    sounds = sounds.rows(sounds.within(*days))
    coverage = difference(Spans(*(_time(np.array([day * _DAY])) for day in days)), missing)
    parts, listened = [_labelled(SILENCE, coverage)], {}
    for microphone, names in hearing.classes.items():
        labels = hearing.draw(microphone, sounds.labels, sounds.places, rng)
        for name in names:
            own = labels == name
            count = rng.poisson(_FALSE_A_DAY / len(names) * (days[1] - days[0]))
            false = rng.uniform(days[0] * _DAY, days[1] * _DAY, count)
            starts = _time(np.concatenate([sounds.starts[own], false]))
            lengths = np.concatenate([sounds.lengths[own], rng.uniform(1.0, 8.0, count)])
            ends = starts + np.rint(lengths * NANOSECONDS).astype(np.int64)
            parts.append(_labelled(name, difference(joined(starts, ends, _JOINED), missing)))
            listened[name] = coverage
    starts, ends, labels = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("starts", "ends", "labels")
    )
    order = np.argsort(starts, kind="stable")
    return HomeSegments(Labelling(starts[order], ends[order], labels[order]), listened)


def _labelled(name: str, spans: Spans) -> Labelling:
    return Labelling(spans.starts, spans.ends, np.full(len(spans.starts), name, object))


def _time(seconds: Float64) -> Int64:
    return np.rint((seconds + _START) * NANOSECONDS).astype(np.int64)
