"""Groups of sounds that are alike: found among descriptors, and known again."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.messages.topics import EmbeddingSpace

LEAST = 8  # sounds of a group, by default
MOST_GROUPS = 1_000  # in a file
MOST_DIMENSIONS = 16
_CLOSE = 3  # neighbours by which a density is judged
MOST_EXAMPLES = 200  # that are kept of a group
_FEWEST_EMBEDDED = 16  # sounds, of which a space is made
_LARGEST = 0.75  # of the sounds: a cluster of more is several things, and what is between them
_RADIUS = 95  # percentile of the distances of its examples to the next one
_LEAST_RADIUS = 1e-6  # of sounds that are all the same
_AT_ONCE = 1024  # points
_ROUNDING = 1e-9  # of squares of distances that are computed by products
NO_GROUP = -1


@dataclass(frozen=True)
class Space:
    """A space in which sounds lie, and examples of groups there.

    Attributes
    ----------
    mean, scale : np.ndarray [shape=(width,)], float64
        Of the descriptors that the space was made of.
    axes : np.ndarray [shape=(d, width)], float64
        Their principal axes.
    examples : np.ndarray [shape=(k, d)], float64
        Points of sounds of the groups.
    of : np.ndarray [shape=(k,)], int64
        The row of the group of each example, ascending.
    radii : np.ndarray [shape=(g,)], float64
        A sound within this distance of an example is of the group.
    """

    mean: Float64
    scale: Float64
    axes: Float64
    examples: Float64
    of: Int64
    radii: Float64

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
            for row in np.unique(self.of):
                radius = self.radii[row]
                away = _distances(points[part], examples[row], radius) / radius
                closer = (away <= 1.0) & (away < nearest[part])
                nearest[part][closer], found[part][closer] = away[closer], row
        return found


_Space = TypeVar("_Space", bound=Space)


@dataclass(frozen=True)
class Groups(Space):
    """Groups, and the spaces in which they lie: by features, and with what a network hears, too.

    A group has examples in both, or in the one of features alone.

    Attributes
    ----------
    numbers : np.ndarray [shape=(g,)], int64
        Of the groups; a number is never used again.
    names : list of str
        Classes that a person named groups; empty where nobody did.
    id : str
        What no other groups have: of which file a mark has its group.
    embedding : EmbeddingSpace or None
        Of the embeddings that sounds are described by, too; None for none.
    """

    features: tuple[str, ...]
    numbers: Int64
    names: list[str] = field(default_factory=list)
    id: str = ""
    embedding: EmbeddingSpace | None = None
    embedded: Space | None = None

    def of_sounds(
        self, descriptors: Float32, embeddings: Float32, embedding: EmbeddingSpace | None
    ) -> Int64:
        """Return the row of the group of each sound; `NO_GROUP` for one that is of none.

        Parameters
        ----------
        descriptors : np.ndarray [shape=(n, width)], float32
        embeddings : np.ndarray [shape=(n, k)], float32
            NaN for a sound without any.
        """
        of, heard = np.empty(len(descriptors), np.int64), self.are_comparable(embeddings)
        heard &= embedding == self.embedding
        of[~heard] = self.find(self.points(descriptors[~heard]))
        if self.embedded is not None and heard.any():
            both = np.concatenate([descriptors[heard], embeddings[heard]], axis=1)
            of[heard] = self.embedded.find(self.embedded.points(both))
        return of

    def space(self, *, embedded: bool) -> Space:
        """Return the space with embeddings, if it is wanted and there; else that of features."""
        return self.embedded if embedded and self.embedded is not None else self

    def are_comparable(self, embeddings: Float32) -> Bool:
        """Return which sounds have embeddings that can be compared with the groups."""
        if self.embedded is None or embeddings.shape[1] != len(self.embedded.mean) - len(self.mean):
            return np.zeros(len(embeddings), bool)
        return is_embedded(embeddings)


def is_embedded(embeddings: Float32) -> Bool:
    """Tell which sounds have an embedding."""
    if not embeddings.shape[1]:
        return np.zeros(len(embeddings), bool)
    return np.isfinite(embeddings.sum(axis=1))


def make_space(descriptors: Float32) -> Space:
    """Make a space of descriptors, in which there is no group yet.

    Parameters
    ----------
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
    return Space(mean, scale, axes, np.empty((0, dimensions)), nothing.astype(np.int64), nothing)


