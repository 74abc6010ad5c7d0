"""Embeddings of one stream of frames, in the integers in which they are logged."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.frame_spans import FrameSpans

WINDOW_FRAMES = 20  # of a window: a second, in whose middle the network's input lies
HOP_FRAMES = 10  # from one window to the next; windows begin at multiples of it
DELAY_FRAMES = WINDOW_FRAMES - 1  # from a frame to the last one of the last window that says of it

Int8 = NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Embeddings(FrameSpans):
    """Embeddings of windows in which there was sound; windows begin at multiples of ten frames.

    Attributes
    ----------
    values : np.ndarray [shape=(m, W)], int8
        As `Projection.quantise` gives them.
    """

    LENGTH = WINDOW_FRAMES

    values: Int8


NO_EMBEDDINGS = Embeddings(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 0), np.int8))
