"""Canvas that draws arrays into a Rerun recording: lanes, bands, lines, heat maps, text, clips."""

import io
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr
import soundfile
from numpy.typing import NDArray

from hearthlog.analyzer.logs.spans import Spans
from hearthlog.analyzer.review.lanes import BACKGROUND
from hearthlog.analyzer.review.timeline import HomeClock, LogLines, Plot, SoundClip, Style
from hearthlog.models.classes import Colour, in_words
from hearthlog.schemas.arrays import Float64, Int64

_STROKE_WIDTH = 2.0  # pixels
# Ends of lines are round and reach half a width too far, so thin lines side by side fill a strip.
# The last line goes around the others: else a short sound would be a row of dots on a large screen.
_STRIP_LINES, _STRIP_WIDTH = 12, 5.0  # screen points
# As many lines as fill a row of 37 points, as of nine classes in a window of 1440.
_ROW_LINES, _ROW_WIDTH, _ROW_SHARE = 6, 6.0, 0.8
ROWS_HEIGHT = 3.9  # of all rows, as of all lanes: so their axes are equally wide
_SHADES = 10  # of a row; each change of its colour is a line of its own for the viewer
_GROUND = np.array(BACKGROUND)
_FILLING = 400  # texts that leave no pause in the data
_LEAST_SHARE = 0.004  # a smaller share makes a band less than a pixel high
_ROWS_AT_ONCE = 72_000  # an hour of frames
_HEAT_SQUARE = 6.5  # half the side: squares overlap from afar, and are apart in close-ups
_POINT = 2.0  # screen points
_DARK_TO_BRIGHT = np.array(  # through purple and red, as matplotlib's magma
    [(0, 0, 4), (59, 15, 112), (140, 41, 129), (222, 73, 104), (254, 159, 109), (252, 253, 191)]
)
_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "CRITICAL"}


