"""The inputs of classifiers: one row of numbers for every window of frames."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Float32, Float64

_FRAMES_AT_ONCE = 256


class InputStream(Protocol):
    """The inputs at the frames of one stream."""

    def __call__(self, features: Float32) -> Float32:
        """Compute the inputs at successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32

        Returns
        -------
        np.ndarray [shape=(m, width)], float32
            At the last m of these frames: those with a whole window since the start or the last
            restart. The same frames give the same bits in blocks of any size.
        """

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""


class Inputs(Protocol):
    """Maps windows of features to inputs.

    Attributes
    ----------
    width : int
        Number of inputs.
    """

    @property
    def width(self) -> int:
        """Number of inputs."""

    def stream(self) -> InputStream:
        """Begin a stream."""

    def of_windows(self, windows: Float32) -> Float32:
        """Compute the inputs of single windows.

        Parameters
        ----------
        windows : np.ndarray [shape=(n, window_frames, d)], float32
            Features.

        Returns
        -------
        np.ndarray [shape=(n, width)], float32
            The same bits as of a stream.
        """


@dataclass(frozen=True)
class WindowStatistics:
    """Mean and standard deviation of a window, of its features or of values made of them.

    Attributes
    ----------
    window_frames : int
    values : callable
        Maps features, shape (n, d), to the values of each frame, shape (n, d').
    values_width : int
        d'.
    changes : bool
        Whether the mean absolute difference from frame to frame is an input too.
    """

    window_frames: int
    values: Callable[[Float32], NDArray[Any]]
    values_width: int
    changes: bool = False

    @property
    def width(self) -> int:
        """Number of inputs."""
        return (3 if self.changes else 2) * self.values_width

    def stream(self) -> "StatisticsStream":
        """Begin a stream."""
        return StatisticsStream(self)

    def of_windows(self, windows: Float32) -> Float32:
        """Compute the inputs of single windows.

        Parameters
        ----------
        windows : np.ndarray [shape=(n, window_frames, d)], float32
            Features.

        Returns
        -------
        np.ndarray [shape=(n, width)], float32
            Means, standard deviations and, with `changes`, mean absolute differences.
        """
        inputs = np.empty((len(windows), self.width), np.float32)
        for start in range(0, len(windows), _FRAMES_AT_ONCE):
            part = windows[start : start + _FRAMES_AT_ONCE]
            values = self.values(part.reshape(-1, part.shape[-1]))
            frames = values.reshape(len(part), self.window_frames, -1).swapaxes(0, 1)
            changes = np.abs(np.diff(frames, axis=0)) if self.changes else ()
            self.reduce([*frames], [*changes], inputs[start : start + _FRAMES_AT_ONCE])
        return inputs

    def reduce(
        self, frames: Sequence[NDArray[Any]], changes: Sequence[NDArray[Any]], out: Float32
    ) -> None:
        """Write the statistics of windows into rows.

        Parameters
        ----------
        frames : sequence of np.ndarray [shape=(n, d')]
            Values of the first frames of all windows, of their second frames and so on, as of
            `successive`.
        changes : sequence of np.ndarray [shape=(n, d')]
            The same of the absolute differences from frame to frame; not used without `changes`.
        out : np.ndarray [shape=(n, width)], float32
            Overwritten: means, standard deviations and, with `changes`, mean absolute differences.
        """
        parts = [*mean_and_std(frames)]
        if self.changes:
            parts.append(_sum(changes) / len(changes))
        np.concatenate(parts, axis=1, out=out, casting="same_kind")


class StatisticsStream:
    """The statistics at the frames of one stream, as `InputStream`.

    Parameters
    ----------
    inputs : WindowStatistics

    Attributes
    ----------
    recent : np.ndarray [shape=(n, d)], float32, or None
        Features of the last frames, at most one less than a window; None at the start and after a
        restart.
    """

    def __init__(self, inputs: WindowStatistics) -> None:
        self.recent: Float32 | None = None
        self._inputs = inputs

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self.recent = None

    def __call__(self, features: Float32) -> Float32:
        """Compute the inputs at successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32

        Returns
        -------
        np.ndarray [shape=(m, width)], float32
            At the last m of these frames: those with a whole window since the start or the last
            restart.
        """
        kind, length = self._inputs, self._inputs.window_frames
        if self.recent is not None:
            features = np.concatenate([self.recent, features])
        self.recent = features[max(len(features) - length + 1, 0) :].copy()
        values = kind.values(features)
        count = max(len(features) - length + 1, 0)
        inputs = np.empty((count, kind.width), np.float32)
        for start in range(0, count, _FRAMES_AT_ONCE):
            end = min(start + _FRAMES_AT_ONCE, count)
            part = values[start : end + length - 1]
            steps = successive(np.abs(np.diff(part, axis=0)), length - 1) if kind.changes else ()
            kind.reduce(successive(part, length), steps, inputs[start:end])
        return inputs


def successive(values: NDArray[Any], length: int) -> list[NDArray[Any]]:
    """View windows of successive rows as one array per place in the window.

    Parameters
    ----------
    values : np.ndarray [shape=(n, d)]
    length : int
        Rows of a window; at most n.

    Returns
    -------
    list of np.ndarray [shape=(n - length + 1, d)]
        Views: the first rows of all windows, the second rows, and so on.
    """
    count = len(values) - length + 1
    return [values[place : place + count] for place in range(length)]


def mean_and_std(frames: Sequence[NDArray[Any]]) -> tuple[Float64, Float64]:
    """Compute mean and standard deviation of many windows at once, in float64.

    The sums go from frame to frame for all windows, so that they stay in the cache.

    Parameters
    ----------
    frames : sequence of np.ndarray [shape=(n, d)]
        As of `successive`.

    Returns
    -------
    mean, std : np.ndarray [shape=(n, d)], float64
        The standard deviation divides by the number of frames.
    """
    mean = _sum(frames) / len(frames)
    square = np.zeros_like(mean)
    deviation = np.empty_like(mean)
    for values in frames:
        np.subtract(values, mean, out=deviation)
        np.square(deviation, out=deviation)
        square += deviation
    return mean, np.sqrt(square / len(frames))


def _sum(frames: Sequence[NDArray[Any]]) -> Float64:
    total = frames[0].astype(np.float64)
    for values in frames[1:]:
        total += values
    return total
