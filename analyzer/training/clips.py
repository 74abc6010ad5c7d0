"""Sound of labelled clips: decoding, room and microphone augmentation, embeddings."""

import hashlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.models.classifiers.model import Model
from hearthlog.models.embedding import WINDOW_FRAMES, Int8
from hearthlog.models.embedding.networks import SteadyNoise, find_network, load_embedder
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.floor import low_power
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.framing import FrameCutter
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices
from hearthlog.schemas.errors import HearthlogWarning, ModelError, SourceError
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS, SAMPLE_RATE
from hearthlog.schemas.messages.topics import EmbeddingSource

NO_NUMBERS = "samples are not finite (NaN or infinity)"
MOST_SECONDS = 3600.0  # of a clip, which is held in memory


class ClipSound(NamedTuple):
    """Complete frames of a clip at 16 kHz, as a recorder processes them, if finite."""

    # [shape=(n, FRAME_SAMPLES)]; without an incomplete frame at the end of the file
    frames: Float32
    breaks: Sequence[int] = ()
    lost: int = 0


def clip_frames(clip: LabelledClip) -> Float32:
    """Read the frames of a clip; see `read_clip`."""
    return read_clip(clip).frames


def read_clip(clip: LabelledClip) -> ClipSound:
    """Read a clip.

    Raise `SourceError` if the clip cannot be read completely, is longer than an hour, or has no
    finite sample.
    """
    cutter = FrameCutter()
    faults: list[str] = []
    blocks: list[Float32] = []
    left = round(MOST_SECONDS / FRAME_SECONDS)
    for block in read_audio(clip.path, clip.start, clip.end, incomplete=faults.append):
        blocks.append(cutter.push(block))
        left -= len(blocks[-1])
        if left < 0:
            raise SourceError(
                f"{clip.path}: is longer than an hour; give it a start and an end in the manifest"
            )
    if faults:
        raise SourceError(faults[0])
    frames = np.concatenate([np.empty((0, FRAME_SAMPLES), np.float32), *blocks])
    is_finite = np.isfinite(frames).all(axis=1)
    if is_finite.all():
        return ClipSound(InfrasoundFilter()(frames))
    if not is_finite.any():
        raise SourceError(f"{clip.path}: {NO_NUMBERS}")
    runs = np.split(np.arange(len(frames)), np.flatnonzero(np.diff(is_finite)) + 1)
    sounds = [InfrasoundFilter()(frames[run]) for run in runs if is_finite[run[0]]]
    breaks = np.cumsum([len(sound) for sound in sounds])[:-1]
    return ClipSound(np.concatenate(sounds), breaks.tolist(), int((~is_finite).sum()))


_COPIED_SHARE = 0.5  # of the copies have reverberation; as many have another microphone
_REVERBERATION_SECONDS = (0.1, 0.6)  # RT60
_DIRECT_DB = (-6.0, 12.0)  # direct sound above the reverberation
_DIRECT_SAMPLES = 48  # 3 ms without an echo
_TILT_SHARE, _TILT = 0.6, (-3.0, 3.0)  # dB an octave
_BUMPS, _BUMP_DB, _BUMP_OCTAVES, _BUMP_WIDTH = 3, (-6.0, 6.0), (-4.0, 3.0), (0.3, 1.0)
_LIMITS_SHARE, _LOW_HERTZ, _HIGH_HERTZ = 0.5, (50.0, 300.0), (3000.0, 8000.0)
_LIMITS_ORDER = 4  # of a Butterworth filter
_SETTLING = 4000  # samples
_GAIN_DB = (-20.0, 20.0)
_SIGNAL_TO_NOISE_DB = (5.0, 30.0)
_SILENCE_DBFS = (-85.0, -40.0)  # noise in a silent room
_ROOM_NOISE_DBFS = (-100.0, -30.0)  # limits of all noise
_STEADY_DBFS = (-85.0, -32.0)
_SLOPES = (0.0, 0.25, 0.5, 0.75, 1.0)  # amplitude falls with the frequency to this power
_LOWEST_HERTZ = 20.0
_FLOOR_ERROR_DB = 1.5  # of a tracked floor, in each band
_STEADY_SECONDS = 5


