"""Sound quality checks: clipped, stuck, below hearing, humming, faint or loud."""

from collections import deque

import numpy as np

from hearthlog.models.features.floor import decibels
from hearthlog.schemas.arrays import Bool, Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS, SAMPLE_RATE

_FULL_SCALE = 0.999
_CLIPPED_SAMPLES = 4  # per frame; the highest sample of a recording may be full scale
_CLIPPED_ENERGY = 0.99 * _CLIPPED_SAMPLES * _FULL_SCALE**2  # with a margin for rounding
_COMPARED_SAMPLES = 16  # samples of a frame: usually enough to detect a change
_CLIPPED_FRAMES = round(1.0 / FRAME_SECONDS)  # of the last minute
_MINUTE = round(60.0 / FRAME_SECONDS)
_LOUD_DBFS = -25.0
_LOUD_FRAMES = 10 * _MINUTE
_STUCK_FRAMES = round(10.0 / FRAME_SECONDS)
_INFRASOUND_FRAMES = round(20.0 / FRAME_SECONDS)
_INFRASOUND_SHARE = 0.8  # of them
_INFRASOUND_POWER = 1e-5  # -50 dBFS
DEAD_STEPS = 2  # of 16 bits: range of a converter's own noise
_DEAD_RANGE = DEAD_STEPS / 32768
_DAY_MINUTES = 1440
_FALL = 1000.0  # 30 dB
_SECOND = round(1.0 / FRAME_SECONDS)
_MAINS = (50, 60)  # Hz
_HARMONICS = np.arange(1, 7)
_HUM_SHARE = 0.7
_HUM_DBFS = -45.0
_HUM_MINUTES = 30

CLIPS = "the microphone clips: turn its volume down"
STUCK = "the microphone gives one value only: connect it again, or replace it"
HUMS = "the microphone hums at {} Hz: check its cable and power supply, or what hums beside it"
OFFSET = "the sound has an offset (DC), which is left out: try another socket or sound card"
RUMBLE = "there is a rumble below hearing, which is left out: keep wind and vibration off"
FAINT = "a whole day was 30 dB fainter than before: is the microphone covered or turned away?"
LOUD = "the room is as loud as most sounds: turn the microphone down, or put it elsewhere"


def problem_of_file(problem: str) -> str:
    """Rephrase a microphone's fault for an audio file."""
    what = problem.partition(":")[0].replace("the microphone", "the file")
    return f"{what}: check with what it was recorded, and how"


class SoundWatch:
    """Checks the sound of one microphone."""

    def __init__(self) -> None:
        self._clipped: Bool = np.empty(0, bool)  # frames of the last minute
        self._loud = 0  # successive frames with a loud noise floor
        self._stuck = 0  # successive frames of one value
        self._infrasound = _Infrasound()
        self._level = _DailyLevel()
        self._hum = _MainsHum()

    def add_samples(self, samples: Float32, filtered: Float32 | None = None) -> None:
        """Add frames [shape=(n, FRAME_SAMPLES)] in full scale, -1 to 1.

        `filtered` has the same samples after `InfrasoundFilter`.
        """
        filtered = samples if filtered is None else filtered
        self._infrasound.add(samples, filtered)
        self._clipped = np.concatenate([self._clipped, _are_clipped(samples)])[-_MINUTE:]
        # Zeros are no fault: in a file they are silence, and a microphone's are reported elsewhere.
        moving = (samples[:, :_COMPARED_SAMPLES] != samples[:, :1]).any(axis=1) | (
            samples[:, 0] == 0.0
        )
        still = np.flatnonzero(~moving)
        moving[still] = np.ptp(samples[still], axis=1) > 0
        moving = np.flatnonzero(moving & ~_is_offset_only(samples, filtered))
        last = int(moving[-1]) if len(moving) else -1
        self._stuck = len(samples) - 1 - last + (self._stuck if last < 0 else 0)
        with np.errstate(over="ignore"):  # floats in a file may have any size
            powers = np.square(samples).mean(axis=1)
        self._level.add(np.minimum(powers, np.float32(1.0)))
        self._hum.add(samples)

    def add_floor(self, powers: Float64) -> None:
        """Add the noise floor of frames [shape=(n,)], as mean squares; full scale is 1."""
        low = np.flatnonzero(decibels(powers) <= _LOUD_DBFS)
        self._loud = len(powers) - 1 - int(low[-1]) if len(low) else self._loud + len(powers)

    def problem(self) -> str:
        """Return the fault and its remedy; empty if there is none."""
        if self._stuck >= _STUCK_FRAMES:
            return STUCK
        if self._clipped.sum() >= _CLIPPED_FRAMES:
            return CLIPS
        if self._loud >= _LOUD_FRAMES:
            return LOUD
        if infrasound := self._infrasound.problem():
            return infrasound
        if self._hum.frequency:
            return HUMS.format(self._hum.frequency)
        return FAINT if self._level.has_fallen else ""


