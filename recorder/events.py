"""What a source of sound hands on: frames, gaps between them, and what it has to report."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from hearthlog.schemas.arrays import Float32, Int64


@dataclass(frozen=True)
class Frames:
    """Successive frames of sound.

    Attributes
    ----------
    first : int
        Number of the first frame.
    samples : np.ndarray [shape=(n, 800)], float32
    stamps : np.ndarray [shape=(n,)], int64
        Time of each frame's first sample in nanoseconds of UTC.
    """

    first: int
    samples: Float32
    stamps: Int64


@dataclass(frozen=True)
class Gap:
    """Audio that was not heard, between two times in nanoseconds of UTC, and why."""

    start: int
    end: int
    reason: str
    frames_lost: int


@dataclass(frozen=True)
class Health:
    """State of a source: level as in `diagnostic_msgs` (0 ok, 1 warning, 2 error)."""

    stamp: int
    level: int
    summary: str
    values: Mapping[str, str] = field(default_factory=dict)


Event = Frames | Gap | Health
