"""Pretrained networks of sounds: files, folders, known answers, and the embeddings of a stream."""

import hashlib
import os
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.models.embedding import (
    HOP_FRAMES,
    NO_EMBEDDINGS,
    WINDOW_FRAMES,
    Embeddings,
    Int8,
    Projection,
    read_projection,
)
from hearthlog.models.embedding.session import (
    NetworkOutput,
    NetworkSession,
    OnnxSession,
    TfliteSession,
)
from hearthlog.models.extensions import Extensions
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.errors import HearthlogWarning, ModelError, printable
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.schemas.messages.topics import EmbeddingSource


def network_folders() -> list[Path]:
    """Return the folders of networks: `hearthlog/networks` in the data folders.

    The data folders are `$XDG_DATA_HOME` (`~/.local/share`) and `$XDG_DATA_DIRS`
    (`/usr/local/share` and `/usr/share`), as in the XDG Base Directory Specification.
    """
    of_user = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")  # noqa: PTH111  that of Path raises where there is no home
    of_all = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    folders = [Path(text) for text in [of_user, *of_all.split(":")]]
    return [folder / "hearthlog" / "networks" for folder in folders if folder.is_absolute()]


def folder_for_new() -> Path:
    """Return the folder for a new network: the user's; for root, the folder shared by all users.

    Services cannot read a user's home, and root fetches networks for a service.
    """
    own, *of_all = network_folders()
    return of_all[0] if of_all and os.geteuid() == 0 else own


_TYPES: dict[str, Callable[[bytes, int, int, int], NetworkSession]] = {
    ".tflite": TfliteSession,
    ".onnx": OnnxSession,
}
_MODULES = {".tflite": ("ai_edge_litert",), ".onnx": ("onnx", "onnxruntime")}


def session_type(suffix: str) -> Callable[[bytes, int, int, int], NetworkSession]:
    """Return the session factory for a file suffix: bytes, window, width and number of names.

    Raise `ModelError` if no runtime supports the suffix.
    """
    if suffix not in _TYPES:
        raise ModelError(f"is no network that can be used: it ends in none of {', '.join(_TYPES)}")
    return _TYPES[suffix]


def missing_modules(suffix: str) -> list[str]:
    """Return the missing modules for files of a suffix, without importing any."""
    return [module for module in _MODULES.get(suffix, ()) if find_spec(module) is None]


SILENCE, TONE, NOISE, BURSTS = "silence", "tone", "noise", "bursts"
_SEED = 20_261_126


@lru_cache(maxsize=2)
def synthetic_sounds(samples: int) -> dict[str, Float32]:
    """Return silence, a 1 kHz tone, steady noise and four bursts of noise a second, by name.

    Each has a number of samples at 16 kHz, from -1 to 1.
    """
    seconds = np.arange(samples) / SAMPLE_RATE
    noise = 2.0 * np.random.default_rng(_SEED).random(samples) - 1.0
    sounds = {
        SILENCE: np.zeros(samples),
        TONE: 0.3 * np.sin(2.0 * np.pi * 1000.0 * seconds),
        NOISE: 0.1 * noise,
        BURSTS: 0.5 * noise * np.exp(-(seconds % 0.25) / 0.02),
    }
    return {name: sound.astype(np.float32) for name, sound in sounds.items()}


ANSWER_TOLERANCE = 1.5  # logits; conversions differ by a few tenths, other networks by much more
_PATIENCE_SECONDS = 5.0


@dataclass(frozen=True)
class NetworkFile:
    """A file with a network."""

    sha256: str
    size: int  # in bytes
    url: str = ""  # download address; empty for a file identified by its digest alone


class KnownAnswer(NamedTuple):
    """The expected output of a network for a synthetic sound."""

    sound: str
    number: int
    name: str
    logit: float


@dataclass(frozen=True)
class EmbeddingNetwork:
    """A pretrained network whose embedding and names are logged."""

    name: str
    files: tuple[NetworkFile, ...]
    window: int  # input samples at 16 kHz, at most a second
    width: int
    names: int
    projection: Path
    licence: str
    attribution: str
    suffix: str = ".tflite"
    answers: tuple[KnownAnswer, ...] = ()

    @property
    def filename(self) -> str:
        """Name of the network's file."""
        return f"{self.name}{self.suffix}"


