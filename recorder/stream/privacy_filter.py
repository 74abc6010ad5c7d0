"""Privacy filter: coarse features and no embeddings for frames with possible speech. No I/O."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.models.embedding.projection import NO_EMBEDDINGS, WINDOW_FRAMES, Embeddings
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

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


TOGETHER = NANOSECONDS // FRAME_NANOSECONDS  # frames that are averaged
_NEVER = 2**63 - 1  # nanoseconds of UTC


class _Frames(NamedTuple):
    features: Float32
    first: int
    stamps: Int64


class LoggedFrames(NamedTuple):
    """Features of successive frames, as they are logged.

    Attributes
    ----------
    features : np.ndarray [shape=(n, d)], float32
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    private : np.ndarray [shape=(n,)], bool
        Which of them somebody may be talking in.
    """

    features: Float32
    first: int
    stamps: Int64
    private: Bool


class PrivacyFilter:
    """Holds features back until it is certain which are private, and makes those coarse.

    Seconds begin at frames whose numbers 20 divides, so they are the same in blocks of any size.
    """

    def __init__(
        self, classes: Sequence[str], width: int, window_frames: int, ahead: int = 0
    ) -> None:
        self._classes = frozenset(classes)
        self._guard = PrivateFrames(classes, window_frames, ahead)
        self._held = _Frames(np.empty((0, width), np.float32), 0, np.empty(0, np.int64))
        self._private: Bool = np.empty(0, bool)  # of the first frames that are held

    @property
    def start(self) -> int:
        """Start of the first frame that is held, in nanoseconds of UTC; without one, never."""
        return int(self._held.stamps[0]) if len(self._held.stamps) else _NEVER

    def unknown(self, classes: Sequence[str] | None) -> list[str]:
        """Return the private classes that a model does not know.

        Parameters
        ----------
        classes : sequence of str or None
            Those that it tells apart; None without a model.
        """
        return sorted(self._classes.difference(classes or ()))

    def push(
        self, features: Float32, first: int, stamps: Int64, labels: FrameLabels | None
    ) -> LoggedFrames:
        """Add frames, which follow the ones before.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.
        labels : FrameLabels or None
            Of the last of these frames; of a model that does not know what is private, all is.

        Returns
        -------
        LoggedFrames
            Those of the seconds that are certain; perhaps none.
        """
        held = self._held
        self._held = _Frames(
            np.concatenate([held.features, features]),
            held.first if len(held.stamps) else first,
            np.append(held.stamps, stamps),
        )
        if labels is not None and self.unknown(labels.classes):
            labels = None
        self._private = np.append(self._private, self._guard.push(len(stamps), labels))
        begun = (self._held.first + len(self._private)) % TOGETHER
        return self._release(max(len(self._private) - begun, 0))

    def close(self) -> LoggedFrames:
        """Return what is held, as the frames to come do not follow those before."""
        self._private = np.append(self._private, self._guard.close())
        return self._release(len(self._private))

    def _release(self, count: int) -> LoggedFrames:
        features, first, stamps = self._held
        private, self._private = self._private[:count], self._private[count:]
        self._held = _Frames(features[count:], first + count, stamps[count:])
        shown = features[:count].copy()
        second = (first + np.arange(count)) // TOGETHER
        for number in np.unique(second[private]):
            rows = private & (second == number)
            shown[rows] = shown[rows].mean(axis=0, dtype=np.float64)
        return LoggedFrames(shown, first, stamps[:count], private)


class EmbeddingPrivacyFilter:
    """Holds embeddings back until it is certain whether their windows are private, and drops those.

    Frames that were not released are private.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._held = NO_EMBEDDINGS
        self._private: Bool = np.ones(WINDOW_FRAMES - 1, bool)  # of the last frames released

    def push(self, embeddings: Embeddings) -> None:
        """Add embeddings."""
        self._held = self._held.followed_by(embeddings)

    def release(self, frames: LoggedFrames) -> Embeddings:
        """Return the embeddings that may be logged, of those that end with some frames."""
        private = np.append(self._private, frames.private)
        self._private = private[1 - WINDOW_FRAMES :]
        ended = self._held.known_at(frames.first, len(frames.stamps))
        self._held = self._held.rows(slice(len(ended.frames), None))
        if not len(ended.frames):
            return ended
        windows = np.asarray(sliding_window_view(private, WINDOW_FRAMES).any(axis=1))
        return ended.rows(np.flatnonzero(~windows[ended.last_frames - frames.first]))