class RoomCopy(NamedTuple):
    """Features of a sound in a room."""

    features: Float32  # [shape=(n, d)]
    floor: Float64  # [shape=(b,)], as the tracker estimates it: band powers of the feature set


def in_room(
    frames: Float32, features: FeatureSet, rng: np.random.Generator, *, silence: bool
) -> RoomCopy:
    """Compute the features of frames in a random room with steady noise and microphone.

    There is at least one frame [shape=(n, FRAME_SAMPLES)].
    """
    sound, level = other_room(frames, rng, silence=silence)
    return in_noise(sound, level, features, rng, silence=silence)


def other_room(
    frames: Float32, rng: np.random.Generator, *, silence: bool
) -> tuple[Float64, float]:
    """Return frames in a random room [shape=(n * FRAME_SAMPLES,)], and the noise level in dBFS.

    There is at least one frame [shape=(n, FRAME_SAMPLES)]. Reverberation is exponentially decaying
    noise after the direct sound, as in Moorer, "About this reverberation business", 1979; a
    microphone has tilt, bumps and band limits.
    """
    sound = frames.ravel().astype(np.float64) * 10.0 ** (rng.uniform(*_GAIN_DB) / 20.0)
    if rng.random() < _COPIED_SHARE:
        seconds, direct = rng.uniform(*_REVERBERATION_SECONDS), rng.uniform(*_DIRECT_DB)
        sound = reverberated(sound, seconds, direct, rng)
    if rng.random() < _COPIED_SHARE:
        sound = filtered(sound, _microphone_response(rng))
    noise_level = level_of(sound) - rng.uniform(*_SIGNAL_TO_NOISE_DB)
    if silence:
        noise_level = rng.uniform(*_SILENCE_DBFS)
    return sound, float(np.clip(noise_level, *_ROOM_NOISE_DBFS))


def in_noise(
    sound: Float64, level: float, features: FeatureSet, rng: np.random.Generator, *, silence: bool
) -> RoomCopy:
    """Compute the features of a sound [shape=(n,)] in steady noise of a level in dBFS.

    The sound has complete frames at 16 kHz, at least one.
    """
    noise = steady_noise(len(sound), level, rng)
    copy = captured(sound + noise, features)
    assert features.band_powers is not None
    if silence:
        floor = low_power(features.band_powers(copy))
    else:
        floor = features.band_powers(captured(noise, features)).mean(axis=0)
    return RoomCopy(copy, floor * _floor_error(len(floor), rng))


def level_of(sound: Float64) -> float:
    """Return the mean level of a sound [shape=(n,)] in dBFS, at least -120."""
    return float(10.0 * np.log10(np.mean(np.square(sound, dtype=np.float64)) + 1e-12))


def empty_room(features: FeatureSet, rng: np.random.Generator) -> RoomCopy:
    """Compute the features of some seconds of steady noise."""
    level = rng.uniform(*_STEADY_DBFS)
    noise = steady_noise(_STEADY_SECONDS * SAMPLE_RATE, level, rng)
    copy = captured(noise, features)
    assert features.band_powers is not None
    floor = low_power(features.band_powers(copy), rng.uniform(0.05, 0.5))
    return RoomCopy(copy, floor * _floor_error(len(floor), rng))


