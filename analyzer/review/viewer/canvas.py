"""Draw arrays into a Rerun recording: lanes, bands, lines, heat maps, lines of text, clips."""

import io
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr
import soundfile
from numpy.typing import NDArray

from hearthlog.analyzer.colours import Colour
from hearthlog.analyzer.review.timeline.model import FrameValues, LogLines, SoundClip
from hearthlog.schemas.arrays import Float64, Int64

TIMELINE = "time"
_LAYERS = 4  # of translucent bands, one on the other: opaque enough
_ROWS_AT_ONCE = 72_000  # an hour of frames
_HEAT_SQUARE = 6.5  # half its side: from afar squares overlap, close up they lie apart
_DARK_TO_BRIGHT = np.array(  # through purple and red, as matplotlib's magma
    [(0, 0, 4), (59, 15, 112), (140, 41, 129), (222, 73, 104), (254, 159, 109), (252, 253, 191)]
)
_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "CRITICAL"}


class Canvas:
    """Draws arrays into a recording. Times are nanoseconds of UTC, shape (n,).

    Parameters
    ----------
    recording : rr.RecordingStream
        Goes to a file, or to a viewer.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self.recording = recording

    def configure_lane(self, entity: str, colours: Mapping[str, Colour]) -> None:
        """Give the states of a lane their colours.

        Parameters
        ----------
        entity : str
            Path of the lane in the recording.
        colours : mapping of str to Colour
            By state: red, green and blue, 0 to 255.
        """
        style = rr.StateConfiguration(
            values=list(colours), labels=list(colours), colors=list(colours.values())
        )
        self.recording.log(entity, style, static=True)

    def change_states(self, entity: str, times: Int64, states: Sequence[str | None]) -> None:
        """Put a lane into a state at each time.

        Parameters
        ----------
        entity : str
            Configured by `configure_lane`.
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        states : sequence of (str or None)
            n of them; None is no state.
        """
        column = rr.StateChange.columns(state=pa.array(states, pa.string()))
        self.recording.send_columns(entity, [_time_column(times)], column)

    def configure_bands(self, entity: str, names: Sequence[str], colours: Sequence[Colour]) -> None:
        """Set names and colours of the bands of an entity, which gets a child for each layer.

        Parameters
        ----------
        entity : str
            Path of the bands in the recording.
        names : sequence of str
            Of the k bands, the lowest first.
        colours : sequence of Colour
            Of each: red, green and blue, 0 to 255.
        """
        for layer in range(_LAYERS):
            style = rr.Measurements.from_fields(
                colors=colours, widths=[0.0] * len(names), names=names if layer == 0 else None
            )
            self.recording.log(f"{entity}/{layer}", style, static=True)

    def add_bands(self, entity: str, times: Int64, shares: Float64) -> None:
        """Stack shares of one as bands.

        Parameters
        ----------
        entity : str
            Configured by `configure_bands`.
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        shares : np.ndarray [shape=(n, k)], float64
            0 to 1; NaN where there is nothing.
        """
        half = shares / 2
        middles = np.cumsum(shares, axis=1) - half
        lengths = [shares.shape[1]] * len(times)
        columns = rr.Measurements.columns(
            values=middles.ravel(), variances=(half * half).ravel()
        ).partition(lengths)
        for layer in range(_LAYERS):
            self.recording.send_columns(f"{entity}/{layer}", [_time_column(times)], columns)

    def configure_lines(self, entity: str, names: Sequence[str], colours: Sequence[Colour]) -> None:
        """Set names and colours of the lines of an entity.

        Parameters
        ----------
        entity : str
            Path of the lines in the recording.
        names : sequence of str
            Of the k lines.
        colours : sequence of Colour
            Of each: red, green and blue, 0 to 255.
        """
        style = rr.SeriesLines(names=names, colors=colours, aggregation_policy="average")
        self.recording.log(entity, style, static=True)

    def draw_lines(self, entity: str, times: Int64, values: NDArray[np.floating]) -> None:
        """Draw a line for each column of values.

        Parameters
        ----------
        entity : str
            Configured by `configure_lines`.
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        values : np.ndarray [shape=(n, k)], float
            NaN interrupts a line.
        """
        width = values.shape[1]
        for first in range(0, len(times), _ROWS_AT_ONCE):
            part = values[first : first + _ROWS_AT_ONCE]
            column = rr.Scalars.columns(scalars=part.ravel()).partition([width] * len(part))
            stamps = _time_column(times[first : first + _ROWS_AT_ONCE])
            self.recording.send_columns(entity, [stamps], column)

    def draw_frames(self, entity: str, names: Sequence[str], parts: Iterable[FrameValues]) -> None:
        """Draw frames as lines, interrupted where frames are missing.

        Parameters
        ----------
        entity : str
            Configured by `configure_lines`.
        names : sequence of str
            Of its lines; every part has some of them.
        parts : iterable of FrameValues
            Each of at least one frame.
        """
        for part in parts:
            self.draw_lines(entity, *_with_holes(part, names))

    def configure_heat_map(self, entity: str, names: Sequence[str]) -> None:
        """Set the names of the rows of a heat map.

        Parameters
        ----------
        entity : str
            Path of the heat map in the recording.
        names : sequence of str
            Of the k rows, the lowest first.
        """
        count = len(names)
        style = rr.SeriesPoints(
            names=names, markers=["square"] * count, marker_sizes=[_HEAT_SQUARE] * count
        )
        self.recording.log(entity, style, static=True)

    def add_shades(self, entity: str, times: Int64, shade: Float64) -> None:
        """Draw squares of a heat map.

        Parameters
        ----------
        entity : str
            Configured by `configure_heat_map`.
        times : np.ndarray [shape=(n,)], int64
            In nanoseconds of UTC.
        shade : np.ndarray [shape=(n, k)], float64
            0 (dark) to 1 (bright).
        """
        scale = np.linspace(0.0, 1.0, len(_DARK_TO_BRIGHT))
        colours = np.stack([np.interp(shade, scale, part) for part in _DARK_TO_BRIGHT.T], axis=-1)
        count = shade.shape[1]
        heights = np.tile(np.arange(count, dtype=np.float64), len(times))
        lengths = [count] * len(times)
        columns = [
            *rr.Scalars.columns(scalars=heights).partition(lengths),
            *rr.SeriesPoints.columns(colors=colours.round().astype(np.uint8).reshape(-1, 3))
            .partition(lengths),
        ]  # fmt: skip
        self.recording.send_columns(entity, [_time_column(times)], columns)

    def write_lines(self, entity: str, lines: LogLines) -> None:
        """Add lines of text, each at its time and with its level.

        Parameters
        ----------
        entity : str
            Path of the text in the recording.
        lines : LogLines
        """
        if len(lines.times):
            levels = [_LEVELS.get(level, "INFO") for level in lines.levels.tolist()]
            column = rr.TextLog.columns(text=lines.texts.tolist(), level=levels)
            self.recording.send_columns(entity, [_time_column(lines.times)], column)

    def show_clip(self, entity: str, clip: SoundClip) -> None:
        """Add a clip of sound at its start.

        Parameters
        ----------
        entity : str
            Path of the clip in the recording.
        clip : SoundClip
        """
        stream = io.BytesIO()
        soundfile.write(stream, clip.samples, clip.rate, format="FLAC", subtype="PCM_16")
        self.recording.set_time(TIMELINE, timestamp=np.datetime64(clip.start, "ns"))
        self.recording.log(
            entity, rr.AssetAudio(contents=stream.getvalue(), media_type="audio/flac")
        )
        self.recording.reset_time()


def _time_column(times: Int64) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, timestamp=times.astype("datetime64[ns]"))


def _with_holes(part: FrameValues, names: Sequence[str]) -> tuple[Int64, Float64]:
    """Bring frames to the named columns, and insert a row of NaN where frames are missing."""
    values = np.full((len(part.times), len(names)), np.nan)
    values[:, [names.index(name) for name in part.names]] = part.values
    length = int(np.median(np.diff(part.times))) if len(part.times) > 1 else 0
    missing = np.flatnonzero(np.diff(part.times) > 1.5 * length) + 1
    times = np.insert(part.times, missing, part.times[missing - 1] + length)
    return times, np.insert(values, missing, np.nan, axis=0)
