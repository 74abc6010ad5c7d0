"""Mean and standard deviation of the features over the last window, at every frame."""

import numpy as np

from hearthlog.models.features.window_inputs import mean_and_std, successive
from hearthlog.schemas.arrays import Float32

_FRAMES_AT_ONCE = 256


class RollingStatistics:
    """Statistics of one stream of frames over its last frames.

    Every window is summed anew from its own frames, since running sums would drift over months.

    Parameters
    ----------
    window_frames : int
        Frames of the window.
    """

    def __init__(self, window_frames: int) -> None:
        self._window = window_frames
        self._recent: Float32 | None = None

    @property
    def recent(self) -> Float32 | None:
        """The features of the last frames, one less than a window; None after a gap."""
        return self._recent

    def restart(self) -> None:
        """Empty the window: the next frame does not follow the last one."""
        self._recent = None

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
        mean = np.empty_like(features)
        std = np.empty_like(features)
        for start in range(0, len(features), _FRAMES_AT_ONCE):
            block = slice(start, start + _FRAMES_AT_ONCE)
            self._compute(features[block], mean[block], std[block])
        return mean, std

    def _compute(self, features: Float32, mean: Float32, std: Float32) -> None:
        recent = features[:0] if self._recent is None else self._recent
        values = np.concatenate([recent, features])
        filling = min(max(self._window - 1 - len(recent), 0), len(features))
        for i in range(filling):
            frames = [*values[: len(recent) + i + 1, np.newaxis]]
            mean[i : i + 1], std[i : i + 1] = mean_and_std(frames)
        if filling < len(features):
            mean[filling:], std[filling:] = mean_and_std(successive(values, self._window))
        self._recent = values[max(len(values) - self._window + 1, 0) :].copy()