def reverberated(
    sound: Float64, seconds: float, direct: float, rng: np.random.Generator
) -> Float64:
    """Add reverberation of `seconds` (RT60) to a sound [shape=(n,)] at 16 kHz; keep its power.

    `direct` is the level of the direct sound above the reverberation, in dB.
    """
    from scipy.signal import fftconvolve  # noqa: PLC0415  what reads a home needs no rooms

    time = np.arange(int(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    response = rng.standard_normal(len(time)) * 10.0 ** (-3.0 * time / seconds)
    response[:_DIRECT_SAMPLES] = 0.0
    response *= 10.0 ** (-direct / 20.0) / np.sqrt(np.square(response).sum())
    response[0] = 1.0
    return _of_power(fftconvolve(sound, response)[: len(sound)], sound)


def filtered(sound: Float64, response: Callable[[Float64], Float64]) -> Float64:
    """Apply a frequency response, hertz to dB, to a sound at 16 kHz; keep its power."""
    count = len(sound) + _SETTLING + len(sound) % 2
    frequencies = np.linspace(0.0, SAMPLE_RATE / 2, count // 2 + 1)
    gain = 10.0 ** (response(frequencies) / 20.0)
    return _of_power(np.fft.irfft(np.fft.rfft(sound, count) * gain, count)[: len(sound)], sound)


def band_limits(frequencies: Float64, low: float, high: float) -> Float64:
    """Return the response of a band-limited microphone in dB; -3 dB at the limits; all in hertz."""
    frequencies = np.maximum(frequencies, 1.0)
    order = 2 * _LIMITS_ORDER
    below, above = 1.0 + (low / frequencies) ** order, 1.0 + (frequencies / high) ** order
    return -10.0 * np.log10(below * above)


def octaves_of(frequencies: Float64) -> Float64:
    """Return the distance of frequencies in hertz (at least 30) from 1 kHz in octaves."""
    return np.log2(np.maximum(frequencies, 30.0) / 1000.0)


def _microphone_response(rng: np.random.Generator) -> Callable[[Float64], Float64]:
    """Draw a random microphone response."""
    tilt = rng.uniform(*_TILT) * (rng.random() < _TILT_SHARE)
    count = _BUMPS if rng.random() < _TILT_SHARE else 0
    bumps = [
        (rng.uniform(*_BUMP_DB), rng.uniform(*_BUMP_OCTAVES), rng.uniform(*_BUMP_WIDTH))
        for _ in range(count)
    ]
    limited = rng.random() < _LIMITS_SHARE
    low = float(np.exp(rng.uniform(*np.log(_LOW_HERTZ))))
    high = rng.uniform(*_HIGH_HERTZ)

    def response(frequencies: Float64) -> Float64:
        octaves = octaves_of(frequencies)
        decibels = tilt * octaves
        for height, place, width in bumps:
            decibels = decibels + height * np.exp(-0.5 * ((octaves - place) / width) ** 2)
        return decibels + band_limits(frequencies, low, high) if limited else decibels

    return response


def _of_power(changed: Float64, sound: Float64) -> Float64:
    """Scale a processed sound to the power of the original."""
    factor: float = np.sqrt(np.square(sound).mean() / (np.square(changed).mean() + 1e-20))
    return changed * factor


def steady_noise(count: int, level: float, rng: np.random.Generator) -> Float64:
    """Generate Gaussian noise of a level in dBFS whose spectrum falls by 0 to 6 dB per octave."""
    spectrum = np.fft.rfft(rng.standard_normal(count))
    frequencies = np.maximum(np.fft.rfftfreq(count, 1.0 / SAMPLE_RATE), _LOWEST_HERTZ)
    noise = np.fft.irfft(spectrum / frequencies ** rng.choice(_SLOPES), count)
    return noise * (10.0 ** (level / 20.0) / np.sqrt(np.mean(np.square(noise))))


def captured(sound: Float64, features: FeatureSet) -> Float32:
    """Compute the features of sound captured by a 16-bit microphone, which clips at full scale.

    The sound [shape=(n,)] has complete frames at 16 kHz; the features have shape (n /
    FRAME_SAMPLES, d).
    """
    samples = np.clip(np.rint(sound * 32767.0), -32768, 32767) / 32768.0
    return features.extractor()(samples.astype(np.float32).reshape(-1, FRAME_SAMPLES))


def _floor_error(bands: int, rng: np.random.Generator) -> Float64:
    return 10.0 ** (rng.normal(0.0, _FLOOR_ERROR_DB, bands) / 10.0)


AS_IT_IS, IN_A_ROOM, SHORT = 0, 1, 2  # versions of windows

_WINDOW = WINDOW_FRAMES * FRAME_SAMPLES
_HALF = _WINDOW // 2
_HOP, _HOP_IN_ROOM = 4000, 8000  # samples: windows in a room cost as much, but help training less
_FILLED = 0.5  # filled share of a window, for a clip that is long enough
_FILLED_BY_SHORT = 0.45  # filled share of a window, for a shorter clip
_PADDING_DBFS = -75.0  # digital silence does not occur in rooms
_MOST_WINDOWS = 32  # windows of a version of a clip, evenly spaced
_MIDDLE = 2000  # samples on either side of the middle of a window
_BELOW_CLIP = 10 ** (-12 / 10)  # 12 dB, limit for the centre of a window
_SHORT_SECONDS = (0.3, 0.3, 0.6, 0.6)
SHORT_PARTS = len(_SHORT_SECONDS)  # of a clip
_SHORT_NOISE_DBFS = (-80.0, -60.0)
_SHORT_PLACE = (0.1, 0.9)  # of the window: range for a short part
_FAINTER_DB = (-20.0, 0.0)  # every other short part
_NEAR, _FAR = 5, 1 << 60  # frames
_EMBEDDING_SEED = 20_261_126


class Embeds(Protocol):
    """Embeds a window of 20 frames into logged integers, as `Embedder` does."""

    def __call__(self, window: Float32) -> Int8:
        """Compute the integers of a window."""


class ClipEmbeddings(NamedTuple):
    """Embedded windows of a clip."""

    values: Int8  # [shape=(m, W)]; logged integers
    version: Indices  # [shape=(m,)]; `AS_IT_IS`, `IN_A_ROOM` or `SHORT`
    taught: Bool  # [shape=(m,)]; whether heads are trained on the window; others are faint
    # [shape=(m,)]; frame at which an unchanged window starts, may be negative; else 0
    starts: Indices

    def at(self, start: int) -> Int8:
        """Return the window nearest to a start frame [shape=(1, W)]; (0, W) if none within five."""
        away = np.where(self.version == AS_IT_IS, np.abs(self.starts - start), _FAR)
        nearest = int(away.argmin()) if len(away) else 0
        return self.values[nearest : nearest + int(len(away) > 0 and away[nearest] <= _NEAR)]

    def part(self, rows: slice) -> "ClipEmbeddings":
        """Return a subset of the windows."""
        return ClipEmbeddings._make(column[rows] for column in self)


class ClipEmbedder:
    """Embeds the windows of clips; each clip is embedded once."""

    def __init__(self, embed: Embeds, seed: int = 0) -> None:
        self._embed, self._seed = embed, seed
        self.source: EmbeddingSource | None = getattr(embed, "source", None)
        self._done: dict[bytes, ClipEmbeddings] = {}

    def __call__(self, frames: Float32, segments: Indices, *, silence: bool) -> ClipEmbeddings:
        """Embed the windows of a clip; see `clip_embeddings`."""
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
    """Embed the windows of a clip of one or more frames; deterministic for a clip and seed.

    Homes contain partly filled windows, short sounds and other rooms; so do these windows. Windows
    of the clip's `segments` [shape=(k,)], start frames in multiples of five, are always embedded;
    of a clip of `silence` only these.
    """
    digest = hashlib.blake2b(np.ascontiguousarray(frames).tobytes(), digest_size=8).digest()
    rng = np.random.default_rng([_EMBEDDING_SEED + seed, int.from_bytes(digest, "little")])
    sound, parts = frames.ravel().astype(np.float64), []
    count = len(sound) + 2 * _HALF  # with half a window on both sides
    padded = _padded(sound, 10.0 ** (_PADDING_DBFS / 20.0) * rng.standard_normal(count))
    taught = np.empty(0, np.intp) if silence else _taught(padded, len(sound), _HOP)
    middles = np.union1d(taught, segments * FRAME_SAMPLES + _HALF)
    parts.append(
        _embedded(padded, middles, embed, AS_IT_IS)._replace(
            taught=np.isin(middles, taught), starts=(middles - _HALF) // FRAME_SAMPLES
        )
    )
    if not silence:
        echoing, level = other_room(frames, rng, silence=False)
        noise = steady_noise(count, level, rng)
        of_room = _noise_of(noise)
        padded = _padded(echoing, noise)
        padded = np.clip(np.rint(padded * 32767.0), -32768, 32767) / 32768.0
        middles = _taught(padded, len(sound), _HOP_IN_ROOM)
        in_room = _embedded(
            padded, middles, lambda window: embed(of_room.reduced(window)), IN_A_ROOM
        )
        parts.append(in_room)
        parts.append(_of_version([embed(one) for one in _short_parts(sound, rng)], SHORT))
    return ClipEmbeddings(*map(np.concatenate, zip(*parts, strict=True)))


def _padded(sound: Float64, noise: Float64) -> Float64:
    noise[_HALF : _HALF + len(sound)] += sound
    return noise


def _taught(padded: Float64, count: int, hop: int) -> Indices:
    """Return centres of training windows in samples: filled enough and not faint at the centre."""
    middles = np.arange(0, count + 1, hop)
    filled = np.minimum(middles + _HALF, count) - np.maximum(middles - _HALF, 0)
    enough = min(_FILLED * _WINDOW, _FILLED_BY_SHORT * count)
    power = np.concatenate([[0.0], np.cumsum(np.square(padded))])
    middle = power[middles + _HALF + _MIDDLE] - power[middles + _HALF - _MIDDLE]
    loud = middle > _BELOW_CLIP * middle.mean()
    return spread(middles[(filled >= enough) & loud], _MOST_WINDOWS)


def spread(values: Indices, most: int | None) -> Indices:
    """Choose `most` values [shape=(n,)] at even distances; None for all."""
    count = len(values) if most is None else min(len(values), most)
    return values[np.linspace(0, len(values) - 1, count).round().astype(np.intp)]


def _embedded(padded: Float64, middles: Indices, embed: Embeds, version: int) -> ClipEmbeddings:
    windows = [_window(padded[middle : middle + _WINDOW]) for middle in middles.tolist()]
    if not windows:  # as wide as any
        return _embedded(padded, np.zeros(1, np.intp), embed, version).part(slice(0))
    return _of_version([embed(window) for window in windows], version)


def _of_version(values: Sequence[Int8], version: int) -> ClipEmbeddings:
    count = len(values)
    return ClipEmbeddings(
        np.stack(values), np.full(count, version), np.ones(count, bool), np.zeros(count, np.intp)
    )


def _window(samples: Float64) -> Float32:
    window = np.zeros(_WINDOW, np.float32)
    window[: len(samples)] = samples
    return window.reshape(WINDOW_FRAMES, FRAME_SAMPLES)


def _short_parts(sound: Float64, rng: np.random.Generator) -> Iterator[Float32]:
    """Yield windows of faint noise with the loudest short part of a sound at a random place."""
    power = np.concatenate([[0.0], np.cumsum(np.square(sound))])
    for number, seconds in enumerate(_SHORT_SECONDS):
        length = min(int(seconds * SAMPLE_RATE), len(sound))
        loudest = int(np.argmax(power[length:] - power[:-length]))
        part = sound[loudest : loudest + length] * np.hanning(length) ** 0.1  # avoids clicks
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
    """Return the learned noise of an otherwise silent room."""
    noise = SteadyNoise()
    for first in range(0, len(samples) - _WINDOW + 1, _WINDOW):
        noise.learn(_window(samples[first : first + _WINDOW]))
    return noise


def model_embedder(model: Model) -> ClipEmbedder | None:
    """Return the clip embedder for the heads of a model; None without heads.

    If the network is missing or the projection differs, a `HearthlogWarning` reports that the model
    is evaluated without it.
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
    """Return the clip embedder of a network.

    Raise `ModelError` if the network is unknown, missing, a different file, or unusable.
    """
    path = find_network(network)
    if path is None:
        raise ModelError(
            f"the network {network} is not here; fetch it: hearthlog models fetch {network}"
        )
    return ClipEmbedder(load_embedder(network, path), seed)
