"""Scaling of inputs to standard deviations from the mean."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hearthlog.models.classifiers.model import Array
from hearthlog.schemas.arrays import Float32, Float64

SCALER: Mapping[str, np.dtype[Any]] = {
    "scaler_mean": np.dtype(np.float64),
    "scaler_scale": np.dtype(np.float64),
}
_SMALLEST_SCALE = 1e-30  # no quotient of finite inputs overflows


class Scaler:
    """Scales inputs by a model's mean and standard deviation."""

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        self._mean = arrays["scaler_mean"]
        self._scale = arrays["scaler_scale"]

    def __call__(self, inputs: Float32) -> Float64:
        """Scale inputs, of shape (n, width)."""
        return (inputs - self._mean) / self._scale


def scaler_shapes(width: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays `SCALER` for a number of inputs."""
    return dict.fromkeys(SCALER, (width,))


def scaler_problem(arrays: Mapping[str, Array]) -> str | None:
    """Return an error in the arrays of `Scaler`, which are finite and of valid shapes; or None."""
    if (arrays["scaler_scale"] >= _SMALLEST_SCALE).all():
        return None
    return "scaler_scale has values that are not positive"
