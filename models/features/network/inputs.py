"""Inputs of classifiers from the features of a network: the embedding at the end of a window."""

from dataclasses import dataclass

import numpy as np

from hearthlog.schemas.arrays import Float32, Float64


@dataclass(frozen=True)
class LastEmbedding:
    """The embedding that the last frame of a window has, as `Inputs`.

    Attributes
    ----------
    window_frames : int
        So many that the sound behind that embedding lies in the window as a whole.
    """

    window_frames: int
    width: int
    needs_floor: bool = False

    def stream(self) -> "EmbeddingStream":
        """Begin a stream."""
        return EmbeddingStream(self)

    def of_windows(self, windows: Float32, floors: Float64 | None = None) -> Float32:
        """Compute the inputs of single windows.

        Parameters
        ----------
        windows : np.ndarray [shape=(n, window_frames, 1 + width)], float32
        floors : np.ndarray [shape=(n, b)], float64, optional
            Not used.

        Returns
        -------
        np.ndarray [shape=(n, width)], float32
        """
        del floors
        return np.ascontiguousarray(windows[:, -1, 1:])


class EmbeddingStream:
    """The embeddings at the frames of one stream, as `InputStream`."""

    def __init__(self, inputs: LastEmbedding) -> None:
        self._inputs = inputs
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._lacking = self._inputs.window_frames - 1  # frames before the first whole window

    def __call__(self, features: Float32, floors: Float64 | None = None) -> Float32:
        """Return the inputs at successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, 1 + width)], float32
        floors : np.ndarray [shape=(n, b)], float64, optional
            Not used.

        Returns
        -------
        np.ndarray [shape=(m, width)], float32
            At the last m of these frames: those with a whole window since the start or the last
            restart.
        """
        del floors
        inputs = features[self._lacking :, 1:]
        self._lacking = max(self._lacking - len(features), 0)
        return np.ascontiguousarray(inputs)
