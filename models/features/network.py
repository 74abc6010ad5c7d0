"""Feature sets from user-supplied networks: an ONNX file, and a card next to it."""

import hashlib
import json
import math
import os
import re
import warnings
import zlib
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hearthlog.models.embedding.networks import network_folders
from hearthlog.models.embedding.session import OnnxModel
from hearthlog.models.features import FeatureSet
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.errors import HearthlogWarning, ModelError, printable
from hearthlog.schemas.files import read_limited, read_toml
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

INPUTS = "embedding"
MOST_VALUES = 4096
_NAME = re.compile("[a-z][a-z0-9_-]{0,63}")
_CARD, _NETWORK = ".toml", ".onnx"
_SIZE_LIMIT = 512 << 20  # the largest networks of the field have 350 MB
_LONGEST = int(2.5 * SAMPLE_RATE)  # samples in the window of a label, at most
_DIGEST = "sha256"

_Name = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f]{1,64}$")]
_Optional = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f]{0,200}$")]


class _Content(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    sha256: Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
    sample_rate: Annotated[int, Field(ge=8000, le=96_000)]
    window_seconds: Annotated[float, Field(ge=0.05, le=2.5)]
    hop_seconds: Annotated[float, Field(ge=0.05, le=2.5)]
    width: Annotated[int, Field(ge=1, le=MOST_VALUES)]
    input: _Optional = ""
    output: _Optional = ""
    names: Annotated[list[_Name], Field(max_length=MOST_VALUES)] = []


@dataclass(frozen=True)
class NetworkCard:
    """The content of a card."""

    path: Path
    sha256: str
    sample_rate: int
    window: int  # samples at 16 kHz of one input
    hop: int  # samples at 16 kHz between successive inputs
    names: tuple[str, ...]
    input: str  # name in the network; empty for its only input
    output: str  # name in the network; empty for its only output

    @property
    def name(self) -> str:
        """Name of the feature set."""
        return self.path.stem

    @property
    def window_frames(self) -> int:
        """Smallest number of frames that always ends with a complete window of the network."""
        return -(-self._reach // FRAME_SAMPLES)

    @property
    def _reach(self) -> int:
        return self.window + self.hop - math.gcd(self.hop, FRAME_SAMPLES)

    @property
    def version(self) -> int:
        """A number derived from the settings, other than the network, that affect the values."""
        shaping = [self.sample_rate, self.window, self.hop, len(self.names)]
        text = json.dumps([*shaping, self.input, self.output])
        return 1 + zlib.crc32(text.encode()) % ((1 << 31) - 1)


def card_names() -> list[str]:
    """Return the names of all networks with a card, in alphabetical order."""
    names = set()
    for folder in network_folders():
        try:
            names |= {path.stem for path in folder.glob("*" + _CARD)}
        except OSError:  # such as a home folder hidden from a service
            continue
    return sorted(filter(_NAME.fullmatch, names))


def has_card(name: str) -> bool:
    """Return whether there is a card of this name."""
    return bool(_NAME.fullmatch(name)) and os.path.lexists(find_card(name))


def find_card(name: str) -> Path:
    """Return the first card of a network in the folders of networks, or the path for a new card."""
    places = [folder / (name + _CARD) for folder in network_folders()]
    return next(filter(os.path.lexists, places), places[0])


def read_card(path: Path) -> NetworkCard:
    """Read a card `NAME.toml`; the network `NAME.onnx` next to it is not opened.

    Raise `ModelError` if the card cannot be read or is invalid.
    """
    content = read_toml(path, "card of a network", ModelError)
    network = path.with_suffix(_NETWORK)
    if _DIGEST not in content:
        digest = hashlib.sha256(read_network(network)).hexdigest()
        line = f'{_DIGEST} = "{digest}"'
        raise ModelError(f"{path}: does not say which network it is about; {network} is {line}")
    try:
        checked = _Content.model_validate(content)
    except ValidationError as error:
        raise ModelError(f"{path}: {_first_problem(error)}") from error
    card = NetworkCard(
        path=network,
        sha256=checked.sha256,
        sample_rate=checked.sample_rate,
        window=round(checked.window_seconds * SAMPLE_RATE),
        hop=round(checked.hop_seconds * SAMPLE_RATE),
        names=tuple(checked.names) or _numbered(checked.width),
        input=checked.input,
        output=checked.output,
    )
    if problem := _problem(card, checked.width):
        raise ModelError(f"{path}: {problem}")
    return card


def read_network(path: Path) -> bytes:
    """Read a network, at most 512 MB; raise `ModelError` if it is missing, larger or unreadable."""
    return read_limited(path, "network", _SIZE_LIMIT, ModelError)


def _numbered(width: int) -> tuple[str, ...]:
    return tuple(f"embedding_{number}" for number in range(1, width + 1))


def _problem(card: NetworkCard, width: int) -> str | None:
    if len(card.names) != width:
        return f"names: there are {len(card.names)}, and width says {width}"
    if len({"level", *card.names}) <= width:
        return "names: one is there twice, or is level, which is the first value of every frame"
    if card.window + card.hop > _LONGEST:
        return (
            "window_seconds and hop_seconds: together more than 2.5, which is too long for labels"
        )
    return None


def _first_problem(error: ValidationError) -> str:
    first: Any = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part)[:64] for part in first["loc"])
    return printable(f"{where}: {first['msg']}")[:200]


