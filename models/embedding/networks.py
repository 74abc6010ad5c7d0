"""Networks of sounds that are known: which files they are, and what they give."""

import hashlib
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from hearthlog.models.embedding.embeddings import Int8
from hearthlog.models.embedding.projection import Projection, read_projection
from hearthlog.models.embedding.session import TfliteSession
from hearthlog.models.errors import ModelError
from hearthlog.models.extensions import Extensions
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.messages.topics import EmbeddingSource
from hearthlog.schemas.storage.small_file import read_whole

_SIZE_LIMIT = 512 << 20


@dataclass(frozen=True)
class NetworkFile:
    """A file that holds a network.

    Attributes
    ----------
    sha256 : str
    size : int
        In bytes.
    url : str
        Where it is published; empty for one that is known by its digest alone.
    """

    sha256: str
    size: int
    url: str = ""


@dataclass(frozen=True)
class EmbeddingNetwork:
    """A pretrained network whose embedding and names are logged.

    Attributes
    ----------
    name : str
        Also that of its file, with `.tflite`.
    files : tuple of NetworkFile
        Conversions of the same weights; the first is the one to fetch.
    window : int
        Samples at 16 kHz that it takes, of a second at most.
    width, names : int
        Of its embedding, and of its scores.
    projection : Path
        Of its output onto what is logged.
    licence, attribution : str
    """

    name: str
    files: tuple[NetworkFile, ...]
    window: int
    width: int
    names: int
    projection: Path
    licence: str
    attribution: str

    @property
    def filename(self) -> str:
        """Name of its file."""
        return f"{self.name}.tflite"


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
)

NETWORKS = Extensions(
    "hearthlog.embedding_networks", EmbeddingNetwork, "network of sounds", [YAMNET]
)


class Embedder:
    """Computes what is logged for a window of sound.

    Parameters
    ----------
    network : EmbeddingNetwork
    path : Path
        Its file.

    Attributes
    ----------
    network : EmbeddingNetwork
    projection : Projection
    sha256 : str
        Of the file.

    Raises
    ------
    ModelError
        If the file is missing, is another one, or cannot be used.
    """

    def __init__(self, network: EmbeddingNetwork, path: Path) -> None:
        data = read_whole(path, "network", _SIZE_LIMIT, ModelError)
        self.network, self.sha256 = network, hashlib.sha256(data).hexdigest()
        known = {each.sha256 for each in network.files}
        if self.sha256 not in known:
            raise ModelError(
                f"{path}: is not the network {network.name} (its sha256 begins with "
                f"{self.sha256[:12]}); fetch it: hearthlog models fetch {network.name}"
            )
        self.projection: Projection = read_projection(network.projection)
        try:
            self._session = TfliteSession(data, network.window, network.width, network.names)
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error

    @property
    def source(self) -> EmbeddingSource:
        """What logs say of their embeddings."""
        steps = tuple(self.projection.steps.tolist())
        sha256 = self.projection.sha256
        return EmbeddingSource(self.network.name, self.sha256, sha256, self.projection.names, steps)

    def __call__(self, window: Float32) -> Int8:
        """Compute the integers of a window.

        Parameters
        ----------
        window : np.ndarray [shape=(WINDOW_FRAMES, FRAME_SAMPLES)], float32
            In whose middle the input of the network lies.

        Returns
        -------
        np.ndarray [shape=(W,)], int8
        """
        samples = window.reshape(-1)
        start = (len(samples) - self.network.window) // 2
        output = self._session(samples[start : start + self.network.window])
        return self.projection.quantise(output)


def network_folders() -> list[Path]:
    """Return the folders of networks: `hearthlog/networks` of the folders of data.

    Those are `$XDG_DATA_HOME` (`~/.local/share`) and `$XDG_DATA_DIRS` (`/usr/local/share` and
    `/usr/share`), as in the XDG Base Directory Specification.
    """
    of_user = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")  # noqa: PTH111  that of Path raises where there is no home
    of_all = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    folders = [Path(text) for text in [of_user, *of_all.split(":")]]
    return [folder / "hearthlog" / "networks" for folder in folders if folder.is_absolute()]


def find_network(name: str) -> Path | None:
    """Return the file of a network; None where there is none.

    Parameters
    ----------
    name : str
    """
    places = [folder / NETWORKS.get(name).filename for folder in network_folders()]
    return next(filter(os.path.lexists, places), None)


@lru_cache(maxsize=2)
def load_embedder(name: str, path: Path) -> Embedder:
    """Load a network once, however many microphones there are.

    Parameters
    ----------
    name : str
    path : Path

    Raises
    ------
    ModelError
        As `Embedder`.
    """
    return Embedder(NETWORKS.get(name), path)