class ClipWatch:
    """Checks a sound of a few seconds, which is too short for a `SoundWatch`."""

    def __init__(self) -> None:
        self._frames = self._clipped = self._still = self._zero = 0
        self._held: Float32 = np.empty((0, FRAME_SAMPLES), np.float32)  # less than a second
        self._seconds: list[int] = []  # mains frequency of each second's hum, or 0

    def add_samples(self, samples: Float32) -> None:
        """Add successive frames [shape=(n, FRAME_SAMPLES)] in full scale, -1 to 1."""
        self._frames += len(samples)
        self._clipped += int(_are_clipped(samples).sum())
        is_flat = np.ptp(samples, axis=1) <= _DEAD_RANGE
        is_still = is_flat & (np.abs(samples[:, 0]) > _DEAD_RANGE)
        self._still += int(is_still.sum())
        self._zero += int((is_flat & ~is_still).sum())  # silence in a file
        held = np.concatenate([self._held, samples])
        full = len(held) - len(held) % _SECOND
        seconds, self._held = np.split(held, [full])
        self._seconds += map(_hum_of, seconds.reshape(-1, SAMPLE_RATE))

    def problem(self) -> str:
        """Return the fault and its remedy; empty if there is none."""
        if 2 * self._still > self._frames - self._zero:
            return STUCK
        if self._clipped >= _CLIPPED_FRAMES or 2 * self._clipped > self._frames:
            return CLIPS
        for frequency in _MAINS:
            if 2 * self._seconds.count(frequency) > len(self._seconds):
                return HUMS.format(frequency)
        return ""


def _is_offset_only(samples: Float32, filtered: Float32) -> Bool:
    """Return the frames that hold only an offset: a dead microphone."""
    if filtered is samples:
        return np.zeros(len(samples), bool)
    is_offset_only = np.ptp(samples[:, :_COMPARED_SAMPLES], axis=1) <= _DEAD_RANGE
    flat = np.flatnonzero(is_offset_only)
    is_flat = np.ptp(samples[flat], axis=1) <= _DEAD_RANGE
    is_offset_only[flat] = is_flat & (filtered[flat] != samples[flat]).any(axis=1)
    return is_offset_only


def _are_clipped(samples: Float32) -> Bool:
    with np.errstate(over="ignore"):
        clipped = np.vecdot(samples, samples) >= _CLIPPED_ENERGY
    loud = np.flatnonzero(clipped)
    clipped[loud] = (np.abs(samples[loud]) >= _FULL_SCALE).sum(axis=1) >= _CLIPPED_SAMPLES
    return clipped


class _Infrasound:
    """Recent output that the infrasound filter removed."""

    def __init__(self) -> None:
        self._means = self._powers = np.zeros(_INFRASOUND_FRAMES, np.float32)

    def add(self, samples: Float32, filtered: Float32) -> None:
        if filtered is samples and not self._powers.any():
            return
        means, powers = np.zeros((2, len(samples)), np.float32)
        changed = np.flatnonzero((filtered != samples).any(axis=1))
        removed = samples[changed] - filtered[changed]
        means[changed], powers[changed] = removed.mean(axis=1), np.square(removed).mean(axis=1)
        self._means = np.concatenate([self._means, means])[-_INFRASOUND_FRAMES:]
        self._powers = np.concatenate([self._powers, powers])[-_INFRASOUND_FRAMES:]

    def problem(self) -> str:
        if (
            np.count_nonzero(self._powers > _INFRASOUND_POWER)
            < _INFRASOUND_SHARE * _INFRASOUND_FRAMES
        ):
            return ""
        return OFFSET if self._means.mean() ** 2 > 0.5 * self._powers.mean() else RUMBLE


class _DailyLevel:
    """Tracks the loudest minute of each day of sound."""

    def __init__(self) -> None:
        self.has_fallen = False
        self._powers: Float32 = np.empty(0, np.float32)  # of the frames of this minute
        self._minutes: list[float] = []  # of this day
        self._days: deque[float] = deque(maxlen=7)

    def add(self, powers: Float32) -> None:
        self._powers = np.concatenate([self._powers, powers])
        if len(self._powers) < _MINUTE:
            return
        self._minutes.append(float(self._powers.mean()))
        self._powers = self._powers[:0]
        if len(self._minutes) == _DAY_MINUTES:
            loudest = max(self._minutes)
            self.has_fallen = bool(self._days) and loudest * _FALL < float(np.median(self._days))
            if not self.has_fallen:
                self._days.append(loudest)
            self._minutes = []


class _MainsHum:
    """Checks one second of every minute for mains hum."""

    def __init__(self) -> None:
        self.frequency = 0  # Hz; 0 for no hum
        self._frames = 0
        self._second: list[Float32] = []
        self._minutes = 0
        self._last = 0

    def add(self, samples: Float32) -> None:
        self._frames += len(samples)
        if self._frames < _MINUTE:
            return
        self._second.append(samples)
        if sum(map(len, self._second)) < _SECOND:
            return
        second = np.concatenate(self._second)[:_SECOND].reshape(-1)
        self._frames, self._second = 0, []
        hum = _hum_of(second)
        self._minutes = self._minutes + 1 if hum and hum == self._last else int(hum > 0)
        self._last = hum
        self.frequency = hum if self._minutes >= _HUM_MINUTES else 0


def _hum_of(second: Float32) -> int:
    """Return the mains frequency if it holds most of a second's power, else 0."""
    assert len(second) == SAMPLE_RATE == _SECOND * FRAME_SAMPLES
    if decibels(np.square(second, dtype=np.float64).mean()) < _HUM_DBFS:
        return 0
    power = np.square(np.abs(np.fft.rfft(second * np.hanning(len(second)))))
    power[:20] = 0.0  # below the range of microphones, in bins of 1 Hz
    around = np.arange(-2, 3)
    for frequency in _MAINS:
        bins = (frequency * _HARMONICS[:, np.newaxis] + around).reshape(-1)
        if power[bins].sum() > _HUM_SHARE * power.sum():
            return frequency
    return 0
