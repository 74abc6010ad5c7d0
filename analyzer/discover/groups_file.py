"""The file of the groups of a home: arrays and names, checked when read."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import safetensors
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hearthlog.analyzer.discover.descriptors import descriptor_width
from hearthlog.analyzer.discover.groups import (
    MOST_DIMENSIONS,
    MOST_EXAMPLES,
    MOST_GROUPS,
    Groups,
    Space,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.models.classes import CLASS_NAME
from hearthlog.models.classifiers.model import MOST_VALUES
from hearthlog.schemas.arrays import read_sealed, write_sealed
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.messages.topics import EmbeddingSpace
from hearthlog.schemas.new_files import open_lock, replaced_file

GROUPS = "groups.safetensors"  # in a folder of logs
_KEY = "hearthlog_groups"
_FORMAT: Final = 1
_FORMAT_OF_EMBEDDINGS: Final = 2  # which a version that cannot use them refuses
_LARGEST = 64 << 20  # bytes
_LARGEST_HEADER = 1 << 20
_LEAST_NUMBER, _MOST_NUMBER = 1, (1 << 31) - 1
_SMALL, _LARGE = 1e-6, 1e6  # of radii and scales; all other numbers are at most as large
_ARRAYS = {"mean": 1, "scale": 1, "axes": 2, "examples": 2, "of": 1, "radii": 1}  # of a space
_EMBEDDED = "embedded_"  # before those of the space with embeddings
_WHOLE = {"of", "numbers"}

_Name = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
_Class = Annotated[str, StringConstraints(pattern=rf"^({CLASS_NAME.pattern})?$")]


class _Embedding(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    network: _Name
    projection_sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
    width: Annotated[int, Field(ge=1, le=MOST_VALUES)]


class _Head(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: Annotated[int, Field(ge=1, le=_FORMAT_OF_EMBEDDINGS)]
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8}$")]
    features: Annotated[list[_Name], Field(min_length=1, max_length=256)]
    names: Annotated[list[_Class], Field(max_length=MOST_GROUPS)]
    embedding: _Embedding | None = None


@contextmanager
def locked_groups(path: Path) -> Iterator[None]:
    """Keep others from the file of groups, who wait.

    Raise `DataError` if its folder cannot be written.
    """
    lock_file = path.with_name(f".{path.name}.lock")
    try:
        lock = os.fdopen(open_lock(lock_file), "rb")
    except OSError as error:
        raise DataError(f"{lock_file}: cannot be written ({error.strerror})") from error
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def save_groups(groups: Groups, path: Path) -> None:
    """Write the file of groups, in place of the one that is there.

    Raise `LogError` if it cannot be written.
    """
    head = _Head(format=_FORMAT, id=groups.id, features=list(groups.features), names=groups.names)
    arrays = {"numbers": groups.numbers, **{name: getattr(groups, name) for name in _ARRAYS}}
    if groups.embedding is not None:
        head.format = _FORMAT_OF_EMBEDDINGS
        head.embedding = _Embedding(**groups.embedding._asdict())
        arrays |= {_EMBEDDED + name: getattr(groups.embedded, name) for name in _ARRAYS}
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    data = write_sealed(arrays, _KEY, head.model_dump_json(exclude_none=True))
    with replaced_file(path, readers=log_readers(path.parent)) as temporary:
        temporary.write_bytes(data)


def load_groups(path: Path) -> Groups | None:
    """Read the file of groups; None if there is none.

    Raise `DataError` if it is no such file, or damaged.
    """
    if not path.exists():
        return None
    data = read_whole(path, "file of groups", _LARGEST, DataError)
    size = int.from_bytes(data[:8], "little")
    if size > _LARGEST_HEADER:
        raise DataError(f"{path}: is no file of groups (its header is too large)")
    try:
        arrays, text, damaged = read_sealed(path, data, _KEY)
        head = _Head.model_validate_json(text)
    except (safetensors.SafetensorError, KeyError, ValidationError) as error:
        raise DataError(f"{path}: is no file of groups of this version of hearthlog") from error
    if damaged:
        raise DataError(damaged)
    if problem := _problem(head, arrays):
        raise DataError(f"{path}: is damaged: {problem}; move it away to begin anew")
    embedding, embedded = None, None
    if head.embedding is not None:
        embedding = EmbeddingSpace(**head.embedding.model_dump())
        embedded = Space(**{name: arrays.pop(_EMBEDDED + name) for name in _ARRAYS})
    return Groups(
        **arrays,
        features=tuple(head.features),
        names=head.names,
        id=head.id,
        embedding=embedding,
        embedded=embedded,
    )


def _problem(head: _Head, arrays: dict[str, NDArray[Any]]) -> str:
    """Return what does not fit; empty if all does."""
    expected = {"numbers": 1, **_ARRAYS}
    if head.embedding is not None:
        expected |= {_EMBEDDED + name: dimensions for name, dimensions in _ARRAYS.items()}
    if arrays.keys() != expected.keys():
        return "it has other arrays"
    for name, dimensions in expected.items():
        whole = name.removeprefix(_EMBEDDED) in _WHOLE
        array, kind = arrays[name], np.int64 if whole else np.float64
        if array.ndim != dimensions or array.dtype != kind:
            return f"{name} is not as it has to be"
        if not whole and not (np.abs(array) <= _LARGE).all():
            return f"{name} has numbers that are too large, or none"
    width, numbers = descriptor_width(head.features), arrays["numbers"]
    fits = (
        numbers.shape == (len(head.names),)
        and len(np.unique(numbers)) == len(numbers)
        and (numbers >= _LEAST_NUMBER).all()
        and (numbers <= _MOST_NUMBER).all()
        and _fits(arrays, "", len(numbers), (width, width))
        and np.array_equal(np.unique(arrays["of"]), np.arange(len(numbers)))
    )
    if fits and head.embedding is not None:
        widths = width + 1, width + head.embedding.width
        fits = _fits(arrays, _EMBEDDED, len(numbers), widths)
    return "" if fits else "its arrays do not fit each other"


def _fits(
    arrays: dict[str, NDArray[Any]], prefix: str, count: int, widths: tuple[int, int]
) -> bool:
    """Return whether shapes, classes and scales of the arrays of a space are consistent."""
    mean, scale, axes, examples, of, radii = (arrays[prefix + name] for name in _ARRAYS)
    return bool(
        mean.shape == scale.shape == axes.shape[1:]
        and widths[0] <= len(mean) <= widths[1]
        and examples.shape[1:] == axes.shape[:1]
        and radii.shape == (count,)
        and of.shape == examples.shape[:1]
        and np.isin(of, np.arange(count)).all()
        and np.bincount(of, minlength=1).max() <= MOST_EXAMPLES
        and (radii >= _SMALL).all()
        and (scale >= _SMALL).all()
        and 1 <= len(axes) <= MOST_DIMENSIONS
    )