_LARGEST = 65_504.0  # of half precision, to which values are rounded
_SOUND_SEED = 20_261_125


class Network:
    """A network in memory; `of_silence` [shape=(width,)] is the embedding of digital silence.

    Raise `ModelError` if the file is not the network of the card, its input or output contradicts
    the card, or onnxruntime is not installed.
    """

    def __init__(self, card: NetworkCard) -> None:
        self._card = card
        data = read_network(card.path)
        try:
            _check_digest(data, card)
            count = len(self._resampled(np.zeros(card.window, np.float32)))
            self._model = OnnxModel(data, count, card.input)
            self._output = self._model.chosen_output(card.output)
            self.of_silence = self._tried()
        except ModelError as error:
            raise ModelError(f"{card.path}: {printable(str(error))[:300]}") from error

    def embed(self, window: Float32) -> Float32:
        """Compute the embedding [shape=(width,)] of samples [shape=(window,)] at 16 kHz, -1 to 1.

        It is in half precision; the mean if the network gives several. Non-finite values are 0. If
        the network fails, it is that of silence, with a `HearthlogWarning`.
        """
        try:
            (values,) = self._model.run(self._resampled(window), [self._output])
            self._check_shape(values)
        except Exception:  # noqa: BLE001  onnxruntime's are many; no sound may end a recording
            text = "the network fails at some sound, which counts as silence"
            warnings.warn(HearthlogWarning(text, self._card.path), stacklevel=2)
            return self.of_silence
        return _in_half_precision(values)

    def _resampled(self, window: Float32) -> Float32:
        if self._card.sample_rate == SAMPLE_RATE:
            return np.ascontiguousarray(window)
        import soxr  # noqa: PLC0415  takes time, and most networks hear at 16 kHz

        resampled: Float32 = soxr.resample(window, SAMPLE_RATE, self._card.sample_rate)
        return resampled

    def _tried(self) -> Float32:
        """Run the network on noise and on silence; return the embedding of silence."""
        noise = np.random.default_rng(_SOUND_SEED).uniform(-1.0, 1.0, self._card.window)
        windows = [
            self._resampled(window.astype(np.float32))
            for window in (noise, 0.1 * noise, np.zeros_like(noise))
        ]
        (values,) = self._model.tried(windows, [self._output], self._check)
        return _in_half_precision(values)

    def _check(self, outputs: list[Any]) -> None:
        (values,) = outputs
        self._check_shape(values)
        if not np.isfinite(values).all():
            raise ModelError(f"gives values that are not finite as {self._output}")

    def _check_shape(self, values: Any) -> None:
        width, output = len(self._card.names), self._output
        if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or not values.ndim:
            raise ModelError(f"gives no numbers as {output}")
        if values.shape[-1] != width or not values.size:
            what = f"gives {output} of shape {list(values.shape)}"
            most = f" (and {MOST_VALUES} are the most)" if values.shape[-1] > MOST_VALUES else ""
            raise ModelError(f"{what}; its card says that it has {width} values{most}")


@lru_cache(maxsize=4)
def load_network(card: NetworkCard) -> Network:
    """Load a network once for all extractors; raise `ModelError` as `Network` does."""
    return Network(card)


def _check_digest(data: bytes, card: NetworkCard) -> None:
    digest = hashlib.sha256(data).hexdigest()
    if digest != card.sha256:
        raise ModelError(f"has sha256 {digest}, and its card is about {card.sha256}")


def _in_half_precision(values: Any) -> Float32:
    means = values.reshape(-1, values.shape[-1]).astype(np.float64).mean(axis=0)
    np.nan_to_num(means, copy=False, posinf=_LARGEST, neginf=-_LARGEST)
    half: Float32 = np.clip(means, -_LARGEST, _LARGEST).astype(np.float16).astype(np.float32)
    return half + np.float32(0.0)  # no -0, which is the same to a classifier