class Canvas:
    """Draws arrays into a recording. Times are nanoseconds of UTC, shape (n,).

    Rerun has axes of UTC only, so it receives the home's local time as if it were UTC.
    """

    def __init__(self, recording: rr.RecordingStream, clock: HomeClock) -> None:
        self.recording = recording
        self.clock = clock

    def draw_strips(
        self, entity: str, places: tuple[float, float], spans: Spans, name: str, colour: Colour
    ) -> None:
        """Draw spans, at least one, in time order, as strips of a least width, also from afar.

        The width is some points. `places` are middle and thickness in units of the view; a colour
        is red, green and blue, 0 to 255.
        """
        height, thickness = places
        style = rr.SeriesLines(
            names=[name] * _STRIP_LINES,
            colors=[colour] * _STRIP_LINES,
            widths=[_STRIP_WIDTH] * _STRIP_LINES,
            aggregation_policy="off",
        )
        self.recording.log(entity, style, static=True)
        starts, ends = spans  # a hole before each, or the first one is cut off in the middle
        times = np.stack([starts, starts, starts, ends, ends, ends], axis=1).ravel()
        lines = height + thickness * np.linspace(-0.5, 0.5, _STRIP_LINES)
        begin, holes = lines.copy(), np.full(_STRIP_LINES, np.nan)
        begin[-1] = lines[0]
        shape = [holes, begin, lines, lines, begin, holes]
        self.draw_lines(entity, times, np.tile(shape, (len(starts), 1)))

    def hide(self, entity: str) -> None:
        """Hide strips; a recording cannot delete data."""
        self.recording.log(
            entity, rr.SeriesLines(visible_series=[False] * _STRIP_LINES), static=True
        )

    def fill(self, entity: str, start: int, end: int) -> None:
        """Put empty texts in a span (ns of UTC).

        A viewer's time ruler has the span of the data, and leaves out long pauses in them.
        """
        times = np.linspace(start, end, _FILLING, dtype=np.int64)
        texts = rr.TextDocument.columns(text=[""] * len(times))
        self.recording.send_columns(entity, [self._time_column(times)], texts)

    def write(self, entity: str, text: str, media_type: rr.MediaType | None = None) -> None:
        """Set the text of a text entity, plain or such as `text/markdown`."""
        self.recording.log(entity, rr.TextDocument(text, media_type=media_type), static=True)

    def configure_states(
        self, entity: str, colours: Mapping[str, Colour], names: Sequence[str] | None = None
    ) -> None:
        """Set the colours (RGB, 0 to 255) and displayed names of the states of a lane."""
        labels = [*map(in_words, colours)] if names is None else names
        style = rr.StateConfiguration(
            values=list(colours), labels=labels, colors=[*colours.values()]
        )
        self.recording.log(entity, style, static=True)

    def change_states(self, entity: str, times: Int64, states: Sequence[str | None]) -> None:
        """Set the state of a lane, None for no state, at each time, in nanoseconds of UTC."""
        column = rr.StateChange.columns(state=pa.array(states, pa.string()))
        self.recording.send_columns(entity, [self._time_column(times)], column)

    def configure(
        self, entity: str, style: Style, names: Sequence[str], colours: Sequence[Colour] = ()
    ) -> None:
        """Set the names and colours (red, green and blue, 0 to 255) of the columns of an entity."""
        count = len(names)
        look: rr.SeriesLines | rr.SeriesPoints
        match style:
            case Style.BANDS:
                widths = [_STROKE_WIDTH] * count
                look = rr.SeriesLines(
                    names=names, colors=colours, widths=widths, aggregation_policy="MinMax"
                )
            case Style.ROWS:
                look = rr.SeriesLines(
                    names=np.repeat(names, _ROW_LINES).tolist(),
                    widths=[_ROW_WIDTH] * count * _ROW_LINES,
                    aggregation_policy="off",
                )
            case Style.LINE:
                look = rr.SeriesLines(names=names, colors=colours, aggregation_policy="average")
            case Style.POINTS:
                sizes = [_POINT] * count
                look = rr.SeriesPoints(
                    names=names, colors=colours, markers=["circle"] * count, marker_sizes=sizes
                )
            case Style.HEAT_MAP:
                sizes = [_HEAT_SQUARE] * count
                look = rr.SeriesPoints(names=names, markers=["square"] * count, marker_sizes=sizes)
        self.recording.log(entity, look, static=True)

    def add_bands(
        self, entity: str, times: Int64, shares: NDArray[np.floating], length: int, strokes: int = 1
    ) -> None:
        """Stack shares of one as bands: each is filled by a line that goes up and down in it.

        Times are middles of spans of `length`, in nanoseconds of UTC; shares [shape=(n, k)] are 0
        to 1, or NaN where there is nothing. `strokes` of a span that are fewer than its pixels
        leave holes between.
        """
        # Half a stroke is a line of its own for the viewer, which keeps something of each.
        upper = np.where(shares < _LEAST_SHARE, np.nan, np.cumsum(shares, axis=1))
        lower = upper - shares
        ends = np.tile(np.stack([lower, upper], axis=1), (1, strokes, 1))
        steps = (np.arange(2 * strokes) + 0.5) / (2 * strokes) - 0.5
        places = times[:, np.newaxis] + (steps * length).astype(np.int64)
        self.draw_lines(entity, places.ravel(), ends.reshape(-1, shares.shape[1]))

    def add_rows(
        self,
        entity: str,
        times: Int64,
        shares: NDArray[np.floating],
        length: int,
        colours: Sequence[Colour],
    ) -> None:
        """Draw shares of one as rows from above in k colours, the brighter the larger a share is.

        Times and shares are as of `add_bands`.
        """
        there = ~np.isnan(shares).all(axis=1)
        levels = np.rint(np.nan_to_num(shares[there]) * _SHADES)
        if not len(levels):
            return
        starts = times[there] - length // 2
        first = np.append(True, np.diff(starts) > 1.5 * length)  # of a part without a hole
        last = np.append(first[1:], True)
        kept = first | np.append(True, (levels[1:] != levels[:-1]).any(axis=1))
        ends = starts[last] + length
        # Of rows at one time the viewer may take a value without its hole: none share a time.
        stamps = np.concatenate([starts[first], starts[kept] + first[kept], ends - 1, ends])
        shades = np.concatenate([levels[first], levels[kept], levels[last], levels[last]])
        order = np.argsort(stamps, kind="stable")
        count = levels.shape[1]
        middles = count - np.arange(count) - 0.5
        lines = np.linspace(-0.5, 0.5, _ROW_LINES) * _ROW_SHARE
        places = (middles[:, np.newaxis] + lines).ravel() * (ROWS_HEIGHT / count)
        heights = np.tile(places, (len(stamps), 1))
        heights[: first.sum()] = heights[-last.sum() :] = np.nan
        shades = shades[np.roll(order, 1)]  # the viewer draws a piece in the colour of its end
        light = shades[:, :, np.newaxis] / _SHADES
        mixed = _GROUND + light * (np.array(colours) - _GROUND)
        drawn = np.repeat(mixed.round().astype(np.uint8), _ROW_LINES, axis=1)
        lengths = [count * _ROW_LINES] * len(stamps)
        columns = [
            *rr.Scalars.columns(scalars=heights[order].ravel()).partition(lengths),
            *rr.SeriesLines.columns(colors=drawn.reshape(-1, 3)).partition(lengths),
        ]
        self.recording.send_columns(entity, [self._time_column(stamps[order])], columns)

    def draw_lines(self, entity: str, times: Int64, values: NDArray[np.floating]) -> None:
        """Draw a line for each column of values [shape=(n, k)]; NaN interrupts a line."""
        width = values.shape[1]
        for first in range(0, len(times), _ROWS_AT_ONCE):
            part = values[first : first + _ROWS_AT_ONCE]
            column = rr.Scalars.columns(scalars=part.ravel()).partition([width] * len(part))
            stamps = self._time_column(times[first : first + _ROWS_AT_ONCE])
            self.recording.send_columns(entity, [stamps], column)

    def draw_frames(
        self, entity: str, names: Sequence[str], parts: Iterable[Plot], step: float
    ) -> None:
        """Draw frames as lines, interrupted where frames are missing.

        A frame equal to both its neighbours is skipped. Each part has at least one frame.
        """
        for part in parts:
            times, values = _with_holes(part, names)
            rounded = np.rint(values / step) * step
            changes = np.append(True, (rounded[1:] != rounded[:-1]).any(axis=1))
            kept = changes | np.append(changes[1:], True)
            self.draw_lines(entity, times[kept], rounded[kept])

    def add_shades(self, entity: str, times: Int64, shade: NDArray[np.floating]) -> None:
        """Draw squares of a heat map; shades [shape=(n, k)] are 0 (dark) to 1 (bright)."""
        colours = _coloured(shade)
        count = shade.shape[1]
        heights = np.tile(np.arange(count, dtype=np.float64), len(times))
        lengths = [count] * len(times)
        columns = [
            *rr.Scalars.columns(scalars=heights).partition(lengths),
            *rr.SeriesPoints.columns(colors=colours.reshape(-1, 3))
            .partition(lengths),
        ]  # fmt: skip
        self.recording.send_columns(entity, [self._time_column(times)], columns)

    def show_image(self, entity: str, time: int, shade: NDArray[np.floating], text: str) -> None:
        """Show an image from a time (ns of UTC) on, with a text in the entity below.

        Shades [shape=(rows, columns)] are 0 (dark) to 1 (bright).
        """
        self.recording.set_time(
            self.clock.name, timestamp=np.datetime64(self.clock.shown(time), "ns")
        )
        self.recording.log(entity, rr.Image(_coloured(shade)).compress())
        self.recording.log(f"{entity}/text", rr.TextDocument(text))
        self.recording.reset_time()

    def write_lines(self, entity: str, lines: LogLines) -> None:
        """Add lines of text, each at its time and with its level."""
        if len(lines.times):
            levels = [_LEVELS.get(level, "INFO") for level in lines.levels.tolist()]
            column = rr.TextLog.columns(text=lines.texts.tolist(), level=levels)
            self.recording.send_columns(entity, [self._time_column(lines.times)], column)

    def show_clips(self, entity: str, clips: Sequence[SoundClip], start: int) -> None:
        """Add one or more clips in time order at their starts, separated by a moment of silence.

        `start` of the view is nanoseconds of UTC. A viewer shows the latest data, however old, and
        an error before the first data.
        """
        rate = clips[0].rate
        silence = np.zeros(rate // 10, np.int16)
        quiet = {min(start, clips[0].start), *(clip.end for clip in clips)}
        for time in sorted(quiet - {clip.start for clip in clips}):
            self._show_clip(entity, SoundClip(time, rate, silence))
        for clip in clips:
            self._show_clip(entity, clip)

    def _show_clip(self, entity: str, clip: SoundClip) -> None:
        stream = io.BytesIO()
        soundfile.write(stream, clip.samples, clip.rate, format="FLAC", subtype="PCM_16")
        start = np.datetime64(self.clock.shown(clip.start), "ns")
        self.recording.set_time(self.clock.name, timestamp=start)
        self.recording.log(
            entity, rr.AssetAudio(contents=stream.getvalue(), media_type="audio/flac")
        )
        self.recording.reset_time()

    def _time_column(self, times: Int64) -> rr.TimeColumn:
        shown = self.clock.shown(times).astype("datetime64[ns]")
        return rr.TimeColumn(self.clock.name, timestamp=shown)


def _coloured(shade: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the colours of shades from 0 (dark) to 1 (bright)."""
    scale = np.linspace(0.0, 1.0, len(_DARK_TO_BRIGHT))
    colours = np.stack([np.interp(shade, scale, part) for part in _DARK_TO_BRIGHT.T], axis=-1)
    return colours.round().astype(np.uint8)


def _with_holes(part: Plot, names: Sequence[str]) -> tuple[Int64, Float64]:
    """Align frames to the named columns, and insert a row of NaN where frames are missing."""
    values = np.full((len(part.times), len(names)), np.nan)
    values[:, [names.index(name) for name in part.names]] = part.values
    length = int(np.median(np.diff(part.times))) if len(part.times) > 1 else 0
    missing = np.flatnonzero(np.diff(part.times) > 1.5 * length) + 1
    times = np.insert(part.times, missing, part.times[missing - 1] + length)
    return times, np.insert(values, missing, np.nan, axis=0)
