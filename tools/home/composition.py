"""The sound of a plan in the rooms of a home, block by block, and its features."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy.ndimage import grey_closing
from scipy.signal import lfilter, oaconvolve

from hearthlog.schemas.arrays import Float32, Float64, Int16
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.home.clips import ArrayCache, ClipLibrary, frame_powers
from hearthlog.tools.home.routine import (
    BATHROOM,
    BEDROOM,
    FAN,
    FRIDGE,
    KITCHEN,
    LIVING_ROOM,
    OUTSIDE,
    ROOMS,
    STEADY_FRAMES,
    STREET,
    HomePlan,
    PlannedSound,
)
from hearthlog.tools.home.sounds import SimulationError, generator

PERIOD_FRAMES = 2400  # period of steady noise
TAIL_FRAMES = 8  # frames of reverberation after a sound

_WALLS = {  # attenuation in dB, doors ajar
    frozenset({LIVING_ROOM, KITCHEN}): 10.0,
    frozenset({LIVING_ROOM, BEDROOM}): 16.0,
    frozenset({LIVING_ROOM, BATHROOM}): 20.0,
    frozenset({KITCHEN, BEDROOM}): 22.0,
    frozenset({KITCHEN, BATHROOM}): 20.0,
    frozenset({BEDROOM, BATHROOM}): 14.0,
}
_WINDOW = 24.0
_DULLING_DB = 9.0  # dB of attenuation that remove an octave at the top
_FLOOR_DBFS = {LIVING_ROOM: -64.0, KITCHEN: -60.0, BATHROOM: -62.0, BEDROOM: -67.0}
_FLOOR_SPREAD_DB = 3.0
_REVERBERATION = {LIVING_ROOM: 0.35, KITCHEN: 0.4, BATHROOM: 0.55, BEDROOM: 0.25, OUTSIDE: 0.2}
_DIRECT_DB = {True: 8.0, False: 0.0}  # dB over the reverberation, in the same room or not
_DIRECT_SAMPLES = 48
_STEADY = {FRIDGE: (KITCHEN, -50.0), FAN: (BATHROOM, -42.0), STREET: (OUTSIDE, -42.0)}
_HUM_HERTZ, _HUM_HARMONICS = 50.0, 8
_LOWEST_HERTZ = 20.0


def attenuation(room: str, microphone: str) -> float:
    """Return the attenuation in dB from a room to the microphone's room."""
    if room == microphone:
        return 0.0
    return _WALLS.get(frozenset({room, microphone}), _WINDOW)


class Rooms:
    """The acoustics of a home from the position of a microphone.

    `floor` [shape=(PERIOD_FRAMES, FRAME_SAMPLES)] is periodic noise of the room. Raise
    `SimulationError` if there is no such room.
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
            name: self._steadily_audible(name, rng) for name in _STEADY
        }
        self._responses: dict[str, Float64] = {}

    def received(self, sound: Float32, room: str) -> Float32:
        """Return a sound of a room as received by the microphone, with a tail.

        Sound [shape=(n * FRAME_SAMPLES,)], result [shape=((n + TAIL_FRAMES) * FRAME_SAMPLES,)].
        """
        if room not in self._responses:
            self._responses[room] = self._response(room)
        length = len(sound) + TAIL_FRAMES * FRAME_SAMPLES
        wet = np.zeros(length)
        full = oaconvolve(sound.astype(np.float64), self._responses[room])[:length]
        wet[: len(full)] = full
        fade = FRAME_SAMPLES
        wet[-fade:] *= np.linspace(1.0, 0.0, fade)
        return wet.astype(np.float32)

    def _response(self, room: str) -> Float64:
        """Make the impulse response from a room to the microphone: direct sound and echoes."""
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
        pole = _pole(lost)  # walls attenuate high frequencies
        return lfilter([1.0 - pole], [1.0, -pole], response) * 10.0 ** (-lost / 20.0)

    def _steadily_audible(self, name: str, rng: np.random.Generator) -> Float32:
        room, level = _STEADY[name]
        lost = attenuation(room, self._microphone)
        hum = 0.7 if name == FRIDGE else 0.0
        slope = rng.uniform(0.8, 1.0) if name == STREET else rng.uniform(0.3, 0.7)
        return _noise(rng, level - lost, slope, hum, lambda sound: _low_passed(sound, lost))


def _low_passed(spectrum: Float64, lost: float) -> Float64:
    """Attenuate high frequencies in the spectrum of periodic noise."""
    pole = _pole(lost)
    turn = np.exp(-1j * np.pi * np.linspace(0.0, 1.0, len(spectrum)))
    return spectrum * np.abs((1.0 - pole) / (1.0 - pole * turn))


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
    """Make periodic noise of a level in dBFS.

    Its amplitude falls with the frequency to the power of `slope`; `hum` is the share of mains hum
    in its power.
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


_CACHE_BYTES = 96 << 20
_MAX_PEAK = 0.9
_PAUSE_FRAMES = 11  # shorter pauses belong to the sound
_TINY = 1e-9


