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
    """Successive syllables, coughs or knocks: runs of them, and pauses between the runs.

    Parameters
    ----------
    samples : int
        Samples of the sound, at 16 kHz.
    length, gap : (float, float)
        Shortest and longest element, and gap between two elements of a run, in seconds.
    pause : (float, float)
        Shortest and longest pause between two runs, in seconds.

    Attributes
    ----------
    starts : np.ndarray [shape=(count,)], intp
        Samples at which the elements start.
    lengths : np.ndarray [shape=(count,)], float64
        Samples that they last.
    """

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
        """Return the samples at which elements end, inside the sound.

        Returns
        -------
        np.ndarray [shape=(m,)], intp
        """
        ends = (self.starts + self.lengths).astype(np.intp)
        return ends[ends < self._samples]

    def envelope(self, gains: Float64, attack: float, release: float) -> Float64:
        """Return an envelope that rises and falls with each element.

        Parameters
        ----------
        gains : np.ndarray [shape=(count,)], float64
            Height of each element.
        attack, release : float
            Shares of an element in which it rises and falls, 0 to 1.

        Returns
        -------
        np.ndarray [shape=(samples,)], float64
        """
        corners = np.array([0.0, attack, 1.0 - release, 1.0])
        at = self.starts[:, np.newaxis] + self.lengths[:, np.newaxis] * corners
        height = gains[:, np.newaxis] * np.array([0.0, 1.0, 0.8, 0.0])
        return np.interp(np.arange(self._samples), at.ravel(), height.ravel())

    def position(self) -> Float64:
        """Return the position in each element, from 0 at its start to 1 at its end.

        Returns
        -------
        np.ndarray [shape=(samples,)], float64
        """
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
    """Pass a glottal source through formants that glide from vowel to vowel.

    The formants are those of Peterson & Barney (1952).

    Parameters
    ----------
    pitch : np.ndarray [shape=(samples,)], float64
        In hertz.
    tract : float
        Factor of the formants; 1 for a man.
    breath : float
        Standard deviation of the noise in the source, whose sawtooth reaches from -1 to 1.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
    """
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
    """Return a sawtooth of a varying pitch, its edges rounded (polyBLEP) against aliases.

    Parameters
    ----------
    pitch : np.ndarray [shape=(samples,)], float64
        In hertz, below 8000.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
        From -1 to 1.
    """
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
    """Return decaying sines, as of struck objects.

    Parameters
    ----------
    hits : np.ndarray [shape=(samples,)], float64
        Amplitude of the sine that begins at each sample, mostly 0.
    frequency : float
        In hertz; silence from 8000 on.
    seconds : float
        Time in which a sine decays to 1/e.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
    """
    if frequency >= SAMPLE_RATE / 2:
        return np.zeros(len(hits))
    a1, a2 = _resonance(frequency, 1.0 / (np.pi * seconds))
    height = np.sin(2.0 * np.pi * frequency / SAMPLE_RATE)
    return lfilter([height], [1.0, a1, a2], hits)


def impulses(samples: int, at: Indices, gains: Float64) -> Float64:
    """Return impulses at some samples, and 0 elsewhere.

    Parameters
    ----------
    at : np.ndarray [shape=(n,)], intp
        Samples of the impulses, below `samples`.
    gains : np.ndarray [shape=(n,)], float64
        Their heights.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
    """
    hits = np.zeros(samples)
    hits[at] = gains
    return hits


def decays(samples: int, at: Indices, seconds: float, gains: Float64 | None = None) -> Float64:
    """Return an envelope that jumps at some samples and decays after each of them.

    Parameters
    ----------
    samples : int
        Samples of the sound, at 16 kHz.
    at : np.ndarray [shape=(n,)], intp
        Samples at which it jumps, below `samples`.
    seconds : float
        Time in which it decays to 1/e.
    gains : np.ndarray [shape=(n,)], float64, optional
        Heights of the jumps; 1 by default.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
    """
    hits = impulses(samples, at, np.ones(len(at)) if gains is None else gains)
    return lfilter([1.0], [1.0, -np.exp(-1.0 / (seconds * SAMPLE_RATE))], hits)


def band_noise(rng: np.random.Generator, samples: int, low: float, high: float) -> Float64:
    """Return noise between two frequencies, of about power 1.

    Parameters
    ----------
    samples : int
        Samples of the sound, at 16 kHz.
    low, high : float
        Edges of the band in hertz, above 0 and below 8000.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
    """
    sos = butter(2, (low, high), "bandpass", fs=SAMPLE_RATE, output="sos")
    return sosfilt(sos, rng.standard_normal(samples)) * np.sqrt(SAMPLE_RATE / 2 / (high - low))


def wander(rng: np.random.Generator, samples: int, rate: float, depth: float) -> Float64:
    """Return a random factor about 1 that changes slowly.

    Parameters
    ----------
    samples : int
        Samples of the sound, at 16 kHz.
    rate : float
        New values a second, between which the factor glides.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
    """
    points = int(samples / SAMPLE_RATE * rate) + 2
    values = np.exp(depth * rng.standard_normal(points))
    return np.interp(np.arange(samples) * (rate / SAMPLE_RATE), np.arange(points), values)


def vibrato(samples: int, rate: float, depth: float) -> Float64:
    """Return a factor about 1 that swings as a sine.

    Parameters
    ----------
    samples : int
        Samples of the sound, at 16 kHz.
    rate : float
        Swings a second.
    depth : float
        Largest distance from 1.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
    """
    return 1.0 + depth * np.sin(np.arange(samples) * (2.0 * np.pi * rate / SAMPLE_RATE))
