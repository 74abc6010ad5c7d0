"""The plan of a simulated home: sounds with place and time, and their clips."""

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

TELEVISION, RADIO, PHONE = "television", "radio", "phone"
RESIDENT, VISITOR, OUTSIDE = "resident", "visitor", "outside"

BEDROOM, BATHROOM, KITCHEN, LIVING_ROOM = "bedroom", "bathroom", "kitchen", "living_room"
ROOMS = (BEDROOM, BATHROOM, KITCHEN, LIVING_ROOM)

FRIDGE, STREET, FAN = "fridge", "street", "fan"
STEADY_FRAMES = 20  # fade of a steady noise
LONGEST_FRAMES = 1200  # of one sound


@dataclass(frozen=True)
class PlannedSound:
    """One sound.

    Attributes
    ----------
    level : float
        In dBFS, for a microphone in the same room.
    """

    start: int
    frames: int
    clip: HomeClip
    origin: str
    room: str
    level: float
    activity: str

    @property
    def end(self) -> int:
        """The frame after the last frame."""
        return self.start + self.frames


@dataclass(frozen=True)
class PlannedNoise:
    """A steady noise during some time.

    Attributes
    ----------
    start, end : int
        First frame, and the frame after the last frame; including fades of a second each.
    """

    name: str
    start: int
    end: int


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
