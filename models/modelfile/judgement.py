"""Whether a model may label a home, and why not: one small file for each, beside the models.

The file is named by the content of the model, so that another model of the same name has none.
"""

import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hearthlog.models.errors import ModelError
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.new_files import private_folder, replaced_file

_FOLDER = "judgements"
_LARGEST = 1 << 16  # bytes
_MOST_REASONS = 32
_LONGEST_REASON = 500  # characters
_SHA256 = "[0-9a-f]{64}"

_Text = Annotated[str, StringConstraints(max_length=_LONGEST_REASON, pattern="^[^\x00-\x1f\x7f]*$")]


class Judgement(BaseModel):
    """Whether a model may label.

    Attributes
    ----------
    champion : str
        SHA-256 of the model that it was compared with; empty if there was none.
    judged : int
        When, in nanoseconds of UTC.
    reasons : tuple of str
        Why it may not, each a sentence; empty if it may.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Annotated[str, StringConstraints(pattern=f"^{_SHA256}$")]
    champion: Annotated[str, StringConstraints(pattern=f"^({_SHA256})?$")]
    judged: Annotated[int, Field(ge=0, lt=1 << 63, strict=True)]
    reasons: Annotated[tuple[_Text, ...], Field(max_length=_MOST_REASONS)] = ()
    insisted: Annotated[bool, Field(strict=True)] = False

    @property
    def may_label(self) -> bool:
        """Whether the model may label."""
        return self.insisted or not self.reasons


def judgement_path(folder: Path, sha256: str) -> Path:
    """Return where the judgement of a model is kept."""
    return folder / _FOLDER / f"{sha256}.json"


def judgements_of(folder: Path) -> list[Path]:
    """List the files of the judgements of a folder of models."""
    return list((folder / _FOLDER).glob("*.json"))


def read_judgement(folder: Path, sha256: str) -> Judgement | None:
    """Read the judgement of a model.

    Returns
    -------
    Judgement or None
        None if there is none; what is no judgement of this model counts as none.
    """
    path = judgement_path(folder, sha256)
    with suppress(OSError, ValidationError):
        if path.is_file():
            with path.open("rb") as stream:
                data = stream.read(_LARGEST + 1)
            if len(data) <= _LARGEST:
                judgement = Judgement.model_validate_json(data)
                return judgement if judgement.model == sha256 else None
    return None


def write_judgement(folder: Path, judgement: Judgement) -> None:
    """Keep a judgement, in the place of an earlier one of the same model.

    Raise `ModelError` if it cannot be written.
    """
    path = judgement_path(folder, judgement.model)
    try:
        private_folder(path.parent)
        with replaced_file(path) as temporary:
            temporary.write_text(judgement.model_dump_json(indent=2))
    except (LogError, OSError) as error:
        raise ModelError(f"{path}: cannot be written ({error})") from error


def insist(folder: Path, sha256: str) -> None:
    """Let a model label whatever its judgement says, or without one.

    Raise `ModelError` if that cannot be written.
    """
    judgement = read_judgement(folder, sha256)
    if judgement is None or not judgement.may_label:
        judgement = judgement or Judgement(model=sha256, champion="", judged=time.time_ns())
        write_judgement(folder, judgement.model_copy(update={"insisted": True}))
