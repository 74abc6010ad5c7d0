"""Sounds of the simulated person, and the plan of a short day."""

from collections.abc import Sequence
from dataclasses import dataclass

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
from hearthlog.tools.home.clips import ClipLibrary, HomeClip
from hearthlog.tools.home.sounds import SimulationError, generator

TELEVISION, RADIO, PHONE = "television", "radio", "phone"
RESIDENT, VISITOR, OUTSIDE = "resident", "visitor", "outside"

BEDROOM, BATHROOM, KITCHEN, LIVING_ROOM = "bedroom", "bathroom", "kitchen", "living_room"
ROOMS = (BEDROOM, BATHROOM, KITCHEN, LIVING_ROOM)

FRIDGE, STREET, FAN = "fridge", "street", "fan"
STEADY_FRAMES = 20  # fade of a steady noise
LONGEST_FRAMES = 1200  # of one sound


@dataclass(frozen=True)
class PlannedSound:
    """One sound."""

    start: int
    frames: int
    clip: HomeClip
    origin: str
    room: str
    level: float  # in dBFS, for a microphone in the same room
    activity: str

    @property
    def end(self) -> int:
        """The frame after the last frame."""
        return self.start + self.frames


@dataclass(frozen=True)
class PlannedNoise:
    """A steady noise during some time."""

    name: str
    start: int  # first frame, including a fade of a second
    end: int  # frame after the last frame, including a fade of a second


@dataclass(frozen=True)
class HomePlan:
    """The sounds of a simulated home."""

    frames: int
    sounds: Sequence[PlannedSound]
    steady: Sequence[PlannedNoise]


Range = tuple[float, float]

# In dBFS, for a microphone in the same room.
LEVELS: dict[str, Range] = {
    SPEECH: (-34.0, -26.0),
    MUSIC: (-36.0, -28.0),
    PHONE_RING: (-30.0, -22.0),
    COUGHING: (-30.0, -20.0),
    CRYING: (-30.0, -22.0),
    YELLING: (-22.0, -14.0),
    LAUGHING: (-30.0, -22.0),
    OBJECTS_ACTIVITY: (-38.0, -28.0),
    FLUSHING_WATER: (-28.0, -20.0),
    SHOWER: (-30.0, -24.0),
    TAP_WATER: (-36.0, -28.0),
    OTHER_NEGATIVE: (-26.0, -16.0),
}
_QUIETER_DB = {TELEVISION: 6.0, RADIO: 4.0}
_SUSTAINED = {MUSIC, SHOWER, TAP_WATER, PHONE_RING}  # may last longer than their clips


class Cast:
    """The assignment of clips to the origins of sounds."""

    def __init__(self, library: ClipLibrary, rng: np.random.Generator) -> None:
        self._library = library
        self._clips: dict[tuple[str, str], Sequence[HomeClip]] = {}
        for label in (SPEECH, LAUGHING, YELLING, CRYING):
            own = library.of_groups(label, 1, rng)
            others = [clip for clip in library.of(label) if clip not in own]
            self._clips[RESIDENT, label] = own
            self._clips[VISITOR, label] = self._clips[TELEVISION, label] = others or own

    def of(self, origin: str, label: str) -> Sequence[HomeClip]:
        """Return the clips of a label for an origin; empty if there are none."""
        return self._clips.get((origin, label)) or self._library.of(label)


class SoundCourse:
    """A sequence of sounds without overlaps."""

    def __init__(self, cast: Cast, rng: np.random.Generator, end: int) -> None:
        self.now = 0
        self.sounds: list[PlannedSound] = []
        self._cast = cast
        self._rng = rng
        self._end = end

    def wait(self, seconds: Range) -> None:
        """Advance by a random time."""
        self.now += round(self._rng.uniform(*seconds) / FRAME_SECONDS)

    def wait_until(self, frame: int) -> None:
        """Advance to a frame, unless it has passed."""
        self.now = max(self.now, frame)

    def sound(
        self,
        label: str,
        room: str,
        activity: str,
        seconds: float | None = None,
        origin: str = RESIDENT,
    ) -> None:
        """Add one clip, or enough clips to last some seconds."""
        clips = self._cast.of(origin, label)
        if not clips:
            return
        level = self._rng.uniform(*LEVELS[label]) - _QUIETER_DB.get(origin, 0.0)
        until = self.now + 1 if seconds is None else self.now + round(seconds / FRAME_SECONDS)
        while self.now < until and self.now < self._end:
            clip = clips[int(self._rng.integers(len(clips)))]
            frames = clip.frames
            if seconds is not None and label in _SUSTAINED:
                frames = until - self.now
            frames = min(frames, LONGEST_FRAMES, self._end - self.now)
            self.sounds.append(PlannedSound(self.now, frames, clip, origin, room, level, activity))
            self.now += frames
            if label not in _SUSTAINED:
                self.wait((0.1, 0.8))