YAMNET = EmbeddingNetwork(
    name="yamnet",
    files=(
        NetworkFile(
            "4d8b4a53282dc83ef04e3e7dbc4fbc98082e34e44ed798e16c3a0cdd4c584faf",
            4_126_810,
            "https://storage.googleapis.com/mediapipe-models/audio_classifier/yamnet/float32/1/"
            "yamnet.tflite",
        ),
        NetworkFile("687f226c147a2caab4706fbbab5e9cecb14b9a368264bf61108078b1fddf68f5", 3_959_752),
    ),
    window=15_600,
    width=1024,
    names=521,
    projection=Path(__file__).parent / "yamnet.safetensors",
    licence="Apache-2.0",
    attribution="YAMNet, Google LLC, https://github.com/tensorflow/models",
    answers=(  # of the second file: the first was not available when this was written
        KnownAnswer(TONE, 475, "beep", 2.2),
        KnownAnswer(NOISE, 514, "white noise", 1.3),
        KnownAnswer(BURSTS, 132, "music", -1.1),
        KnownAnswer(BURSTS, 158, "drum machine", -1.1),
    ),
)

NETWORKS = Extensions(
    "hearthlog.embedding_networks", EmbeddingNetwork, "network of sounds", [YAMNET]
)


class Embedder:
    """Computes the logged values of a window of sound; first runs on synthetic sounds.

    Raise `ModelError` if the file is missing, is not the expected file, or cannot be used.
    """

    def __init__(self, network: EmbeddingNetwork, path: Path) -> None:
        data, self.sha256 = read_network_file(network, path)
        self.network = network
        self.projection: Projection = read_projection(network.projection)
        self._path = path
        try:
            _check_projection(network, self.projection)
            open_session = session_type(network.suffix)
            self._session = open_session(data, network.window, network.width, network.names)
            self._of_silence = self._tried()
        except ModelError as error:
            raise ModelError(f"{path}: {printable(str(error))[:300]}") from error

    @property
    def source(self) -> EmbeddingSource:
        """Source of the embeddings, as recorded in logs."""
        steps = tuple(self.projection.steps.tolist())
        sha256 = self.projection.sha256
        return EmbeddingSource(self.network.name, self.sha256, sha256, self.projection.names, steps)

    def __call__(self, window: Float32) -> Int8:
        """Compute the integers [shape=(W,)] of a window [shape=(WINDOW_FRAMES, FRAME_SAMPLES)].

        The network's input lies in its middle. If the network fails, they are those of silence,
        with a `HearthlogWarning`.
        """
        samples = window.reshape(-1)
        start = (len(samples) - self.network.window) // 2
        try:
            output = self._session(samples[start : start + self.network.window])
            self._check_shape(output)
        except Exception:  # noqa: BLE001  runtimes raise many; no sound may end a recording
            text = "the network fails at some sound, which counts as silence"
            warnings.warn(HearthlogWarning(text, self._path), stacklevel=2)
            return self._of_silence
        return self.projection.quantise(output)

    def different_answers(self) -> list[str]:
        """Return a line for each known answer that this file does not reproduce.

        Models were trained with the answers of one file; another conversion of the same weights may
        round differently, but only slightly.
        """
        sounds = synthetic_sounds(self.network.window)
        lines = []
        for sound, number, name, expected in self.network.answers:
            value = float(self._session(sounds[sound]).logits[number])
            if abs(value - expected) > ANSWER_TOLERANCE:
                lines.append(f"{name} of {sound}: {value:.2f}, where {expected:.2f} is known")
        return lines

    def _tried(self) -> Int8:
        """Run the network on loud sounds and on silence; return the values of silence."""
        sounds = synthetic_sounds(self.network.window)
        for window in (10.0 * sounds[NOISE], sounds[BURSTS], sounds[SILENCE]):
            begin = time.monotonic()
            try:
                output = self._session(window)
            except Exception as error:  # as above
                raise ModelError(f"fails ({error})") from error
            if time.monotonic() - begin > _PATIENCE_SECONDS:
                raise ModelError(f"takes more than {_PATIENCE_SECONDS:g} s for a window")
            self._check_shape(output)
            if not all(np.isfinite(each).all() for each in output):
                raise ModelError("gives values that are not finite")
        return self.projection.quantise(output)

    def _check_shape(self, output: NetworkOutput) -> None:
        shapes = [list(each.shape) for each in output]
        wanted = [[self.network.width], [self.network.names]]
        if shapes != wanted:
            raise ModelError(f"gives values of shapes {shapes}, not {wanted}")


