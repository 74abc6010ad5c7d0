"""Privacy filter: coarse features and no embeddings for frames with possible speech. No I/O."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.models.embedding import NO_EMBEDDINGS, WINDOW_FRAMES, Embeddings
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

# Probability of speech: measured, see docs/recorder.md. The higher limit is for models whose
# probabilities are calibrated on people who are not in the training data.
PRIVATE_LIMIT, PRIVATE_LIMIT_ELSEWHERE = 0.02, 0.04
NAMED_LIMIT, NAMED_LIMIT_ELSEWHERE = 0.04, 0.06  # if the network's names do not indicate it either
PRIVATE_LOGIT = -2.0  # of a class by its names
NAMED_FRAMES = 20  # hold time of such names: a network misses the short words of a sentence
_BEHIND_FRAMES = 12  # plus a window of 0.4 s before them: sound of the last second counts


class PrivateFrames:
    """Determines which frames are private, as soon as it is certain; none without `classes`.

    A label is available with the last frame of its window, of `window_frames`, at least a second. A
    frame is private unless all windows within one second before and after it were labelled, and
    none of them is likely to be of a private class. Frames next to a gap have fewer windows, and
    are private.
    """

    def __init__(self, classes: Sequence[str], window_frames: int, ahead: int = 0) -> None:
        self.delay = window_frames - 1 + ahead
        self._window, self._ahead = window_frames, ahead
        self._classes = tuple(classes)
        self._begin()

    def _begin(self) -> None:
        self._likely: Bool = self._unlabelled(_BEHIND_FRAMES)
        self._unnamed = NAMED_FRAMES + 1  # frames since the last names of a private class

    def push(self, count: int, labels: FrameLabels | None) -> Bool:
        """Add at least one next frame; return which frames decided now are private [shape=(m,)]."""
        self._likely = np.append(self._likely, self._unlabelled(count))
        if labels is not None and len(labels.novelty):
            end = len(self._likely) - min(labels.ahead, self._ahead)
            self._likely[max(end - len(labels.novelty), 0) : end] = self._judge(labels)
        return self._decide()

    def close(self) -> Bool:
        """Return whether each undecided frame is private [shape=(m,)], and reset."""
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
            return np.any(~(by_features < limit), axis=1)  # NaN counts as private
        # A network misses some speech entirely: the features alone can make a frame private.
        by_names = labels.by_names[:, columns]
        limits = np.where(np.isfinite(by_names), named_limit, limit)
        likely: Bool = np.any(~(by_features < limits), axis=1)
        return likely | self._is_named(np.any(by_names >= PRIVATE_LOGIT, axis=1))

    def _is_named(self, named: Bool) -> Bool:
        """Return whether each next frame is at most `NAMED_FRAMES` after a named one."""
        frames = np.arange(1, len(named) + 1)
        latest = np.maximum.accumulate(np.where(named, frames, 1 - self._unnamed))
        self._unnamed = int(len(named) + 1 - latest[-1])
        return np.asarray(frames - latest <= NAMED_FRAMES)

    def _unlabelled(self, count: int) -> Bool:
        """Return whether frames without a label may be private: true if any class is private."""
        return np.full(count, bool(self._classes))

    def _decide(self) -> Bool:
        span = _BEHIND_FRAMES + self._window
        decided = self._likely[: len(self._likely) - self._ahead]
        count = len(decided) - span + 1
        if count <= 0:
            return np.zeros(0, bool)
        private = np.asarray(sliding_window_view(decided, span).any(axis=1))
        self._likely = self._likely[count:]
        return private


TOGETHER = NANOSECONDS // FRAME_NANOSECONDS  # frames averaged together
_NEVER = 2**63 - 1  # nanoseconds of UTC


class _Frames(NamedTuple):
    features: Float32
    first: int
    stamps: Int64


class LoggedFrames(NamedTuple):
    """Features of successive frames, as logged."""

    features: Float32  # [shape=(n, d)]
    first: int
    stamps: Int64  # [shape=(n,)] starts of the frames in nanoseconds of UTC
    private: Bool  # [shape=(n,)] whether a frame may contain speech


class PrivacyFilter:
    """Buffers features until it is decided which are private, and averages the private ones.

    Seconds begin at frame numbers divisible by 20, so results do not depend on the block size.
    """

    def __init__(
        self, classes: Sequence[str], width: int, window_frames: int, ahead: int = 0
    ) -> None:
        self._classes = frozenset(classes)
        self._guard = PrivateFrames(classes, window_frames, ahead)
        self._held = _Frames(np.empty((0, width), np.float32), 0, np.empty(0, np.int64))
        self._private: Bool = np.empty(0, bool)  # for the first held frames

    @property
    def start(self) -> int:
        """Start of the first held frame, in nanoseconds of UTC; `_NEVER` without a held frame."""
        return int(self._held.stamps[0]) if len(self._held.stamps) else _NEVER

    def unknown(self, classes: Sequence[str] | None) -> list[str]:
        """Return the private classes that a model with these classes, or no model, lacks."""
        return sorted(self._classes.difference(classes or ()))

    def push(
        self, features: Float32, first: int, stamps: Int64, labels: FrameLabels | None
    ) -> LoggedFrames:
        """Add the next frames [shape=(n, d)]; return those of the decided seconds, if any.

        `stamps` [shape=(n,)] are their starts in nanoseconds of UTC; `labels` are those of the last
        of these frames. If the model lacks a private class, everything is private.
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
        """Return all held frames; the next frames do not follow them."""
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
    """Buffers embeddings until their windows are decided, and drops private ones.

    Frames that were not released are private.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset: the next frame does not follow the last one."""
        self._held = NO_EMBEDDINGS
        self._private: Bool = np.ones(WINDOW_FRAMES - 1, bool)  # of the last frames released

    def push(self, embeddings: Embeddings) -> None:
        """Add embeddings."""
        self._held = self._held.followed_by(embeddings)

    def release(self, frames: LoggedFrames) -> Embeddings:
        """Return the embeddings that end with these frames and may be logged."""
        private = np.append(self._private, frames.private)
        self._private = private[1 - WINDOW_FRAMES :]
        ended = self._held.available_at(frames.first, len(frames.stamps))
        self._held = self._held.rows(slice(len(ended.frames), None))
        if not len(ended.frames):
            return ended
        windows = np.asarray(sliding_window_view(private, WINDOW_FRAMES).any(axis=1))
        return ended.rows(np.flatnonzero(~windows[ended.last_frames - frames.first]))
