"""Days of the simulated person, from midnight to midnight."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    LAUGHING,
    MUSIC,
    OBJECTS_ACTIVITY,
    OTHER_NEGATIVE,
    PHONE_RING,
    SHOWER,
    SPEECH,
    TAP_WATER,
    YELLING,
)
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.routine import (
    BATHROOM,
    BEDROOM,
    DAY_FRAMES,
    FAN,
    FRIDGE,
    KITCHEN,
    LIVING_ROOM,
    OUTSIDE,
    PHONE,
    RADIO,
    RESIDENT,
    STREET,
    TELEVISION,
    VISITOR,
    Cast,
    HomePlan,
    PlannedNoise,
    PlannedSound,
    SoundCourse,
)
from hearthlog.tools.home.sounds import SimulationError, generator

MOST_DAYS = 3660
_HOUR = 3600.0
_DAY = 24 * _HOUR

_NIGHT_COUGHS, _DAY_COUGHS = 4.0, 6.0  # average number of bouts
_WORSE, _WORST = 0.5, 6.0  # additional bouts per day, and the limit, as factors
_VISIT_CHANCE = (0.3, 0.7)  # on a weekday, at a weekend


@dataclass(frozen=True)
class Habits:
    """The habits of a simulated person."""

    seed: int = 0  # not negative; determines the days and the clips
    first_weekday: int = 0  # weekday of the first day, 0 for Monday
    # day, from 0, from which every night has more coughs than the night before
    coughs_from: int | None = None


def plan_days(days: int, library: ClipLibrary, habits: Habits) -> HomePlan:
    """Plan 1 to 3660 days from midnight to midnight; fewer days give the beginning of more.

    Raise `SimulationError` if `days` or the seed is out of range.
    """
    if not 1 <= days <= MOST_DAYS:
        raise SimulationError(f"a home is simulated for 1 to {MOST_DAYS} days, not {days}")
    cast = Cast(library, generator(habits.seed, 0))
    sounds: list[PlannedSound] = []
    steady: list[PlannedNoise] = []
    for number in range(days):
        day = _Day(number, cast, habits)
        day.live()
        sounds += day.sounds()
        steady += day.steady
    steady.sort(key=lambda noise: noise.start)
    return HomePlan(days * DAY_FRAMES, sounds, steady)


class _Day:
    """One day: its schedule, then the resulting sounds."""

    def __init__(self, number: int, cast: Cast, habits: Habits) -> None:
        self._rng = generator(habits.seed, 1, number)
        self._begin = number * DAY_FRAMES
        end = self._begin + DAY_FRAMES
        self._person, self._television, self._radio, self._outside = (
            SoundCourse(cast, self._rng, end) for _ in range(4)
        )
        self._end = end
        self._number = number
        self._weekend = (habits.first_weekday + number) % 7 >= 5
        self._parity = habits.seed % 2
        self._worse = 1.0
        if habits.coughs_from is not None and number >= habits.coughs_from:
            worse = 1.0 + _WORSE * (number - habits.coughs_from + 1)
            self._worse = min(worse, _WORST)
        self._doings: list[tuple[float, Callable[[], None]]] = []
        self.steady: list[PlannedNoise] = []

    def sounds(self) -> list[PlannedSound]:
        """Return all sounds of the day, sorted by start."""
        voices = (self._person, self._television, self._radio, self._outside)
        found = [sound for voice in voices for sound in voice.sounds]
        return sorted(found, key=lambda sound: (sound.start, sound.origin))

    def live(self) -> None:
        """Draw the schedule of the day, and carry it out in order."""
        rng = self._rng
        up = (8.2 if self._weekend else 7.0) + rng.normal(0.0, 0.3)
        bed = 22.6 + rng.normal(0.0, 0.3)
        self._plan_night(up, bed)
        self._at(up, self._get_up)
        self._at(up + rng.uniform(0.4, 0.8), self._eat, "breakfast", 10)
        self._some(0.4, up + 0.9, self._listen)
        self._some(0.6, rng.uniform(9.5, 10.5), self._tidy)
        self._at(12.3 + rng.normal(0.0, 0.3), self._eat, "lunch", 16)
        self._some(_VISIT_CHANCE[self._weekend], rng.uniform(14.0, 16.0), self._be_visited)
        self._some(0.5 if self._weekend else 0.15, 16.5, self._watch, 1.0, 2.0)
        self._at(18.0 + rng.normal(0.0, 0.3), self._eat, "supper", 12)
        self._at(19.3 + rng.normal(0.0, 0.3), self._watch, 2.0, 3.0)
        for _ in range(rng.poisson(1.2)):
            self._at(rng.uniform(9.0, 20.5), self._phone)
        for _ in range(1 + rng.poisson(3.0)):
            self._at(rng.uniform(up + 1.5, bed - 0.5), self._use_toilet)
        for _ in range(rng.poisson(_DAY_COUGHS)):
            self._at(rng.uniform(up, bed), self._cough, LIVING_ROOM, "day")
        for _ in range(rng.poisson(3.0)):
            self._at(rng.uniform(6.0, 23.0), self._add_outside_sounds)
        self._some(0.06, rng.uniform(10.0, 21.0), self._despair)
        self._at(bed, self._go_to_bed)
        for seconds, do in sorted(self._doings, key=lambda doing: doing[0]):
            self._person.wait_until(self._frame(seconds))
            do()
        self._hum()

    def _plan_night(self, up: float, bed: float) -> None:
        rng = self._rng
        for _ in range(rng.poisson(_NIGHT_COUGHS * self._worse)):
            hour = rng.uniform(0.0, up + 24.0 - bed)
            self._at(hour if hour < up else hour - up + bed, self._cough, BEDROOM, "night")
        self._some(0.7, rng.uniform(1.0, up - 1.0), self._use_toilet)

    def _at(self, hour: float, do: Callable[..., None], *arguments: object) -> None:
        seconds = float(np.clip(hour, 0.0, 23.98)) * _HOUR
        self._doings.append((seconds, partial(do, *arguments)))

    def _some(
        self, chance: float, hour: float, do: Callable[..., None], *arguments: object
    ) -> None:
        if self._rng.random() < chance:
            self._at(hour, do, *arguments)

    def _frame(self, seconds: float) -> int:
        return self._begin + round(seconds / FRAME_SECONDS)

    def _cough(self, room: str, activity: str) -> None:
        for _ in range(self._rng.integers(1, 4)):
            self._person.sound(COUGHING, room, activity)
            self._person.wait((0.3, 1.5))

    def _use_toilet(self) -> None:
        self._person.wait((30.0, 120.0))
        self._person.sound(FLUSHING_WATER, BATHROOM, "toilet")
        self._person.wait((2.0, 8.0))
        self._person.sound(TAP_WATER, BATHROOM, "toilet", self._rng.uniform(4.0, 15.0))

    def _get_up(self) -> None:
        self._use_toilet()
        if (self._number + self._parity) % 2 == 0:
            self._person.wait((20.0, 120.0))
            begin = self._person.now
            seconds = self._rng.uniform(180.0, 420.0)
            self._person.sound(SHOWER, BATHROOM, "shower", seconds)
            after = round(self._rng.uniform(60.0, 300.0) / FRAME_SECONDS)
            self.steady.append(PlannedNoise(FAN, begin, self._person.now + after))
        for _ in range(self._rng.integers(1, 4)):
            self._person.wait((10.0, 60.0))
            self._person.sound(TAP_WATER, BATHROOM, "washing", self._rng.uniform(3.0, 12.0))

    def _eat(self, meal: str, sounds: int) -> None:
        for _ in range(self._rng.poisson(sounds)):
            if self._rng.random() < 0.2:
                self._person.sound(TAP_WATER, KITCHEN, meal, self._rng.uniform(3.0, 15.0))
            else:
                self._person.sound(OBJECTS_ACTIVITY, KITCHEN, meal, self._rng.uniform(2.0, 12.0))
            self._person.wait((5.0, 50.0))

    def _tidy(self) -> None:
        for _ in range(self._rng.poisson(15)):
            self._person.sound(
                OBJECTS_ACTIVITY, LIVING_ROOM, "tidying", self._rng.uniform(2.0, 10.0)
            )
            self._person.wait((10.0, 90.0))

    def _phone(self) -> None:
        person = self._person
        person.sound(PHONE_RING, LIVING_ROOM, "call", self._rng.uniform(4.0, 14.0), PHONE)
        if self._rng.random() < 0.2:
            return
        until = person.now + round(self._rng.uniform(60.0, 400.0) / FRAME_SECONDS)
        while person.now < until:
            person.sound(SPEECH, LIVING_ROOM, "call", self._rng.uniform(2.0, 12.0))
            person.wait((1.5, 9.0))

    def _be_visited(self) -> None:
        person = self._person
        until = person.now + round(self._rng.uniform(1200.0, 4200.0) / FRAME_SECONDS)
        while person.now < until:
            origin = VISITOR if self._rng.random() < 0.5 else RESIDENT
            label = LAUGHING if self._rng.random() < 0.08 else SPEECH
            seconds = None if label == LAUGHING else self._rng.uniform(2.0, 15.0)
            person.sound(label, LIVING_ROOM, "visit", seconds, origin)
            person.wait((0.2, 6.0))

    def _watch(self, least: float, most: float) -> None:
        """Turn the television on; it continues by itself."""
        self._play(self._television, TELEVISION, LIVING_ROOM, self._rng.uniform(least, most))
        if self._rng.random() < 0.5:
            self._person.wait((300.0, 1500.0))
            self._person.sound(LAUGHING, LIVING_ROOM, "television")

    def _listen(self) -> None:
        self._play(self._radio, RADIO, KITCHEN, self._rng.uniform(0.3, 0.9))

    def _play(self, device: SoundCourse, origin: str, room: str, hours: float) -> None:
        """Play programmes of some minutes: talk, music or a comedy."""
        device.wait_until(self._person.now)
        until = min(device.now + round(hours * _HOUR / FRAME_SECONDS), self._end)
        while device.now < until:
            kind = self._rng.choice((SPEECH, MUSIC, LAUGHING), p=(0.6, 0.2, 0.2))
            end = min(device.now + round(self._rng.uniform(120, 600) / FRAME_SECONDS), until)
            while device.now < end:
                if kind == MUSIC:
                    device.sound(MUSIC, room, origin, self._rng.uniform(30.0, 60.0), origin)
                    continue
                funny = kind == LAUGHING and self._rng.random() < 0.25
                device.sound(LAUGHING if funny else SPEECH, room, origin, origin=origin)
                device.wait((0.2, 1.2))

    def _add_outside_sounds(self) -> None:
        self._outside.wait_until(self._person.now)
        for _ in range(self._rng.integers(1, 6)):
            self._outside.sound(OTHER_NEGATIVE, OUTSIDE, "outside", origin=OUTSIDE)
            self._outside.wait((1.0, 10.0))

    def _despair(self) -> None:
        for label in (YELLING, YELLING, CRYING, YELLING, CRYING, CRYING):
            self._person.sound(label, LIVING_ROOM, "despair", self._rng.uniform(2.0, 12.0))
            self._person.wait((0.5, 8.0))

    def _go_to_bed(self) -> None:
        self._use_toilet()
        self._person.wait((20.0, 90.0))
        self._person.sound(TAP_WATER, BATHROOM, "washing", self._rng.uniform(5.0, 30.0))

    def _hum(self) -> None:
        """Add the fridge, on and off, and the street by day."""
        rng = self._rng
        self.steady.append(
            PlannedNoise(
                STREET, self._frame(rng.uniform(5.8, 6.8) * _HOUR), self._frame(22.9 * _HOUR)
            )
        )
        second = rng.uniform(60.0, 1500.0)
        while second < _DAY - 1200.0:
            on = rng.uniform(540.0, 1080.0)
            self.steady.append(PlannedNoise(FRIDGE, self._frame(second), self._frame(second + on)))
            second += on + rng.uniform(1200.0, 2100.0)