def new_groups(
    features: Sequence[str],
    descriptors: Float32,
    embedding: EmbeddingSpace | None = None,
    embeddings: Float32 | None = None,
) -> Groups:
    """Make the spaces of some sounds, without any group.

    Parameters
    ----------
    descriptors : np.ndarray [shape=(n, width)], float32
        At least two, of which some differ.
    embeddings : np.ndarray [shape=(n, k)], float32, optional
    """
    embedded = None
    if embedding is not None and embeddings is not None:
        heard = is_embedded(embeddings)
        if heard.sum() >= _FEWEST_EMBEDDED:
            both = np.concatenate([descriptors[heard], embeddings[heard]], axis=1)
            embedded = make_space(both)
    return Groups(
        **vars(make_space(descriptors)),
        features=tuple(features),
        numbers=np.empty(0, np.int64),
        embedding=None if embedded is None else embedding,
        embedded=embedded,
    )


def add_groups(
    groups: Groups,
    points: Float64,
    of: Int64,
    least: int = LEAST,
    embedded: Float64 | None = None,
) -> Groups:
    """Add the clusters of points that no group knows yet, the largest first: HDBSCAN.

    Those of all points are looked for, for what is left beside the groups of an earlier time would
    fall into others than it did among all.

    Parameters
    ----------
    points : np.ndarray [shape=(n, d)], float64
        In the order of time.
    of : np.ndarray [shape=(n,)], int64
        The row of the group that knows a point, or `NO_GROUP`. A cluster is new if most of its
        points are of none.
    least : int, optional
        Sounds of a group, at least.
    embedded : np.ndarray [shape=(n, d)], float64, optional
        Where the sounds lie by their embeddings, too: then clusters are looked for there.
    """
    from sklearn.cluster import HDBSCAN  # noqa: PLC0415

    if len(points) < max(2 * least, _CLOSE + 1):
        return groups
    clusters = HDBSCAN(
        min_cluster_size=least,
        min_samples=_CLOSE,
        max_cluster_size=max(int(_LARGEST * len(points)), least),
        copy=True,
    )
    labels = clusters.fit_predict(points if embedded is None else embedded)
    sizes = np.bincount(labels[labels >= 0])
    for label in np.argsort(-sizes, kind="stable"):
        own = labels == label
        new = own & (of == NO_GROUP)
        if 2 * new.sum() > own.sum() and new.sum() >= least and len(groups.numbers) < MOST_GROUPS:
            groups = _add(groups, points[new], None if embedded is None else embedded[new])
    return groups


def identified(groups: Groups) -> Groups:
    """Give groups that were made now an id, which others have only if they are the same."""
    arrays = [groups.mean, groups.scale, groups.axes, groups.examples, groups.of]
    if groups.embedded is not None:
        arrays.append(groups.embedded.examples)
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


def _add(groups: Groups, points: Float64, embedded: Float64 | None) -> Groups:
    number, row = groups.numbers.max(initial=0) + 1, len(groups.numbers)
    in_both = groups.embedded
    if in_both is not None:
        in_both = _with_examples(in_both, embedded, row)
    return replace(
        _with_examples(groups, points, row),
        numbers=np.append(groups.numbers, number),
        names=[*groups.names, ""],
        embedded=in_both,
    )


def _with_examples(space: _Space, points: Float64 | None, row: int) -> _Space:
    """Add a group to a space; None for one that has no examples there."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    if points is None:
        return replace(space, radii=np.append(space.radii, _LEAST_RADIUS))
    examples = points[np.linspace(0, len(points) - 1, min(len(points), MOST_EXAMPLES)).astype(int)]
    steps = cKDTree(examples).query(examples, 2)[0][:, 1]
    radius = max(float(np.percentile(steps, _RADIUS)), _LEAST_RADIUS)
    return replace(
        space,
        examples=np.concatenate([space.examples, examples]),
        of=np.append(space.of, np.full(len(examples), row)),
        radii=np.append(space.radii, radius),
    )
