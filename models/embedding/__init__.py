"""Embeddings of sound: the output of a pretrained network for a window, projected as logged."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import safetensors
from numpy.typing import NDArray

from hearthlog.models.embedding.session import NetworkOutput
from hearthlog.schemas.arrays import (
    Bool,
    Float32,
    Float64,
    Indices,
    Int64,
    read_sealed,
    write_sealed,
)
from hearthlog.schemas.errors import ModelError
from hearthlog.schemas.files import read_limited


@dataclass(frozen=True, eq=False)
class FrameSpans:
    """Spans of equal length, with one row per span in every field."""

    LENGTH: ClassVar[int]  # frames

    frames: Int64  # [shape=(m,)] number of the first frame of each span; increasing
    stamps: Int64  # [shape=(m,)] starts of these frames in nanoseconds of UTC

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def last_frames(self) -> Int64:
        """Numbers of the frames that complete the spans."""
        return self.frames + (self.LENGTH - 1)

    def rows(self, chosen: slice | Indices | Bool) -> Self:
        """Return the chosen spans."""
        return type(self)(*(getattr(self, each.name)[chosen] for each in fields(self)))

    def available_at(self, first: int, count: int) -> Self:
        """Return the spans that are completed by some successive frames."""
        begin, end = np.searchsorted(self.last_frames, [first, first + count])
        return self.rows(slice(begin, end))

    def begun_in(self, start: int, end: int) -> Self:
        """Return the spans with `start` <= begin < `end`, in nanoseconds of UTC."""
        return self.rows(slice(*np.searchsorted(self.stamps, [start, end])))

    def followed_by(self, later: Self) -> Self:
        """Concatenate these spans and later spans; an empty side may have any width."""
        if not len(self):
            return later
        if not len(later):
            return self
        names = [each.name for each in fields(self)]
        pairs = ((getattr(self, name), getattr(later, name)) for name in names)
        return type(self)(*map(np.concatenate, pairs))


WINDOW_FRAMES = 20  # frames of a window: a second, with the network's input in the middle
HOP_FRAMES = 10  # frames between windows; windows begin at multiples of it
DELAY_FRAMES = WINDOW_FRAMES - 1  # frames from a frame to the end of its last window

Int8 = NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Embeddings(FrameSpans):
    """Embeddings of windows in which there was sound; windows begin at multiples of ten frames."""

    LENGTH = WINDOW_FRAMES

    values: Int8  # [shape=(m, W)] from `Projection.quantise`


NO_EMBEDDINGS = Embeddings(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 0), np.int8))


_KEY = "projection"
_SIZE_LIMIT = 16 << 20
_HIGHEST = 127  # of an int8; symmetric: the lowest is -127


@dataclass(frozen=True, eq=False)
class Projection:
    """A projection onto W integers: k components, then the groups."""

    mean: Float32  # [shape=(E,)] in half precision, like the components
    components: Float32  # [shape=(E, k)]
    steps: Float32  # [shape=(W,)] step between adjacent integers
    lows: Float32  # [shape=(W,)] lower limit of the values
    groups: Mapping[str, Sequence[int]]
    sha256: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values."""
        count = self.components.shape[1]
        return (*(f"component_{number}" for number in range(1, count + 1)), *self.groups)

    @cached_property
    def _grouped(self) -> tuple[Indices, Indices]:
        numbers = np.concatenate([np.array(group, np.intp) for group in self.groups.values()])
        lengths = [len(group) for group in self.groups.values()]
        return numbers, np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.intp)

    def quantise(self, output: NetworkOutput) -> Int8:
        """Convert network output to logged integers [shape=(W,)]; non-finite values count as 0."""
        embedding, logits = (np.nan_to_num(each, posinf=0.0, neginf=0.0) for each in output)
        numbers, starts = self._grouped
        components = (embedding - self.mean) @ self.components
        values = np.concatenate([components, np.maximum.reduceat(logits[numbers], starts)])
        steps = np.rint(np.maximum(values, self.lows) / self.steps)
        quantised: Int8 = np.clip(steps, -_HIGHEST, _HIGHEST).astype(np.int8)
        return quantised

    def values(self, quantised: Int8) -> Float64:
        """Convert logged integers [shape=(n, W)] to standard deviations, and logits."""
        return quantised.astype(np.float64) * self.steps.astype(np.float64)


def write_projection(projection: Projection, path: Path) -> None:
    """Write a projection."""
    arrays: dict[str, NDArray[Any]] = {
        "mean": projection.mean.astype(np.float16),
        "components": np.ascontiguousarray(projection.components, np.float16),
        "steps": projection.steps,
        "lows": projection.lows,
    }
    groups = {name: list(group) for name, group in projection.groups.items()}
    path.write_bytes(write_sealed(arrays, _KEY, json.dumps(groups)))


@lru_cache(maxsize=4)
def read_projection(path: Path) -> Projection:
    """Read a projection; raise `ModelError` if the file is missing or damaged."""
    data = read_limited(path, "projection of a network", _SIZE_LIMIT, ModelError)
    try:
        arrays, text, damage = read_sealed(path, data, _KEY)
        groups = json.loads(text)
        arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
        projection = Projection(
            arrays["mean"],
            arrays["components"],
            arrays["steps"],
            arrays["lows"],
            groups,
            hashlib.sha256(data).hexdigest(),
        )
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise ModelError(f"{path}: is no projection of a network ({error})") from error
    if damage:
        raise ModelError(damage)
    return projection
