"""Sounds of a simulated home.

They are caricatures: rhythm, pitch and colour are right, so that a model can tell them apart, and
no two are the same. A model trained on them is useless in a real home.
"""

from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.home.waveforms import (
    Range,
    Train,
    band_noise,
    decays,
    impulses,
    ring,
    sawtooth,
    vibrato,
    voiced,
    wander,
)

_MAX_SECONDS = 300.0  # bounds the memory of one sound, to about 500 MB
_MAX_PEAK = 0.95
_MAX_DULLNESS = 0.8
_DOOR_DECIBELS = 10.0
_FADE_SECONDS = 0.01
_TINY = 1e-9
_SCALES = ((0, 2, 4, 5, 7, 9, 11), (0, 2, 3, 5, 7, 8, 10))  # major, minor; semitones


class SimulationError(HearthlogError):
    """The simulated home cannot make what was asked for."""


class RoomTone:
    """Background noise of one room, -65 to -60 dBFS, as one endless stream."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._level = _amplitude(rng.uniform(-65.0, -60.0))
        self._pole = rng.uniform(0.85, 0.95)
        self._gain = np.sqrt(1.0 - self._pole**2)  # a noise of power 1 keeps its power
        self._state = np.zeros(1)

    def __call__(self, samples: int) -> Float64:
        """Return the next samples.

        Returns
        -------
        np.ndarray [shape=(samples,)], float64
            Full scale is -1 to 1, at 16 kHz.
        """
        noise = self._rng.standard_normal(samples)
        coloured, self._state = lfilter([self._gain], [1.0, -self._pole], noise, zi=self._state)
        return self._level * coloured


def synthesize(label: str, seconds: float, seed: int) -> Float32:
    """Make one sound, with the room's background noise.

    Parameters
    ----------
    seconds : float
        More than 0, at most 300.
    seed : int
        Not negative. The same arguments give the same samples.

    Returns
    -------
    np.ndarray [shape=(n,)], float32
        Full scale is -1 to 1, at 16 kHz.

    Raises
    ------
    SimulationError
        If there is no such sound, if it cannot last that long, or if the seed is negative.
    """
    samples = round(seconds * SAMPLE_RATE) if 0 < seconds <= _MAX_SECONDS else 0
    if samples < 1:
        raise SimulationError(f"a sound lasts more than 0 and at most 300 s, not {seconds}")
    rng = generator(seed)
    return (dry_sound(label, samples, rng) + RoomTone(rng)(samples)).astype(np.float32)


def generator(*seed: int) -> np.random.Generator:
    """Return the random generator of a seed.

    Parameters
    ----------
    *seed : int
        A seed, and further integers that tell its uses apart. None is negative.

    Raises
    ------
    SimulationError
        If one of them is negative.
    """
    if min(seed) < 0:
        raise SimulationError(f"a seed is a whole number from 0, not {min(seed)}")
    return np.random.default_rng(seed)


def dry_sound(label: str, samples: int, rng: np.random.Generator) -> Float64:
    """Make one sound without the room; its ends are faded.

    Parameters
    ----------
    samples : int
        At least 1, at 16 kHz.

    Returns
    -------
    np.ndarray [shape=(samples,)], float64
        Full scale is -1 to 1, at 16 kHz.

    Raises
    ------
    SimulationError
        If there is no such sound.
    """
    if label not in _SOUNDS:
        raise SimulationError(f"no sound is called {label!r}; there are {', '.join(LABELS)}")
    make, levels = _SOUNDS[label]
    distance = rng.uniform()  # 0 beside the microphone, 1 behind a door
    # A one-pole low-pass: distance and doors take the high frequencies first.
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


# How each sound is made, and its level in dBFS beside the microphone.
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
