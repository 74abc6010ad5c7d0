"""Sounds around an array of microphones, one after the other, in a simulated room."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyroomacoustics as pra
from scipy.signal import fftconvolve

from hearthlog.recorder.direction.geometry import SPEED_OF_SOUND
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import SAMPLE_RATE

_ROOMS = np.array([[3.5, 3.0, 2.4], [6.0, 5.0, 2.7]])  # metres, least and most
_FROM_WALLS = 0.3, 0.8  # metres, of a source and of the array
_HEIGHTS = (0.4, 1.7), (0.7, 1.2)  # metres, of sources and of the array
_NEAREST, _FARTHEST = 1.0, 3.5  # metres from the array, seen from above
_BEFORE, _PAUSE = 3.0, 1.5  # seconds of the room alone
_PLACED, _MATCHED_DB = 0.001, 1.0  # deviations of real microphones: metres, gain
_WAVES = 48  # of noise from everywhere
_LEVEL = 0.03  # full scale is 1


class Placed(NamedTuple):
    """A sound of a scene: its seconds, and where it was, in radians."""

    start: float
    end: float
    azimuth: float


class Scene(NamedTuple):
    """What an array hears without noise, and what is true.

    Attributes
    ----------
    samples : np.ndarray [shape=(n, c)], float64
        Each sound has a mean square of 1 in its seconds.
    sounds : list of Placed
    microphones : np.ndarray [shape=(c, 3)], float64
        Where they are, in metres from the middle of the array.
    """

    samples: Float64
    sounds: list[Placed]
    microphones: Float64


def room_scene(
    clips: Sequence[Float64], places: Float64, rt60: float, rng: np.random.Generator
) -> Scene:
    """Place clips around an array whose microphones are not quite where they should be.

    Parameters
    ----------
    clips : sequence of np.ndarray [shape=(n,)], float64
        At 16 kHz.
    places : np.ndarray [shape=(c, 2)], float64
        Where the microphones should be, in metres.
    rt60 : float
        Seconds in which an echo falls by 60 dB.
    rng : np.random.Generator
    """
    size = rng.uniform(*_ROOMS)
    microphones = np.pad(places, ((0, 0), (0, 1))) + rng.normal(0, _PLACED, (len(places), 3))
    gains = 10 ** (rng.normal(0, _MATCHED_DB, len(places)) / 20)
    centre = _place(size, _FROM_WALLS[1], _HEIGHTS[1], rng)
    absorption, order = pra.inverse_sabine(rt60, size)
    heard, sounds, at = [], [], int(_BEFORE * SAMPLE_RATE)
    for clip in clips:
        source = _source(size, centre, rng)
        room = pra.ShoeBox(
            size, fs=SAMPLE_RATE, materials=pra.Material(absorption), max_order=order
        )
        room.add_source(source)
        room.add_microphone_array((centre + microphones).T)
        room.compute_rir()
        length = max(len(one[0]) for one in room.rir)
        echoes = np.stack([np.pad(one[0], (0, length - len(one[0]))) for one in room.rir], axis=1)
        sound = fftconvolve(clip[:, np.newaxis], echoes * gains, axes=0)
        heard.append((at, sound / np.sqrt(np.square(sound[: len(clip)]).mean())))
        ahead, left, _ = source - centre
        end = at + len(clip)
        sounds.append(Placed(at / SAMPLE_RATE, end / SAMPLE_RATE, float(np.arctan2(left, ahead))))
        at += len(sound) + int(_PAUSE * SAMPLE_RATE)
    samples = np.zeros((at, len(places)))
    for start, sound in heard:
        samples[start : start + len(sound)] += sound
    return Scene(samples, sounds, microphones)


def room_noise(scene: Scene, rng: np.random.Generator) -> Float64:
    """Make the pink noise of a room, which comes from everywhere.

    Parameters
    ----------
    scene : Scene
        Whose length and microphones it is for.
    rng : np.random.Generator

    Returns
    -------
    np.ndarray [shape=(n, c)], float64
        Of a mean square of 1.
    """
    count = 1 << int(np.ceil(np.log2(len(scene.samples))))
    frequencies = np.fft.rfftfreq(count, 1 / SAMPLE_RATE)
    spectrum = np.zeros((len(frequencies), len(scene.microphones)), complex)
    for _ in range(_WAVES):
        towards = rng.normal(size=3)
        ahead = scene.microphones @ towards / np.linalg.norm(towards) / SPEED_OF_SOUND
        wave = rng.normal(size=len(frequencies)) + 1j * rng.normal(size=len(frequencies))
        turned = np.exp(2j * np.pi * frequencies[:, np.newaxis] * ahead)
        spectrum += wave[:, np.newaxis] * turned
    spectrum /= np.sqrt(np.maximum(frequencies, 50.0))[:, np.newaxis]
    noise = np.fft.irfft(spectrum, axis=0)[: len(scene.samples)]
    return noise / np.sqrt(np.square(noise).mean())


def add_noise(scene: Scene, noise: Float64, snr: float) -> Float32:
    """Add noise to a scene, as 16 bits have it.

    Parameters
    ----------
    scene : Scene
    noise : np.ndarray [shape=(n, c)], float64
        Of a mean square of 1.
    snr : float
        Power of the sounds over that of the noise, in dB.

    Returns
    -------
    np.ndarray [shape=(n, c)], float32
    """
    mixed = _LEVEL * (scene.samples + 10 ** (-snr / 20) * noise)
    return (np.round(np.clip(mixed, -1, 1) * 32767) / 32768).astype(np.float32)


def _place(
    size: Float64, margin: float, heights: tuple[float, float], rng: np.random.Generator
) -> Float64:
    return np.array([*rng.uniform(margin, size[:2] - margin), rng.uniform(*heights)])


def _source(size: Float64, centre: Float64, rng: np.random.Generator) -> Float64:
    while True:
        place = _place(size, _FROM_WALLS[0], _HEIGHTS[0], rng)
        if _NEAREST <= np.linalg.norm((place - centre)[:2]) <= _FARTHEST:
            return place
