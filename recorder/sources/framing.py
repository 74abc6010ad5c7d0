"""Frames of 50 ms from blocks of samples, stamped by a sample clock and the wall clock."""

import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import soxr
from numpy.typing import NDArray

from hearthlog.recorder.events import Frames, Gap
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.errors import SourceError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.messages.message_types import CLOCK_SET


class FrameCutter:
    """Resamples one sound from a rate in Hz to 16 kHz and cuts it into frames.

    `channels` is that of an array; None for samples without a channel axis.
    """

    def __init__(self, rate: float = SAMPLE_RATE, channels: int | None = None) -> None:
        self._shape = () if channels is None else (channels,)
        self._held = np.empty((0, *self._shape), np.float32)
        self._resampler = None
        if rate != SAMPLE_RATE:
            self._resampler = soxr.ResampleStream(rate, SAMPLE_RATE, channels or 1, dtype="float32")

    def push(self, samples: Float32, *, last: bool = False) -> Float32:
        """Add samples [shape=(m,) or (m, c)]; return frames [shape=(n, 800) or (n, 800, c)].

        The samples are at the rate of the sound, the frames at 16 kHz.
        """
        if self._resampler is not None:
            samples = self._resampler.resample_chunk(samples, last=last)
        self._held = np.concatenate([self._held, samples])
        full = len(self._held) - len(self._held) % FRAME_SAMPLES
        frames, self._held = np.split(self._held, [full])
        return frames.reshape(-1, FRAME_SAMPLES, *self._shape)


_WINDOW_SECONDS = 2.0
_WINDOWS = 150  # five minutes: long enough for 1 ppm, short enough to follow the temperature
_PRIOR_PPM = 50.0  # expected error of a sound card's crystal before a measurement
_STEEPEST = 0.1  # seconds of steering per second: keeps frames in order for any input
_PRIOR_NOISE = 100e-6  # seconds: expected lateness of the earliest observation of a window
_LATE = _PRIOR_NOISE  # later observations pull the line no further: the machine was busy
_ROUNDS = 10  # of reweighting


