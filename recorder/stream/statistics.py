"""Mean and standard deviation of the features over the last window."""

import numpy as np

from hearthlog.models.features.window_inputs import mean_and_std
from hearthlog.schemas.arrays import Float32, Indices

LOGGED_EVERY = 20  # frames: each message is of a second of its own


class RollingStatistics:
    """Statistics of one stream of frames over its last frames.

    Every window is summed anew from its own frames, since running sums would drift over months.
    """

    def __init__(self, window_frames: int, width: int) -> None:
        self._length, self._width = window_frames, width
        self.restart()

    def restart(self) -> None:
        """Empty the window: the next frame does not follow the last one."""
        self._recent: Float32 = np.empty((0, self._width), np.float32)

    def __call__(self, features: Float32, places: Indices | None = None) -> tuple[Float32, Float32]:
        """Compute the statistics at some of successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        places : np.ndarray [shape=(m,)], intp, optional
            Of the frames, from 0 on, ascending; all by default.

        Returns
        -------
        mean, std : np.ndarray [shape=(m, d)], float32
            Over the last window, or over all frames since the start or the last restart where
            these are fewer; the standard deviation divides by their number.
        """
        frames = np.concatenate([self._recent, features])
        places = np.arange(len(features)) if places is None else places
        begins = places + len(self._recent) + 1 - self._length
        filling = int(np.count_nonzero(begins < 0))
        mean, std = np.empty((2, len(places), self._width), np.float32)
        for row, begin in enumerate(begins[:filling].tolist()):
            first = [*frames[: begin + self._length, np.newaxis]]
            (mean[row],), (std[row],) = mean_and_std(first)
        windows = [frames[begins[filling:] + place] for place in range(self._length)]
        mean[filling:], std[filling:] = mean_and_std(windows)
        self._recent = frames[max(len(frames) - self._length + 1, 0) :].copy()
        return mean, std
