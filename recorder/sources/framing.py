"""From blocks of captured samples to frames with stamps, and gaps where samples are missing."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.sources.frame_cutter import FrameCutter
from hearthlog.recorder.sources.sample_clock import SampleClock
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.messages.message_types import CLOCK_SET

_ADC_CLOCK_SECONDS = 60.0  # an ADC time further from now is on an unknown clock
STEP_SECONDS = 0.25  # of the time of day: less is a clock that is steered
_LOSS_SECONDS = 0.010
_STEADY_SECONDS = 0.002  # an ADC that has been this exact for so many blocks
_STEADY_BLOCKS = 50  # is believed when it says that samples are missing
_INT16_FULL_SCALE = np.float32(32768.0)


@dataclass(frozen=True)
class SampleBlock:
    """Samples that the capture process sent in one piece.

    Attributes
    ----------
    samples : np.ndarray [shape=(n,) or (n, c)], int16
        With an axis of channels, if it is an array of microphones.
    overflowed : bool
        The sound card lost samples before the last one of this block, or a little earlier.
    adc_time : float
        When the first sample was taken, in seconds of a clock of the driver's choice.
    arrival : float
        When the block arrived, in seconds of CLOCK_MONOTONIC.
    """

    index: int
    samples: NDArray[np.int16]
    overflowed: bool
    adc_time: float
    arrival: float

    @property
    def has_adc_time(self) -> bool:
        """Whether its ADC time can be trusted: those on other clocks jump about by 0.1 s."""
        return abs(self.adc_time - self.arrival) < _ADC_CLOCK_SECONDS

    def taken_at(self, rate: float) -> float:
        """Return the time at or before which the first sample was taken.

        Parameters
        ----------
        rate : float
            Samples per second.

        Returns
        -------
        float
            Seconds of CLOCK_MONOTONIC.
        """
        return self.adc_time if self.has_adc_time else self.arrival - len(self.samples) / rate


class Framer:
    """Cuts the sound of one microphone into frames, over all runs of its capture process.

    All samples of a frame follow each other: after a loss the next frame begins with the first
    sample that was captured again.
    """

    def __init__(self) -> None:
        self._next_frame = 0
        self._end: int | None = None  # of the last frame, on CLOCK_MONOTONIC
        self._last_stamp = 0
        self._end_offset = 0  # CLOCK_REALTIME less CLOCK_MONOTONIC at that end, in nanoseconds
        self._reason = ""
        self._rate = float(SAMPLE_RATE)
        self._channels: int | None = None
        self._clock = SampleClock(SAMPLE_RATE)
        self._wall_offset = 0  # CLOCK_REALTIME less CLOCK_MONOTONIC, in nanoseconds
        self._expected = 0  # index of the next block, if nothing is lost
        self._steady = 0  # blocks in a row that came when expected
        self._was_steady = False
        self._lost = 0  # samples that the sound card lost, which its driver did not count
        self._lost_reason = ""
        self._origin = 0  # index of the first sample since the last loss
        self._framed = 0  # samples at 16 kHz that became frames since then
        self._cutter = FrameCutter()

    @property
    def ppm(self) -> float:
        """How much faster than nominal the microphone's clock runs, in parts per million."""
        return self._clock.ppm

    @property
    def last_stamp(self) -> int:
        """Stamp of the last frame in nanoseconds of UTC; 0 before the first one."""
        return self._last_stamp

    def begin(
        self,
        rate: int,
        wall_offset: int,
        reason: str,
        lost_reason: str = "",
        channels: int | None = None,
    ) -> None:
        """Start anew with another capture process.

        Parameters
        ----------
        rate : int
            Samples per second that it delivers.
        wall_offset : int
            CLOCK_REALTIME less CLOCK_MONOTONIC in nanoseconds.
        reason : str
            Why there was no sound in between.
        lost_reason : str
            Why blocks may not follow each other; by default the recorder was too slow.
        channels : int or None
            Of an array; None of a single microphone.
        """
        self._rate = float(rate)
        self._channels = channels
        self._lost_reason = lost_reason or "the recorder was too slow"
        self._clock = SampleClock(rate)
        self._expected = self._lost = self._steady = 0
        step = (wall_offset - self._end_offset) / NANOSECONDS
        if self._end is not None and abs(step) > STEP_SECONDS:
            reason = f"{reason}; {clock_set_by(step)}"
        self._restart(0, reason)
        self._wall_offset = wall_offset

    def step_clock(self, wall_offset: int) -> None:
        """Follow a change of the time of day; only the samples of the unfinished frame are lost.

        Parameters
        ----------
        wall_offset : int
            CLOCK_REALTIME less CLOCK_MONOTONIC in nanoseconds.
        """
        step = (wall_offset - self._wall_offset) / NANOSECONDS
        self._restart(self._expected + self._lost, clock_set_by(step))
        self._wall_offset = wall_offset

    def add(self, block: SampleBlock) -> list[Frames | Gap]:
        """Add a block and return the frames that it completes.

        Returns
        -------
        list of Frames or Gap
            At most one `Frames`, after the gap before it, if there is one.
        """
        if block.index != self._expected:
            self._restart(block.index + self._lost, self._lost_reason)
        self._expected = block.index + len(block.samples)
        taken = block.taken_at(self._rate)
        missing = self._missing_before(block, taken)
        if missing:
            self._lost += missing
            # The loss lies somewhere inside this block: the first good sample is the next one's.
            self._restart(self._expected + self._lost, "the sound card lost samples")
            return []
        self._clock.observe(block.index + self._lost, taken, is_exact=block.has_adc_time)
        return self._cut(block.samples.astype(np.float32) / _INT16_FULL_SCALE)

    def _missing_before(self, block: SampleBlock, taken: float) -> int:
        """Count the samples that the sound card lost, by how late this block's ADC time is."""
        if not self._clock.started:
            return 0
        late = taken - float(self._clock.time(block.index + self._lost))
        self._steady = self._steady + 1 if abs(late) < _STEADY_SECONDS else 0
        is_loss = block.overflowed or (block.has_adc_time and self._was_steady)
        self._was_steady = self._steady >= _STEADY_BLOCKS
        return round(late * self._rate) if is_loss and late > _LOSS_SECONDS else 0

    def _restart(self, origin: int, reason: str) -> None:
        self._reason = reason
        self._origin = origin
        self._framed = 0
        self._cutter = FrameCutter(self._rate, self._channels)

    def _cut(self, samples: Float32) -> list[Frames | Gap]:
        frames = self._cutter.push(samples)
        count = len(frames)
        if count == 0:
            return []
        times = self._times(count)
        self._framed += count * FRAME_SAMPLES
        if self._reason and self._end is not None:  # it began while another one was heard
            heard = int(np.searchsorted(times, self._end))
            times, frames, count = times[heard:], frames[heard:], count - heard
            if count == 0:
                return []
        gap = self._gap_before(int(times[0]))
        stamps = times + self._wall_offset
        complete = frames_of(self._next_frame, frames, stamps)
        self._next_frame += count
        self._end = int(times[-1]) + FRAME_NANOSECONDS
        self._end_offset = self._wall_offset
        self._last_stamp = int(stamps[-1])
        return [complete] if gap is None else [gap, complete]

    def _times(self, count: int) -> Int64:
        """Return when the next frames start, in nanoseconds of CLOCK_MONOTONIC."""
        position = self._framed + np.arange(count) * FRAME_SAMPLES
        index = self._origin + position * np.float64(self._rate / SAMPLE_RATE)
        return np.round(self._clock.time(index) * NANOSECONDS).astype(np.int64)

    def _gap_before(self, time: int) -> Gap | None:
        reason, self._reason = self._reason, ""
        if not reason or self._end is None:
            return None
        lost = max(round((time - self._end) / FRAME_NANOSECONDS), 1)
        self._next_frame += lost
        return Gap(self._end + self._end_offset, time + self._wall_offset, reason, lost)


def clock_set_by(seconds: float) -> str:
    """Say in the reason of a gap that the clock was set."""
    return f"{CLOCK_SET} by {seconds:+.3f} s"


def frames_of(first: int, frames: Float32, stamps: Int64) -> Frames:
    """Make the event of frames of one microphone, or of an array.

    Parameters
    ----------
    frames : np.ndarray [shape=(n, 800) or (n, 800, c)], float32
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    """
    if frames.ndim == 2:
        return Frames(first, frames, stamps)
    return Frames(first, np.ascontiguousarray(frames[:, :, 0]), stamps, frames)