def _check_projection(network: EmbeddingNetwork, projection: Projection) -> None:
    """Refuse a projection made for another network's output."""
    numbers = [number for group in projection.groups.values() for number in group]
    fits = projection.components.shape[0] == projection.mean.shape[0] == network.width
    of_names = all(group for group in projection.groups.values())
    if not fits or not of_names or not all(0 <= each < network.names for each in numbers):
        raise ModelError(f"{network.projection} is no projection of its output")


def read_network_file(network: EmbeddingNetwork, path: Path) -> tuple[bytes, str]:
    """Return content and SHA-256 of a network's file.

    Raise `ModelError` if the file is missing, cannot be read, or is unknown.
    """
    sizes = {each.size for each in network.files}
    source = "" if network.files[0].url else " --from FILE"
    remedy = f"fetch it: hearthlog models fetch {network.name}{source}"
    with suppress(OSError):  # the error is raised on reading
        size = path.stat().st_size
        if path.is_file() and size not in sizes:
            sizes_text = " or ".join(f"{each:,}" for each in sorted(sizes))
            raise ModelError(
                f"{path}: is not the network {network.name}, or not all of it: it has {size:,} "
                f"bytes, not {sizes_text}; {remedy}"
            )
    data = read_limited(path, "network", max(sizes), ModelError)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 not in {each.sha256 for each in network.files}:
        raise ModelError(
            f"{path}: is not the network {network.name} (its sha256 begins with {sha256[:12]}); "
            f"{remedy}"
        )
    return data, sha256


def find_network(name: str) -> Path | None:
    """Return the file of a network; None if there is none."""
    places = [folder / NETWORKS.get(name).filename for folder in network_folders()]
    return next(filter(os.path.lexists, places), None)


@lru_cache(maxsize=2)
def load_embedder(name: str, path: Path) -> Embedder:
    """Load a network once for all microphones; raise `ModelError` as `Embedder` does."""
    return Embedder(NETWORKS.get(name), path)


LEFT_DBFS = -75.0  # level of the noise behind the clips that heads are trained on
_FRAME, _HOP = 1600, 800  # samples: the noise of long frames is the least audible
_LEAST_GAIN = 0.01
_MOST_WINDOWS = 10  # windows in the running mean: five seconds


