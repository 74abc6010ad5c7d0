"""Features as they may be logged: those of what is private are averaged over a second. No I/O."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.models.embedding.projection import NO_EMBEDDINGS, WINDOW_FRAMES, Embeddings
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.recorder.stream.private_frames import PrivateFrames
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

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


class Veil:
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


class EmbeddingVeil:
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
