"""Directions of an array, read back from its log."""

import numpy as np

from hearthlog.models.classifiers.evidence import BLOCK_FRAMES, Directions
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns

LARGEST_FRAME = 1 << 62
DIRECTION_FIELDS = ("header.stamp", "frame", "azimuth", "confidence")


def directions_of(columns: Columns) -> Directions:
    """Return the directions that a log has.

    Raise `LogError` if no array has such directions.
    """
    stamps, numbers, azimuths, confidences = (columns[path] for path in DIRECTION_FIELDS)
    possible = (numbers <= LARGEST_FRAME) & (numbers % BLOCK_FRAMES == 0)
    possible &= (np.abs(azimuths) <= np.float32(np.pi)) & (confidences >= 0) & (confidences <= 1)
    if not possible.all():
        raise LogError(f"{columns.topic}: holds directions that no array has")
    return Directions(numbers.astype(np.int64), stamps, azimuths, confidences)
