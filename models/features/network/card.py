"""The card of a network: a TOML file beside it that says what it is given, and what it gives."""

import hashlib
import json
import math
import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hearthlog.models.embedding.folders import network_folders
from hearthlog.models.errors import ModelError
from hearthlog.schemas.errors import printable
from hearthlog.schemas.files import read_toml, read_whole
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

INPUTS = "embedding"
MOST_VALUES = 4096
_NAME = re.compile("[a-z][a-z0-9_-]{0,63}")
_CARD, _NETWORK = ".toml", ".onnx"
_SIZE_LIMIT = 512 << 20  # the largest of the field have 350 MB
_LONGEST = int(2.5 * SAMPLE_RATE)  # samples that a label may take
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
    """What a card says.

    Attributes
    ----------
    window, hop : int
        Samples at 16 kHz that it is given at once, and from one time to the next.
    input, output : str
        Names in the network; empty for its only one.
    """

    path: Path
    sha256: str
    sample_rate: int
    window: int
    hop: int
    names: tuple[str, ...]
    input: str
    output: str

    @property
    def name(self) -> str:
        """Name of the feature set."""
        return self.path.stem

    @property
    def window_frames(self) -> int:
        """Frames at whose end there is a window of the network that lies in them as a whole."""
        return -(-self._reach // FRAME_SAMPLES)

    @property
    def _reach(self) -> int:
        return self.window + self.hop - math.gcd(self.hop, FRAME_SAMPLES)

    @property
    def version(self) -> int:
        """A number of what shapes the values besides the network."""
        shaping = [self.sample_rate, self.window, self.hop, len(self.names)]
        text = json.dumps([*shaping, self.input, self.output])
        return 1 + zlib.crc32(text.encode()) % ((1 << 31) - 1)


def card_names() -> list[str]:
    """Return the names of all networks that have a card, in alphabetical order."""
    names = set()
    for folder in network_folders():
        try:
            names |= {path.stem for path in folder.glob("*" + _CARD)}
        except OSError:  # such as a home that a service must not see
            continue
    return sorted(filter(_NAME.fullmatch, names))


def has_card(name: str) -> bool:
    """Tell whether there is a card of a name."""
    return bool(_NAME.fullmatch(name)) and os.path.lexists(find_card(name))


def find_card(name: str) -> Path:
    """Return the card of a name.

    Returns
    -------
    Path
        The first in the folders of networks; where there is none, the place for it.
    """
    places = [folder / (name + _CARD) for folder in network_folders()]
    return next(filter(os.path.lexists, places), places[0])


def read_card(path: Path) -> NetworkCard:
    """Read a card.

    Parameters
    ----------
    path : Path
        A file `NAME.toml`; the network is `NAME.onnx` beside it, and is not opened.

    Raises
    ------
    ModelError
        If the card cannot be read, or says what cannot be.
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
    """Read the file of a network, of 512 MB at most.

    Raise `ModelError` if there is none, it is larger, or cannot be read.
    """
    return read_whole(path, "network", _SIZE_LIMIT, ModelError)


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