_FLOOR = 1e-10  # -100 dBFS


class NetworkExtractor:
    """Features of one stream of frames.

    Windows of the network end every hop after the start or the last restart; earlier samples count
    as silence. The network receives windows one by one, so blocks of any size give the same bits.

    Raise `ModelError` if the network is not the network of the card, or contradicts the card.
    """

    def __init__(self, card: NetworkCard) -> None:
        self._window, self._hop, self._width = card.window, card.hop, len(card.names)
        self._network = load_network(card)
        self._of_silence = self._network.of_silence
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._recent = np.zeros(self._window, np.float32)  # samples, up to the end of the last hop
        self._last = self._of_silence

    def __call__(self, frames: Float32) -> Float32:
        """Compute the features [shape=(n, 1 + width)] of frames [shape=(n, FRAME_SAMPLES)].

        They are in half precision: the level in dBFS, then the embedding. Samples are -1 to 1;
        non-finite ones count as 0, those out of range are clipped.
        """
        samples = np.clip(np.nan_to_num(frames, posinf=0.0, neginf=0.0), -1.0, 1.0)
        values = np.empty((len(frames), 1 + self._width), np.float32)
        values[:, 0] = _levels(samples)
        if not len(frames):
            return values
        embeddings = [self._last]
        before = len(self._recent) - self._window  # samples since the end of the last hop
        sound = np.concatenate([self._recent, samples.ravel()])
        ends = range(self._window + self._hop, len(sound) + 1, self._hop)
        embeddings += [self._network.embed(sound[end - self._window : end]) for end in ends]
        frame_ends = before + FRAME_SAMPLES * np.arange(1, len(frames) + 1)
        values[:, 1:] = np.stack(embeddings)[frame_ends // self._hop]
        self._last = embeddings[-1]
        self._recent = sound[len(ends) * self._hop :].copy()
        return values


def _levels(samples: Float32) -> Float32:
    exact = samples.astype(np.float64)
    power = np.vecdot(exact, exact) / FRAME_SAMPLES
    levels: Float32 = (10.0 * np.log10(power + _FLOOR)).astype(np.float16).astype(np.float32)
    return levels


@dataclass(frozen=True)
class LastEmbedding:
    """The embedding at the last frame of a window, as `Inputs`."""

    window_frames: int  # large enough for the complete sound of that embedding to lie in the window
    width: int
    needs_floor: bool = False

    def stream(self) -> "LastEmbeddingStream":
        """Begin a stream."""
        return LastEmbeddingStream(self)

    def of_windows(self, windows: Float32, floors: Float64 | None = None) -> Float32:
        """Return the inputs [shape=(n, width)] of windows [shape=(n, window_frames, 1 + width)].

        `floors` are unused.
        """
        del floors
        return np.ascontiguousarray(windows[:, -1, 1:])


class LastEmbeddingStream:
    """The embeddings at the frames of one stream, as `InputStream`."""

    def __init__(self, inputs: LastEmbedding) -> None:
        self._inputs = inputs
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._lacking = self._inputs.window_frames - 1  # frames before the first complete window

    def __call__(self, features: Float32, floors: Float64 | None = None) -> Float32:
        """Return the inputs [shape=(m, width)] at the last m of n frames [shape=(n, 1 + width)].

        They are the frames with a complete window since the start or the last restart; `floors` are
        unused.
        """
        del floors
        inputs = features[self._lacking :, 1:]
        self._lacking = max(self._lacking - len(features), 0)
        return np.ascontiguousarray(inputs)


def network_features(name: str) -> FeatureSet:
    """Return a network's feature set; raise `ModelError` if its card is unreadable or invalid."""
    return _features(read_card(find_card(name)))


@lru_cache(maxsize=8)
def _features(card: NetworkCard) -> FeatureSet:
    return FeatureSet(
        name=card.name,
        version=card.version,
        feature_names=("level", *card.names),
        units=("dBFS", *("1" for _ in card.names)),
        window_frames=card.window_frames,
        extractor=partial(NetworkExtractor, card),
        inputs={INPUTS: LastEmbedding(card.window_frames, len(card.names))},
        power=_power,
        band_powers=_band_powers,
        digest=card.sha256,
    )


def _power(features: NDArray[Any]) -> NDArray[Any]:
    power: NDArray[Any] = 10.0 ** (features[..., 0].astype(np.float64) / 10.0)
    return power


def _band_powers(features: Float32) -> Float64:
    """Return the power of the only band, and the identical power of the frame."""
    power: Float64 = _power(features)
    return np.stack([power, power], axis=1)
