"""Support vector machines with RBF kernel, one against one, with numpy alone."""

from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hearthlog.models.batch_invariant import aligned, rowwise_matmul
from hearthlog.models.classifiers.classifier_kind import ClassifierKind
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.schemas.arrays import Float32, Float64

HOME_VOTE = 2.0  # decisions of pairs lie around -1 and 1
HOME_SHARE = 100.0  # of one vector of the home, where a support vector has 1
HOME_SHARPNESS = 10.0
_TINY = 1e-200
_SUPPORT_AT_ONCE = 256  # a product this small no BLAS divides among threads
_SMALLEST_SCALE = 1e-30  # no quotient of finite inputs overflows

_Part = tuple[int, slice, Float64]  # a class, its columns, their coefficients
_Positive = Annotated[float, Field(gt=0.0, le=1e6)]


class SvmParameters(BaseModel):
    """Of a support vector machine; gamma is of the kernel exp(-gamma |x - s|^2)."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    cost: _Positive
    gamma: _Positive


class SvmKind(ClassifierKind):
    """Its arrays, for C classes.

    scaler_mean, scaler_scale : [shape=(width,)], float64
        Of the inputs.
    support_vectors : [shape=(n, width)], float32
        Inputs, not scaled, class after class.
    support_counts : [shape=(C,)], int64
        Support vectors of each class.
    dual_coefficients : [shape=(C - 1, n)], float64
        As in libsvm: row j of a vector of class i is against class j if j < i, else j + 1.
    intercepts : [shape=(C (C - 1) / 2,)], float64
        Of the pairs (0, 1), (0, 2) … (1, 2) …; a positive decision is for the first of a pair.
    home_vectors : [shape=(h, width)], float32, optional
        Inputs that a home has corrected, which draw what is like them to their class.
    home_target : [shape=(h,)], int64, optional
        Their classes.
    """

    name = "svm-rbf"
    parameters = SvmParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        "scaler_mean": np.dtype(np.float64),
        "scaler_scale": np.dtype(np.float64),
        "support_vectors": np.dtype(np.float32),
        "support_counts": np.dtype(np.int64),
        "dual_coefficients": np.dtype(np.float64),
        "intercepts": np.dtype(np.float64),
    }
    optional: Mapping[str, np.dtype[Any]] = {
        "home_vectors": np.dtype(np.float32),
        "home_target": np.dtype(np.int64),
    }

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the shapes that arrays must have."""
        total, home = (
            len(arrays[name]) if name in arrays and arrays[name].ndim else 0
            for name in ("support_vectors", "home_vectors")
        )
        shapes: dict[str, tuple[int, ...]] = {
            "scaler_mean": (width,),
            "scaler_scale": (width,),
            "support_vectors": (total, width),
            "support_counts": (classes,),
            "dual_coefficients": (classes - 1, total),
            "intercepts": (classes * (classes - 1) // 2,),
        }
        if home:
            shapes["home_vectors"], shapes["home_target"] = (home, width), (home,)
        return shapes

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Say what contradicts itself."""
        if not (arrays["scaler_scale"] >= _SMALLEST_SCALE).all():
            return "scaler_scale has values that are not positive"
        counts, total = arrays["support_counts"], len(arrays["support_vectors"])
        if (counts < 0).any() or counts.sum() != total:
            return f"support_counts do not add up to the {total} support vectors"
        target = arrays.get("home_target", counts[:0])
        if ((target < 0) | (target >= classes)).any():
            return "home_target has classes that the model has not"
        return None

    def machine(self, model: Model) -> "SvmMachine":
        """Make what decides."""
        return SvmMachine(model)

    def summary(self, model: Model) -> str:
        """Say how many support vectors there are."""
        return f"{len(model.arrays['support_vectors'])} support vectors"

    def kept_inputs(self, model: Model) -> Sequence[Float32]:
        """Return the vectors, which are inputs of windows that were learned from."""
        names = ("support_vectors", "home_vectors")
        return [model.arrays[name] for name in names if name in model.arrays]


SVM_RBF = SvmKind()


class SvmMachine:
    """Inference of one model; its pairs of classes decide as scikit-learn's `SVC` within 1e-5.

    A class is as sure as the weakest of its pairs. Where a home has vectors of its own, it is the
    surer, the more of what is near is the home's, and of that class.
    """

    def __init__(self, model: Model) -> None:
        self._mean = model.arrays["scaler_mean"]
        self._scale = model.arrays["scaler_scale"]
        self._intercepts = model.arrays["intercepts"]
        self._blocks = _blocks(model)
        self._home_blocks = _home_blocks(model)
        self._count = len(model.classes)
        self._first, self._second = np.triu_indices(self._count, 1)

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Decide for each class; novelty is one minus the kernel of the nearest support vector.

        It is 0 where that is the same as the window, towards 1 where nothing is near.
        """
        extended = self._extended(inputs)
        pairs, others, nearest = self._pairs(extended)
        decision = weakest_pairs(pairs, self._count)
        if self._home_blocks:
            decision += home_votes(self._home(extended), others)
        return decision, -np.expm1(np.minimum(nearest, 0.0))

    def _extended(self, inputs: Float32) -> Float64:
        """Scaled inputs x as (x, |x|^2, 1), shape (n, width + 2)."""
        scaled = (inputs - self._mean) / self._scale
        square = np.vecdot(scaled, scaled)[:, np.newaxis]
        return np.concatenate([scaled, square, np.ones_like(square)], axis=1)

    def _pairs(self, extended: Float64) -> tuple[Float64, Float64, Float64]:
        """Decide for every pair of classes, by the kernels of the support vectors.

        Returns
        -------
        decisions : np.ndarray [shape=(n, C (C - 1) / 2)]
        others : np.ndarray [shape=(n, 1)]
            Sums of the sharp kernels; zeros, where no home has vectors to be compared with.
        nearest : np.ndarray [shape=(n,)]
            Logarithm of the largest kernel.
        """
        nearest = np.full(len(extended), -np.inf)
        against = np.zeros((self._count, len(extended), self._count - 1))
        others = np.zeros((len(extended), 1))
        rows = np.arange(len(extended))
        for weights, parts in self._blocks:
            distance = rowwise_matmul(extended, weights)
            largest = distance[rows, distance.argmax(axis=1)]
            if largest.max() > 0.0:  # by rounding
                np.minimum(distance, 0.0, out=distance)
            np.maximum(nearest, largest, out=nearest)
            if self._home_blocks:
                sharp = np.exp(HOME_SHARPNESS * distance)
                others += rowwise_matmul(sharp, np.ones((len(weights.T), 1)))
            kernel = np.exp(distance, out=distance)
            for index, columns, coefficients in parts:
                against[index] += rowwise_matmul(kernel[:, columns], coefficients)
        first, second = self._first, self._second
        decision = against[first, :, second - 1] + against[second, :, first]
        return decision.T + self._intercepts, others, nearest

    def _home(self, extended: Float64) -> Float64:
        """Sum the sharp kernels of the home's vectors by class, shape (n, C)."""
        home = np.zeros((len(extended), self._count))
        for weights, one_hot in self._home_blocks:
            home += rowwise_matmul(np.exp(HOME_SHARPNESS * _distance(extended, weights)), one_hot)
        return home


def weakest_pairs(pairs: Float64, classes: int) -> Float64:
    """Decide for each class as the weakest of its pairs does.

    Unlike the number of pairs that a class wins, this can be calibrated.

    Parameters
    ----------
    pairs : np.ndarray [shape=(n, C (C - 1) / 2)]
        Decisions for the first class of (0, 1), (0, 2) … (1, 2) …, against the second.
    classes : int
        C.

    Returns
    -------
    np.ndarray [shape=(n, C)]
    """
    decision = np.full((len(pairs), classes), np.inf)
    for place, (first, second) in enumerate(combinations(range(classes), 2)):
        np.minimum(decision[:, first], pairs[:, place], out=decision[:, first])
        np.minimum(decision[:, second], -pairs[:, place], out=decision[:, second])
    return decision


def home_votes(home: Float64, others: Float64) -> Float64:
    """Let what a home has corrected draw to its class what is nearer to it than to all else.

    With a few segments among thousands a support vector machine is content to get these right;
    the share that they have of what is near makes them count for others as well, and leaves alone
    what is near to nothing of the home.

    Parameters
    ----------
    home : np.ndarray [shape=(n, C)]
        Kernels, `HOME_SHARPNESS` times as sharp as the machine's, summed over the home's vectors.
    others : np.ndarray [shape=(n, 1)]
        The same, summed over the support vectors.
    """
    home = HOME_SHARE * home
    return HOME_VOTE * home / (home.sum(axis=1, keepdims=True) + others + _TINY)


def _distance(extended: Float64, weights: Float64) -> Float64:
    """Return -gamma |x - s|^2, which rounding must not make positive."""
    distance = rowwise_matmul(extended, weights)
    return np.minimum(distance, 0.0, out=distance)


def _blocks(model: Model) -> list[tuple[Float64, list[_Part]]]:
    """Divide the support vectors into blocks of weights, and these by class."""
    weights = _weights(model, model.arrays["support_vectors"])
    ends = np.cumsum(model.arrays["support_counts"]).tolist()
    blocks = []
    for low in range(0, len(weights), _SUPPORT_AT_ONCE):
        high = min(low + _SUPPORT_AT_ONCE, len(weights))
        parts = []
        for index, (start, end) in enumerate(pairwise([0, *ends])):
            first, last = max(start, low), min(end, high)
            if first < last:
                coefficients = aligned(model.arrays["dual_coefficients"][:, first:last].T)
                parts.append((index, slice(first - low, last - low), coefficients))
        blocks.append((aligned(weights[low:high].T), parts))
    return blocks


def _home_blocks(model: Model) -> list[tuple[Float64, Float64]]:
    """Vectors of the home, as (weights, which class each is of)."""
    if "home_vectors" not in model.arrays:
        return []
    weights = _weights(model, model.arrays["home_vectors"])
    one_hot = np.eye(len(model.classes))[model.arrays["home_target"]]
    cuts = range(_SUPPORT_AT_ONCE, len(weights), _SUPPORT_AT_ONCE)
    return [
        (aligned(part.T), of)
        for part, of in zip(np.split(weights, cuts), np.split(one_hot, cuts), strict=True)
    ]


def _weights(model: Model, vectors: Float32) -> Float64:
    """Rows that, times (x, |x|^2, 1), give -gamma |x - s|^2 of every vector s."""
    gamma = model.description.parameters["gamma"]
    scaled = (vectors - model.arrays["scaler_mean"]) / model.arrays["scaler_scale"]
    square = np.vecdot(scaled, scaled)[:, np.newaxis]
    return np.concatenate([2.0 * gamma * scaled, np.full_like(square, -gamma), -gamma * square], 1)
