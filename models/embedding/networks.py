"""Pretrained networks of sounds: files, folders, runtimes, and known answers."""

import hashlib
import os
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.models.embedding import Int8, Projection, read_projection
from hearthlog.models.embedding.session import (
    NetworkOutput,
    NetworkSession,
    OnnxSession,
    TfliteSession,
)
from hearthlog.models.extensions import Extensions
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import HearthlogWarning, ModelError, printable
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.frames import SAMPLE_RATE
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
