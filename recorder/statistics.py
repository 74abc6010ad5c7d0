"""Mean and standard deviation of the features over the last window, at every frame."""

import numpy as np

from hearthlog.models.features.window_inputs import WindowStatistics, mean_and_std
from hearthlog.schemas.arrays import Float32


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
        statistics = np.empty((len(features), 2 * self._width), np.float32)
        whole = self._windows(features)
        filling = len(features) - len(whole)
        statistics[filling:] = whole
        frames = np.concatenate([before, features[:filling]])[:, np.newaxis]
        for row, end in enumerate(range(len(before) + 1, len(frames) + 1)):
            statistics[row] = np.concatenate(mean_and_std([*frames[:end]]), axis=None)
        return statistics[:, : self._width], statistics[:, self._width :]
