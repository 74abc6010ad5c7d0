"""Which sound may be kept, and which of it is wanted. No I/O."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hearthlog.models.classes import SILENCE, class_name
from hearthlog.recorder.events import Frames
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.times import NANOSECONDS

Keep = Literal["off", "events", "unsure", "always"]

# Of a second that is heard for speech: measured, see docs/recorder.md.
PRIVATE_LIMIT = 0.02
UNSURE_CONFIDENCE = 0.5
UNSURE_NOVELTY = 0.7
_BEHIND_FRAMES = NANOSECONDS // FRAME_NANOSECONDS


class Labelled(NamedTuple):
    """What a classifier says of successive frames.

    Attributes
    ----------
    classes : tuple of str
    probabilities : np.ndarray [shape=(n, C)], float32
    novelty : np.ndarray [shape=(n,)], float32
    """

    classes: tuple[str, ...]
    probabilities: Float32
    novelty: Float32


class Sound(NamedTuple):
    """Frames of sound to be kept, which follow each other.

    Attributes
    ----------
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    samples : np.ndarray [shape=(n, 800)], int16
    """

    stamps: Int64
    samples: NDArray[np.int16]


class ClipFinder:
    """Holds sound back until it is known whether it may be kept, and is wanted.

    A label speaks of the window that ends with its frame. A frame may be kept if all windows with
    it were labelled, and none of them is likely to be of a class that is never kept. Frames
    next to a gap are not in so many windows, and are not kept.

    Parameters
    ----------
    keep : Keep
        `events`: sound around all that is not called silence; `unsure`: around what the model is
        not sure of, or has not learned; `always`: everything.
    never : sequence of str
        Classes that are never kept.
    pre_roll_frames : int
        Kept before the sound that is wanted.
    window_frames : int
        Of which a label speaks.
    """

    def __init__(
        self, keep: Keep, never: Sequence[str], pre_roll_frames: int, window_frames: int
    ) -> None:
        self._window = window_frames
        self._keep = keep
        self._never = tuple(never)
        # So much sound before a label's frame is wanted because of it.
        self._before = 0 if keep == "always" else self._window - 1 + pre_roll_frames
        self._ahead = max(self._before, self._window - 1)
        self._begin()

    def _begin(self) -> None:
        """Hold nothing. `_private` and `_wanted` begin some frames before the sound that is held.

        These frames are decided on, but what is behind them is wanted because of them.
        """
        self._next = -1
        self._samples: NDArray[np.int16] = np.empty((0, FRAME_SAMPLES), np.int16)
        self._stamps: Int64 = np.empty(0, np.int64)
        self._private: Float32 = self._unlabelled(_BEHIND_FRAMES)
        self._wanted: Bool = np.zeros(_BEHIND_FRAMES, bool)

    def push(self, frames: Frames, labelled: Labelled | None) -> list[Sound]:
        """Add frames, the last of which are labelled, and return what is now known to be kept.

        The labels must know all classes that are never kept.
        """
        found = []
        if frames.first != self._next:
            found = self.close()
        self._next = frames.first + len(frames.samples)
        self._append(frames, labelled)
        return [*found, *self._decide(len(self._samples) - self._ahead)]

    def close(self) -> list[Sound]:
        """Return what is to be kept of a sound that ends, and begin anew."""
        self._private = np.append(self._private, self._unlabelled(self._ahead))
        self._wanted = np.append(self._wanted, np.zeros(self._ahead, bool))
        found = self._decide(len(self._samples))
        self._begin()
        return found

    def _append(self, frames: Frames, labelled: Labelled | None) -> None:
        count = len(frames.samples)
        private, wanted = self._unlabelled(count), np.zeros(count, bool)
        if labelled is not None and len(labelled.novelty):
            last = slice(count - len(labelled.novelty), None)
            private[last], wanted[last] = self._of_labels(labelled)
        self._samples = np.concatenate([self._samples, _pcm(frames.samples)])
        self._stamps = np.append(self._stamps, frames.stamps)
        self._private = np.append(self._private, private)
        self._wanted = np.append(self._wanted, wanted)

    def _of_labels(self, labelled: Labelled) -> tuple[Float32, Bool]:
        classes, probabilities, novelty = labelled
        never = [classes.index(name) for name in self._never]
        private = probabilities[:, never].max(axis=1, initial=0.0)
        if self._keep == "unsure":
            sure = probabilities.max(axis=1) >= UNSURE_CONFIDENCE
            return private, ~sure | (novelty > UNSURE_NOVELTY)
        loud = np.array([class_name(name) != SILENCE for name in classes])
        return private, loud[probabilities.argmax(axis=1)]

    def _unlabelled(self, count: int) -> Float32:
        """Take what is not labelled for private, unless nothing is."""
        return np.full(count, np.inf if self._never else 0.0, np.float32)

    def _decide(self, count: int) -> list[Sound]:
        """Decide on the first frames that are held."""
        if count <= 0:
            return []
        private = self._private[_BEHIND_FRAMES:][: count + self._window - 1]
        kept = sliding_window_view(private, self._window).max(axis=1) < PRIVATE_LIMIT
        if self._keep != "always":
            around = self._wanted[: _BEHIND_FRAMES + count + self._before]
            kept &= sliding_window_view(around, _BEHIND_FRAMES + self._before + 1).any(axis=1)
        edges = np.flatnonzero(np.diff(kept, prepend=False, append=False))
        found = [
            Sound(self._stamps[start:end], self._samples[start:end])
            for start, end in edges.reshape(-1, 2).tolist()
        ]
        self._samples, self._stamps = self._samples[count:], self._stamps[count:]
        self._private, self._wanted = self._private[count:], self._wanted[count:]
        return found


def _pcm(samples: Float32) -> NDArray[np.int16]:
    return np.clip(np.rint(samples * 32768.0), -32768, 32767).astype(np.int16)
