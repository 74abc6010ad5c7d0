"""Embeddings of a network, read back from a log."""

import numpy as np

from hearthlog.models.embedding.embeddings import HOP_FRAMES, WINDOW_FRAMES, Embeddings
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns

LARGEST_FRAME = 1 << 62
EMBEDDING_FIELDS = ("header.stamp", "frame", "frames", "values")


def embeddings_of(columns: Columns) -> Embeddings:
    """Return the embeddings that a log has.

    Parameters
    ----------
    columns : Columns
        Of the type `AudioEmbedding`, with `EMBEDDING_FIELDS`.

    Raises
    ------
    LogError
        If no recorder writes such embeddings.
    """
    stamps, numbers, frames, values = (columns[path] for path in EMBEDDING_FIELDS)
    possible = (numbers <= LARGEST_FRAME) & (numbers % HOP_FRAMES == 0) & (frames == WINDOW_FRAMES)
    if not possible.all() or values.ndim != 2:
        raise LogError(f"{columns.topic}: holds embeddings that no recorder writes")
    return Embeddings(numbers.astype(np.int64), stamps, values)
