"""Which sound may be kept, and which of it is worth keeping. No I/O."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.recorder.config import Keep
from hearthlog.recorder.events import Frames
from hearthlog.recorder.stream.private_frames import PrivateFrames
from hearthlog.schemas.arrays import Bool, Float32, Int16, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS

_UNSURE_CONFIDENCE = 0.5
_UNSURE_NOVELTY = 0.7
_AFTER_FRAMES = NANOSECONDS // FRAME_NANOSECONDS


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

    A frame may be kept unless it is private, as of `PrivateFrames`.

    Parameters
    ----------
    keep : Keep
        `events`: sound around all that is not labelled silence; `unsure`: around what the model is
        not sure of, or has not learned; `always`: everything.
    window_frames : int
        A second, or the length of the window of a label, if that is longer.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        keep: Keep,
        never: Sequence[str],
        pre_roll_frames: int,
        window_frames: int,
        late_frames: int = 0,
        most_ahead: int = 0,
    ) -> None:
        self._window = window_frames
        self._keep = keep
        self._guard = PrivateFrames(never, window_frames, most_ahead)
        # How many frames before a label's own frame are kept because of the label.
        self._before = 0 if keep == "always" else self._window - 1 + pre_roll_frames
        self._most_ahead = most_ahead
        self._ahead = max(self._before, self._window - 1 + late_frames) + most_ahead
        self._begin()

    def _begin(self) -> None:
        """Hold nothing.

        `_private` is of the first frames that are held. `_worth` begins some frames before them:
        these frames are decided, but what follows them is kept because of them.
        """
        self._next = -1
        self._samples: Int16 = np.empty((0, FRAME_SAMPLES), np.int16)
        self._stamps: Int64 = np.empty(0, np.int64)
        self._private: Bool = np.zeros(0, bool)
        self._worth: Bool = np.zeros(_AFTER_FRAMES, bool)

    def push(self, frames: Frames, labels: FrameLabels | None) -> list[KeptSound]:
        """Add frames and return the sound that is now certain to be kept.

        Parameters
        ----------
        frames : Frames
            Where they do not follow the frames before, those are decided first, as by `close`.
        labels : FrameLabels or None
            Of the last of these frames; their classes include all that are never kept.
        """
        sounds = []
        if frames.first != self._next:
            sounds = self.close()
        self._next = frames.first + len(frames.samples)
        self._append(frames, labels)
        return [*sounds, *self._decide(len(self._samples) - self._ahead)]

    def close(self) -> list[KeptSound]:
        """Return what is to be kept of a sound that ends, and begin anew."""
        self._private = np.append(self._private, self._guard.close())
        self._worth = np.append(self._worth, np.zeros(self._ahead, bool))
        sounds = self._decide(len(self._samples))
        self._begin()
        return sounds

    def _append(self, frames: Frames, labels: FrameLabels | None) -> None:
        count = len(frames.samples)
        self._worth = np.append(self._worth, np.zeros(count, bool))
        if labels is not None and len(labels.novelty):
            end = len(self._worth) - min(labels.ahead, self._most_ahead)
            self._worth[max(end - len(labels.novelty), 0) : end] = self._judge(labels)
        self._samples = np.concatenate([self._samples, _pcm(frames.samples)])
        self._stamps = np.append(self._stamps, frames.stamps)
        self._private = np.append(self._private, self._guard.push(count, labels))

    def _judge(self, labels: FrameLabels) -> Bool:
        """Return whether each window is worth keeping."""
        if self._keep == "unsure":
            unsure: Bool = labels.novelty > _UNSURE_NOVELTY
            if not labels.calibrated_elsewhere:
                unsure |= labels.probabilities.max(axis=1) < _UNSURE_CONFIDENCE
            return unsure
        loud = np.array([class_name(name) != SILENCE for name in labels.classes])
        return loud[labels.probabilities.argmax(axis=1)]

    def _decide(self, count: int) -> list[KeptSound]:
        """Decide on the first frames that are held."""
        if count <= 0:
            return []
        kept = ~self._private[:count]
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
