"""The file of the voices of a home: arrays and names, checked when read."""

from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import safetensors
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hearthlog.analyzer.discover.home_voices import MOST_VOICES, Voices
from hearthlog.analyzer.discover.voice_space import voice_space
from hearthlog.analyzer.discover.voices import Evidence
from hearthlog.analyzer.errors import DataError
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.arrays import read_sealed, write_sealed
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.new_files import replaced_file

VOICES = "voices.safetensors"  # in a folder of logs
_KEY = "hearthlog_voices"
_FORMAT: Final = 1
_LARGEST = 4 << 20  # bytes
_LARGEST_HEADER = 1 << 20
_LEAST_NUMBER, _MOST_NUMBER = 1, (1 << 31) - 1
_LARGE = 1e9  # of counts and sums
_ARRAYS = {"numbers": np.int64, "counts": np.float64, "sums": np.float64}

_Name = Annotated[str, StringConstraints(pattern=rf"^({CLASS_NAME.pattern})?$")]


class _Head(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: Annotated[int, Field(ge=1, le=_FORMAT)]
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8}$")]
    names: Annotated[list[_Name], Field(max_length=MOST_VOICES)]


def save_voices(voices: Voices, path: Path) -> None:
    """Write the file of voices, in place of the one that is there.

    Raise `DataError` if it could not be read again, for the features of the voices are too
    large. Raise `LogError` if it cannot be written.
    """
    head = _Head(format=_FORMAT, id=voices.id, names=voices.names)
    arrays = {"numbers": voices.numbers, **voices.evidence._asdict()}
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    if not _fits(head, arrays):
        raise DataError(
            f"{path}: not written, for some speech has features that no sound has; leave out logs "
            "that hearthlog did not record"
        )
    data = write_sealed(arrays, _KEY, head.model_dump_json())
    with replaced_file(path, readers=log_readers(path.parent)) as temporary:
        temporary.write_bytes(data)


def load_voices(path: Path) -> Voices | None:
    """Read the file of voices; None if there is none.

    Raise `DataError` if it is no such file, or damaged.
    """
    if not path.exists():
        return None
    data = read_whole(path, "file of voices", _LARGEST, DataError)
    size = int.from_bytes(data[:8], "little")
    if size > _LARGEST_HEADER:
        raise DataError(f"{path}: is no file of voices (its header is too large)")
    try:
        arrays, text, damaged = read_sealed(path, data, _KEY)
        head = _Head.model_validate_json(text)
    except (safetensors.SafetensorError, KeyError, ValidationError) as error:
        raise DataError(f"{path}: is no file of voices of this version of hearthlog") from error
    if damaged:
        raise DataError(damaged)
    if not _fits(head, arrays):
        raise DataError(f"{path}: is damaged; move it away to begin anew")
    return Voices(
        arrays["numbers"], Evidence(arrays["counts"], arrays["sums"]), head.names, head.id
    )


def _fits(head: _Head, arrays: dict[str, NDArray[Any]]) -> bool:
    count, dimensions = len(head.names), len(voice_space().spread)
    shapes = {"numbers": (count,), "counts": (count,), "sums": (count, dimensions)}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        return False
    numbers, counts, sums = (arrays[name] for name in _ARRAYS)
    return (
        all(arrays[name].dtype == kind for name, kind in _ARRAYS.items())
        and len(np.unique(numbers)) == count
        and bool(((numbers >= _LEAST_NUMBER) & (numbers <= _MOST_NUMBER)).all())
        and bool(((counts >= 1.0) & (counts <= _LARGE)).all())
        and bool((np.abs(sums) <= _LARGE).all())
    )
