"""Spans that stand for many: chosen so that what they have not taught is like one of them.

What a set of spans covers is a facility location function, of which the greedy choice has at least
1 - 1 / e of the most that is possible (Nemhauser, Wolsey and Fisher, "An analysis of approximations
for maximizing submodular set functions", 1978).
"""

import numpy as np

from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices

MOST_CANDIDATES = 3000  # of which all pairs are compared
_SEED = 20_261_123


def sample(weights: Float64, most: int = MOST_CANDIDATES) -> tuple[Indices, Float64]:
    """Choose rows that stand for all: each as likely as it weighs, spread over their order.

    Parameters
    ----------
    weights : np.ndarray [shape=(n,)], float64
        Not negative.

    Returns
    -------
    rows : np.ndarray [shape=(m,)], intp
        Ascending; all that weigh something, if they are not more. The same weights give the same.
    shares : np.ndarray [shape=(m,)], float64
        How much of the sum of all weights each of them stands for.
    """
    rows = np.flatnonzero(weights > 0.0)
    if len(rows) <= most:
        return rows, weights[rows]
    sums = np.cumsum(weights[rows])
    step = float(sums[-1]) / most
    places = (np.arange(most) + np.random.default_rng(_SEED).random(most)) * step
    hit, times = np.unique(np.searchsorted(sums, places), return_counts=True)
    return rows[hit], times * np.float64(step)


def cover(points: Float64, gamma: float, weights: Float64, eligible: Bool, count: int) -> Indices:
    """Choose points to which most of the weight of all points is similar.

    Each time it is the point that adds the most to the sum of weight times similarity to the
    nearest chosen point, where the similarity of x and y is exp(-gamma |x - y|^2).

    Parameters
    ----------
    points : np.ndarray [shape=(n, width)], float64
        A row that is not finite is similar to none.
    weights : np.ndarray [shape=(n,)], float64
        Not negative.
    eligible : np.ndarray [shape=(n,)], bool
        Which may be chosen.
    count : int
        How many, at most.

    Returns
    -------
    np.ndarray [shape=(m,)], intp
        In the order in which they were chosen; none that adds nothing.
    """
    similar = _similarities(points, gamma)
    nearest = np.zeros(len(points), np.float32)
    weight, left = weights.astype(np.float32), eligible.copy()
    chosen = []
    for _ in range(min(count, int(eligible.sum()))):
        gains = np.where(left, np.maximum(similar - nearest, 0.0) @ weight, 0.0)
        best = int(gains.argmax())
        if gains[best] <= 0.0:
            break
        chosen.append(best)
        left[best] = False
        nearest = np.maximum(nearest, similar[best])
    return np.array(chosen, np.intp)


def _similarities(points: Float64, gamma: float) -> Float32:
    known = np.isfinite(points.sum(axis=1))
    there = np.where(known[:, np.newaxis], points, 0.0).astype(np.float32)
    squares = np.vecdot(there, there)
    distances = squares[:, np.newaxis] + squares - 2.0 * (there @ there.T)
    similar = np.exp(np.float32(-gamma) * np.maximum(distances, 0.0))
    similar[~known], similar[:, ~known] = 0.0, 0.0
    np.fill_diagonal(similar, 1.0)
    return similar