class SampleClock:
    """Maps a sample index to the capture time of the sample; `rate` is nominal, in Hz.

    Observations are late, never early, by the delays of the sound card and the scheduler. So the
    earliest observation of each window of two seconds counts, and a line is fitted through these. A
    busy machine can be late during a complete window: residuals above the line count linearly (as
    in Huber's loss), residuals below by their square. Behind a sound server the delays are a
    hundred times longer and no line can be fitted: then the earliest observation of all windows
    counts. The time is steered towards each new line, never set to it: time does not jump.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._windows: deque[tuple[float, float]] = deque(maxlen=_WINDOWS)
        self._window_end = 0.0
        self._earliest: tuple[float, float] | None = None
        self._earliest_steered = 0.0
        # From `_anchor` (a nominal time) on, time = nominal + _late + _slope * (nominal - _anchor).
        self._origin: float | None = None
        self._anchor = 0.0
        self._late = 0.0
        self._slope = 0.0
        self._fitted_slope = 0.0
        self._is_exact = True

    @property
    def started(self) -> bool:
        """Whether there is an observation."""
        return self._origin is not None

    @property
    def ppm(self) -> float:
        """Deviation of the sample rate from nominal, in parts per million; positive is faster."""
        return -self._fitted_slope * 1e6

    def observe(self, index: int, time: float, *, is_exact: bool = True) -> None:
        """Add an upper bound on a sample's capture time, in seconds of CLOCK_MONOTONIC.

        It `is_exact` if it comes from the sound card rather than from an arrival.
        """
        self._is_exact = is_exact
        nominal = index / self._rate
        if self._origin is None:
            self._origin = time - nominal
            self._anchor, self._window_end = nominal, nominal + _WINDOW_SECONDS
        late = time - self._origin - nominal
        if nominal >= self._window_end:
            self._close_window(nominal)
        steered = late - self._slope * (nominal - self._anchor)
        if self._earliest is None or steered < self._earliest_steered:
            self._earliest, self._earliest_steered = (nominal, late), steered

    def time(self, index: Float64 | float) -> Float64:
        """Compute capture times, in seconds of CLOCK_MONOTONIC, of indices [shape=() or (n,)].

        Sample indices may be fractional. At least one observation is required.
        """
        assert self._origin is not None
        nominal = np.asarray(index) / self._rate
        return self._origin + nominal + self._late + self._slope * (nominal - self._anchor)

    def _close_window(self, nominal: float) -> None:
        if self._earliest is not None:
            self._windows.append(self._earliest)
        self._earliest = None
        self._window_end = nominal + _WINDOW_SECONDS
        now = self._late + self._slope * (nominal - self._anchor)
        self._fitted_slope, ahead = self._fit(nominal + _WINDOW_SECONDS)
        self._anchor, self._late = nominal, now
        slope = (ahead - now) / _WINDOW_SECONDS
        self._slope = min(max(slope, -_STEEPEST), _STEEPEST)

    def _fit(self, nominal: float) -> tuple[float, float]:
        """Return the slope of the lateness, and the lateness at a nominal time."""
        at, late = rows = np.array([*zip(*self._windows, strict=True)])
        if not self._is_exact:
            return 0.0, float(late.min())
        weight = np.ones(len(at))
        for _ in range(_ROUNDS):
            center, mean = (weight * rows).sum(axis=1) / weight.sum()
            apart, over = at - center, late - mean
            spread = (weight * apart**2).sum() + (_PRIOR_NOISE / (_PRIOR_PPM * 1e-6)) ** 2
            slope = float((weight * apart * over).sum() / spread)
            above = over - slope * apart
            weight = _LATE / np.maximum(above, _LATE)
        return slope, float(mean + slope * (nominal - center))


_ADC_CLOCK_SECONDS = 60.0  # an ADC time further from the arrival is on an unknown clock
STEP_SECONDS = 0.25  # of the time of day: less is a steered clock
_LOSS_SECONDS = 0.010
_STEADY_SECONDS = 0.002  # an ADC clock this exact for so many blocks
_STEADY_BLOCKS = 50  # is trusted when it shows missing samples
_INT16_FULL_SCALE = np.float32(32768.0)


@dataclass(frozen=True)
class SampleBlock:
    """One block of samples from the capture process."""

    index: int
    # [shape=(n,) or (n, c)] with a channel axis for an array of microphones
    samples: NDArray[np.int16]
    # the sound card lost samples before the last sample of this block, or a little earlier
    overflowed: bool
    # capture time of the first sample, in seconds of a clock of the driver's choice
    adc_time: float
    arrival: float  # arrival of the block, in seconds of CLOCK_MONOTONIC

    @property
    def has_adc_time(self) -> bool:
        """Whether the ADC time can be trusted: times on other clocks jump about by 0.1 s."""
        return abs(self.adc_time - self.arrival) < _ADC_CLOCK_SECONDS

    def taken_at(self, rate: float) -> float:
        """Return an upper bound on the first sample's time, in seconds of CLOCK_MONOTONIC."""
        return self.adc_time if self.has_adc_time else self.arrival - len(self.samples) / rate


