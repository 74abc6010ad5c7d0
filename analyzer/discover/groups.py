"""Groups of similar sounds: descriptors, clusters, and the groups file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StringConstraints

from hearthlog.analyzer.discover import (
    MOST_CLUSTERS,
    NO_CLUSTER,
    ClusterId,
    ClusterKind,
    ClusterNames,
    Clusters,
    StrictModel,
    are_numbers,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.spans import concatenated_ranges
from hearthlog.models.classifiers.model import MOST_VALUES
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.messages.topics import EmbeddingSpace

LEAST = 8  # default minimum of sounds per group
MOST_DIMENSIONS = 16
_CLOSE = 3  # neighbours of a density estimate
MOST_EXAMPLES = 200  # kept per group
_FEWEST_EMBEDDED = 16  # sounds needed to build an embedding space
_LARGEST_CLUSTER = (
    0.75  # of the sounds: a larger cluster merges several things and the gaps between them
)
_RADIUS = 95  # percentile of the distances from examples to their nearest example
_LEAST_RADIUS = 1e-6  # for groups of identical sounds
_AT_ONCE = 1024  # points
_MAPPED_AT_ONCE = 10_000  # sounds
_ROUNDING = 1e-9  # error of squared distances computed by matrix products


@dataclass(frozen=True)
class Space:
    """A descriptor space with examples of groups."""

    mean: Float64  # [shape=(width,)]; of the descriptors the space was fitted on
    scale: Float64  # [shape=(width,)]; likewise
    axes: Float64  # [shape=(d, width)]; principal axes of the descriptors
    examples: Float64  # [shape=(k, d)]; points of example sounds
    of: Int64  # [shape=(k,)]; group row of each example, ascending
    radii: Float64  # [shape=(g,)]; a sound so near to an example belongs to the group

    def points(self, descriptors: Float32) -> Float64:
        """Return the points of descriptors, shape (n, d)."""
        return ((descriptors - self.mean) / self.scale) @ self.axes.T

    def find(self, points: Float64) -> Int64:
        """Return the group row of each point; `NO_CLUSTER` for a point without a group.

        If several groups match, the nearest example relative to the group's radius decides.
        """
        examples = [self.examples[self.of == row] for row in range(len(self.radii))]
        nearest, found = np.full(len(points), np.inf), np.full(len(points), NO_CLUSTER)
        for first in range(0, len(points), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            for row in np.unique(self.of):
                radius = self.radii[row]
                away = _distances(points[part], examples[row], radius) / radius
                closer = (away <= 1.0) & (away < nearest[part])
                nearest[part][closer], found[part][closer] = away[closer], row
        return found

    def with_group(self, points: Float64 | None) -> "Space":
        """Return a copy with a group of points; None for a group without examples here."""
        from scipy.spatial import cKDTree  # noqa: PLC0415

        if points is None:
            return replace(self, radii=np.append(self.radii, _LEAST_RADIUS))
        count = min(len(points), MOST_EXAMPLES)
        examples = points[np.linspace(0, len(points) - 1, count).astype(int)]
        steps = cKDTree(examples).query(examples, 2)[0][:, 1]
        radius = max(float(np.percentile(steps, _RADIUS)), _LEAST_RADIUS)
        return replace(
            self,
            examples=np.concatenate([self.examples, examples]),
            of=np.append(self.of, np.full(count, len(self.radii))),
            radii=np.append(self.radii, radius),
        )


@dataclass(frozen=True)
class Groups(Clusters):
    """Groups in two spaces: features alone, and features with embeddings.

    A group has examples in both spaces, or in the feature space alone.
    """

    features: tuple[str, ...]
    space: Space
    embedding: EmbeddingSpace | None = None  # space of the embeddings in the descriptors, if any
    embedded: Space | None = None

    def points(self, descriptors: Float32, embeddings: Float32) -> tuple[Float64, Float64]:
        """Return the points of sounds in both spaces: [shape=(n, d)] and [shape=(n, e)].

        Embeddings [shape=(n, k)] are in the space of the groups' embeddings. A sound without is
        NaN, also in its point; e is 0 if the groups have none.
        """
        points = np.empty((len(descriptors), len(self.space.axes)))
        width = 0 if self.embedded is None else len(self.embedded.axes)
        embedded = np.full((len(points), width), np.nan)
        for first in range(0, len(points), _MAPPED_AT_ONCE):
            part = slice(first, first + _MAPPED_AT_ONCE)
            points[part] = self.space.points(descriptors[part])
            if self.embedded is not None and self.are_comparable(embeddings[part]).any():
                both = np.concatenate([descriptors[part], embeddings[part]], axis=1)
                embedded[part] = self.embedded.points(both)
        return points, embedded

    def find(self, points: Float64, embedded: Float64) -> Int64:
        """Return the group row of each sound; `NO_CLUSTER` for a sound without a group."""
        if self.embedded is None:
            return self.space.find(points)
        of, embedded_rows = np.empty(len(points), np.int64), is_embedded(embedded)
        of[embedded_rows] = self.embedded.find(embedded[embedded_rows])
        of[~embedded_rows] = self.space.find(points[~embedded_rows])
        return of

    def are_comparable(self, embeddings: Float32) -> Bool:
        """Return which sounds have embeddings comparable with those of the groups."""
        width = 0 if self.embedded is None else len(self.embedded.mean) - len(self.space.mean)
        if embeddings.shape[1] != width:
            return np.zeros(len(embeddings), bool)
        return is_embedded(embeddings)


def is_embedded(embeddings: Float32 | Float64) -> Bool:
    """Return which sounds have an embedding."""
    if not embeddings.shape[1]:
        return np.zeros(len(embeddings), bool)
    return np.isfinite(embeddings.sum(axis=1))


def make_space(descriptors: Float32) -> Space:
    """Fit a space without groups to at least two descriptors [shape=(n, width)], not all equal."""
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
    """Fit the spaces of at least two sounds, not all equal, without groups.

    Descriptors have shape (n, width), embeddings (n, k).
    """
    embedded = None
    if embedding is not None and embeddings is not None:
        embedded_rows = is_embedded(embeddings)
        if embedded_rows.sum() >= _FEWEST_EMBEDDED:
            both = np.concatenate([descriptors[embedded_rows], embeddings[embedded_rows]], axis=1)
            embedded = make_space(both)
    return Groups(
        np.empty(0, np.int64),
        tuple(features),
        make_space(descriptors),
        None if embedded is None else embedding,
        embedded,
    )


def add_groups(
    groups: Groups,
    points: Float64,
    of: Int64,
    least: int = LEAST,
    embedded: Float64 | None = None,
) -> Groups:
    """Add new HDBSCAN clusters of `least` sounds or more as groups, largest first.

    All points [shape=(n, d)], in time order, are clustered, since the points outside existing
    groups would cluster differently alone; points in the embedding space are used instead if there
    are any. A cluster is new if most of its points have no group: `of` is the group row, or
    `NO_CLUSTER`.
    """
    from sklearn.cluster import HDBSCAN  # noqa: PLC0415

    if len(points) < max(2 * least, _CLOSE + 1):
        return groups
    clusters = HDBSCAN(
        min_cluster_size=least,
        min_samples=_CLOSE,
        max_cluster_size=max(int(_LARGEST_CLUSTER * len(points)), least),
        copy=True,
    )
    labels = clusters.fit_predict(points if embedded is None else embedded)
    sizes = np.bincount(labels[labels >= 0])
    for label in np.argsort(-sizes, kind="stable"):
        own = labels == label
        new = own & (of == NO_CLUSTER)
        if 2 * new.sum() > own.sum() and new.sum() >= least and len(groups.numbers) < MOST_CLUSTERS:
            in_both = groups.embedded and groups.embedded.with_group(
                None if embedded is None else embedded[new]
            )
            space = groups.space.with_group(points[new])
            groups = groups.with_new(1, space=space, embedded=in_both)
    return groups


def identified(groups: Groups) -> Groups:
    """Assign an id to new groups; equal ids mean equal groups."""
    space = groups.space
    arrays = [space.mean, space.scale, space.axes, space.examples, space.of]
    return groups.identified(arrays + ([groups.embedded.examples] if groups.embedded else []))


def _distances(points: Float64, examples: Float64, radius: float) -> Float64:
    """Return the distance of each point to the nearest example; infinity beyond the radius.

    Fast but inexact matrix products only exclude the points that are surely beyond the radius.
    """
    own, theirs = (points**2).sum(axis=1), (examples**2).sum(axis=1)
    squares = own[:, np.newaxis] + theirs - 2.0 * points @ examples.T
    slack = _ROUNDING * (radius**2 + own.max() + theirs.max())
    near = np.flatnonzero(squares.min(axis=1) <= radius**2 + slack)
    away = np.full(len(points), np.inf)
    differences = points[near][:, np.newaxis] - examples
    away[near] = np.sqrt((differences**2).sum(axis=2).min(axis=1))
    return away


_ENERGY = "energy"
_WEIGHT = 0.3  # power of the energy: the loud part of a sound dominates, the decay counts a little
_LEAST_ENERGY = 1e-12
_DESCRIBED_AT_ONCE = 16_384  # frames of sounds, or one sound: fits the memory of a small box


def descriptor_width(names: Sequence[str]) -> int:
    """Return the descriptor length for these features."""
    return 3 * len(_used(names)) + 1


def describe(values: Float32, names: Sequence[str], first: Int64, last: Int64) -> Float32:
    """Return descriptors [shape=(n, descriptor_width(names))] of sounds.

    They are means, standard deviations and mean absolute differences of successive frames, each
    feature by feature, and the binary logarithm of the number of frames. Values [shape=(frames, f)]
    are named; the energy weights the frames and is not part of the result. `first` and `last`
    (exclusive) are the rows of each sound.
    """
    if not len(first):
        return np.empty((0, descriptor_width(names)), np.float32)
    block = np.cumsum(last - first) // _DESCRIBED_AT_ONCE
    begins = np.flatnonzero(np.diff(block, prepend=-1))
    ends = np.append(begins[1:], len(first))
    blocks = zip(begins, ends, strict=True)
    return np.concatenate(
        [_described(values, names, first[begin:end], last[begin:end]) for begin, end in blocks]
    )


def _described(values: Float32, names: Sequence[str], first: Int64, last: Int64) -> Float32:
    counts = last - first
    sound, rows = concatenated_ranges(first, counts)
    begins = np.cumsum(counts) - counts
    x = values[rows][:, _used(names)].astype(np.float64)
    weights = _weights(values[rows], names)
    weights /= np.repeat(np.add.reduceat(weights, begins), counts)
    mean = np.add.reduceat(weights[:, np.newaxis] * x, begins)
    x -= mean[sound]
    deviation = np.sqrt(np.add.reduceat(weights[:, np.newaxis] * x**2, begins))
    change = np.abs(np.diff(x, axis=0, prepend=x[:1]))
    change[begins] = 0.0
    change = np.add.reduceat(change, begins) / np.maximum(counts - 1, 1)[:, np.newaxis]
    parts = mean, deviation, change, np.log2(counts)[:, np.newaxis]
    return np.concatenate(parts, axis=1).astype(np.float32)


def _used(names: Sequence[str]) -> list[int]:
    return [place for place, name in enumerate(names) if name != _ENERGY]


def _weights(values: Float32, names: Sequence[str]) -> Float64:
    if _ENERGY not in names:
        return np.ones(len(values))
    energy = values[:, list(names).index(_ENERGY)].astype(np.float64)
    return np.maximum(energy, _LEAST_ENERGY) ** _WEIGHT


_FORMAT: Final = 1
_FORMAT_OF_EMBEDDINGS: Final = 2  # refused by versions without embedding support
_SMALL, _LARGE = 1e-6, 1e6  # limits of radii and scales; all other numbers are at most as large
_ARRAYS = {"mean": 1, "scale": 1, "axes": 2, "examples": 2, "of": 1, "radii": 1}  # of a space
_EMBEDDED = "embedded_"  # prefix of the arrays of the embedding space
_INTEGERS = {"of", "numbers"}

_Name = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]


class _Embedding(StrictModel):
    network: _Name
    projection_sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
    width: Annotated[int, Field(ge=1, le=MOST_VALUES)]


class _Header(StrictModel):
    format: Annotated[int, Field(ge=1, le=_FORMAT_OF_EMBEDDINGS)]
    id: ClusterId
    features: Annotated[list[_Name], Field(min_length=1, max_length=256)]
    names: ClusterNames
    embedding: _Embedding | None = None


GROUPS: Final = ClusterKind("group", "discover", "3=doorbell", _Header, 64 << 20)


def save_groups(groups: Groups, path: Path) -> None:
    """Write the groups file, replacing an existing one.

    Raise `LogError` if it cannot be written.
    """
    arrays = {"numbers": groups.numbers, **vars(groups.space)}
    number, embedding = _FORMAT, None
    if groups.embedding is not None:
        number, embedding = _FORMAT_OF_EMBEDDINGS, _Embedding(**groups.embedding._asdict())
        arrays |= {_EMBEDDED + name: array for name, array in vars(groups.embedded).items()}
    header = _Header(
        format=number,
        id=groups.id,
        features=list(groups.features),
        names=groups.names,
        embedding=embedding,
    )
    GROUPS.write(path, arrays, header)


def load_groups(path: Path) -> Groups | None:
    """Read the groups file; None if it does not exist.

    Raise `DataError` if it is not a groups file, or damaged.
    """
    found = GROUPS.read(path)
    if found is None:
        return None
    arrays, header = found
    if problem := _problem(header, arrays):
        raise DataError(f"{path}: is damaged: {problem}; move it away to begin anew")
    embedding, embedded = None, None
    if header.embedding is not None:
        embedding = EmbeddingSpace(**header.embedding.model_dump())
        embedded = Space(**{name: arrays[_EMBEDDED + name] for name in _ARRAYS})
    return Groups(
        arrays["numbers"],
        tuple(header.features),
        Space(**{name: arrays[name] for name in _ARRAYS}),
        embedding,
        embedded,
        names=header.names,
        id=header.id,
    )


def _problem(header: _Header, arrays: dict[str, NDArray[Any]]) -> str:
    """Return the inconsistency of a groups file; empty if there is none."""
    expected = {"numbers": 1, **_ARRAYS}
    if header.embedding is not None:
        expected |= {_EMBEDDED + name: dimensions for name, dimensions in _ARRAYS.items()}
    if arrays.keys() != expected.keys():
        return "it has other arrays"
    for name, dimensions in expected.items():
        is_integer = name.removeprefix(_EMBEDDED) in _INTEGERS
        array, kind = arrays[name], np.int64 if is_integer else np.float64
        if array.ndim != dimensions or array.dtype != kind:
            return f"{name} is not as it has to be"
        if not is_integer and not (np.abs(array) <= _LARGE).all():
            return f"{name} has numbers that are too large, or none"
    width, numbers = descriptor_width(header.features), arrays["numbers"]
    fits = (
        are_numbers(numbers, header.names)
        and _fits(arrays, "", len(numbers), (width, width))
        and np.array_equal(np.unique(arrays["of"]), np.arange(len(numbers)))
    )
    if fits and header.embedding is not None:
        widths = width + 1, width + header.embedding.width
        fits = _fits(arrays, _EMBEDDED, len(numbers), widths)
    return "" if fits else "its arrays do not fit each other"


def _fits(
    arrays: dict[str, NDArray[Any]], prefix: str, count: int, widths: tuple[int, int]
) -> bool:
    """Return whether shapes, group rows and scales of a space's arrays are consistent."""
    mean, scale, axes, examples, of, radii = (arrays[prefix + name] for name in _ARRAYS)
    return bool(
        mean.shape == scale.shape == axes.shape[1:]
        and widths[0] <= len(mean) <= widths[1]
        and examples.shape[1:] == axes.shape[:1]
        and radii.shape == (count,)
        and of.shape == examples.shape[:1]
        and np.isin(of, np.arange(count)).all()
        and np.bincount(of, minlength=1).max() <= MOST_EXAMPLES
        and (radii >= _SMALL).all()
        and (scale >= _SMALL).all()
        and 1 <= len(axes) <= MOST_DIMENSIONS
    )
