"""Machines with RBF kernels, in numpy alone: support vectors, and a linear head on landmarks."""

from collections.abc import Mapping
from itertools import combinations, pairwise
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from hearthlog.models.batch_invariant import aligned, rowwise_matmul
from hearthlog.models.classifiers import ClassifierKind, target_problem
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.schemas.arrays import Float32, Float64

_EXACT = 4096  # steps: its square, 2^24, is the limit up to which float32 holds all whole numbers
_FARTHEST = 1 << 20  # steps: with a thousand inputs, sums of squares are exact in float64


class Prepared(NamedTuple):
    """Windows or vectors."""

    # [shape=(n, width + 2) or (width + 2, m), float32 or float64] windows in rows, vectors in
    # columns
    values: NDArray[Any]
    longest: float  # length of the longest window or vector, in steps; 0 without steps


class Distances(Protocol):
    """The exponents of a kernel, -gamma |x - s|^2, of scaled inputs x and vectors s."""

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m), all at most 0."""


class RoundedDistances:
    """Distances of inputs in whole steps: the same bits with any BLAS, on any processor.

    Products of whole numbers and all their sums are exact in any order: in float32 if rows and
    vectors are close enough to the mean, as almost all are, else in float64.
    """

    def __init__(self, gamma: float, steps: int) -> None:
        self._steps = steps
        self._factor = gamma / steps**2

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""
        rounded = in_steps(scaled, self._steps)
        return _exact(_as_rows(rounded), rounded)

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""
        rounded = in_steps(scaled, self._steps)
        values, longest = _exact(_as_columns(rounded, 1.0), rounded)
        return Prepared(aligned(values), longest)

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m), all at most 0."""
        # No partial sum of the products is above (|x| + |s|)^2.
        type_ = np.float32 if rows.longest + vectors.longest <= _EXACT else np.float64
        product = rows.values.astype(type_, copy=False) @ vectors.values.astype(type_, copy=False)
        exponents: Float64 = np.multiply(product, self._factor, dtype=np.float64)
        return exponents


class UnroundedDistances:
    """Distances for models of hearthlog 0.1."""

    def __init__(self, gamma: float) -> None:
        self._gamma = gamma

    def rows(self, scaled: Float64) -> Prepared:
        """Prepare scaled inputs, of shape (n, width)."""
        return Prepared(_as_rows(scaled), 0.0)

    def vectors(self, scaled: Float64) -> Prepared:
        """Prepare scaled vectors, of shape (m, width)."""
        return Prepared(aligned(_as_columns(scaled, self._gamma)), 0.0)

    def between(self, rows: Prepared, vectors: Prepared) -> Float64:
        """Return the exponents, of shape (n, m), all at most 0."""
        product = rowwise_matmul(rows.values, vectors.values)
        return np.minimum(product, 0.0, out=product)  # rounding puts a few above 0


def in_steps(scaled: Float64, steps: int) -> Float64:
    """Round standard deviations from the mean [shape=(n, width)] to whole steps, -2^20 to 2^20."""
    return np.clip(np.rint(steps * scaled), -_FARTHEST, _FARTHEST)


def _as_rows(inputs: Float64) -> Float64:
    """Return inputs x as (x, |x|^2, 1)."""
    square = np.vecdot(inputs, inputs)[:, np.newaxis]
    return np.concatenate([inputs, square, np.ones_like(square)], axis=1)


def _as_columns(vectors: Float64, gamma: float) -> Float64:
    """Return columns whose product with (x, |x|^2, 1) is -gamma |x - s|^2."""
    square = np.vecdot(vectors, vectors)[:, np.newaxis]
    parts = 2.0 * gamma * vectors, np.full_like(square, -gamma), -gamma * square
    return np.concatenate(parts, axis=1).T


def _exact(values: Float64, rounded: Float64) -> Prepared:
    """Convert values to float32 if that is exact."""
    longest = float(np.vecdot(rounded, rounded).max(initial=0.0)) ** 0.5
    return Prepared(values if longest > _EXACT else values.astype(np.float32), longest)


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


