"""Which frames nobody can be talking in. No I/O."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.schemas.arrays import Bool

# Probability of speech: measured, see docs/recorder.md. The higher limit is for models whose
# probabilities hold for people whom they were not learned from.
PRIVATE_LIMIT, PRIVATE_LIMIT_ELSEWHERE = 0.02, 0.04
NAMED_LIMIT, NAMED_LIMIT_ELSEWHERE = 0.04, 0.06  # where the names of a network are against it, too
PRIVATE_LOGIT = -2.0  # of the names of a class
NAMED_FRAMES = 20  # for which such names count on: a network misses the short words of a sentence
_BEHIND_FRAMES = 12  # with a window of 0.4 s before them: what ended less than a second ago counts


class PrivateFrames:
    """Tells which frames are private, as soon as it is certain.

    A label is known with the last frame of its window. A frame is private unless all windows within
    a second of it, before and behind, were labelled, and none of them is likely to be of a class
    that is. Frames beside a gap have fewer windows, and are private.

    Parameters
    ----------
    classes : sequence of str
        Those that are private; if there are none, no frame is.
    window_frames : int
        A second, or the length of the window of a label, if that is longer.
    """

    def __init__(self, classes: Sequence[str], window_frames: int, ahead: int = 0) -> None:
        self.delay = window_frames - 1 + ahead
        self._window, self._ahead = window_frames, ahead
        self._classes = tuple(classes)
        self._begin()

    def _begin(self) -> None:
        self._likely: Bool = self._unlabelled(_BEHIND_FRAMES)
        self._unnamed = NAMED_FRAMES + 1  # frames since names were of a private class

    def push(self, count: int, labels: FrameLabels | None) -> Bool:
        """Add frames, which follow the ones before.

        Parameters
        ----------
        count : int
            At least one.

        Returns
        -------
        np.ndarray [shape=(m,)], bool
            Of the next m frames that are certain, whether they are private.
        """
        self._likely = np.append(self._likely, self._unlabelled(count))
        if labels is not None and len(labels.novelty):
            end = len(self._likely) - min(labels.ahead, self._ahead)
            self._likely[max(end - len(labels.novelty), 0) : end] = self._judge(labels)
        return self._decide()

    def close(self) -> Bool:
        """Return whether the frames are private that are not certain yet, and begin anew.

        Returns
        -------
        np.ndarray [shape=(m,)], bool
        """
        self._likely = np.append(self._likely, self._unlabelled(self.delay))
        private = self._decide()
        self._begin()
        return private

    def _judge(self, labels: FrameLabels) -> Bool:
        """Return whether each window may be of a private class."""
        columns = [labels.classes.index(name) for name in self._classes]
        limit, named_limit = PRIVATE_LIMIT, NAMED_LIMIT
        if labels.calibrated_elsewhere:
            limit, named_limit = PRIVATE_LIMIT_ELSEWHERE, NAMED_LIMIT_ELSEWHERE
        by_features = labels.by_features[:, columns]
        if labels.by_names is None:
            return np.any(~(by_features < limit), axis=1)  # as NaN is
        # A network hears some speech not at all: whatever it says, features may forbid.
        by_names = labels.by_names[:, columns]
        limits = np.where(np.isfinite(by_names), named_limit, limit)
        likely: Bool = np.any(~(by_features < limits), axis=1)
        return likely | self._is_named(np.any(by_names >= PRIVATE_LOGIT, axis=1))

    def _is_named(self, named: Bool) -> Bool:
        """Return which of the next frames are at most `NAMED_FRAMES` behind one that is named."""
        frames = np.arange(1, len(named) + 1)
        latest = np.maximum.accumulate(np.where(named, frames, 1 - self._unnamed))
        self._unnamed = int(len(named) + 1 - latest[-1])
        return np.asarray(frames - latest <= NAMED_FRAMES)

    def _unlabelled(self, count: int) -> Bool:
        """Return whether frames without a label may be private: unless nothing is."""
        return np.full(count, bool(self._classes))

    def _decide(self) -> Bool:
        span = _BEHIND_FRAMES + self._window
        known = self._likely[: len(self._likely) - self._ahead]
        count = len(known) - span + 1
        if count <= 0:
            return np.zeros(0, bool)
        private = np.asarray(sliding_window_view(known, span).any(axis=1))
        self._likely = self._likely[count:]
        return private
