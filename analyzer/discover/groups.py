"""Groups of sounds that are alike: found among descriptors, and known again."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hearthlog.schemas.arrays import Float32, Float64, Int64

LEAST = 8  # sounds of a group, by default
MOST_GROUPS = 1_000  # in a file
MOST_DIMENSIONS = 16
_CLOSE = 3  # neighbours by which a density is judged
MOST_EXAMPLES = 200  # that are kept of a group
_RADIUS = 95  # percentile of the distances of its examples to the next one
_LEAST_RADIUS = 1e-6  # of sounds that are all the same
_AT_ONCE = 1024  # points
_ROUNDING = 1e-9  # of squares of distances that are computed by products
NO_GROUP = -1


@dataclass(frozen=True)
class Groups:
    """Groups, and the space in which they lie.

    Attributes
    ----------
    features : tuple of str
        The names of the features that the sounds are described by.
    mean, scale : np.ndarray [shape=(width,)], float64
        Of the descriptors that the space was made of.
    axes : np.ndarray [shape=(d, width)], float64
        Their principal axes.
    examples : np.ndarray [shape=(k, d)], float64
        Points of sounds of the groups.
    of : np.ndarray [shape=(k,)], int64
        The row of the group of each example, ascending.
    numbers : np.ndarray [shape=(g,)], int64
        Of the groups; a number is never used again.
    radii : np.ndarray [shape=(g,)], float64
        A sound within this distance of an example is of the group.
    names : list of str
        Classes that a person named groups; empty where nobody did.
    id : str
        What no other groups have: of which file a mark has its group.
    """

    features: tuple[str, ...]
    mean: Float64
    scale: Float64
    axes: Float64
    examples: Float64
    of: Int64
    numbers: Int64
    radii: Float64
    names: list[str] = field(default_factory=list)
    id: str = ""

    def points(self, descriptors: Float32) -> Float64:
        """Return where described sounds lie, shape (n, d)."""
        return ((descriptors - self.mean) / self.scale) @ self.axes.T

    def find(self, points: Float64) -> Int64:
        """Return the row of the group of each point; `NO_GROUP` for one that is of none.

        Of several groups it is that to whose examples a point is nearest, by their radii.
        """
        examples = [self.examples[self.of == row] for row in range(len(self.radii))]
        nearest, found = np.full(len(points), np.inf), np.full(len(points), NO_GROUP)
        for first in range(0, len(points), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            for row, radius in enumerate(self.radii):
                away = _distances(points[part], examples[row], radius) / radius
                closer = (away <= 1.0) & (away < nearest[part])
                nearest[part][closer], found[part][closer] = away[closer], row
        return found


def make_space(features: Sequence[str], descriptors: Float32) -> Groups:
    """Make a space of descriptors, in which there is no group yet.

    Parameters
    ----------
    features : sequence of str
        Their names.
    descriptors : np.ndarray [shape=(n, width)], float32
        At least two, of which some differ.
    """
    from sklearn.decomposition import PCA  # noqa: PLC0415

    x = descriptors.astype(np.float64)
    mean, scale = x.mean(axis=0), x.std(axis=0)
    scale[scale == 0.0] = 1.0
    dimensions = min(MOST_DIMENSIONS, *x.shape)
    axes = PCA(dimensions, svd_solver="full").fit((x - mean) / scale).components_
    nothing = np.empty(0)
    return Groups(
        tuple(features),
        mean,
        scale,
        axes,
        np.empty((0, dimensions)),
        nothing.astype(np.int64),
        nothing.astype(np.int64),
        nothing,
    )


def add_groups(groups: Groups, points: Float64, of: Int64, least: int = LEAST) -> Groups:
    """Add the clusters of points that no group knows yet, the largest first: HDBSCAN.

    Those of all points are looked for, for what is left beside the groups of an earlier time would
    fall into others than it did among all.

    Parameters
    ----------
    groups : Groups
    points : np.ndarray [shape=(n, d)], float64
        In the order of time.
    of : np.ndarray [shape=(n,)], int64
        The row of the group that knows a point, or `NO_GROUP`. A cluster is new if most of its
        points are of none.
    least : int, optional
        Sounds of a group, at least.
    """
    from sklearn.cluster import HDBSCAN  # noqa: PLC0415

    if len(points) < max(2 * least, _CLOSE + 1):
        return groups
    clusters = HDBSCAN(min_cluster_size=least, min_samples=_CLOSE, copy=True)
    labels = clusters.fit_predict(points)
    sizes = np.bincount(labels[labels >= 0])
    for label in np.argsort(-sizes, kind="stable"):
        own = labels == label
        new = own & (of == NO_GROUP)
        if 2 * new.sum() > own.sum() and new.sum() >= least and len(groups.numbers) < MOST_GROUPS:
            groups = _add(groups, points[new])
    return groups


def identified(groups: Groups) -> Groups:
    """Give groups that were made now an id, which others have only if they are the same."""
    arrays = groups.mean, groups.scale, groups.axes, groups.examples, groups.of
    digest = hashlib.sha256(b"".join(each.tobytes() for each in arrays)).hexdigest()
    return replace(groups, id=digest[:8])


def _distances(points: Float64, examples: Float64, radius: float) -> Float64:
    """Return how far each point is from the nearest example; infinity beyond the radius.

    Products of matrices, which are fast and not exact, only tell which points are surely beyond.
    """
    own, theirs = (points**2).sum(axis=1), (examples**2).sum(axis=1)
    squares = own[:, np.newaxis] + theirs - 2.0 * points @ examples.T
    slack = _ROUNDING * (radius**2 + own.max() + theirs.max())
    near = np.flatnonzero(squares.min(axis=1) <= radius**2 + slack)
    away = np.full(len(points), np.inf)
    differences = points[near][:, np.newaxis] - examples
    away[near] = np.sqrt((differences**2).sum(axis=2).min(axis=1))
    return away


def _add(groups: Groups, points: Float64) -> Groups:
    from scipy.spatial import cKDTree  # noqa: PLC0415

    examples = points[np.linspace(0, len(points) - 1, min(len(points), MOST_EXAMPLES)).astype(int)]
    steps = cKDTree(examples).query(examples, 2)[0][:, 1]
    radius = max(float(np.percentile(steps, _RADIUS)), _LEAST_RADIUS)
    number = groups.numbers.max(initial=0) + 1
    return replace(
        groups,
        examples=np.concatenate([groups.examples, examples]),
        of=np.append(groups.of, np.full(len(examples), len(groups.numbers))),
        numbers=np.append(groups.numbers, number),
        radii=np.append(groups.radii, radius),
        names=[*groups.names, ""],
    )
