"""Which sound may be kept, and which of it is worth keeping. No I/O."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.recorder.config import Keep
from hearthlog.recorder.events import Frames
from hearthlog.schemas.arrays import Bool, Float32, Int16, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.times import NANOSECONDS

# Probability of speech: measured, see docs/recorder.md. The higher limit is for models whose
# probabilities hold for people whom they were not learned from.
PRIVATE_LIMIT, PRIVATE_LIMIT_ELSEWHERE = 0.02, 0.04
_UNSURE_CONFIDENCE = 0.5
_UNSURE_NOVELTY = 0.7
_AFTER_FRAMES = NANOSECONDS // FRAME_NANOSECONDS
_BEHIND_FRAMES = 12  # with a window of 0.4 s before them: what ended less than a second ago counts


class KeptSound(NamedTuple):
    """Successive frames of sound to be kept.

    Attributes
    ----------
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    samples : np.ndarray [shape=(n, 800)], int16
    """

    stamps: Int64
    samples: Int16


class ClipFinder:
    """Holds sound back until it is certain whether it may be kept, and is worth keeping.

    A label is known with the last frame of its window. A frame may be kept if all windows within a
    second of it, before and behind, were labelled, and none of them is likely to be of a class that
    is never kept. Frames beside a gap have fewer windows, and are not kept.

    Parameters
    ----------
    keep : Keep
        `events`: sound around all that is not labelled silence; `unsure`: around what the model is
        not sure of, or has not learned; `always`: everything.
    never : sequence of str
        Classes that are never kept.
    pre_roll_frames : int
        Frames kept before a sound that is worth keeping.
    window_frames : int
        A second, or the length of the window of a label, if that is longer.
    """

    def __init__(
        self, keep: Keep, never: Sequence[str], pre_roll_frames: int, window_frames: int
    ) -> None:
        self._window = window_frames
        self._keep = keep
        self._never = tuple(never)
        # How many frames before a label's own frame are kept because of the label.
        self._before = 0 if keep == "always" else self._window - 1 + pre_roll_frames
        self._ahead = max(self._before, self._window - 1)
        self._begin()

    def _begin(self) -> None:
        """Hold nothing.

        `_private` and `_worth` begin some frames before the sound that is held: these frames are
        decided, but what follows them is kept because of them.
        """
        self._next = -1
        self._samples: Int16 = np.empty((0, FRAME_SAMPLES), np.int16)
        self._stamps: Int64 = np.empty(0, np.int64)
        self._private: Bool = self._unlabelled(_AFTER_FRAMES)
        self._worth: Bool = np.zeros(_AFTER_FRAMES, bool)

    def push(self, frames: Frames, labels: FrameLabels | None) -> list[KeptSound]:
        """Add frames and return the sound that is now certain to be kept.

        Parameters
        ----------
        frames : Frames
            Where they do not follow the frames before, those are decided first, as by `close`.
        labels : FrameLabels or None
            Of the last of these frames; their classes include all that are never kept.

        Returns
        -------
        list of KeptSound
            In the order of time.
        """
        sounds = []
        if frames.first != self._next:
            sounds = self.close()
        self._next = frames.first + len(frames.samples)
        self._append(frames, labels)
        return [*sounds, *self._decide(len(self._samples) - self._ahead)]

    def close(self) -> list[KeptSound]:
        """Return what is to be kept of a sound that ends, and begin anew.

        Returns
        -------
        list of KeptSound
            In the order of time.
        """
        self._private = np.append(self._private, self._unlabelled(self._ahead))
        self._worth = np.append(self._worth, np.zeros(self._ahead, bool))
        sounds = self._decide(len(self._samples))
        self._begin()
        return sounds

    def _append(self, frames: Frames, labels: FrameLabels | None) -> None:
        count = len(frames.samples)
        private, worth = self._unlabelled(count), np.zeros(count, bool)
        if labels is not None and len(labels.novelty):
            labelled = slice(count - len(labels.novelty), None)
            private[labelled], worth[labelled] = self._judge(labels)
        self._samples = np.concatenate([self._samples, _pcm(frames.samples)])
        self._stamps = np.append(self._stamps, frames.stamps)
        self._private = np.append(self._private, private)
        self._worth = np.append(self._worth, worth)

    def _judge(self, labels: FrameLabels) -> tuple[Bool, Bool]:
        """Return whether each window may be private, and whether it is worth keeping."""
        probabilities, elsewhere = labels.probabilities, labels.calibrated_elsewhere
        never = [labels.classes.index(name) for name in self._never]
        limit = PRIVATE_LIMIT_ELSEWHERE if elsewhere else PRIVATE_LIMIT
        private = np.any(~(probabilities[:, never] < limit), axis=1)  # as NaN is
        if self._keep == "unsure":
            unsure = labels.novelty > _UNSURE_NOVELTY
            if not elsewhere:
                unsure |= probabilities.max(axis=1) < _UNSURE_CONFIDENCE
            return private, unsure
        loud = np.array([class_name(name) != SILENCE for name in labels.classes])
        return private, loud[probabilities.argmax(axis=1)]

    def _unlabelled(self, count: int) -> Bool:
        """Return whether frames without a label may be private: unless nothing is."""
        return np.full(count, bool(self._never))

    def _decide(self, count: int) -> list[KeptSound]:
        """Decide on the first frames that are held."""
        if count <= 0:
            return []
        span = _BEHIND_FRAMES + self._window
        private = self._private[_AFTER_FRAMES - _BEHIND_FRAMES :][: count + span - 1]
        kept = ~sliding_window_view(private, span).any(axis=1)
        if self._keep != "always":
            around = self._worth[: _AFTER_FRAMES + count + self._before]
            kept &= sliding_window_view(around, _AFTER_FRAMES + self._before + 1).any(axis=1)
        edges = np.flatnonzero(np.diff(kept, prepend=False, append=False))
        sounds = [
            KeptSound(self._stamps[start:end], self._samples[start:end])
            for start, end in edges.reshape(-1, 2).tolist()
        ]
        self._samples, self._stamps = self._samples[count:], self._stamps[count:]
        self._private, self._worth = self._private[count:], self._worth[count:]
        return sounds


def _pcm(samples: Float32) -> Int16:
    return np.clip(np.rint(samples * 32768.0), -32768, 32767).astype(np.int16)
