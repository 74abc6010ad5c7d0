"""Scenes: clips laid over steady noise, with the truth known."""

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from scipy.fft import irfft, rfft

from hearthlog.analyzer.errors import DataError
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import SAMPLE_RATE

Colour = Literal["white", "pink", "brown"]
Clip = TypeVar("Clip")

_SINGLE_SECONDS = 0.3
_SLOPES = {"pink": 0.5, "brown": 1.0}
_LOWEST_HERTZ = np.float32(20.0)  # below it the spectrum is flat
_AT_ONCE = 1 << 20
_SECONDS = (3.0, 10.0)  # of a sound at most
_PAUSES = (0.5, 2.0, 6.0)  # seconds between two sounds
_SINGLE_PAUSES = (2.0, 8.0)
_MOST_SINGLE = 120
_BEFORE, _AFTER = 2.0, 5.0  # seconds of noise before the first sound and after the last
_LAST = 12.0  # seconds before the end in which no sound begins
_TAPER = 0.1  # power of a Hann window: faded in and out without losing loudness


class Span(NamedTuple):
    """What sounds in some time; seconds from the start of the scene."""

    start: float
    end: float
    label: str


class Scene(NamedTuple):
    """Sound whose labels are known.

    Attributes
    ----------
    samples : np.ndarray [shape=(n,)], float32
        At 16 kHz, -1 to 1.
    truth : list of Span
        One after the other without gaps; silence lies between the sounds.
    """

    samples: Float32
    truth: list[Span]

    @property
    def sounds(self) -> list[Span]:
        """What is not silence."""
        return [span for span in self.truth if span.label != SILENCE]


def background(seconds: float, level: float, colour: Colour, seed: int) -> Float32:
    """Make the noise of a scene.

    Parameters
    ----------
    seconds : float
        More than 0.
    level : float
        In dBFS.
    seed : int
        Not negative.

    Returns
    -------
    np.ndarray [shape=(n,)], float32
        Samples at 16 kHz.
    """
    rng, noise = np.random.default_rng(seed), np.empty(int(seconds * SAMPLE_RATE), np.float32)
    for part in _parts(noise):
        part[:] = rng.standard_normal(len(part))
    if colour != "white":
        noise = _coloured(noise, _SLOPES[colour])
    power = sum(np.square(part, dtype=np.float64).sum() for part in _parts(noise)) / len(noise)
    noise *= 10.0 ** (level / 20.0) / np.sqrt(power)
    return noise


def _parts(noise: Float32) -> list[Float32]:
    return [noise[start : start + _AT_ONCE] for start in range(0, len(noise), _AT_ONCE)]


def _coloured(noise: Float32, slope: float) -> Float32:
    """Let the amplitude of noise fall with the frequency to a power; the noise is overwritten."""
    spectrum = rfft(noise, overwrite_x=True)  # in single precision, as an hour of noise is long
    frequencies = np.arange(len(spectrum), dtype=np.float32) * np.float32(SAMPLE_RATE / len(noise))
    spectrum /= np.maximum(frequencies, _LOWEST_HERTZ) ** np.float32(slope)
    coloured: Float32 = irfft(spectrum, len(noise), overwrite_x=True)
    return coloured


def compose(
    clips: Mapping[str, Sequence[Clip]],
    read: Callable[[Clip], Float32],
    noise: Float32,
    seed: int,
    gain: float = 0.0,
) -> Scene:
    """Lay clips over noise, 0.5, 2 or 6 s apart, 3 to 10 s of each at most.

    Parameters
    ----------
    clips : mapping of str to sequence
        The clips of each label, which are all as likely; at least one label, each with a clip.
    read : callable
        Gives the samples of a clip at 16 kHz, not none; one clip is held at a time.
    noise : np.ndarray [shape=(n,)], float32
        As of `background`; it is overwritten.
    gain : float
        Of the clips, in dB.

    Raises
    ------
    DataError
        If there is no time for a sound.
    """
    rng = random.Random(seed)  # noqa: S311  no secret

    def sounds() -> Iterator[tuple[str, Float32, float]]:
        while True:
            label = rng.choice(sorted(clips))
            sound = read(rng.choice(clips[label]))
            sound = sound[: int(rng.uniform(*_SECONDS) * SAMPLE_RATE)]
            yield label, sound, rng.choice(_PAUSES)

    return _laid(sounds(), noise, gain)


def compose_single(  # noqa: PLR0913, PLR0917
    label: str,
    clips: Sequence[Clip],
    read: Callable[[Clip], Float32],
    noise: Float32,
    seed: int,
    gain: float = 0.0,
) -> Scene:
    """Lay up to 120 single short sounds of one label over noise, 2 to 8 s apart.

    Each is the loudest 0.3 s of a clip.

    Parameters
    ----------
    clips : sequence
        At least one.

    Raises
    ------
    DataError
        If there is no time for a sound.
    """
    rng = random.Random(seed)  # noqa: S311  no secret

    def sounds() -> Iterator[tuple[str, Float32, float]]:
        while True:
            rng.choice([label])  # the same draws as of a scene
            sound = loudest(read(rng.choice(clips)), _SINGLE_SECONDS)
            yield label, sound, rng.uniform(*_SINGLE_PAUSES)

    return _laid(islice(sounds(), _MOST_SINGLE), noise, gain)


def loudest(sound: Float32, seconds: float) -> Float32:
    """Return the loudest part of a sound, faded in and out.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float32
        Samples at 16 kHz.
    """
    count = int(seconds * SAMPLE_RATE)
    if len(sound) <= count:
        return sound
    energy = np.cumsum(np.concatenate([[0.0], np.square(sound, dtype=np.float64)]))
    start = int(np.argmax(energy[count:] - energy[:-count]))
    part = sound[start : start + count] * np.hanning(count) ** _TAPER
    return part.astype(np.float32)


def _laid(sounds: Iterator[tuple[str, Float32, float]], noise: Float32, gain: float) -> Scene:
    """Lay (label, samples, seconds of pause behind it) over noise, while there is time."""
    last, now = len(noise) / SAMPLE_RATE - _LAST, _BEFORE
    if last <= now:
        raise DataError(
            f"a scene of {len(noise) / SAMPLE_RATE:g} s has no time for a sound; make it longer "
            f"than {_BEFORE + _LAST:g} s"
        )
    truth: list[Span] = []
    end = 0.0  # of the sound before
    while now < last and (drawn := next(sounds, None)):
        label, sound, pause = drawn
        start = int(now * SAMPLE_RATE)
        noise[start : start + len(sound)] += sound * np.float32(10.0 ** (gain / 20.0))
        length = len(sound) / SAMPLE_RATE
        truth += [Span(end, now, SILENCE), Span(now, now + length, label)]
        end = now + length
        now += length + pause
    samples = noise[: int((now + _AFTER) * SAMPLE_RATE)]
    np.clip(samples, -1.0, 1.0, out=samples)
    return Scene(samples, [*truth, Span(end, len(samples) / SAMPLE_RATE, SILENCE)])
