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
)
from hearthlog.analyzer.errors import DataError
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.storage.new_files import open_lock, replaced_file
from hearthlog.schemas.storage.sealed_file import read_sealed, write_sealed
from hearthlog.schemas.storage.small_file import read_whole

GROUPS = "groups.safetensors"  # in a folder of logs
_KEY = "hearthlog_groups"
_FORMAT: Final = 1
_LARGEST = 64 << 20  # bytes
_LARGEST_HEADER = 1 << 20
_LEAST_NUMBER, _MOST_NUMBER = 1, (1 << 31) - 1
_SMALL, _LARGE = 1e-6, 1e6  # of radii and scales; all other numbers are at most as large
_ARRAYS = {"mean": 1, "scale": 1, "axes": 2, "examples": 2, "of": 1, "numbers": 1, "radii": 1}
_WHOLE = {"of", "numbers"}

_Name = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
_Class = Annotated[str, StringConstraints(pattern=rf"^({CLASS_NAME.pattern})?$")]


class _Head(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: Annotated[int, Field(ge=1, le=_FORMAT)]
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8}$")]
    features: Annotated[list[_Name], Field(min_length=1, max_length=256)]
    names: Annotated[list[_Class], Field(max_length=MOST_GROUPS)]


@contextmanager
def locked_groups(path: Path) -> Iterator[None]:
    """Keep others from the file of groups, who wait.

    Raises
    ------
    DataError
        If its folder cannot be written.
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

    Raises
    ------
    LogError
        If it cannot be written.
    """
    head = _Head(format=_FORMAT, id=groups.id, features=list(groups.features), names=groups.names)
    arrays = {name: np.ascontiguousarray(getattr(groups, name)) for name in _ARRAYS}
    data = write_sealed(arrays, _KEY, head.model_dump_json())
    with replaced_file(path, readers=log_readers(path.parent)) as temporary:
        temporary.write_bytes(data)


def load_groups(path: Path) -> Groups | None:
    """Read the file of groups; None if there is none.

    Raises
    ------
    DataError
        If it is no such file, or damaged.
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
    return Groups(tuple(head.features), **arrays, names=head.names, id=head.id)


def _problem(head: _Head, arrays: dict[str, NDArray[Any]]) -> str:
    """Return what does not fit; empty if all does."""
    if arrays.keys() != _ARRAYS.keys():
        return "it has other arrays"
    for name, dimensions in _ARRAYS.items():
        array, kind = arrays[name], np.int64 if name in _WHOLE else np.float64
        if array.ndim != dimensions or array.dtype != kind:
            return f"{name} is not as it has to be"
        if name not in _WHOLE and not (np.abs(array) <= _LARGE).all():
            return f"{name} has numbers that are too large, or none"
    width, count = descriptor_width(head.features), len(head.names)
    axes, examples, of = arrays["axes"], arrays["examples"], arrays["of"]
    fits = (
        arrays["mean"].shape == arrays["scale"].shape == axes.shape[1:] == (width,)
        and examples.shape[1:] == axes.shape[:1]
        and arrays["numbers"].shape == arrays["radii"].shape == (count,)
        and of.shape == examples.shape[:1]
        and np.array_equal(np.unique(of), np.arange(count))
        and np.bincount(of, minlength=1).max() <= MOST_EXAMPLES
        and len(np.unique(arrays["numbers"])) == count
        and (arrays["radii"] >= _SMALL).all()
        and (arrays["scale"] >= _SMALL).all()
        and (arrays["numbers"] >= _LEAST_NUMBER).all()
        and (arrays["numbers"] <= _MOST_NUMBER).all()
        and 1 <= len(axes) <= MOST_DIMENSIONS
    )
    return "" if fits else "its arrays do not fit each other"
