"""Sounds around an array of microphones, one after the other, in a simulated room."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyroomacoustics as pra
from scipy.signal import fftconvolve

from hearthlog.recorder.stream.directions import SPEED_OF_SOUND
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


class Room(NamedTuple):
    """A room, and an array in it whose microphones are not quite where they should be.

    Attributes
    ----------
    size, centre : np.ndarray [shape=(3,)], float64
        Of the room, and where the middle of the array is, in metres.
    microphones : np.ndarray [shape=(c, 3)], float64
        Where they are, in metres from the middle of the array.
    gains : np.ndarray [shape=(c,)], float64
    rt60 : float
        Seconds in which an echo falls by 60 dB.
    """

    size: Float64
    centre: Float64
    microphones: Float64
    gains: Float64
    rt60: float

    def anywhere(self, rng: np.random.Generator) -> Float64:
        """Draw a place of a source, 1 to 3.5 m from the array."""
        return _source(self.size, self.centre, rng)

    def azimuth(self, source: Float64) -> float:
        """Return whence the sound of a source comes, in radians."""
        ahead, left, _ = source - self.centre
        return float(np.arctan2(left, ahead))

    def echoes(self, source: Float64) -> Float64:
        """Return the impulse responses of the microphones: [shape=(n, c)]."""
        absorption, order = pra.inverse_sabine(self.rt60, self.size)
        room = pra.ShoeBox(
            self.size, fs=SAMPLE_RATE, materials=pra.Material(absorption), max_order=order
        )
        room.add_source(source)
        room.add_microphone_array((self.centre + self.microphones).T)
        room.compute_rir()
        length = max(len(one[0]) for one in room.rir)
        padded = [np.pad(one[0], (0, length - len(one[0]))) for one in room.rir]
        return np.stack(padded, axis=1) * self.gains


def draw_room(places: Float64, rt60: float, rng: np.random.Generator) -> Room:
    """Draw a room of 3.5 to 6 m.

    Parameters
    ----------
    places : np.ndarray [shape=(c, 2)], float64
        Where the microphones should be, in metres.
    rt60 : float
    rng : np.random.Generator
    """
    size = rng.uniform(*_ROOMS)
    microphones = np.pad(places, ((0, 0), (0, 1))) + rng.normal(0, _PLACED, (len(places), 3))
    gains = 10 ** (rng.normal(0, _MATCHED_DB, len(places)) / 20)
    centre = _place(size, _FROM_WALLS[1], _HEIGHTS[1], rng)
    return Room(size, centre, microphones, gains, rt60)


def convolved_with(echoes: Float64, clip: Float64) -> Float64:
    """Return what microphones hear of a clip, of a mean square of 1 in its seconds.

    Parameters
    ----------
    echoes : np.ndarray [shape=(m, c)], float64
    clip : np.ndarray [shape=(n,)], float64

    Returns
    -------
    np.ndarray [shape=(n + m - 1, c)], float64
    """
    sound = fftconvolve(clip[:, np.newaxis], echoes, axes=0)
    return sound / np.sqrt(np.square(sound[: len(clip)]).mean())


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
    room = draw_room(places, rt60, rng)
    sources = [room.anywhere(rng) for _ in clips]
    echoed = [
        convolved_with(room.echoes(at), clip) for at, clip in zip(sources, clips, strict=True)
    ]
    return laid_out(room, sources, clips, echoed)


def laid_out(
    room: Room, sources: Sequence[Float64], clips: Sequence[Float64], echoed: Sequence[Float64]
) -> Scene:
    """Lay sounds one behind the other.

    Parameters
    ----------
    room : Room
    sources : sequence of np.ndarray [shape=(3,)], float64
        Where each is.
    clips, echoed : sequence of np.ndarray
        Without the room, and as `convolved_with` returns them.
    """
    sounds, at, channels = [], int(_BEFORE * SAMPLE_RATE), len(room.microphones)
    pause = np.zeros((int(_PAUSE * SAMPLE_RATE), channels))
    parts = [np.zeros((at, channels))]
    for source, clip, sound in zip(sources, clips, echoed, strict=True):
        end = at + len(clip)
        sounds.append(Placed(at / SAMPLE_RATE, end / SAMPLE_RATE, room.azimuth(source)))
        parts += [sound, pause]
        at += len(sound) + len(pause)
    return Scene(np.concatenate(parts), sounds, room.microphones)


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