DAY_FRAMES = round(86_400 / FRAME_SECONDS)
_MAX_MINUTES = 1440.0
_MIN_SILENCE = 1.0  # before a sound, in seconds
_FRIDGE_SECONDS = (60.0, 120.0), (150.0, 250.0)  # on and off
_EVENT_SECONDS = {
    SPEECH: (10.0, 40.0),
    MUSIC: (30.0, 60.0),
    PHONE_RING: (4.0, 12.0),
    COUGHING: (0.5, 3.0),
    CRYING: (6.0, 15.0),
    YELLING: (2.0, 8.0),
    LAUGHING: (2.0, 7.0),
    OBJECTS_ACTIVITY: (4.0, 20.0),
    FLUSHING_WATER: (8.0, 14.0),
    SHOWER: (30.0, 60.0),
    TAP_WATER: (4.0, 15.0),
}
# Parts of the day: their seconds in a day of 24 minutes, the room, and the sounds.
_DAY_PARTS = (
    ("night", 110, BEDROOM, RESIDENT, "coughing"),
    ("getting up", 110, BATHROOM, RESIDENT, "flushing_water tap_water shower"),
    (
        "breakfast",
        100,
        KITCHEN,
        RESIDENT,
        "objects_activity tap_water coughing objects_activity objects_activity",
    ),
    ("call", 80, LIVING_ROOM, RESIDENT, "phone_ring speech"),
    ("radio", 150, KITCHEN, RADIO, "music objects_activity music"),
    (
        "tidying",
        130,
        LIVING_ROOM,
        RESIDENT,
        "objects_activity tap_water objects_activity coughing objects_activity tap_water",
    ),
    ("nap", 110, BEDROOM, RESIDENT, "coughing flushing_water"),
    (
        "television",
        190,
        LIVING_ROOM,
        TELEVISION,
        "speech laughing speech laughing music laughing speech",
    ),
    (
        "supper",
        130,
        KITCHEN,
        RESIDENT,
        "objects_activity tap_water objects_activity coughing objects_activity",
    ),
    ("call", 80, LIVING_ROOM, RESIDENT, "phone_ring speech laughing"),
    ("despair", 110, LIVING_ROOM, RESIDENT, "yelling crying yelling crying crying speech"),
    ("going to bed", 70, BATHROOM, RESIDENT, "flushing_water tap_water coughing"),
    ("night", 70, BEDROOM, RESIDENT, "coughing"),
)
_ROOMS = {FLUSHING_WATER: BATHROOM, SHOWER: BATHROOM}
_DEVICES = {SPEECH, MUSIC, LAUGHING}  # sounds of a television


def plan_short_day(minutes: float, library: ClipLibrary, seed: int) -> HomePlan:
    """Plan a day of a person living alone, compressed into some minutes.

    A shorter day has less silence between the sounds, and then fewer of them (10 minutes hold about
    three quarters of what 24 do). Raise `SimulationError` if `minutes` is less than a frame or
    above 1440, or the seed is negative.
    """
    frames = round(minutes * 60.0 / FRAME_SECONDS) if 0 < minutes <= _MAX_MINUTES else 0
    if frames < 1:
        raise SimulationError(f"a day lasts more than 0 and at most 1440 minutes, not {minutes}")
    rng = generator(seed)
    voices = SoundCourse(Cast(library, rng), rng, frames)
    share = frames * FRAME_SECONDS / sum(part[1] for part in _DAY_PARTS)
    begin = 0.0
    for activity, seconds, room, origin, sounds in _DAY_PARTS:
        for start, length, label in _placed(rng, seconds * share, sounds.split()):
            voices.wait_until(round((begin + start) / FRAME_SECONDS))
            whose = PHONE if label == PHONE_RING else origin if label in _DEVICES else RESIDENT
            voices.sound(label, _ROOMS.get(label, room), activity, length, whose)
        begin += seconds * share
    return HomePlan(frames, voices.sounds, _steady(rng, frames))


def _placed(
    rng: np.random.Generator, seconds: float, labels: list[str]
) -> list[tuple[float, float, str]]:
    """Place the sounds that fit, in order, with random silences between them."""
    chosen, left = [], seconds - _MIN_SILENCE
    for label in labels:
        length = rng.uniform(*_EVENT_SECONDS[label])
        if length + _MIN_SILENCE <= left:
            chosen.append((length, label))
            left -= length + _MIN_SILENCE
    silences = _MIN_SILENCE + max(left, 0.0) * rng.dirichlet(np.full(len(chosen) + 1, 2.0))
    ends = np.cumsum(silences[:-1] + [length for length, _ in chosen])
    return [
        (end - length, length, label) for end, (length, label) in zip(ends, chosen, strict=True)
    ]


def _steady(rng: np.random.Generator, frames: int) -> list[PlannedNoise]:
    """Add the street by day, and the fridge, on and off."""
    steady = [PlannedNoise(STREET, round(0.08 * frames), round(0.9 * frames))]
    begin = round(rng.uniform(10.0, 60.0) / FRAME_SECONDS)
    while begin < frames:
        on, off = (round(rng.uniform(*spread) / FRAME_SECONDS) for spread in _FRIDGE_SECONDS)
        steady.append(PlannedNoise(FRIDGE, begin, begin + on))
        begin += on + off
    return sorted(steady, key=lambda noise: noise.start)
