"""Training windows of a classifier: selection, weighting, rounding and scaling."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.rbf_distances import in_steps
from hearthlog.schemas.arrays import Float32, Float64, Indices

_SEED = 20_261_122
_ROUNDING = 0.01  # of the standard deviation


def spread_over_classes(target: Indices, weight: Float64, most: int, seed: int) -> Indices:
    """Choose `most` windows at random, highest weights first, but fewer of the large classes."""
    shuffled = np.random.default_rng(_SEED + seed).permutation(len(target))
    shuffled = shuffled[np.argsort(-weight[shuffled], kind="stable")]
    order = np.argsort(target[shuffled], kind="stable")
    counts = np.bincount(target)
    rank = np.empty(len(target), np.intp)
    rank[order] = np.concatenate([np.arange(count) for count in counts])
    return shuffled[np.sort(np.argsort(rank, kind="stable")[:most])]


def balanced(target: Indices, weight: Float64) -> Float64:
    """Return weights scaled inversely to the size of the class, as scikit-learn does."""
    counts = np.bincount(target)
    costs = len(target) / (np.count_nonzero(counts) * np.maximum(counts, 1))
    return weight * costs[target]


def fitted_scaler(inputs: Float32) -> StandardScaler:
    """Return a scaler with the mean and standard deviation of inputs, shape (n, width)."""
    return StandardScaler().fit(inputs.astype(np.float64))


def scaler_arrays(scaler: StandardScaler) -> dict[str, NDArray[Any]]:
    """Return the arrays of `hearthlog.models.classifiers.rbf_distances`."""
    return {"scaler_mean": scaler.mean_, "scaler_scale": scaler.scale_}


def rounded_to_steps(scaler: StandardScaler, steps: int | None) -> Pipeline:
    """Return a scaler with the rounding of the trained SVM, in steps per standard deviation."""
    if steps is None:
        return make_pipeline(scaler)
    rounding = FunctionTransformer(_rounded_to_steps, kw_args={"steps": steps})
    return make_pipeline(scaler, rounding)


def _rounded_to_steps(scaled: Float64, steps: int) -> Float64:
    return in_steps(scaled, steps) / steps


def rounded(inputs: Float32) -> Float32:
    """Round inputs [shape=(n, width)] to half precision, which halves the size of a model file.

    They stay unchanged if the error would exceed a hundredth of the standard deviation of an input.
    """
    with np.errstate(over="ignore"):
        half = inputs.astype(np.float16).astype(np.float32)
    spread, error = inputs.std(axis=0), np.abs(half - inputs).max(axis=0)
    return half if ((error <= _ROUNDING * spread) | (spread == 0.0)).all() else inputs


def kept_inputs(model: Model) -> tuple[Float32, Indices] | None:
    """Return the inputs [shape=(n, width)] and class indices that a model has stored, if any.

    An adapted model has those of its base.
    """
    arrays = model.arrays
    if "landmarks" in arrays:
        counts = arrays["landmark_counts"]
        return arrays["landmarks"], np.repeat(np.arange(len(counts)), counts)
    if "base_target" in arrays:
        support, rows = arrays["support_vectors"], arrays["support_base"]
        target = arrays["base_target"].astype(np.intp)
        inputs = np.empty((len(target), support.shape[1]), np.float32)
        inputs[rows[rows >= 0]] = support[rows >= 0]
        inputs[np.setdiff1d(np.arange(len(target)), rows)] = arrays["base_vectors"]
        return inputs, target
    if "support_counts" in arrays:
        counts = arrays["support_counts"]
        return arrays["support_vectors"], np.repeat(np.arange(len(counts)), counts)
    if "learned_inputs" in arrays:
        return arrays["learned_inputs"], arrays["learned_target"].astype(np.intp)
    if "vectors" in arrays:
        return arrays["vectors"], arrays["vectors_target"].astype(np.intp)
    return None
