"""Directions and embeddings of a log as vectors, and their means over spans of time."""

from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.spans import concatenated_ranges
from hearthlog.models.classifiers.evidence import BLOCK_FRAMES, Directions
from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES, Embeddings
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import EmbeddingSource, EmbeddingSpace


class Bearings(NamedTuple):
    """Mean direction of the sound in each of some spans.

    Attributes
    ----------
    azimuths : np.ndarray [shape=(n,)], float64
        In radians, counter-clockwise from x; NaN if no sound was located.
    spreads : np.ndarray [shape=(n,)], float64
        Circular standard deviation, in radians; NaN if no sound was located. Large for a moving
        source or several sources.
    counts : np.ndarray [shape=(n,)], int64
        Number of located blocks.
    """

    azimuths: Float64
    spreads: Float64
    counts: Int64


def as_vectors(azimuths: Float32, confidences: Float32) -> Float64:
    """Convert directions (radians) to vectors [shape=(n, 2)] that can be added: ahead and left.

    The length is the confidence.
    """
    turned = azimuths.astype(np.float64)
    return np.stack([np.cos(turned), np.sin(turned)], axis=1) * confidences[:, np.newaxis]


def degrees_of(vectors: Float64) -> Float64:
    """Return the azimuths of vectors [shape=(n, 2)] ahead and left, in degrees, -180 to 180.

    90 is left; NaN gives NaN.
    """
    ahead, left = vectors.T
    return np.rad2deg(np.arctan2(left, ahead))


def mean_bearings(times: Int64, vectors: Float64, starts: Int64, ends: Int64) -> Bearings:
    """Compute the mean direction of the sound in each span.

    `times` [shape=(m,)] are the starts of the located blocks, ascending, in nanoseconds of UTC;
    `vectors` [shape=(m, 2)] are as from `as_vectors`. Spans may overlap; a block belongs to each
    span that contains its start. The circular mean and standard deviation are those of Mardia and
    Jupp, "Directional Statistics", 2000, weighted by the confidence.
    """
    first, last = np.searchsorted(times, starts), np.searchsorted(times, ends)
    weights = np.hypot(*vectors.T)
    sums = np.zeros((len(times) + 1, 3))
    np.cumsum(np.column_stack([vectors, weights]), axis=0, out=sums[1:])
    counts = np.maximum(last - first, 0)
    ahead, left, weight = np.where(counts[:, np.newaxis] > 0, sums[last] - sums[first], np.nan).T
    with np.errstate(divide="ignore"):
        agreement = np.minimum(np.hypot(ahead, left) / weight, 1.0)
        spreads = np.sqrt(-2 * np.log(agreement))
    return Bearings(np.arctan2(left, ahead), spreads, counts)


LARGEST_FRAME = 1 << 62
DIRECTION_FIELDS = ("header.stamp", "frame", "azimuth", "confidence")


def directions_of(columns: Columns) -> Directions:
    """Return the directions in a log.

    Raise `LogError` if the values are impossible for a microphone array.
    """
    stamps, numbers, azimuths, confidences = (columns[path] for path in DIRECTION_FIELDS)
    possible = (numbers <= LARGEST_FRAME) & (numbers % BLOCK_FRAMES == 0)
    possible &= (np.abs(azimuths) <= np.float32(np.pi)) & (confidences >= 0) & (confidences <= 1)
    if not possible.all():
        raise LogError(f"{columns.topic}: holds directions that no array has")
    return Directions(numbers.astype(np.int64), stamps, azimuths, confidences)


_COMPONENT = "component_"  # network components; the groups of class names hardly measure similarity
_WINDOW = WINDOW_FRAMES * FRAME_NANOSECONDS
EMBEDDING_FIELDS = ("header.stamp", "frame", "frames", "values")


def embeddings_of(columns: Columns) -> Embeddings:
    """Return the embeddings in a log.

    Raise `LogError` if the values are impossible for a recorder.
    """
    stamps, numbers, frames, values = (columns[path] for path in EMBEDDING_FIELDS)
    possible = (numbers <= LARGEST_FRAME) & (numbers % HOP_FRAMES == 0) & (frames == WINDOW_FRAMES)
    if not possible.all() or values.ndim != 2:
        raise LogError(f"{columns.topic}: holds embeddings that no recorder writes")
    return Embeddings(numbers.astype(np.int64), stamps, values)


def mean_embeddings(
    columns: Columns | None, starts: Int64, ends: Int64
) -> tuple[EmbeddingSpace | None, Float32]:
    """Return the mean embedding components of spans, weighted by the overlap with each window.

    `columns` are the embeddings of one log, with stamps and values; None if it has no embeddings.
    Starts and ends are nanoseconds of UTC. Means [shape=(n, k)] are in steps of the logged
    integers, NaN for a span without a window; they are comparable within the same space, which is
    None for embeddings without a source.
    """
    none = np.empty((len(starts), 0), np.float32)
    if columns is None or columns.type != message_types.EMBEDDING or not len(columns):
        return None, none
    source = EmbeddingSource.from_metadata(columns.metadata)
    if source is None or columns["values"].shape[1:] != (len(source.names),):
        return None, none
    own = [place for place, name in enumerate(source.names) if name.startswith(_COMPONENT)]
    if not own:
        return None, none
    order = np.argsort(columns["header.stamp"], kind="stable")  # a clock may have been set back
    stamps, values = columns["header.stamp"][order], columns["values"][order][:, own]
    means = np.full((len(starts), len(own)), np.nan, np.float32)
    first = np.searchsorted(stamps + _WINDOW, starts, "right")
    counts = np.searchsorted(stamps, ends) - first
    there = np.flatnonzero(counts > 0)
    if len(there):
        first, counts = first[there].astype(np.int64), counts[there].astype(np.int64)
        span, rows = concatenated_ranges(first, counts)
        begins = np.cumsum(counts) - counts
        last = np.minimum(stamps[rows] + _WINDOW, ends[there][span])
        weights = (last - np.maximum(stamps[rows], starts[there][span])).astype(np.float64)
        weights /= np.add.reduceat(weights, begins)[span]
        means[there] = np.add.reduceat(weights[:, np.newaxis] * values[rows], begins)
    return source.space, means
