"""Synthetic sounds of a simulated home.

The sounds are caricatures: rhythm, pitch and colour are right, so a model can distinguish them, and
no two are the same. A model trained on them is useless in a real home.
"""

from collections.abc import Callable

import numpy as np
from scipy.signal import butter, lfilter, sosfilt

from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import SAMPLE_RATE

# First three formants of a man's vowels (Peterson & Barney 1952), and a constant fourth.
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

    `length`, `gap` (between two elements of a run) and `pause` (between two runs) are shortest and
    longest values, in seconds. `starts` [shape=(count,)] and `lengths` [shape=(count,), float64] of
    the elements are in samples, at 16 kHz.
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
        """Return the samples at which elements end, within the sound [shape=(m,)]."""
        ends = (self.starts + self.lengths).astype(np.intp)
        return ends[ends < self._samples]

    def envelope(self, gains: Float64, attack: float, release: float) -> Float64:
        """Return an envelope [shape=(samples,)] that rises and falls with each element.

        `gains` [shape=(count,)] are heights, `attack` and `release` shares of an element, 0 to 1.
        """
        corners = np.array([0.0, attack, 1.0 - release, 1.0])
        at = self.starts[:, np.newaxis] + self.lengths[:, np.newaxis] * corners
        height = gains[:, np.newaxis] * np.array([0.0, 1.0, 0.8, 0.0])
        return np.interp(np.arange(self._samples), at.ravel(), height.ravel())

    def position(self) -> Float64:
        """Return the position in each element [shape=(samples,)], from 0 to 1."""
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
    """Pass a glottal source through formants that glide from vowel to vowel [shape=(samples,)].

    The formants are those of Peterson & Barney (1952), times `tract`, 1 for a man. `pitch` is in
    hertz. `breath` is the standard deviation of the noise in the source, whose sawtooth reaches
    from -1 to 1.
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
    """Return a sawtooth, -1 to 1, of a varying pitch in hertz, below 8000 [shape=(samples,)].

    Its edges are rounded (polyBLEP) against aliases.
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
    """Return decaying sines [shape=(samples,)], as from struck objects.

    `hits` has the amplitude of the sine that begins at each sample, mostly 0; `frequency` is in
    hertz, silence from 8000 on; a sine decays to 1/e in `seconds`.
    """
    if frequency >= SAMPLE_RATE / 2:
        return np.zeros(len(hits))
    a1, a2 = _resonance(frequency, 1.0 / (np.pi * seconds))
    height = np.sin(2.0 * np.pi * frequency / SAMPLE_RATE)
    return lfilter([height], [1.0, a1, a2], hits)


def impulses(samples: int, at: Indices, gains: Float64) -> Float64:
    """Return impulses [shape=(samples,)] of some heights [shape=(n,)] at some samples; else 0."""
    hits = np.zeros(samples)
    hits[at] = gains
    return hits


def decays(samples: int, at: Indices, seconds: float, gains: Float64 | None = None) -> Float64:
    """Return an envelope [shape=(samples,)] that jumps at some samples and decays after each.

    It jumps `at` samples [shape=(n,)] below `samples`, by `gains` [shape=(n,)], 1 by default, and
    decays to 1/e in `seconds`, at 16 kHz.
    """
    hits = impulses(samples, at, np.ones(len(at)) if gains is None else gains)
    return lfilter([1.0], [1.0, -np.exp(-1.0 / (seconds * SAMPLE_RATE))], hits)


def band_noise(rng: np.random.Generator, samples: int, low: float, high: float) -> Float64:
    """Return noise of about power 1 between two frequencies [shape=(samples,)], at 16 kHz.

    They are in hertz, above 0 and below 8000.
    """
    sos = butter(2, (low, high), "bandpass", fs=SAMPLE_RATE, output="sos")
    return sosfilt(sos, rng.standard_normal(samples)) * np.sqrt(SAMPLE_RATE / 2 / (high - low))


def wander(rng: np.random.Generator, samples: int, rate: float, depth: float) -> Float64:
    """Return a random factor about 1 that changes slowly [shape=(samples,)], at 16 kHz.

    It glides between `rate` new values a second.
    """
    points = int(samples / SAMPLE_RATE * rate) + 2
    values = np.exp(depth * rng.standard_normal(points))
    return np.interp(np.arange(samples) * (rate / SAMPLE_RATE), np.arange(points), values)


def vibrato(samples: int, rate: float, depth: float) -> Float64:
    """Return a factor about 1 that swings as a sine [shape=(samples,)], at 16 kHz.

    `rate` is in swings a second, `depth` is the largest distance from 1.
    """
    return 1.0 + depth * np.sin(np.arange(samples) * (2.0 * np.pi * rate / SAMPLE_RATE))


