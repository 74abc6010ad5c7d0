"""Windows of clips as a network hears them, to learn heads from.

A home gives windows that a sound fills in part, short sounds, and other rooms; so do these.
"""

import hashlib
import warnings
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from hearthlog.analyzer.training.rooms import other_room, steady_noise
from hearthlog.models.classifiers.model import Model
from hearthlog.models.embedding.networks import find_network, load_embedder
from hearthlog.models.embedding.projection import WINDOW_FRAMES, Int8
from hearthlog.models.embedding.stream import SteadyNoise
from hearthlog.models.errors import ModelError
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.schemas.messages.topics import EmbeddingSource

AS_IT_IS, IN_A_ROOM, SHORT = 0, 1, 2  # versions of windows

_WINDOW = WINDOW_FRAMES * FRAME_SAMPLES
_HALF = _WINDOW // 2
_HOP, _HOP_IN_ROOM = 4000, 8000  # samples: windows in a room cost as much, and teach less
_FILLED = 0.5  # of a window, by a clip that is long enough
_FILLED_BY_SHORT = 0.45  # of a clip that is shorter
_NOISE_DBFS = -75.0  # where a clip is silent, no room is
_MOST = 32  # windows of a version of a clip, evenly spaced
_MIDDLE = 2000  # samples on either side of the middle of a window
_BELOW_CLIP = 10 ** (-12 / 10)  # 12 dB, that the middle of a window may be
_SHORT_SECONDS = (0.3, 0.3, 0.6, 0.6)
SHORT_PARTS = len(_SHORT_SECONDS)  # of a clip
_SHORT_NOISE_DBFS = (-80.0, -60.0)
_SHORT_PLACE = (0.1, 0.9)  # of the window, in which a short part lies
_FAINTER_DB = (-20.0, 0.0)  # every other short part
_NEAR, _FAR = 5, 1 << 60  # frames
_SEED = 20_261_126


class Embeds(Protocol):
    """Embeds a window of 20 frames, as `Embedder` does: the integers that are logged."""

    def __call__(self, window: Float32) -> Int8:
        """Compute the integers of a window."""


class ClipEmbeddings(NamedTuple):
    """Windows of a clip.

    Attributes
    ----------
    values : np.ndarray [shape=(m, W)], int8
        As they are logged.
    version : np.ndarray [shape=(m,)], intp
        `AS_IT_IS`, `IN_A_ROOM` or `SHORT`.
    taught : np.ndarray [shape=(m,)], bool
        Whether heads learn from the window; the others are where the sound is faint.
    starts : np.ndarray [shape=(m,)], intp
        Frames of the clip at which windows as it is begin; below 0 before it. 0 of other versions.
    """

    values: Int8
    version: Indices
    taught: Bool
    starts: Indices

    def at(self, start: int) -> Int8:
        """Return the window nearest to one that begins at a frame, at most five frames from it.

        Returns
        -------
        np.ndarray [shape=(1 or 0, W)], int8
            None if there is none so near.
        """
        away = np.where(self.version == AS_IT_IS, np.abs(self.starts - start), _FAR)
        nearest = int(away.argmin()) if len(away) else 0
        return self.values[nearest : nearest + int(len(away) > 0 and away[nearest] <= _NEAR)]

    def part(self, rows: slice) -> "ClipEmbeddings":
        """Return some of the windows."""
        return ClipEmbeddings(
            self.values[rows], self.version[rows], self.taught[rows], self.starts[rows]
        )


class ClipEmbedder:
    """Embeds the windows of clips, those of each clip once."""

    def __init__(self, embed: Embeds, seed: int = 0) -> None:
        self._embed, self._seed = embed, seed
        self.source: EmbeddingSource | None = getattr(embed, "source", None)
        self._done: dict[bytes, ClipEmbeddings] = {}

    def __call__(self, frames: Float32, segments: Indices, *, silence: bool) -> ClipEmbeddings:
        """Embed the windows of a clip, as of `clip_embeddings`."""
        digest = hashlib.sha256(np.ascontiguousarray(frames).tobytes())
        digest.update(segments.astype("<i8").tobytes() + bytes([silence]))
        key = digest.digest()
        if key not in self._done:
            self._done[key] = clip_embeddings(
                frames, self._embed, segments, silence=silence, seed=self._seed
            )
        return self._done[key]


def clip_embeddings(
    frames: Float32, embed: Embeds, segments: Indices, *, silence: bool, seed: int = 0
) -> ClipEmbeddings:
    """Embed the windows of a clip; the same clip and seed give the same ones.

    Parameters
    ----------
    frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        At least one.
    segments : np.ndarray [shape=(k,)], intp
        Frames at which the segments of the clip begin, multiples of five: these windows are
        embedded in any case.
    silence : bool
        Whether nothing happens in the clip: then only its segments are embedded.
    """
    digest = hashlib.blake2b(np.ascontiguousarray(frames).tobytes(), digest_size=8).digest()
    rng = np.random.default_rng([_SEED + seed, int.from_bytes(digest, "little")])
    sound, parts = frames.ravel().astype(np.float64), []
    padded = _padded(sound, 10.0 ** (_NOISE_DBFS / 20.0) * rng.standard_normal(_room(sound)))
    taught = np.empty(0, np.intp) if silence else _taught(padded, len(sound), _HOP)
    middles = np.union1d(taught, segments * FRAME_SAMPLES + _HALF)
    parts.append(
        _embedded(padded, middles, embed, AS_IT_IS)._replace(
            taught=np.isin(middles, taught), starts=(middles - _HALF) // FRAME_SAMPLES
        )
    )
    if not silence:
        echoing, level = other_room(frames, rng, silence=False)
        noise = steady_noise(_room(sound), level, rng)
        of_room = _noise_of(noise)
        padded = _padded(echoing, noise)
        padded = np.clip(np.rint(padded * 32767.0), -32768, 32767) / 32768.0
        middles = _taught(padded, len(sound), _HOP_IN_ROOM)
        in_room = _embedded(
            padded, middles, lambda window: embed(of_room.reduced(window)), IN_A_ROOM
        )
        parts.append(in_room)
        shorts = [embed(window) for window in _short_parts(sound, rng)]
        count = len(shorts)
        parts.append(
            ClipEmbeddings(
                np.stack(shorts),
                np.full(count, SHORT),
                np.ones(count, bool),
                np.zeros(count, np.intp),
            )
        )
    return ClipEmbeddings(*map(np.concatenate, zip(*parts, strict=True)))


