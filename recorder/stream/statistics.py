"""Mean and standard deviation of the features over the last window, at every frame."""

import numpy as np

from hearthlog.models.features.window_inputs import WindowStatistics, mean_and_std
from hearthlog.schemas.arrays import Float32

LOGGED_EVERY = 20  # frames: each message is of a second of its own


class RollingStatistics:
    """Statistics of one stream of frames over its last frames.

    Every window is summed anew from its own frames, since running sums would drift over months.

    Parameters
    ----------
    window_frames : int
        Frames of the window.
    width : int
        Number of features of a frame.
    """

    def __init__(self, window_frames: int, width: int) -> None:
        self._width = width
        self._windows = WindowStatistics(window_frames, np.asarray, width).stream()

    @property
    def recent(self) -> Float32 | None:
        """The features of the last frames, one less than a window; None after a gap."""
        return self._windows.recent

    def restart(self) -> None:
        """Empty the window: the next frame does not follow the last one."""
        self._windows.restart()

    def __call__(self, features: Float32) -> tuple[Float32, Float32]:
        """Compute the statistics at each of successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32

        Returns
        -------
        mean, std : np.ndarray [shape=(n, d)], float32
            Over the last window, or over all frames since the start or the last restart where
            these are fewer; the standard deviation divides by their number.
        """
        before = features[:0] if self.recent is None else self.recent
        rows = self._windows(features)
        if filling := len(features) - len(rows):
            frames = np.concatenate([before, features[:filling]])[:, np.newaxis]
            ends = range(len(before) + 1, len(frames) + 1)
            first = [np.concatenate(mean_and_std([*frames[:end]]), axis=1) for end in ends]
            rows = np.concatenate([*first, rows], dtype=np.float32, casting="same_kind")
        return rows[:, : self._width], rows[:, self._width :]
