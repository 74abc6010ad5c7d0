"""Embeddings of a network, read back from a log."""

import numpy as np

from hearthlog.analyzer.logs.spans import ranges
from hearthlog.models.embedding.projection import HOP_FRAMES, WINDOW_FRAMES, Embeddings
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import EmbeddingSource, EmbeddingSpace

LARGEST_FRAME = 1 << 62
_COMPONENT = "component_"  # of what a network hears: its groups of names make few things alike
_WINDOW = WINDOW_FRAMES * FRAME_NANOSECONDS
EMBEDDING_FIELDS = ("header.stamp", "frame", "frames", "values")


def embeddings_of(columns: Columns) -> Embeddings:
    """Return the embeddings that a log has.

    Raise `LogError` if no recorder writes such embeddings.
    """
    stamps, numbers, frames, values = (columns[path] for path in EMBEDDING_FIELDS)
    possible = (numbers <= LARGEST_FRAME) & (numbers % HOP_FRAMES == 0) & (frames == WINDOW_FRAMES)
    if not possible.all() or values.ndim != 2:
        raise LogError(f"{columns.topic}: holds embeddings that no recorder writes")
    return Embeddings(numbers.astype(np.int64), stamps, values)


def mean_embeddings(
    columns: Columns | None, starts: Int64, ends: Int64
) -> tuple[EmbeddingSpace | None, Float32]:
    """Return what a network hears in spans: its components, by how much of a window each is in.

    Parameters
    ----------
    columns : Columns or None
        Of one log, with stamps and values; None if it has no embeddings.
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.

    Returns
    -------
    space : EmbeddingSpace or None
        With what they can be compared; None for embeddings that do not say it.
    means : np.ndarray [shape=(n, k)], float32
        In steps of the logged integers; NaN for a span without a window.
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
        span, rows = ranges(first, counts)
        begins = np.cumsum(counts) - counts
        last = np.minimum(stamps[rows] + _WINDOW, ends[there][span])
        weights = (last - np.maximum(stamps[rows], starts[there][span])).astype(np.float64)
        weights /= np.add.reduceat(weights, begins)[span]
        means[there] = np.add.reduceat(weights[:, np.newaxis] * values[rows], begins)
    return source.space, means
