"""The rooms of a simulated home: what a microphone in one of them hears of the others."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.signal import lfilter, oaconvolve

from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.home.plan import (
    BATHROOM,
    BEDROOM,
    FAN,
    FRIDGE,
    KITCHEN,
    LIVING_ROOM,
    OUTSIDE,
    ROOMS,
    STREET,
)
from hearthlog.tools.home.sounds import SimulationError, generator

PERIOD_FRAMES = 2400  # after which steady noise repeats itself
TAIL_FRAMES = 8  # of reverberation behind a sound

_WALLS = {  # attenuation in dB, doors ajar
    frozenset({LIVING_ROOM, KITCHEN}): 10.0,
    frozenset({LIVING_ROOM, BEDROOM}): 16.0,
    frozenset({LIVING_ROOM, BATHROOM}): 20.0,
    frozenset({KITCHEN, BEDROOM}): 22.0,
    frozenset({KITCHEN, BATHROOM}): 20.0,
    frozenset({BEDROOM, BATHROOM}): 14.0,
}
_WINDOW = 24.0
_DULLING_DB = 9.0  # of attenuation take an octave off the top
_FLOOR_DBFS = {LIVING_ROOM: -64.0, KITCHEN: -60.0, BATHROOM: -62.0, BEDROOM: -67.0}
_FLOOR_SPREAD_DB = 3.0
_REVERBERATION = {LIVING_ROOM: 0.35, KITCHEN: 0.4, BATHROOM: 0.55, BEDROOM: 0.25, OUTSIDE: 0.2}
_DIRECT_DB = {True: 8.0, False: 0.0}  # over the reverberation, in the same room or not
_DIRECT_SAMPLES = 48
_STEADY = {FRIDGE: (KITCHEN, -50.0), FAN: (BATHROOM, -42.0), STREET: (OUTSIDE, -42.0)}
_HUM_HERTZ, _HUM_HARMONICS = 50.0, 8
_LOWEST_HERTZ = 20.0


def attenuation(room: str, microphone: str) -> float:
    """Return by how many dB a sound of a room is weaker where the microphone is."""
    if room == microphone:
        return 0.0
    return _WALLS.get(frozenset({room, microphone}), _WINDOW)


class Rooms:
    """What a microphone hears of a home.

    Attributes
    ----------
    floor : np.ndarray [shape=(PERIOD_FRAMES, FRAME_SAMPLES)], float32
        Noise of the room, which repeats itself.

    Raises
    ------
    SimulationError
        If there is no such room.
    """

    def __init__(self, microphone: str, seed: int) -> None:
        if microphone not in ROOMS:
            raise SimulationError(f"no room is called {microphone!r}; there are {', '.join(ROOMS)}")
        self._microphone = microphone
        self._seed = seed
        rng = generator(seed, 2, ROOMS.index(microphone))
        level = _FLOOR_DBFS[microphone] + rng.uniform(-_FLOOR_SPREAD_DB, _FLOOR_SPREAD_DB)
        self.floor = _noise(rng, level, rng.uniform(0.25, 0.9))
        self.steady: Mapping[str, Float32] = {
            name: self._heard_steadily(name, rng) for name in _STEADY
        }
        self._responses: dict[str, Float64] = {}

    def heard(self, sound: Float32, room: str) -> Float32:
        """Return a sound of a room as the microphone hears it.

        Parameters
        ----------
        sound : np.ndarray [shape=(n * FRAME_SAMPLES,)], float32

        Returns
        -------
        np.ndarray [shape=((n + TAIL_FRAMES) * FRAME_SAMPLES,)], float32
        """
        if room not in self._responses:
            self._responses[room] = self._response(room)
        length = len(sound) + TAIL_FRAMES * FRAME_SAMPLES
        heard = np.zeros(length)
        full = oaconvolve(sound.astype(np.float64), self._responses[room])[:length]
        heard[: len(full)] = full
        fade = FRAME_SAMPLES
        heard[-fade:] *= np.linspace(1.0, 0.0, fade)
        return heard.astype(np.float32)

    def _response(self, room: str) -> Float64:
        """Make the impulse response from a room to the microphone: the sound, and its echoes."""
        place = (*ROOMS, OUTSIDE).index(room)
        rng = generator(self._seed, 3, place, ROOMS.index(self._microphone))
        seconds = max(_REVERBERATION[room], _REVERBERATION[self._microphone])
        time = np.arange(int(min(seconds, 0.45) * SAMPLE_RATE)) / SAMPLE_RATE
        response = rng.standard_normal(len(time)) * 10.0 ** (-3.0 * time / seconds)
        response[:_DIRECT_SAMPLES] = 0.0
        direct = _DIRECT_DB[room == self._microphone]
        response *= 10.0 ** (-direct / 20.0) / np.sqrt(np.square(response).sum())
        response[0] = 1.0
        response /= np.sqrt(np.square(response).sum())
        lost = attenuation(room, self._microphone)
        return _dulled(response, lost) * 10.0 ** (-lost / 20.0)

    def _heard_steadily(self, name: str, rng: np.random.Generator) -> Float32:
        room, level = _STEADY[name]
        lost = attenuation(room, self._microphone)
        hum = 0.7 if name == FRIDGE else 0.0
        slope = rng.uniform(0.8, 1.0) if name == STREET else rng.uniform(0.3, 0.7)
        return _noise(rng, level - lost, slope, hum, lambda sound: _low_passed(sound, lost))


def _dulled(sound: Float64, lost: float) -> Float64:
    """Take the high frequencies, which walls take first."""
    pole = _pole(lost)
    dulled: Float64 = lfilter([1.0 - pole], [1.0, -pole], sound)
    return dulled


def _low_passed(spectrum: Float64, lost: float) -> Float64:
    """Do the same to the spectrum of a noise that repeats itself."""
    pole = _pole(lost)
    turn = np.exp(-1j * np.pi * np.linspace(0.0, 1.0, len(spectrum)))
    passed: Float64 = spectrum * np.abs((1.0 - pole) / (1.0 - pole * turn))
    return passed


def _pole(lost: float) -> float:
    if lost == 0.0:
        return 0.0
    corner = SAMPLE_RATE / 2.0 * 2.0 ** (-lost / _DULLING_DB)
    return float(np.exp(-2.0 * np.pi * corner / SAMPLE_RATE))


def _noise(
    rng: np.random.Generator,
    level: float,
    slope: float,
    hum: float = 0.0,
    passed: Callable[[Float64], Float64] = np.asarray,
) -> Float32:
    """Make noise of so many dBFS, whose end its beginning follows.

    Its amplitude falls with the frequency to the power of `slope`; `hum` is the share of its power
    that is mains hum.
    """
    count = PERIOD_FRAMES * FRAME_SAMPLES
    frequency = np.maximum(np.fft.rfftfreq(count, 1.0 / SAMPLE_RATE), _LOWEST_HERTZ)
    amplitude = passed(frequency**-slope)
    amplitude /= np.sqrt(np.square(amplitude).sum())
    spectrum = amplitude * np.exp(2j * np.pi * rng.random(len(frequency)))
    spectrum *= np.sqrt(1.0 - hum)
    if hum:
        step = round(_HUM_HERTZ * count / SAMPLE_RATE)
        harmonics = 1.0 / np.arange(1, _HUM_HARMONICS + 1)
        harmonics *= np.sqrt(hum / np.square(harmonics).sum())
        spectrum[step : step * (_HUM_HARMONICS + 1) : step] += harmonics
    noise = np.fft.irfft(spectrum, count) * (count / np.sqrt(2.0) * 10.0 ** (level / 20.0))
    return noise.astype(np.float32).reshape(PERIOD_FRAMES, FRAME_SAMPLES)
