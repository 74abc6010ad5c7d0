"""Building blocks of the simulated sounds: rhythms, voices, ringing, noise; all at 16 kHz."""

import numpy as np
from scipy.signal import butter, lfilter, sosfilt

from hearthlog.schemas.arrays import Float64, Indices
from hearthlog.schemas.frames import SAMPLE_RATE

# First three formants of a man's vowels (Peterson & Barney 1952), and a fixed fourth.
_VOWELS = {
    "a": (730, 1090, 2440, 3400),
    "e": (530, 1840, 2480, 3400),
    "i": (270, 2290, 3010, 3400),
    "o": (570, 840, 2410, 3400),
    "u": (300, 870, 2240, 3400),
}
_BANDWIDTHS = (80, 100, 140, 220)

Range = tuple[float, float]


class Train:
    """Successive syllables, coughs or knocks: runs of them, and pauses between the runs."""

    def __init__(  # noqa: PLR0913 - five ranges describe a rhythm
        self,
        rng: np.random.Generator,
        samples: int,
        length: Range,
        gap: Range,
        *,
        run: tuple[int, int],
        pause: Range,
    ) -> None:
        count = int(samples / SAMPLE_RATE / (length[0] + gap[0])) + 2
        lengths = rng.uniform(*length, count)
        gaps = rng.uniform(*gap, count)
        last_of_run = np.cumsum(rng.integers(*run, count, endpoint=True)) - 1
        last_of_run = last_of_run[last_of_run < count]
        gaps[last_of_run] = rng.uniform(*pause, len(last_of_run))
        starts = np.cumsum(lengths + gaps) - lengths - gaps
        inside = starts * SAMPLE_RATE < samples
        self._samples = samples
        self.starts = (starts[inside] * SAMPLE_RATE).astype(np.intp)
        self.lengths = lengths[inside] * SAMPLE_RATE
        self.count = len(self.starts)

    def ends(self) -> Indices:
        """Return the samples at which the elements end, inside the sound."""
        ends = (self.starts + self.lengths).astype(np.intp)
        return ends[ends < self._samples]

    def envelope(self, gains: Float64, attack: float, release: float) -> Float64:
        """Return rises and falls; attack and release are shares of the lengths of the elements."""
        corners = np.array([0.0, attack, 1.0 - release, 1.0])
        at = self.starts[:, np.newaxis] + self.lengths[:, np.newaxis] * corners
        height = gains[:, np.newaxis] * np.array([0.0, 1.0, 0.8, 0.0])
        return np.interp(np.arange(self._samples), at.ravel(), height.ravel())

    def position(self) -> Float64:
        """Return the position in each element, 0 to 1."""
        at = self.starts[:, np.newaxis] + self.lengths[:, np.newaxis] * np.array([0.0, 1.0])
        return np.interp(np.arange(self._samples), at.ravel(), np.tile([0.0, 1.0], self.count))


def voiced(  # noqa: PLR0913 - a voice is these
    rng: np.random.Generator,
    train: Train,
    pitch: Float64,
    vowels: str,
    *,
    tract: float,
    breath: float = 0.05,
) -> Float64:
    """Pass a glottal source through formants that glide from vowel to vowel."""
    samples = len(pitch)
    source = sawtooth(pitch) + breath * rng.standard_normal(samples)
    tract *= rng.uniform(0.92, 1.08)
    spoken = rng.integers(0, len(vowels), train.count)
    voice = np.zeros(samples)
    for index, vowel in enumerate(vowels):
        share = np.interp(
            np.arange(samples), train.starts + train.lengths / 2.0, (spoken == index) * 1.0
        )
        formants = np.array(_VOWELS[vowel]) * tract
        coefficients = [_resonance(f, b) for f, b in zip(formants, _BANDWIDTHS, strict=True)]
        sos = [[1.0 + a1 + a2, 0.0, 0.0, 1.0, a1, a2] for a1, a2 in coefficients]
        voice += share * sosfilt(sos, source)
    return voice


def sawtooth(pitch: Float64) -> Float64:
    """Return a sawtooth of a varying pitch, its edges rounded (polyBLEP) against aliases."""
    step = pitch / SAMPLE_RATE
    phase = np.cumsum(step) % 1.0
    after, before = phase / step, (phase - 1.0) / step
    rounded = np.where(after < 1.0, -((after - 1.0) ** 2), 0.0)
    rounded += np.where(before > -1.0, (before + 1.0) ** 2, 0.0)
    return 2.0 * phase - 1.0 - rounded


def _resonance(frequency: float, bandwidth: float) -> tuple[float, float]:
    radius = np.exp(-np.pi * bandwidth / SAMPLE_RATE)
    return -2.0 * radius * np.cos(2.0 * np.pi * frequency / SAMPLE_RATE), radius**2


def ring(hits: Float64, frequency: float, seconds: float) -> Float64:
    """Return decaying sines of amplitude 1, as of struck objects."""
    if frequency >= SAMPLE_RATE / 2:
        return np.zeros(len(hits))
    a1, a2 = _resonance(frequency, 1.0 / (np.pi * seconds))
    height = np.sin(2.0 * np.pi * frequency / SAMPLE_RATE)
    return lfilter([height], [1.0, a1, a2], hits)


def impulses(samples: int, at: Indices, gains: Float64) -> Float64:
    """Return impulses of some heights at some samples."""
    hits = np.zeros(samples)
    hits[at] = gains
    return hits


def decays(samples: int, at: Indices, seconds: float, gains: Float64 | None = None) -> Float64:
    """Return an envelope that jumps at some samples and decays in `seconds` to 1/e."""
    hits = impulses(samples, at, np.ones(len(at)) if gains is None else gains)
    return lfilter([1.0], [1.0, -np.exp(-1.0 / (seconds * SAMPLE_RATE))], hits)


def band_noise(rng: np.random.Generator, samples: int, low: float, high: float) -> Float64:
    """Return noise between two frequencies, of about power 1."""
    sos = butter(2, (low, high), "bandpass", fs=SAMPLE_RATE, output="sos")
    return sosfilt(sos, rng.standard_normal(samples)) * np.sqrt(SAMPLE_RATE / 2 / (high - low))


def wander(rng: np.random.Generator, samples: int, rate: float, depth: float) -> Float64:
    """Return a factor about 1 that takes a new value `rate` times a second."""
    points = int(samples / SAMPLE_RATE * rate) + 2
    values = np.exp(depth * rng.standard_normal(points))
    return np.interp(np.arange(samples) * (rate / SAMPLE_RATE), np.arange(points), values)


def vibrato(samples: int, rate: float, depth: float) -> Float64:
    """Return a factor about 1 that swings `rate` times a second."""
    return 1.0 + depth * np.sin(np.arange(samples) * (2.0 * np.pi * rate / SAMPLE_RATE))