class AudibleSound(NamedTuple):
    """A planned sound at the level received by the microphone."""

    plan: PlannedSound
    power: Float64  # [shape=(n,)] mean square of each frame from its start on, with pauses filled


class Composition:
    """The sound of a plan as received by a microphone."""

    def __init__(self, plan: HomePlan, library: ClipLibrary, rooms: Rooms) -> None:
        self.plan = plan
        self._library = library
        self.rooms = rooms
        self._starts = np.array([sound.start for sound in plan.sounds], np.int64)
        longest = max((sound.frames for sound in plan.sounds), default=0)
        self._reach = longest + TAIL_FRAMES
        self._cache = ArrayCache(_CACHE_BYTES)
        self._powers = ArrayCache(_CACHE_BYTES)
        self._steady_powers = {
            name: float(frame_powers(noise).mean())
            for name, noise in [("", rooms.floor), *rooms.steady.items()]
        }

    def samples(self, first: int, count: int) -> Int16:
        """Compose frames [shape=(count, FRAME_SAMPLES)], the same in blocks of any size."""
        mix = self._background(first, count)
        for sound in self.sounds(first, first + count):
            begin, end = max(sound.start, first), min(audible_until(sound), first + count)
            wet = self._wet(sound)[begin - sound.start : end - sound.start]
            mix[begin - first : end - first] += wet * np.float32(self._gain(sound))
        return quantised(mix)

    def audible(self, first: int, count: int) -> Iterator[AudibleSound]:
        """Yield the sounds that begin in some frames, at their received level."""
        places = np.searchsorted(self._starts, (first, first + count))
        for sound in self.plan.sounds[places[0] : places[1]]:
            yield AudibleSound(sound, np.float64(self._gain(sound) ** 2) * self._loudness(sound)[0])

    def floor_power(self, first: int, count: int) -> Float64:
        """Return the mean square of the steady noise [shape=(count,)]."""
        power = np.full(count, self._steady_powers[""])
        for name, gains in self.gains(first, count).items():
            power += self._steady_powers[name] * gains[1:] ** 2
        return power

    def _background(self, first: int, count: int) -> Float32:
        phase = np.arange(first, first + count) % PERIOD_FRAMES
        mix = self.rooms.floor[phase]
        within = np.arange(1, FRAME_SAMPLES + 1, dtype=np.float32) / FRAME_SAMPLES
        for name, gains in self.gains(first, count).items():
            if not gains.any():
                continue
            noise = self.rooms.steady[name][phase]
            if not (gains == 1.0).all():
                steps = np.diff(gains)[:, np.newaxis].astype(np.float32)
                noise *= gains[:-1, np.newaxis].astype(np.float32) + steps * within
            mix += noise
        return mix

    def gains(self, first: int, count: int) -> dict[str, Float64]:
        """Return the gain of each steady noise at the edges of frames, in a fixed order."""
        edges = np.arange(first, first + count + 1)
        gains = {name: np.zeros(count + 1) for name in self.rooms.steady}
        for noise in self.plan.steady:
            if noise.start < first + count and noise.end > first:
                rising = np.minimum(edges - noise.start, noise.end - edges) / STEADY_FRAMES
                gains[noise.name] += np.clip(rising, 0.0, 1.0)
        return gains

    def sounds(self, first: int, end: int) -> list[PlannedSound]:
        """Find the audible sounds in some frames, in the order of the plan."""
        places = np.searchsorted(self._starts, (first - self._reach, end))
        near = self.plan.sounds[places[0] : places[1]]
        return [sound for sound in near if audible_until(sound) > first]

    def _wet(self, sound: PlannedSound) -> Float32:
        """Return a sound as received, shape (frames, FRAME_SAMPLES), for a level of 0 dBFS."""

        def make() -> Float32:
            dry = self._library.sound(sound.clip, sound.frames)
            return self.rooms.received(dry, sound.room).reshape(-1, FRAME_SAMPLES)

        return self._cache((sound.clip.name, sound.frames, sound.room), make)

    def _loudness(self, sound: PlannedSound) -> tuple[Float32, float]:
        """Return the mean square of each frame and the highest sample, for a level of 0 dBFS."""

        def make() -> Float32:
            wet = self._wet(sound)
            around = np.pad(frame_powers(wet), _PAUSE_FRAMES)  # closing erodes at the edges
            power = grey_closing(around, _PAUSE_FRAMES)[_PAUSE_FRAMES:-_PAUSE_FRAMES]
            return np.append(power, np.abs(wet).max()).astype(np.float32)

        made = self._powers((sound.clip.name, sound.frames, sound.room), make)
        return made[:-1], float(made[-1])

    def _gain(self, sound: PlannedSound) -> float:
        _, peak = self._loudness(sound)
        return float(min(10.0 ** (sound.level / 20.0), _MAX_PEAK / max(peak, _TINY)))


def audible_until(sound: PlannedSound) -> int:
    """Return the frame after the reverberation of a sound."""
    return sound.end + TAIL_FRAMES


def quantised(mix: Float32) -> Int16:
    """Convert samples in full scale to integers."""
    return np.clip(np.rint(mix * 32768.0), -32768, 32767).astype(np.int16)