HOME_VOTE = 2.0  # decisions of pairs lie around -1 and 1
HOME_SHARE = 100.0  # weight of a home vector; a support vector has 1
HOME_SHARPNESS = 10.0
_TINY = 1e-200
_SUPPORT_AT_ONCE = 256  # no BLAS splits a product of this size among threads

_Part = tuple[int, slice, Float64]  # a class, its columns, and their coefficients
_Positive = Annotated[float, Field(gt=0.0, le=1e6)]


class SvmParameters(BaseModel):
    """Parameters of a machine."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    cost: _Positive
    gamma: _Positive  # of the kernel exp(-gamma |x - s|^2)
    # rounding steps per standard deviation of the inputs; None for models of hearthlog 0.1, which
    # do not round
    steps: Annotated[int, Field(ge=1, le=1024)] | None = None


class SvmKind(ClassifierKind):
    """Support vector machines; the arrays for C classes.

    scaler_mean, scaler_scale : [shape=(width,)], float64
        Mean and standard deviation of the inputs.
    support_vectors : [shape=(n, width)], float32
        Unscaled inputs, sorted by class.
    support_counts : [shape=(C,)], int64
        Number of support vectors of each class.
    dual_coefficients : [shape=(C - 1, n)], float64
        As in libsvm: row j of a vector of class i is against class j if j < i, else j + 1.
    intercepts : [shape=(C (C - 1) / 2,)], float64
        For the pairs (0, 1), (0, 2) … (1, 2) …; a positive decision is for the first of a pair.
    home_vectors : [shape=(h, width)], float32, optional
        Inputs corrected by a home, which attract similar inputs to their class.
    home_target : [shape=(h,)], int64, optional
        Classes of the home vectors.
    base_target : [shape=(b,)], int64, optional
        Classes of the support vectors of the model before adaptation, kept for further
        adaptations.
    support_base : [shape=(n,)], int64, optional
        Index of each support vector among these, from 0; -1 for a vector of the home.
    base_vectors : [shape=(m, width)], float32, optional
        Those that are no longer support vectors, in their order.
    base_costs : [shape=(C,)], float64, optional
        Cost of an error on a window of each class, relative to the cost of the method.
    """

    name = "svm-rbf"
    parameters = SvmParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        **SCALER,
        "support_vectors": np.dtype(np.float32),
        "support_counts": np.dtype(np.int64),
        "dual_coefficients": np.dtype(np.float64),
        "intercepts": np.dtype(np.float64),
    }
    optional: Mapping[str, np.dtype[Any]] = {
        "home_vectors": np.dtype(np.float32),
        "home_target": np.dtype(np.int64),
        "base_target": np.dtype(np.int64),
        "support_base": np.dtype(np.int64),
        "base_vectors": np.dtype(np.float32),
        "base_costs": np.dtype(np.float64),
    }

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the required shapes, as `ClassifierKind.shapes`."""
        total, home, base = (
            len(arrays[name]) if name in arrays and arrays[name].ndim else 0
            for name in ("support_vectors", "home_vectors", "base_target")
        )
        shapes: dict[str, tuple[int, ...]] = {
            **scaler_shapes(width),
            "support_vectors": (total, width),
            "support_counts": (classes,),
            "dual_coefficients": (classes - 1, total),
            "intercepts": (classes * (classes - 1) // 2,),
        }
        if home:
            shapes["home_vectors"], shapes["home_target"] = (home, width), (home,)
        if base:
            shapes["base_target"], shapes["support_base"] = (base,), (total,)
            kept = int(np.count_nonzero(arrays.get("support_base", np.empty(0)) >= 0))
            shapes["base_vectors"] = (base - kept, width)
            if "base_costs" in arrays:
                shapes["base_costs"] = (classes,)
        return shapes

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return an error in the arrays, as `ClassifierKind.problem`."""
        counts, total = arrays["support_counts"], len(arrays["support_vectors"])
        if (counts < 0).any() or counts.sum() != total:
            return f"support_counts do not add up to the {total} support vectors"
        if not (arrays.get("base_costs", np.ones(1)) > 0.0).all():
            return "base_costs has values that are not positive"
        rows = arrays.get("support_base", counts[:0])
        kept = rows[rows >= 0]
        if (kept >= len(arrays.get("base_target", kept))).any() or len(np.unique(kept)) < len(kept):
            return "support_base has numbers that no vector of the base has, or one twice"
        return scaler_problem(arrays) or target_problem(
            classes, arrays, "home_target", "base_target"
        )

    def machine(self, model: Model) -> "SvmMachine":
        """Prepare a model for inference."""
        return SvmMachine(model)

    def summary(self, model: Model) -> str:
        """Return the number of support vectors in words."""
        return f"{len(model.arrays['support_vectors'])} support vectors"


SVM_RBF = SvmKind()


class SvmMachine:
    """Inference of one model; its pairs of classes agree with scikit-learn's `SVC` within 1e-5.

    The decision value of a class is the value of its weakest pair, plus `home_votes`.
    """

    def __init__(self, model: Model) -> None:
        self._scaled = Scaler(model.arrays)
        self._intercepts = model.arrays["intercepts"]
        self._count = len(model.classes)
        self._has_novelty = model.description.novelty == "machine"
        self._distances = _distances(model)
        self._blocks = self._support(model)
        self._home_blocks = self._of_home(model)
        self._first, self._second = np.triu_indices(self._count, 1)

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Compute decisions [shape=(n, C)] and novelty [shape=(n,)] of inputs [shape=(n, width)].

        Inputs are finite. Novelty is one minus the kernel of the nearest support vector, 0 to 1;
        NaN for a model whose novelty is derived from its probabilities.
        """
        rows = self._distances.rows(self._scaled(inputs))
        pairs, others, nearest = self._pairs(rows)
        decision = weakest_pairs(pairs, self._count)
        if self._home_blocks:
            decision += home_votes(self._home(rows), others)
        return decision, -np.expm1(nearest)

    def _pairs(self, rows: Prepared) -> tuple[Float64, Float64, Float64]:
        """Return decisions of pairs [shape=(n, C (C - 1) / 2)], others and nearest.

        Others [shape=(n, 1)] are sums of the sharp kernels of the support vectors; zeros without
        home vectors. Nearest [shape=(n,)] is the logarithm of the kernel of the nearest support
        vector; NaN if the novelty is not computed.
        """
        count = len(rows.values)
        nearest = np.full(count, -np.inf if self._has_novelty else np.nan)
        against = np.zeros((self._count, count, self._count - 1))
        others = np.zeros((count, 1))
        for vectors, parts in self._blocks:
            exponents = self._distances.between(rows, vectors)
            if self._has_novelty:
                np.maximum(nearest, exponents.max(axis=1), out=nearest)
            if self._home_blocks:
                sharp = np.exp(HOME_SHARPNESS * exponents)
                others += rowwise_matmul(sharp, np.ones((sharp.shape[1], 1)))
            kernel = np.exp(exponents, out=exponents)
            for index, columns, coefficients in parts:
                against[index] += rowwise_matmul(kernel[:, columns], coefficients)
        first, second = self._first, self._second
        decision = against[first, :, second - 1] + against[second, :, first]
        return decision.T + self._intercepts, others, nearest

    def _home(self, rows: Prepared) -> Float64:
        """Return the sums of the sharp kernels of the home vectors by class, shape (n, C)."""
        home = np.zeros((len(rows.values), self._count))
        for vectors, one_hot in self._home_blocks:
            exponents = self._distances.between(rows, vectors)
            home += rowwise_matmul(np.exp(HOME_SHARPNESS * exponents), one_hot)
        return home

    def _support(self, model: Model) -> list[tuple[Prepared, list[_Part]]]:
        """Divide the support vectors into blocks, each with its parts by class."""
        vectors = self._scaled(model.arrays["support_vectors"])
        ends = np.cumsum(model.arrays["support_counts"]).tolist()
        blocks = []
        for low in range(0, len(vectors), _SUPPORT_AT_ONCE):
            high = min(low + _SUPPORT_AT_ONCE, len(vectors))
            parts = []
            for index, (start, end) in enumerate(pairwise([0, *ends])):
                first, last = max(start, low), min(end, high)
                if first < last:
                    coefficients = aligned(model.arrays["dual_coefficients"][:, first:last].T)
                    parts.append((index, slice(first - low, last - low), coefficients))
            blocks.append((self._distances.vectors(vectors[low:high]), parts))
        return blocks

    def _of_home(self, model: Model) -> list[tuple[Prepared, Float64]]:
        """Divide the home vectors into blocks, each with its one-hot classes."""
        if "home_vectors" not in model.arrays:
            return []
        vectors = self._scaled(model.arrays["home_vectors"])
        one_hot = np.eye(self._count)[model.arrays["home_target"]]
        cuts = range(_SUPPORT_AT_ONCE, len(vectors), _SUPPORT_AT_ONCE)
        blocks = zip(np.split(vectors, cuts), np.split(one_hot, cuts), strict=True)
        return [(self._distances.vectors(part), classes) for part, classes in blocks]


def weakest_pairs(pairs: Float64, classes: int) -> Float64:
    """Return the decision value of each class [shape=(n, C)]: the value of its weakest pair.

    Unlike the number of pairs won by a class, this value can be calibrated. `pairs` [shape=(n, C (C
    - 1) / 2)] are for the first class of (0, 1), (0, 2) … (1, 2) …, against the second.
    """
    decision = np.full((len(pairs), classes), np.inf)
    for place, (first, second) in enumerate(combinations(range(classes), 2)):
        np.minimum(decision[:, first], pairs[:, place], out=decision[:, first])
        np.minimum(decision[:, second], -pairs[:, place], out=decision[:, second])
    return decision


def home_votes(home: Float64, others: Float64) -> Float64:
    """Compute the addition to decisions near a home's vectors [shape=(n, C)], 0 to `HOME_VOTE`.

    A support vector machine learns a few segments of a home among thousands, but not similar
    sounds. A vote is the share of a home's class among all vectors nearby, so inputs far from all
    home vectors stay unchanged. `home` [shape=(n, C)] are sums over the home vectors of kernels
    with gamma times `HOME_SHARPNESS`, by class; `others` [shape=(n, 1)] are the same sums over the
    support vectors.
    """
    home = HOME_SHARE * home
    return HOME_VOTE * home / (home.sum(axis=1, keepdims=True) + others + _TINY)


def _distances(model: Model) -> Distances:
    parameters = SvmParameters.model_validate(model.description.parameters)
    if parameters.steps is None:
        return UnroundedDistances(parameters.gamma)
    return RoundedDistances(parameters.gamma, parameters.steps)


_LANDMARKS_AT_ONCE = 256  # no BLAS splits a product of this size among threads


class LandmarkParameters(BaseModel):
    """Parameters of the kernel."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    gamma: Annotated[float, Field(gt=0.0, le=1e6)]  # of the kernel exp(-gamma |x - l|^2)
    steps: Annotated[int, Field(ge=1, le=1024)]


class LandmarksKind(ClassifierKind):
    """Linear decisions on the kernels of landmarks; the arrays for C classes.

    scaler_mean, scaler_scale : [shape=(width,)], float64
        Of the inputs.
    landmarks : [shape=(m, width)], float32
        Unscaled inputs, sorted by class.
    landmark_counts : [shape=(C,)], int64
        Number of landmarks of each class; 0 for a class added by a home.
    home_landmarks : [shape=(h, width)], float32, optional
        Landmarks of the home that the model was adapted to, after the others.
    weights : [shape=(m + h, C)], float64
        Of the kernels.
    bias : [shape=(C,)], float64
    base_weights : [shape=(m, B)], float64, optional
        Weights before any adaptation to a home, of the B classes at that time.
    base_bias : [shape=(B,)], float64, optional
    """

    name = "rbf-landmarks"
    parameters = LandmarkParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        **SCALER,
        "landmarks": np.dtype(np.float32),
        "landmark_counts": np.dtype(np.int64),
        "weights": np.dtype(np.float64),
        "bias": np.dtype(np.float64),
    }
    optional: Mapping[str, np.dtype[Any]] = {
        "home_landmarks": np.dtype(np.float32),
        "base_weights": np.dtype(np.float64),
        "base_bias": np.dtype(np.float64),
    }

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the required shapes, as `ClassifierKind.shapes`."""
        count, home, before = (
            len(arrays[name]) if name in arrays and arrays[name].ndim else 0
            for name in ("landmarks", "home_landmarks", "base_bias")
        )
        shapes: dict[str, tuple[int, ...]] = {
            **scaler_shapes(width),
            "landmarks": (count, width),
            "landmark_counts": (classes,),
            "weights": (count + home, classes),
            "bias": (classes,),
        }
        if home:
            shapes["home_landmarks"] = (home, width)
        if before:
            shapes["base_weights"], shapes["base_bias"] = (count, before), (before,)
        return shapes

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return an error in the arrays, as `ClassifierKind.problem`."""
        counts, total = arrays["landmark_counts"], len(arrays["landmarks"])
        if (counts < 0).any() or counts.sum() != total or not total:
            return f"landmark_counts do not add up to the {total} landmarks"
        before = len(arrays.get("base_bias", counts))
        if before > classes or not counts[:before].all() or counts[before:].any():
            return "landmark_counts has classes of the base without landmarks, or others with some"
        return scaler_problem(arrays)

    def machine(self, model: Model) -> "LandmarksMachine":
        """Prepare a model for inference."""
        parameters = LandmarkParameters.model_validate(model.description.parameters)
        return LandmarksMachine(model.arrays, parameters)

    def summary(self, model: Model) -> str:
        """Return the number of landmarks in words."""
        return f"{len(all_landmarks(model.arrays))} landmarks"


RBF_LANDMARKS = LandmarksKind()


def all_landmarks(arrays: Mapping[str, Array]) -> Float32:
    """Return the landmarks of a model and of its home, in the order of the weights."""
    own: Float32 = arrays["landmarks"]
    home = arrays.get("home_landmarks")
    return own if home is None else np.concatenate([own, home])


class LandmarksMachine:
    """Kernel logistic regression on landmarks: a linear head on a kernel map of the inputs.

    The map is from Williams and Seeger, "Using the Nyström method to speed up kernel machines",
    2001: kernels of a window with some hundreds of points chosen from the training data.
    """

    def __init__(self, arrays: Mapping[str, Array], parameters: LandmarkParameters) -> None:
        self._scaled = Scaler(arrays)
        self._distances = RoundedDistances(parameters.gamma, parameters.steps)
        landmarks, weights = self._scaled(all_landmarks(arrays)), arrays["weights"]
        self._bias = arrays["bias"]
        self._blocks = []
        for start in range(0, len(landmarks), _LANDMARKS_AT_ONCE):
            rows = slice(start, start + _LANDMARKS_AT_ONCE)
            block = self._distances.vectors(landmarks[rows])
            self._blocks.append((block, aligned(weights[rows])))

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return decisions [shape=(n, C)] of finite inputs [shape=(n, width)], and novelty, NaN.

        The decisions are logarithms of probabilities up to a constant and a temperature.
        """
        rows = self._distances.rows(self._scaled(inputs))
        decisions = np.tile(self._bias, (len(inputs), 1))
        for landmarks, weights in self._blocks:
            exponents = self._distances.between(rows, landmarks)
            decisions += rowwise_matmul(np.exp(exponents, out=exponents), weights)
        return decisions, np.full(len(inputs), np.nan)
