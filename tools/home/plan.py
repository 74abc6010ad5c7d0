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
    level : float
        In dBFS, for a microphone in the same room.
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
    start, end : int
        First frame, and the frame after the last one; it comes and goes within a second each,
        inside of them.
    """

    name: str
    start: int
    end: int


@dataclass(frozen=True)
class Plan:
    """What sounds in a home."""

    frames: int
    sounds: Sequence[PlannedSound]
    steady: Sequence[SteadyNoise]