def _room(sound: Float64) -> int:
    """Return the samples of a sound with half a window before and behind it."""
    return len(sound) + 2 * _HALF


def _padded(sound: Float64, noise: Float64) -> Float64:
    noise[_HALF : _HALF + len(sound)] += sound
    return noise


def _taught(padded: Float64, count: int, hop: int) -> Indices:
    """Return the middles of the windows to learn from, in samples of the clip.

    They are filled well enough, and not faint in their middle.
    """
    middles = np.arange(0, count + 1, hop)
    filled = np.minimum(middles + _HALF, count) - np.maximum(middles - _HALF, 0)
    enough = min(_FILLED * _WINDOW, _FILLED_BY_SHORT * count)
    power = np.concatenate([[0.0], np.cumsum(np.square(padded))])
    middle = power[middles + _HALF + _MIDDLE] - power[middles + _HALF - _MIDDLE]
    chosen = middles[(filled >= enough) & (middle > _BELOW_CLIP * middle.mean())]
    kept = np.linspace(0, len(chosen) - 1, min(len(chosen), _MOST)).round().astype(np.intp)
    return chosen[kept]


def _embedded(padded: Float64, middles: Indices, embed: Embeds, version: int) -> ClipEmbeddings:
    windows = [_window(padded[middle : middle + _WINDOW]) for middle in middles.tolist()]
    values, count = [embed(window) for window in windows], len(middles)
    if not values:  # as wide as any
        return _embedded(padded, np.zeros(1, np.intp), embed, version).part(slice(0))
    return ClipEmbeddings(
        np.stack(values),
        np.full(count, version),
        np.ones(count, bool),
        np.zeros(count, np.intp),
    )


def _window(samples: Float64) -> Float32:
    window = np.zeros(_WINDOW, np.float32)
    window[: len(samples)] = samples
    return window.reshape(WINDOW_FRAMES, FRAME_SAMPLES)


def _short_parts(sound: Float64, rng: np.random.Generator) -> Iterator[Float32]:
    """Yield windows of faint noise with a short part of a sound somewhere, the loudest one."""
    power = np.concatenate([[0.0], np.cumsum(np.square(sound))])
    for number, seconds in enumerate(_SHORT_SECONDS):
        length = min(int(seconds * SAMPLE_RATE), len(sound))
        loudest = int(np.argmax(power[length:] - power[:-length]))
        part = sound[loudest : loudest + length] * np.hanning(length) ** 0.1  # no clicks
        if number % 2:
            part *= 10.0 ** (rng.uniform(*_FAINTER_DB) / 20.0)
        level = rng.uniform(*_SHORT_NOISE_DBFS)
        window = 10.0 ** (level / 20.0) * rng.standard_normal(_WINDOW)
        of_room = _noise_of(window)
        first, last = _SHORT_PLACE[0] * _WINDOW, _SHORT_PLACE[1] * _WINDOW - length
        place = int(rng.uniform(first, last))
        window[place : place + length] += part
        yield of_room.reduced(_window(window))


def _noise_of(samples: Float64) -> SteadyNoise:
    """Return the noise of a room in which there is nothing else, as it is learned there."""
    noise = SteadyNoise()
    for first in range(0, len(samples) - _WINDOW + 1, _WINDOW):
        noise.learn(_window(samples[first : first + _WINDOW]))
    return noise


def model_embedder(model: Model) -> ClipEmbedder | None:
    """Return what hears clips for the heads of a model; None if it has none.

    Without its network, or with another projection, a `HearthlogWarning` says that the model is
    tried without it.

    Parameters
    ----------
    model : Model
    """
    mix = model.description.embedding
    if mix is None:
        return None
    try:
        embedder = network_embedder(mix.network)
        source = embedder.source
        if source is not None and source.space == mix.space:
            return embedder
        why = f"it was learned with another projection of the network {mix.network}"
    except ModelError as error:
        why = str(error)
    name = model.name or model.description.scenario_name
    text = f"a model is tried by the features alone: {why}"
    warnings.warn(HearthlogWarning(text, f"model {name}"), stacklevel=2)
    return None


@lru_cache(maxsize=2)
def network_embedder(network: str, seed: int = 0) -> ClipEmbedder:
    """Return what hears clips by a network.

    Raise `ModelError` if it is not known, not there, another file, or cannot be used.
    """
    path = find_network(network)
    if path is None:
        raise ModelError(
            f"the network {network} is not here; fetch it: hearthlog models fetch {network}"
        )
    return ClipEmbedder(load_embedder(network, path), seed)
