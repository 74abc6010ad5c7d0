"""Whence sound came, and what that says of its class: a home's television stays in its corner."""

from dataclasses import dataclass

import numpy as np

from hearthlog.models.frame_spans import FrameSpans
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64

BLOCK_FRAMES = 4  # for which there is one direction: 0.2 s
SECTORS = 36  # of the circle, that a model tells apart
MEMORY_BLOCKS = 5  # of which the last ones speak of a window: a second
MOST_EVIDENCE = 5.0  # that a direction is of a class, a logarithm


@dataclass(frozen=True, eq=False)
class Directions(FrameSpans):
    """Directions of the blocks of one stream of frames in which something could be located.

    Attributes
    ----------
    azimuths : np.ndarray [shape=(m,)], float32
        In radians, -pi to pi, counter-clockwise from x.
    confidences : np.ndarray [shape=(m,)], float32
        By how much the microphones agree on this direction more than on any, 0 to 1.
    """

    LENGTH = BLOCK_FRAMES

    azimuths: Float32
    confidences: Float32


NOWHERE = Directions(
    np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32)
)


def sectors_of(azimuths: Float32) -> Indices:
    """Return the sectors of the circle that directions are in; the middle of the first is ahead.

    Parameters
    ----------
    azimuths : np.ndarray [shape=(n,)], float32
        In radians.

    Returns
    -------
    np.ndarray [shape=(n,)], intp
        0 to 35, counter-clockwise.
    """
    places = np.rint(azimuths.astype(np.float64) * (SECTORS / (2 * np.pi)))
    return places.astype(np.intp) % SECTORS


class DirectionEvidence:
    """What directions say of the windows of one stream of frames.

    To a window belong the blocks that are complete with its last frame, of the last second. What
    each says is averaged, weighted by its confidence, since the blocks of one sound are no
    independent witnesses.

    Parameters
    ----------
    weights : np.ndarray [shape=(C, S)], float64
        Logarithms of how much likelier each class is with each sector.
    """

    def __init__(self, weights: Float64) -> None:
        self._weights = np.ascontiguousarray(weights.T)
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._recent = NOWHERE
        self._full_from: int | None = None

    def is_full(self, frame: int) -> bool:
        """Tell whether directions before the first frame leave no trace from a frame on."""
        return self._full_from is not None and frame >= self._full_from

    def push(self, directions: Directions, first: int, count: int, windows: int) -> Float64:
        """Add successive frames.

        Returns
        -------
        np.ndarray [shape=(windows, C)], float64
            What is added to the logarithms of the probabilities; 0 where nothing was located. The
            same frames give the same bits in pieces of any size.
        """
        if self._full_from is None:
            self._full_from = first + BLOCK_FRAMES * (MEMORY_BLOCKS + 1)
        known = self._recent.followed_by(directions)
        end = first + count
        # The last block that is complete with the last frame of each window.
        newest = np.arange(end - windows + 1, end + 1) // BLOCK_FRAMES - 1
        evidence = self._of_blocks(known, newest)
        oldest = (end // BLOCK_FRAMES - MEMORY_BLOCKS) * BLOCK_FRAMES
        self._recent = known.rows(slice(np.searchsorted(known.frames, oldest), None))
        return evidence

    def _of_blocks(self, known: Directions, newest: Int64) -> Float64:
        """Return what is said by the last second of blocks up to each of some."""
        if not len(newest):
            return np.zeros((0, self._weights.shape[1]))
        count = int(newest[-1] - newest[0]) + 1
        places = known.frames // BLOCK_FRAMES - newest[0] + MEMORY_BLOCKS - 1
        inside = (places >= 0) & (places < count + MEMORY_BLOCKS - 1)
        weights = self._weights[sectors_of(known.azimuths[inside])]
        witnesses = np.zeros((count + MEMORY_BLOCKS - 1, self._weights.shape[1] + 1))
        witnesses[places[inside]] = np.pad(weights, ((0, 0), (0, 1)), constant_values=1.0)
        witnesses[places[inside]] *= known.confidences[inside].astype(np.float64)[:, np.newaxis]
        total = np.zeros((count, witnesses.shape[1]))
        for age in range(MEMORY_BLOCKS):
            total += witnesses[age : age + count]
        means = total[:, :-1] / np.where(total[:, -1:] > 0, total[:, -1:], 1.0)
        return means[newest - newest[0]]