class Framer:
    """Cuts the sound of one microphone into frames, over all runs of its capture process.

    Samples of a frame are contiguous: after a loss the next frame begins with the first new sample.
    `last_stamp` is the last frame's, in nanoseconds of UTC; 0 before the first one.
    """

    def __init__(self) -> None:
        self._next_frame = 0
        self._end: int | None = None  # of the last frame, on CLOCK_MONOTONIC
        self.last_stamp = 0
        self._end_offset = 0  # CLOCK_REALTIME less CLOCK_MONOTONIC at that end, in nanoseconds
        self._reason = ""
        self._rate = float(SAMPLE_RATE)
        self._channels: int | None = None
        self._clock = SampleClock(SAMPLE_RATE)
        self._wall_offset = 0  # CLOCK_REALTIME less CLOCK_MONOTONIC, in nanoseconds
        self._expected = 0  # index of the next block, if nothing is lost
        self._steady = 0  # blocks in a row that came when expected
        self._was_steady = False
        self._lost = 0  # samples lost by the sound card and not counted by its driver
        self._lost_reason = ""
        self._origin = 0  # index of the first sample since the last loss
        self._framed = 0  # samples at 16 kHz in frames since then
        self._cutter = FrameCutter()

    @property
    def ppm(self) -> float:
        """Deviation of the microphone's clock, in parts per million; positive is faster."""
        return self._clock.ppm

    def begin(
        self,
        rate: int,
        wall_offset: int,
        reason: str,
        lost_reason: str = "",
        channels: int | None = None,
    ) -> None:
        """Restart with another capture process, after a gap with a reason.

        `rate` is in Hz, `wall_offset` is CLOCK_REALTIME less CLOCK_MONOTONIC in nanoseconds.
        `lost_reason` is that of missing blocks; by default the recorder was too slow.
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
        """Follow a step of the time of day; only the samples of the unfinished frame are lost.

        `wall_offset` is CLOCK_REALTIME less CLOCK_MONOTONIC in nanoseconds.
        """
        step = (wall_offset - self._wall_offset) / NANOSECONDS
        self._restart(self._expected + self._lost, clock_set_by(step))
        self._wall_offset = wall_offset

    def add(self, block: SampleBlock) -> list[Frames | Gap]:
        """Add a block; return at most one `Frames`, after the gap before it, if there is one."""
        if block.index != self._expected:
            self._restart(block.index + self._lost, self._lost_reason)
        self._expected = block.index + len(block.samples)
        taken = block.taken_at(self._rate)
        missing = self._missing_before(block, taken)
        if missing:
            self._lost += missing
            # The loss is somewhere inside this block: the next block has the first good sample.
            self._restart(self._expected + self._lost, "the sound card lost samples")
            return []
        self._clock.observe(block.index + self._lost, taken, is_exact=block.has_adc_time)
        return self._cut(block.samples.astype(np.float32) / _INT16_FULL_SCALE)

    def _missing_before(self, block: SampleBlock, taken: float) -> int:
        """Return how many samples the sound card lost, from the lateness of the ADC time."""
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
        if self._reason and self._end is not None:  # it overlaps the previous source
            framed = int(np.searchsorted(times, self._end))
            times, frames, count = times[framed:], frames[framed:], count - framed
            if count == 0:
                return []
        gap = self._gap_before(int(times[0]))
        stamps = times + self._wall_offset
        complete = frames_of(self._next_frame, frames, stamps)
        self._next_frame += count
        self._end = int(times[-1]) + FRAME_NANOSECONDS
        self._end_offset = self._wall_offset
        self.last_stamp = int(stamps[-1])
        return [complete] if gap is None else [gap, complete]

    def _times(self, count: int) -> Int64:
        """Return the starts of the next frames, in nanoseconds of CLOCK_MONOTONIC."""
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
    """Format the reason of a gap caused by a clock step."""
    return f"{CLOCK_SET} by {seconds:+.3f} s"


def frames_of(first: int, frames: Float32, stamps: Int64) -> Frames:
    """Create the event of frames [shape=(n, 800) or, of an array, (n, 800, c)].

    `stamps` [shape=(n,)] are their starts in nanoseconds of UTC.
    """
    if frames.ndim == 2:
        return Frames(first, frames, stamps)
    return Frames(first, np.ascontiguousarray(frames[:, :, 0]), stamps, frames)


# ROS has 32 bits for seconds, and MCAP no times before 1970. Margins: one minute for frames
# captured before the clock was read, one day for times in the future that a log may contain.
_FIRST = 60 * NANOSECONDS
_LAST = ((1 << 31) - 86_400) * NANOSECONDS
_LAST_OF_CALENDAR = 253_402_300_799  # seconds: the year 9999 ends


class WallClock:
    """CLOCK_REALTIME, extrapolated while its time is out of the range of a log.

    Without an earlier valid time it continues from 1970, as on a machine with an unset clock.
    `trouble` is the fault of the clock; empty for none.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._offset: int | None = None  # the last valid one

    def offset(self) -> int:
        """Return CLOCK_REALTIME less CLOCK_MONOTONIC in nanoseconds."""
        before = time.monotonic_ns()
        now = time.time_ns()
        monotonic = (before + time.monotonic_ns()) // 2
        is_right = _FIRST <= now < _LAST
        if is_right:
            self._offset = now - monotonic
        elif self._offset is None or monotonic + self._offset >= _LAST:
            self._offset = _FIRST - monotonic
        self.trouble = "" if is_right else _trouble(now)
        return self._offset


def check_times(first: int, last: int) -> None:
    """Raise `SourceError` if times, in nanoseconds of UTC, are out of the range of a log."""
    if first < 0 or last >= _LAST:
        day = _day(first if first < 0 else last)
        raise SourceError(f"a log cannot have sound of {day}, only of 1970 to 2037; say --start")


def _trouble(now: int) -> str:
    return f"the clock says {_day(now)}, which a log cannot have; set it, for all stamps are wrong"


def _day(nanoseconds: int) -> str:
    seconds = min(nanoseconds // NANOSECONDS, _LAST_OF_CALENDAR)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d}"
