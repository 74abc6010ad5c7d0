"""The training windows kept in a model for retraining in a home."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hearthlog.models.classifiers.model import Array

LEARNED: Mapping[str, np.dtype[Any]] = {
    "learned_inputs": np.dtype(np.float32),
    "learned_target": np.dtype(np.int64),
}


def learned_shapes(width: int, arrays: Mapping[str, Array]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays `LEARNED`; empty if a model keeps no windows."""
    inputs = arrays.get("learned_inputs", np.empty(0))
    if not inputs.ndim or not len(inputs):
        return {}
    return {"learned_inputs": (len(inputs), width), "learned_target": (len(inputs),)}


def target_problem(classes: int, arrays: Mapping[str, Array], *names: str) -> str | None:
    """Return an error in the class arrays; None if they are valid or absent.

    `arrays` are finite, with valid types and shapes.
    """
    for name in names:
        target = arrays.get(name, np.empty(0, np.int64))
        if ((target < 0) | (target >= classes)).any():
            return f"{name} has classes that the model has not"
    return None
