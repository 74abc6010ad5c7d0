"""The projection of a network's output onto the integers that are logged.

They are components of the embedding, whitened, and the highest logit of each group of names. A
projection is fixed once for a network, as logs and models depend on it.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from numpy.typing import NDArray

from hearthlog.models.embedding.embeddings import Int8
from hearthlog.models.embedding.session import NetworkOutput
from hearthlog.models.errors import ModelError
from hearthlog.schemas.arrays import Float32, Float64, Indices, read_sealed, write_sealed
from hearthlog.schemas.files import read_whole

_KEY = "projection"
_SIZE_LIMIT = 16 << 20
_HIGHEST = 127  # of an int8; the lowest is its opposite


@dataclass(frozen=True, eq=False)
class Projection:
    """A projection onto W integers: k components, then the groups.

    Attributes
    ----------
    mean : np.ndarray [shape=(E,)], float32
        In half precision, as the components.
    components : np.ndarray [shape=(E, k)], float32
    steps : np.ndarray [shape=(W,)], float32
        Differences from one integer to the next.
    lows : np.ndarray [shape=(W,)], float32
        Values that are lower count as this.
    """

    mean: Float32
    components: Float32
    steps: Float32
    lows: Float32
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
        """Turn the output of a network for a window into what is logged.

        Parameters
        ----------
        output : NetworkOutput
            What is not finite counts as 0.

        Returns
        -------
        np.ndarray [shape=(W,)], int8
        """
        embedding, logits = (np.nan_to_num(each, posinf=0.0, neginf=0.0) for each in output)
        numbers, starts = self._grouped
        components = (embedding - self.mean) @ self.components
        values = np.concatenate([components, np.maximum.reduceat(logits[numbers], starts)])
        steps = np.rint(np.maximum(values, self.lows) / self.steps)
        quantised: Int8 = np.clip(steps, -_HIGHEST, _HIGHEST).astype(np.int8)
        return quantised

    def values(self, quantised: Int8) -> Float64:
        """Turn what is logged into numbers: standard deviations, and logits.

        Parameters
        ----------
        quantised : np.ndarray [shape=(n, W)], int8

        Returns
        -------
        np.ndarray [shape=(n, W)], float64
        """
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
    """Read a projection.

    Raise `ModelError` if there is none, or it is damaged.
    """
    data = read_whole(path, "projection of a network", _SIZE_LIMIT, ModelError)
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
