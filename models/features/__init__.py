"""Feature sets: the values computed from each frame, and everything that depends on them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SECONDS

STEP_FRAMES = 6  # between windows of a segment
_FRAMES_AT_ONCE = 256


class InputStream(Protocol):
    """The inputs at the frames of one stream."""

    def __call__(self, features: Float32, floors: Float64 | None = None) -> Float32:
        """Compute the inputs at successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        floors : np.ndarray [shape=(n, b)], float64, optional
            Floor of the room at each frame, from `FloorTracker`; inputs that need it raise
            TypeError without.

        Returns
        -------
        np.ndarray [shape=(m, width)], float32
            At the last m of these frames: frames with a complete window since the start or the last
            restart. The same frames give the same bits in blocks of any size.
        """

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""


class Inputs(Protocol):
    """Maps windows of features to inputs.

    Attributes
    ----------
    width : int
        Number of inputs.
    window_frames : int
    needs_floor : bool
        Whether the inputs depend on the floor of the room; then a window is at most a second.
    """

    @property
    def width(self) -> int:
        """Number of inputs."""

    @property
    def window_frames(self) -> int:
        """Number of frames of a window."""

    @property
    def needs_floor(self) -> bool:
        """Whether the inputs depend on the floor of the room."""

    def stream(self) -> InputStream:
        """Begin a stream."""

    def of_windows(self, windows: Float32, floors: Float64 | None = None) -> Float32:
        """Compute the inputs of single windows.

        Parameters
        ----------
        windows : np.ndarray [shape=(n, window_frames, d)], float32
            Features.
        floors : np.ndarray [shape=(n, b)], float64, optional
            Floor of the room in each window.

        Returns
        -------
        np.ndarray [shape=(n, width)], float32
            The same bits as from a stream.
        """


def of_segments(inputs: Inputs, segments: Float32, floors: Float64 | None = None) -> Float32:
    """Compute the inputs of windows in segments [shape=(n, places, width)], at `window_places`.

    `segments` [shape=(n, f, d)] have features of at least one window; `floors` [shape=(n, b)] are
    those of the room in each segment.
    """
    length = inputs.window_frames
    return np.stack(
        [
            inputs.of_windows(segments[:, place : place + length], floors)
            for place in window_places(segments.shape[1], length)
        ],
        axis=1,
    )


def window_places(segment_frames: int, window_frames: int) -> range:
    """Return the starts of the windows of a segment, 0.3 s apart."""
    return range(0, segment_frames - window_frames + 1, STEP_FRAMES)


@dataclass(frozen=True)
class WindowStatistics:
    """Mean and standard deviation over a window of features, or of values derived from them."""

    window_frames: int
    # maps features, shape (n, d), to the values of each frame, shape (n, d')
    values: Callable[..., NDArray[Any]]
    values_width: int
    changes: bool = False
    # whether `values` takes floors, shape (n, b), or None as a second argument
    needs_floor: bool = False

    @property
    def width(self) -> int:
        """Number of inputs."""
        return (3 if self.changes else 2) * self.values_width

    def stream(self) -> "StatisticsStream":
        """Begin a stream."""
        return StatisticsStream(self)

    def of_windows(self, windows: Float32, floors: Float64 | None = None) -> Float32:
        """Compute the inputs [shape=(n, width)] of windows [shape=(n, window_frames, d)].

        They are means, standard deviations and, with `changes`, mean absolute differences. `floors`
        [shape=(n, b)] are those of the room in each window.
        """
        inputs = np.empty((len(windows), self.width), np.float32)
        for start in range(0, len(windows), _FRAMES_AT_ONCE):
            part = windows[start : start + _FRAMES_AT_ONCE]
            repeated = None
            if floors is not None:
                part_floors = floors[start : start + _FRAMES_AT_ONCE]
                repeated = part_floors.repeat(self.window_frames, axis=0)
            values = self.values_of(part.reshape(-1, part.shape[-1]), repeated)
            frames = values.reshape(len(part), self.window_frames, -1).swapaxes(0, 1)
            changes = np.abs(np.diff(frames, axis=0)) if self.changes else ()
            self.reduce([*frames], [*changes], inputs[start : start + _FRAMES_AT_ONCE])
        return inputs

    def values_of(self, features: Float32, floors: Float64 | None) -> NDArray[Any]:
        """Return the values of each frame, using its floor if needed."""
        return self.values(features, floors) if self.needs_floor else self.values(features)

    def reduce(
        self, frames: Sequence[NDArray[Any]], changes: Sequence[NDArray[Any]], out: Float32
    ) -> None:
        """Write means, deviations and, with `changes`, differences into rows [shape=(n, width)].

        `frames` and `changes`, the absolute differences from frame to frame, are from `successive`,
        each [shape=(n, d')].
        """
        parts = [*mean_and_std(frames)]
        if self.changes:
            parts.append(_sum(changes) / len(changes))
        np.concatenate(parts, axis=1, out=out, casting="same_kind")


class StatisticsStream:
    """The statistics at the frames of one stream, as `InputStream`."""

    def __init__(self, inputs: WindowStatistics) -> None:
        self._inputs = inputs
        self._values: NDArray[Any] | None = None  # of the last frames, one less than a window

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._values = None

    def __call__(self, features: Float32, floors: Float64 | None = None) -> Float32:
        """Compute the inputs at successive frames, as `InputStream`."""
        kind, length = self._inputs, self._inputs.window_frames
        values = kind.values_of(features, floors)
        if self._values is not None:
            values = np.concatenate([self._values, values])
        count = max(len(values) - length + 1, 0)
        self._values = values[count:].copy()
        inputs = np.empty((count, kind.width), np.float32)
        for start in range(0, count, _FRAMES_AT_ONCE):
            end = min(start + _FRAMES_AT_ONCE, count)
            part = values[start : end + length - 1]
            steps = successive(np.abs(np.diff(part, axis=0)), length - 1) if kind.changes else ()
            kind.reduce(successive(part, length), steps, inputs[start:end])
        return inputs


def successive(values: NDArray[Any], length: int) -> list[NDArray[Any]]:
    """View windows of `length` successive rows, at most n, as one array per place in the window.

    `values` has [shape=(n, d)]; a view, of the first rows of all windows, the second rows, and so
    on, has [shape=(n - length + 1, d)].
    """
    count = len(values) - length + 1
    return [values[place : place + count] for place in range(length)]


def mean_and_std(frames: Sequence[NDArray[Any]]) -> tuple[Float64, Float64]:
    """Compute mean and standard deviation [shape=(n, d)] of frames from `successive`, in float64.

    All windows are summed frame by frame, so the sums stay in the cache. The standard deviation
    divides by the number of frames.
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


SILENCE_POWER = 10 ** (-60 / 10)  # mean square, -60 dBFS: quieter events are not used for training


class Extractor(Protocol):
    """Computes the features of one stream of frames.

    The same frames give the same bits in blocks of any size.
    """

    def __call__(self, frames: Float32) -> Float32:
        """Compute the features of successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
            Samples at 16 kHz in full scale, -1 to 1; some may be out of range or not finite.

        Returns
        -------
        np.ndarray [shape=(n, d)], float32
            Always finite.
        """

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""


@dataclass(frozen=True)
class FeatureSet:
    """The values computed from each frame, and everything that depends on them.

    Attributes
    ----------
    power : callable
        Maps features, shape (..., d), to the mean square of the samples, shape (...); full scale
        is 1.
    band_powers : callable or None
        Maps features, shape (n, d), to powers of b bands, shape (n, b), the last of the complete
        frame; the floor of a room is tracked in these bands. None if the set has no bands.
    augmented : callable or None
        Maps windows of features, shape (n, window_frames, d), and a `np.random.Generator` to the
        features that another microphone in another room would give. None if not supported.
    method : str
        Of `hearthlog train`, learns the best models of these features; empty if none is known.
    digest : str
        SHA-256 of the file that computes the values, in hexadecimal; empty if code computes them.
    """

    name: str
    version: int
    feature_names: tuple[str, ...]
    units: tuple[str, ...]
    window_frames: int
    extractor: Callable[[], Extractor]
    inputs: Mapping[str, Inputs]
    power: Callable[[NDArray[Any]], NDArray[Any]]
    band_powers: Callable[[Float32], Float64] | None = None
    # in quotes: recorder and bridge never load `numpy.random`, which takes 5 MB
    augmented: "Callable[[Float32, np.random.Generator], Float32] | None" = None
    method: str = ""
    digest: str = ""

    @property
    def width(self) -> int:
        """Number of values per frame."""
        return len(self.feature_names)

    @property
    def bands(self) -> int:
        """Number of bands in which the floor of a room is tracked."""
        if self.band_powers is None:
            return 0
        return self.band_powers(np.zeros((1, self.width), np.float32)).shape[1]

    @property
    def window_seconds(self) -> float:
        """Length of the window in seconds."""
        return FRAME_SECONDS * self.window_frames
