"""The plan of a simulated home: what sounds where and when. Pure data, without sound."""

from collections.abc import Sequence
from dataclasses import dataclass

from hearthlog.tools.home.clips import Clip

TELEVISION, RADIO, PHONE = "television", "radio", "phone"
RESIDENT, VISITOR, OUTSIDE = "resident", "visitor", "outside"

BEDROOM, BATHROOM, KITCHEN, LIVING_ROOM = "bedroom", "bathroom", "kitchen", "living_room"
ROOMS = (BEDROOM, BATHROOM, KITCHEN, LIVING_ROOM)

FRIDGE, STREET, FAN = "fridge", "street", "fan"
STEADY_FRAMES = 20  # in which a steady noise comes or goes
LONGEST_FRAMES = 1200  # of one sound


@dataclass(frozen=True)
class PlannedSound:
    """One sound.

    Attributes
    ----------
    start, frames : int
        First frame, and how many.
    clip : Clip
        Cut or repeated to that length.
    origin : str
        Whose it is: `resident`, `visitor`, `television`, `radio`, `phone` or `outside`.
    room : str
        Where it sounds.
    level : float
        In dBFS, for a microphone in the same room.
    activity : str
        What it is part of.
    """

    start: int
    frames: int
    clip: Clip
    origin: str
    room: str
    level: float
    activity: str

    @property
    def end(self) -> int:
        """The frame after the last one."""
        return self.start + self.frames


@dataclass(frozen=True)
class SteadyNoise:
    """A steady noise that is on for some time.

    Attributes
    ----------
    name : str
        `fridge`, `street` or `fan`.
    start, end : int
        First frame, and the frame after the last one; it comes and goes within a second each,
        inside of them.
    """

    name: str
    start: int
    end: int


@dataclass(frozen=True)
class Plan:
    """What sounds in a home.

    Attributes
    ----------
    frames : int
        Length.
    sounds : sequence of PlannedSound
        By their start.
    steady : sequence of SteadyNoise
        By their start; those of one name do not overlap.
    """

    frames: int
    sounds: Sequence[PlannedSound]
    steady: Sequence[SteadyNoise]