class SteadyNoise:
    """Estimates the steady noise of one stream of windows, and subtracts it from other windows.

    The mean power of the noise is subtracted from each bin, as in Boll, "Suppression of acoustic
    noise in speech using spectral subtraction" (1979), down to the noise level of the heads'
    training data: the noise falls by 7 dB. Stronger subtraction removed more of the cues that the
    network uses. The noise is the sound while nothing is above the floor of the room.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset the state."""
        self._power: Float64 | None = None  # power of each bin
        self._windows = 0

    def learn(self, window: Float32) -> None:
        """Add a window [shape=(n, FRAME_SAMPLES)] of only the room, of at least two frames."""
        frames = np.lib.stride_tricks.sliding_window_view(window.reshape(-1), _FRAME)[::_HOP]
        power = np.square(np.abs(np.fft.rfft(frames * _taper(), axis=1))).mean(axis=0)
        self._windows = min(self._windows + 1, _MOST_WINDOWS)
        if self._power is None:
            self._power = power
        self._power = self._power + (power - self._power) / self._windows

    def reduced(self, window: Float32) -> Float32:
        """Return a window [shape=(n, FRAME_SAMPLES)] without its noise, unless negligible."""
        if self._power is None:
            return window
        left = 10.0 ** (LEFT_DBFS / 10.0) * np.square(_taper()).sum()
        least = np.clip(np.sqrt(left / np.maximum(self._power, left * 1e-9)), _LEAST_GAIN, 1.0)
        if least.min() >= 1.0:
            return window
        samples = np.pad(window.reshape(-1).astype(np.float64), _HOP)
        frames = np.lib.stride_tricks.sliding_window_view(samples, _FRAME)[::_HOP]
        spectrum = np.fft.rfft(frames * _taper(), axis=1)
        power = _smoothed(np.square(np.abs(spectrum)))
        share = 1.0 - self._power / np.maximum(power, left * 1e-9)
        spectrum *= np.maximum(np.sqrt(np.maximum(share, 0.0)), least)
        parts = np.fft.irfft(spectrum, _FRAME, axis=1) * _taper()
        halves = parts.reshape(len(parts), 2, _HOP)
        total = halves[1:, 0] + halves[:-1, 1]
        return total.astype(np.float32).reshape(window.shape)


@cache
def _taper() -> Float64:
    """Return the square root of a Hann window: squares of two that overlap by half sum to 1."""
    taper: Float64 = np.sin(np.pi * (np.arange(_FRAME) + 0.5) / _FRAME)
    return taper


def _smoothed(power: Float64) -> Float64:
    """Average over three frames and three bins: single noise bins are far above the mean."""
    padded = np.pad(power, 1, mode="edge")
    rows = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    smooth: Float64 = 0.25 * rows[:, :-2] + 0.5 * rows[:, 1:-1] + 0.25 * rows[:, 2:]
    return smooth


_SOUND_FROM = 4  # frame of a window; earlier sound is more than half a second from the middle


class EmbeddingStream:
    """Embeds the windows of one stream of frames that contain sound.

    Windows begin at frames whose number is a multiple of ten. A window is embedded if there is
    sound within half a second of its middle; the noise of windows without sound is subtracted
    first.
    """

    def __init__(self, embedder: Embedder) -> None:
        self._embedder = embedder
        self._noise = SteadyNoise()
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._noise.restart()
        self._frames = np.empty((0, FRAME_SAMPLES), np.float32)
        self._sound = np.empty(0, bool)
        self._stamps = np.empty(0, np.int64)

    def push(self, frames: Float32, sound: Bool, first: int, stamps: Int64) -> Embeddings:
        """Add successive frames [shape=(n, FRAME_SAMPLES)].

        `sound` [shape=(n,)]: whether the sound that ends with each frame, at most 0.4 s, is above
        the room floor. `stamps` [shape=(n,)] are the starts of the frames in nanoseconds of UTC.
        """
        samples = np.clip(np.nan_to_num(frames, posinf=0.0, neginf=0.0), -1.0, 1.0)
        samples = np.concatenate([self._frames, samples])
        sound = np.concatenate([self._sound, sound])
        stamps = np.concatenate([self._stamps, stamps])
        first -= len(self._frames)
        begins = np.arange(-first % HOP_FRAMES, len(samples) - WINDOW_FRAMES + 1, HOP_FRAMES)
        chosen, values = [], []
        for begin in begins.tolist():
            window, above = samples[begin : begin + WINDOW_FRAMES], sound[begin:][:WINDOW_FRAMES]
            if above[_SOUND_FROM:].any():
                chosen.append(begin)
                values.append(self._embedder(self._noise.reduced(window)))
            elif not above.any():
                self._noise.learn(window)
        self._frames = samples[1 - WINDOW_FRAMES :].copy()
        self._sound, self._stamps = sound[1 - WINDOW_FRAMES :], stamps[1 - WINDOW_FRAMES :]
        if not chosen:
            return NO_EMBEDDINGS
        places = np.array(chosen, np.int64)
        return Embeddings(first + places, stamps[places], np.stack(values))
