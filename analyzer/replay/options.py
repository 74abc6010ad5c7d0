"""How logs are replayed, and what came of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.replay.comparison import ReplayComparison
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.frames import FRAME_SECONDS


@dataclass(frozen=True)
class ReplayOptions:
    """How logs are replayed."""

    kind: str = "features"  # or "audio", for clips
    model: Callable[[RecorderInfo], Model | None] = lambda _: None  # None: no labels
    # By the name of the scenario: those that label beside it.
    scenarios: Mapping[str, Model] = field(default_factory=dict)
    output: Path | None = None  # folder of the new log, if there is to be one
    start_offset: float = 0.0  # seconds from the first message
    duration: float | None = None  # seconds; None for all
    rate: float | None = None  # multiple of real time; None for as fast as possible
    loop: bool = False  # begin anew at the end, until stopped


@dataclass
class Replay:
    """What came of a replay.

    `missing` are times (ns of UTC) before which the logs lack sound that was recorded: the labels
    of the first second there, and the open segment, cannot be as recorded.
    """

    sources: list[Path]  # logs that were replayed
    logs: list[Path] = field(default_factory=list)  # that were written
    frames: int = 0
    labels: int = 0
    segments: int = 0
    gaps: int = 0
    compared: ReplayComparison = field(default_factory=ReplayComparison)
    missing: list[int] = field(default_factory=list)
    unfinished: list[Path] = field(default_factory=list)  # cut off, and replayed up to there
    interrupted: bool = False

    @property
    def seconds(self) -> float:
        """Seconds of sound that were replayed."""
        return self.frames * FRAME_SECONDS
