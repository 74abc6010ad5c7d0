"""The sound of a plan, block by block, and its features without most of that sound."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import grey_closing

from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int16
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.tools.home.clips import ArrayCache, ClipLibrary, frame_powers
from hearthlog.tools.home.plan import STEADY_FRAMES, Plan, PlannedSound
from hearthlog.tools.home.rooms import PERIOD_FRAMES, TAIL_FRAMES, Rooms

_CACHE_BYTES = 96 << 20
_MAX_PEAK = 0.9
_PAUSE_FRAMES = 11  # shorter pauses of a sound belong to it
_FRAMES_AT_ONCE = 384
_TINY = 1e-9


class HeardSound(NamedTuple):
    """A planned sound as loud as the microphone hears it.

    Attributes
    ----------
    power : np.ndarray [shape=(n,)], float64
        Mean square in each frame from its start on, pauses filled up.
    """

    plan: PlannedSound
    power: Float64


class Composition:
    """What a microphone hears of a plan."""

    def __init__(self, plan: Plan, library: ClipLibrary, rooms: Rooms) -> None:
        self.plan = plan
        self._library = library
        self._rooms = rooms
        self._starts = np.array([sound.start for sound in plan.sounds], np.int64)
        longest = max((sound.frames for sound in plan.sounds), default=0)
        self._reach = longest + TAIL_FRAMES
        self._heard = ArrayCache(_CACHE_BYTES)
        self._powers = ArrayCache(_CACHE_BYTES)
        self._steady_powers = {
            name: float(frame_powers(noise).mean())
            for name, noise in [("", rooms.floor), *rooms.steady.items()]
        }

    def samples(self, first: int, count: int) -> Int16:
        """Compose frames.

        Returns
        -------
        np.ndarray [shape=(count, FRAME_SAMPLES)], int16
            The same samples in blocks of any size.
        """
        mix = self._background(first, count)
        for sound in self._sounds(first, first + count):
            begin, end = max(sound.start, first), min(_heard_until(sound), first + count)
            heard = self._wet(sound)[begin - sound.start : end - sound.start]
            mix[begin - first : end - first] += heard * np.float32(self._gain(sound))
        return _quantised(mix)

    def features(self, features: FeatureSet) -> "FeatureStream":
        """Begin a stream of the features of the composed sound."""
        return FeatureStream(self, features)

    def heard(self, first: int, count: int) -> Iterator[HeardSound]:
        """Yield the sounds that begin in some frames, as loud as they are heard."""
        places = np.searchsorted(self._starts, (first, first + count))
        for sound in self.plan.sounds[places[0] : places[1]]:
            yield HeardSound(sound, np.float64(self._gain(sound) ** 2) * self._loudness(sound)[0])

    def floor_power(self, first: int, count: int) -> Float64:
        """Return the mean square of what is steady.

        Returns
        -------
        np.ndarray [shape=(count,)], float64
        """
        power = np.full(count, self._steady_powers[""])
        for name, gains in self._gains(first, count).items():
            power += self._steady_powers[name] * gains[1:] ** 2
        return power

    def busy(self, first: int, count: int) -> Bool:
        """Tell which frames hold more than noise that repeats itself.

        Returns
        -------
        np.ndarray [shape=(count,)], bool
        """
        busy = np.zeros(count, bool)
        for sound in self._sounds(first, first + count):
            busy[max(sound.start - first, 0) : max(_heard_until(sound) - first, 0)] = True
        for gains in self._gains(first, count).values():
            busy |= (gains[:-1] != gains[1:]) | ~np.isin(gains[1:], (0.0, 1.0))
        return busy

    def state(self, frame: int) -> tuple[str, ...]:
        """Return the names of the steady noises that are on in a frame."""
        return tuple(name for name, gains in self._gains(frame, 1).items() if gains[1] > 0.0)

    def steady(self, state: tuple[str, ...]) -> Int16:
        """Compose a period of steady noise alone.

        Returns
        -------
        np.ndarray [shape=(PERIOD_FRAMES, FRAME_SAMPLES)], int16
        """
        mix = self._rooms.floor.copy()
        for name in state:
            mix += self._rooms.steady[name]
        return _quantised(mix)

    def _background(self, first: int, count: int) -> Float32:
        phase = np.arange(first, first + count) % PERIOD_FRAMES
        mix = self._rooms.floor[phase]
        within = np.arange(1, FRAME_SAMPLES + 1, dtype=np.float32) / FRAME_SAMPLES
        for name, gains in self._gains(first, count).items():
            if not gains.any():
                continue
            noise = self._rooms.steady[name][phase]
            if not (gains == 1.0).all():
                steps = np.diff(gains)[:, np.newaxis].astype(np.float32)
                noise *= gains[:-1, np.newaxis].astype(np.float32) + steps * within
            mix += noise
        return mix

    def _gains(self, first: int, count: int) -> dict[str, Float64]:
        """Return the gain of each steady noise at the edges of frames, in a fixed order."""
        edges = np.arange(first, first + count + 1)
        gains = {name: np.zeros(count + 1) for name in self._rooms.steady}
        for noise in self.plan.steady:
            if noise.start < first + count and noise.end > first:
                rising = np.minimum(edges - noise.start, noise.end - edges) / STEADY_FRAMES
                gains[noise.name] += np.clip(rising, 0.0, 1.0)
        return gains

    def _sounds(self, first: int, end: int) -> list[PlannedSound]:
        """Find the sounds that are heard in some frames, in the order of the plan."""
        places = np.searchsorted(self._starts, (first - self._reach, end))
        near = self.plan.sounds[places[0] : places[1]]
        return [sound for sound in near if _heard_until(sound) > first]

    def _wet(self, sound: PlannedSound) -> Float32:
        """Return a sound as it is heard, shape (frames, FRAME_SAMPLES), for a level of 0 dBFS."""

        def make() -> Float32:
            dry = self._library.sound(sound.clip, sound.frames)
            return self._rooms.heard(dry, sound.room).reshape(-1, FRAME_SAMPLES)

        return self._heard((sound.clip.name, sound.frames, sound.room), make)

    def _loudness(self, sound: PlannedSound) -> tuple[Float32, float]:
        """Return the mean square of each frame, and the highest sample, for 0 dBFS."""

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


class FeatureStream:
    """The features of a composition, in the order of the frames.

    Where a frame and the one before hold only steady noise, they are looked up: that noise repeats
    itself, and so do its features. Elsewhere the frames are composed and their features computed.

    Parameters
    ----------
    features : FeatureSet
        The features of a frame must depend on it and the frame before alone.
    """

    def __init__(self, composition: Composition, features: FeatureSet) -> None:
        self._composition = composition
        self._features = features
        self._extractor = features.extractor()
        self._tables: dict[tuple[str, ...], Float32] = {}

    def __call__(self, first: int, count: int) -> Float32:
        """Return the features of frames: the same bits as those of their samples.

        Returns
        -------
        np.ndarray [shape=(count, d)], float32
        """
        before = 1 if first else 0
        busy = self._composition.busy(first - before, count + before)
        computed = busy[before:].copy()
        computed |= busy[:-1] if before else np.concatenate([[True], busy[:-1]])
        values = np.empty((count, self._features.width), np.float32)
        for begin, end in _runs(computed):
            values[begin:end] = self._compute(first + begin, first + end)
        for begin, end in _runs(~computed):
            table = self._table(self._composition.state(first + begin))
            values[begin:end] = table[np.arange(first + begin, first + end) % PERIOD_FRAMES]
        return values

    def _compute(self, begin: int, end: int) -> Float32:
        self._extractor.restart()
        blocks = []
        before = 1 if begin else 0
        for start in range(begin - before, end, _FRAMES_AT_ONCE):
            count = min(_FRAMES_AT_ONCE, end - start)
            blocks.append(self._extractor(full_scale(self._composition.samples(start, count))))
        return np.concatenate(blocks)[before:]

    def _table(self, state: tuple[str, ...]) -> Float32:
        """Return the features of steady noise, each frame behind the one before in its period."""
        if state not in self._tables:
            noise = full_scale(self._composition.steady(state))
            extractor = self._features.extractor()
            extractor(noise[-1:])
            self._tables[state] = extractor(noise)
        return self._tables[state]


def _heard_until(sound: PlannedSound) -> int:
    return sound.end + TAIL_FRAMES


def _quantised(mix: Float32) -> Int16:
    return np.clip(np.rint(mix * 32768.0), -32768, 32767).astype(np.int16)


def full_scale(samples: Int16) -> Float32:
    """Return samples as those of an audio file are read.

    Parameters
    ----------
    samples : np.ndarray, int16
    """
    return samples.astype(np.float32) / np.float32(32768.0)


def _runs(flags: Bool) -> list[tuple[int, int]]:
    """Return where runs of true values begin and end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.view(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