_MAX_SECONDS = 300.0  # bounds the memory of one sound, to about 500 MB
_MAX_PEAK = 0.95
_MAX_DULLNESS = 0.8
_DOOR_DECIBELS = 10.0
_FADE_SECONDS = 0.01
_TINY = 1e-9
_SCALES = ((0, 2, 4, 5, 7, 9, 11), (0, 2, 3, 5, 7, 8, 10))  # major, minor; semitones


class SimulationError(HearthlogError):
    """The simulated home cannot fulfil a request."""


class RoomTone:
    """Background noise of one room, -65 to -60 dBFS, as one endless stream."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._level = _amplitude(rng.uniform(-65.0, -60.0))
        self._pole = rng.uniform(0.85, 0.95)
        self._gain = np.sqrt(1.0 - self._pole**2)  # keeps the power of noise of power 1
        self._state = np.zeros(1)

    def __call__(self, samples: int) -> Float64:
        """Return the next samples [shape=(samples,)] in full scale, -1 to 1, at 16 kHz."""
        noise = self._rng.standard_normal(samples)
        coloured, self._state = lfilter([self._gain], [1.0, -self._pole], noise, zi=self._state)
        return self._level * coloured


def synthesize(label: str, seconds: float, seed: int) -> Float32:
    """Synthesise a sound [shape=(n,)] in the room's noise, -1 to 1 at 16 kHz, of up to 300 seconds.

    The same arguments give the same samples. Raise `SimulationError` if there is no such sound, its
    duration is out of range, or the seed is negative.
    """
    samples = round(seconds * SAMPLE_RATE) if 0 < seconds <= _MAX_SECONDS else 0
    if samples < 1:
        raise SimulationError(f"a sound lasts more than 0 and at most 300 s, not {seconds}")
    rng = generator(seed)
    return (dry_sound(label, samples, rng) + RoomTone(rng)(samples)).astype(np.float32)


def generator(*seed: int) -> np.random.Generator:
    """Return the random generator of a seed, and of integers that distinguish its uses.

    Raise `SimulationError` if one of them is negative.
    """
    if min(seed) < 0:
        raise SimulationError(f"a seed is a whole number from 0, not {min(seed)}")
    return np.random.default_rng(seed)


def dry_sound(label: str, samples: int, rng: np.random.Generator) -> Float64:
    """Synthesise a sound [shape=(samples,)] without the room, -1 to 1 at 16 kHz, with faded ends.

    There is at least one sample. Raise `SimulationError` if there is no such sound.
    """
    if label not in _SOUNDS:
        raise SimulationError(f"no sound is called {label!r}; there are {', '.join(LABELS)}")
    make, levels = _SOUNDS[label]
    distance = rng.uniform()  # 0 next to the microphone, 1 behind a door
    # A one-pole low-pass: distance and doors attenuate high frequencies first.
    pole = _MAX_DULLNESS * distance
    sound = lfilter([1.0 - pole], [1.0, -pole], make(rng, samples))
    sound -= sound.mean()
    rms, peak = np.sqrt(np.mean(sound**2)), np.abs(sound).max()
    if peak == 0.0:
        return sound
    level = rng.uniform(*levels) - _DOOR_DECIBELS * distance
    sound *= min(_amplitude(level) / rms, _MAX_PEAK / peak)
    time = np.arange(samples) / SAMPLE_RATE
    sound *= np.minimum(1.0, np.minimum(time, time[::-1]) / _FADE_SECONDS)
    return sound


def _amplitude(decibels: float) -> float:
    return float(10.0 ** (decibels / 20.0))


def _silence(_rng: np.random.Generator, samples: int) -> Float64:
    return np.zeros(samples)


def _speech(rng: np.random.Generator, samples: int) -> Float64:
    train = Train(rng, samples, (0.1, 0.24), (0.01, 0.06), run=(3, 12), pause=(0.15, 0.5))
    base = rng.uniform(90.0, 230.0)
    pitch = base * wander(rng, samples, 2.0, 0.12) * wander(rng, samples, 30.0, 0.01)
    loudness = train.envelope(rng.uniform(0.4, 1.0, train.count), attack=0.2, release=0.35)
    voice = voiced(rng, train, pitch, "aeiou", tract=(base / 120.0) ** 0.25)
    hiss_at = train.starts[rng.random(train.count) < 0.35]
    hiss = band_noise(rng, samples, 3000.0, 7500.0) * decays(samples, hiss_at, 0.03)
    return voice * loudness + rng.uniform(0.1, 0.3) * hiss


def _crying(rng: np.random.Generator, samples: int) -> Float64:
    train = Train(rng, samples, (0.6, 1.6), (0.08, 0.2), run=(1, 4), pause=(0.2, 0.45))
    arch = np.sin(np.pi * train.position())
    base = rng.uniform(350.0, 450.0)
    pitch = base * (1.0 + rng.uniform(0.15, 0.33) * arch) * wander(rng, samples, 3.0, 0.04)
    pitch *= vibrato(samples, rng.uniform(4.0, 8.0), 0.03)
    loudness = train.envelope(rng.uniform(0.5, 1.0, train.count), attack=0.15, release=0.5)
    sobs = band_noise(rng, samples, 1200.0, 5000.0) * decays(samples, train.ends(), 0.06)
    return voiced(rng, train, pitch, "aeu", tract=1.2) * loudness + 0.1 * sobs


def _yelling(rng: np.random.Generator, samples: int) -> Float64:
    train = Train(rng, samples, (0.25, 0.9), (0.03, 0.12), run=(2, 5), pause=(0.15, 0.4))
    arch = np.sin(np.pi * train.position())
    pitch = rng.uniform(240.0, 420.0) * (1.0 + rng.uniform(0.1, 0.3) * arch)
    pitch *= wander(rng, samples, 60.0, 0.03)  # the roughness of a strained voice
    loudness = train.envelope(rng.uniform(0.7, 1.0, train.count), attack=0.1, release=0.2)
    voice = voiced(rng, train, pitch, "aeo", tract=1.1)
    pressed = np.tanh(rng.uniform(1.5, 3.0) * voice / (voice.std() + _TINY))
    return loudness * (pressed + lfilter([1.0, -0.9], [1.0], pressed))


def _laughing(rng: np.random.Generator, samples: int) -> Float64:
    train = Train(rng, samples, (0.07, 0.13), (0.06, 0.11), run=(4, 10), pause=(0.2, 0.5))
    fall = np.interp(np.arange(samples), train.starts, rng.uniform(0.75, 1.25, train.count))
    base = rng.uniform(180.0, 380.0)
    loudness = train.envelope(rng.uniform(0.6, 1.0, train.count), attack=0.3, release=0.5)
    voice = voiced(rng, train, base * fall, rng.choice(["a", "ae", "ei"]), tract=1.1)
    breath = band_noise(rng, samples, 800.0, 5000.0) * decays(samples, train.starts, 0.04)
    return voice * loudness + rng.uniform(0.3, 0.6) * breath


def _coughing(rng: np.random.Generator, samples: int) -> Float64:
    train = Train(rng, samples, (0.25, 0.42), (0.03, 0.15), run=(1, 4), pause=(0.15, 0.45))
    gains = rng.uniform(0.5, 1.0, train.count)
    burst = band_noise(rng, samples, rng.uniform(300.0, 700.0), rng.uniform(4000.0, 6500.0))
    burst *= decays(samples, train.starts, rng.uniform(0.03, 0.06), gains)
    pitch = rng.uniform(130.0, 280.0) * wander(rng, samples, 40.0, 0.08)
    voice = voiced(rng, train, pitch, "ao", tract=1.0, breath=1.0)
    return burst + rng.uniform(0.15, 0.4) * voice * decays(samples, train.starts, 0.09, gains)


def _music(rng: np.random.Generator, samples: int) -> Float64:
    beat = 60.0 / rng.uniform(70.0, 140.0)
    beats = np.arange(0, samples, round(beat * SAMPLE_RATE))
    count = len(beats)
    steps = rng.integers(0, 7, size=count // 4 + 1).repeat(4)[:count]  # a new chord every bar
    scale = np.array(rng.choice(_SCALES))
    root = rng.uniform(110.0, 220.0)
    ringing = rng.uniform(0.2, 0.8)
    dull = rng.uniform(0.4, 0.8)
    music = np.zeros(samples)
    for degree in range(14):
        in_chord = np.isin((degree - steps) % 7, (0, 2, 4))
        struck = beats[in_chord & (rng.random(count) < 0.7)]
        hits = impulses(samples, struck, rng.uniform(0.4, 1.0, len(struck)))
        pitch = root * 2.0 ** ((scale[degree % 7] + 12 * (degree // 7)) / 12.0)
        for harmonic in range(1, 5):
            music += dull**harmonic * ring(hits, harmonic * pitch, ringing / harmonic)
    bass_pitch = root / 2.0 * 2.0 ** (scale[steps] / 12.0)
    bass = sawtooth(np.repeat(bass_pitch, np.diff(beats, append=samples)))
    return music / (music.std() + _TINY) + rng.uniform(0.1, 0.5) * lfilter([0.1], [1, -0.9], bass)


def _phone_ring(rng: np.random.Generator, samples: int) -> Float64:
    time = np.arange(samples) / SAMPLE_RATE
    on, off = rng.uniform(0.8, 2.0), rng.uniform(0.2, 0.5)
    low = rng.uniform(500.0, 1400.0)
    high = low * rng.uniform(1.15, 1.5)
    second = (time * rng.uniform(12.0, 28.0)) % 1.0 < 0.5
    tone = np.sin(2.0 * np.pi * np.cumsum(np.where(second, high, low)) / SAMPLE_RATE)
    ringing = (time % (on + off) < on).astype(np.float64)
    bell = np.tanh(rng.uniform(1.0, 3.0) * tone)
    return bell * lfilter([0.005], [1.0, -0.995], ringing)


def _objects_activity(rng: np.random.Generator, samples: int) -> Float64:
    train = Train(rng, samples, (0.03, 0.2), (0.03, 0.35), run=(2, 6), pause=(0.2, 0.6))
    item = rng.integers(0, 4, train.count)
    sound = np.zeros(samples)
    for which, (low, high, ringing) in enumerate(
        [(1500.0, 6500.0, 0.08), (800.0, 4000.0, 0.03), (90.0, 500.0, 0.03), (300.0, 2500.0, 0.02)]
    ):
        at = train.starts[item == which]
        hits = impulses(samples, at, rng.uniform(0.2, 1.0, len(at)))
        for frequency in rng.uniform(low, high, 5):
            sound += ring(hits, frequency, ringing * rng.uniform(0.3, 1.5))
    rustle = train.envelope((item == 3) * rng.uniform(0.2, 1.0, train.count), 0.4, 0.4)
    return sound + 0.4 * rustle * band_noise(rng, samples, 2000.0, 7500.0)


def _flushing_water(rng: np.random.Generator, samples: int) -> Float64:
    position = np.linspace(0.0, 1.0, samples)
    over = rng.uniform(0.55, 0.75)
    roar = band_noise(rng, samples, rng.uniform(100.0, 250.0), rng.uniform(1800.0, 3200.0))
    roar *= np.interp(position, [0.0, 0.08, over - 0.15, over, 1.0], [0.3, 1.0, 0.8, 0.15, 0.03])
    roar *= wander(rng, samples, 9.0, 0.3)
    refill = band_noise(rng, samples, rng.uniform(1800.0, 2600.0), rng.uniform(5000.0, 7000.0))
    return roar + rng.uniform(0.15, 0.25) * refill * np.interp(position, [0.1, over], [0.0, 1.0])


def _shower(rng: np.random.Generator, samples: int) -> Float64:
    spray = band_noise(rng, samples, rng.uniform(300.0, 600.0), rng.uniform(6500.0, 7700.0))
    return spray * wander(rng, samples, 4.0, 0.08)


def _tap_water(rng: np.random.Generator, samples: int) -> Float64:
    middle = rng.uniform(1400.0, 2400.0)
    stream = band_noise(rng, samples, middle / 2.0, middle * 1.6) * wander(rng, samples, 25.0, 0.35)
    bubbles = np.zeros(samples)
    for frequency in rng.uniform(400.0, 1400.0, 6):
        at = np.flatnonzero(rng.random(samples) < 6.0 / SAMPLE_RATE)
        bubbles += ring(impulses(samples, at, rng.uniform(0.3, 1.0, len(at))), frequency, 0.012)
    return stream + rng.uniform(0.3, 0.8) * bubbles / (bubbles.std() + _TINY) * stream.std()


# The synthesis of each sound, and its level in dBFS next to the microphone.
_SOUNDS: dict[str, tuple[Callable[[np.random.Generator, int], Float64], Range]] = {
    "silence": (_silence, (-99.0, -99.0)),
    "speech": (_speech, (-34.0, -24.0)),
    "music": (_music, (-34.0, -24.0)),
    "phone_ring": (_phone_ring, (-30.0, -20.0)),
    "coughing": (_coughing, (-30.0, -20.0)),
    "crying": (_crying, (-30.0, -20.0)),
    "yelling": (_yelling, (-20.0, -12.0)),
    "laughing": (_laughing, (-30.0, -20.0)),
    "objects_activity": (_objects_activity, (-38.0, -28.0)),
    "flushing_water": (_flushing_water, (-26.0, -18.0)),
    "shower": (_shower, (-30.0, -22.0)),
    "tap_water": (_tap_water, (-36.0, -26.0)),
}
LABELS = tuple(_SOUNDS)
