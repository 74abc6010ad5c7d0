"""Logs on one time axis: a Rerun recording of labels, probabilities and features.

The only module that knows Rerun, much of which is marked unstable. Writing a recording sends
nothing: Rerun's usage statistics, and the port it opens to the network, are its viewer's.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from analyzer.errors import DataError
from analyzer.tracks import Rows, Spans, Tracks, read_tracks
from schemas import messages
from schemas.errors import LogError
from schemas.files import check_new, new_file

APPLICATION = "hearthlog"
TIMELINE = "time"

_ROWS_AT_ONCE = 72_000  # an hour of frames
_ENERGY = "energy"
_LANES_HEIGHT, _LANE_HEIGHT, _PLOT_HEIGHT = 80, 42, 300  # about pixels, on a screen of 1080
_PROBABILITIES, _LEVEL, _HEAT_MAP = "probabilities", "level", "heat_map"
_HEAT_COLUMNS = 2000
_HEAT_PERCENTILES = (2, 98)
_HEAT_SQUARE = 6.5  # half its side: from afar squares overlap, close up they lie apart
_TINY = np.finfo(np.float64).tiny
_QUIETEST = 1e-10  # of a mean square: -100 dB
# The viewer keeps the range that linked time axes share under this name.
_SHARED_AXIS = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"

_SILENCE, _NOT_HEARD, _BRIGHT = (84, 96, 106), (200, 40, 40), (235, 215, 140)
_COLOURS = (
    (66, 135, 214), (240, 150, 55), (87, 172, 89), (214, 84, 92), (150, 111, 201),
    (164, 120, 96), (226, 128, 190), (190, 190, 70), (60, 190, 200), (245, 205, 90),
    (120, 200, 150), (200, 100, 60),
)  # fmt: skip
_DARK_TO_BRIGHT = np.array(  # through purple and red, as matplotlib's magma
    [(0, 0, 4), (59, 15, 112), (140, 41, 129), (222, 73, 104), (254, 159, 109), (252, 253, 191)]
)

Colour = tuple[int, int, int]
Int64 = NDArray[np.int64]
Float32 = NDArray[np.float32]


def save_timeline(logs: Iterable[Path], output: Path) -> None:
    """Write what some logs hold into one Rerun recording (`.rrd`).

    On the timeline `time` (UTC) it has, under the name of each topic: labels, segments and gaps
    as lanes of states, the probabilities of all classes, the energy in dB, and a heat map of all
    features; and a blueprint that shows them on one linked time axis.

    Parameters
    ----------
    logs : iterable of Path
    output : Path
        Must not exist.

    Raises
    ------
    LogError
        If one of the logs cannot be read.
    DataError
        If there is nothing to show, or the recording cannot be written.
    """
    check_output(output)
    tracks = read_tracks(logs)
    start, end = tracks.range
    if start == end:
        raise DataError("no features, labels, segments or gaps in these logs: nothing to show")
    try:
        with new_file(output) as temporary:
            _write(tracks, temporary)
    except LogError as error:
        raise DataError(str(error)) from error


def check_output(output: Path) -> None:
    """Raise DataError unless a recording can be saved under this name."""
    if output.suffix != ".rrd":
        raise DataError(f"{output}: the name of a Rerun recording must end in .rrd")
    try:
        check_new(output)
    except LogError as error:
        raise DataError(str(error)) from error


def _write(tracks: Tracks, path: Path) -> None:
    rr.set_strict_mode(True)  # or its mistakes become warnings, and its file wrong
    start, end = tracks.range
    recording = rr.RecordingStream(APPLICATION)
    recording.save(path, default_blueprint=_Blueprint(_layout(tracks), start, end))
    recording.send_recording_start_time_nanos(start)
    recording.send_recording_name(f"{_time(start):.16} to {_time(end):.16}")
    colours = _colours(tracks)
    for topic, rows in tracks.rows[messages.LABEL].items():
        _log_states(recording, topic, *_label_changes(rows), colours)
        _log_lines(recording, f"{topic}/{_PROBABILITIES}", rows, colours)
    for topic, spans in tracks.spans[messages.SEGMENT].items():
        _log_states(recording, topic, *_span_changes(spans), colours)
    for topic, spans in tracks.spans[messages.GAP].items():
        reasons = dict.fromkeys(spans.texts, _NOT_HEARD)
        _log_states(recording, topic, *_span_changes(spans), reasons)
    for topic, rows in tracks.rows[messages.FEATURES].items():
        if _ENERGY in rows.names:
            _log_lines(recording, f"{topic}/{_LEVEL}", _level(rows), {_ENERGY: _BRIGHT})
        _log_heat_map(recording, f"{topic}/{_HEAT_MAP}", rows)
    try:
        recording.flush()
    except RuntimeError as error:  # all that comes of a full disk
        raise OSError(f"{error}; is the disk full?") from error
    recording.disconnect()


class _Blueprint(rrb.Blueprint):
    """A blueprint whose linked time axes begin with a given range, which Rerun has no word for."""

    def __init__(self, layout: rrb.Container, start: int, end: int) -> None:
        panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused")
        super().__init__(layout, panel, collapse_panels=True)
        bounds = [rr.encodings.TimeRangeBoundary.absolute(nanos=time) for time in (start, end)]
        self._range = rr.encodings.TimeRange(*bounds)

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        stream.log(_SHARED_AXIS, rrb.TimeAxis(view_range=self._range))


def _layout(tracks: Tracks) -> rrb.Vertical:
    """Show everything, one above the other."""
    axis = rrb.TimeAxis(link="LinkToGlobal")
    lanes = [*tracks.rows[messages.LABEL], *(t for topics in tracks.spans.values() for t in topics)]
    views = [(_LANES_HEIGHT + _LANE_HEIGHT * len(lanes), _lanes(lanes, axis))] if lanes else []
    for topic in tracks.rows[messages.LABEL]:
        name = f"{topic}: probability of each class"
        views.append((_PLOT_HEIGHT, _plot(f"{topic}/{_PROBABILITIES}", name, axis, (0.0, 1.0))))
    for topic, rows in tracks.rows[messages.FEATURES].items():
        if _ENERGY in rows.names:
            name = f"{topic}: level in dB"
            views.append((_PLOT_HEIGHT // 2, _plot(f"{topic}/{_LEVEL}", name, axis)))
        top = len(rows.names) - 1
        ends = f"0 ({rows.names[0]}) to {top} ({rows.names[-1]})"
        name = f"{topic}: {ends}, each from its low values (dark) to its high ones (bright)"
        plot = _plot(f"{topic}/{_HEAT_MAP}", name, axis, (-0.5, top + 0.5))
        views.append((_PLOT_HEIGHT, plot))
    return rrb.Vertical(*(v for _, v in views), row_shares=[height for height, _ in views])


def _lanes(topics: list[str], axis: rrb.TimeAxis) -> rrb.View:
    return rrb.StateTimelineView(contents=topics, name="labels, segments, gaps", time_view=axis)


def _plot(
    entity: str, name: str, axis: rrb.TimeAxis, scale: tuple[float, float] | None = None
) -> rrb.View:
    return rrb.TimeSeriesView(
        origin=entity,
        name=name,
        axis_x=axis,
        axis_y=None if scale is None else rrb.ScalarAxis(range=scale),
        plot_legend=rrb.PlotLegend(visible=entity.endswith(_PROBABILITIES)),
    )


def _colours(tracks: Tracks) -> dict[str, Colour]:
    """Give every label a colour."""
    names = [name for rows in tracks.rows[messages.LABEL].values() for name in rows.names]
    names += [text for spans in tracks.spans[messages.SEGMENT].values() for text in spans.texts]
    colours = cycle(_COLOURS)
    return {n: _SILENCE if n == "silence" else next(colours) for n in dict.fromkeys(names)}


def _label_changes(rows: Rows) -> tuple[Int64, list[str | None]]:
    """Run-length encode the labels; None is where nothing was labelled."""
    begins = np.union1d(rows.breaks, np.flatnonzero(np.diff(rows.labels, prepend=-2)))
    stops = np.append(rows.breaks, len(rows.times)) - 1
    after = np.append(rows.times[rows.breaks], np.iinfo(np.int64).max)
    # Of equal times the later row wins, so the ends come first.
    times = np.concatenate([np.minimum(rows.ends[stops], after), rows.times[begins]])
    states = [*[None] * len(stops), *(rows.names[i] for i in rows.labels[begins])]
    order = np.argsort(times, kind="stable")
    return times[order], [states[i] for i in order]


def _span_changes(spans: Spans) -> tuple[Int64, list[str | None]]:
    """Begin each span with its text, and end it with None unless the next one follows at once."""
    last = np.flatnonzero(spans.ends < np.append(spans.starts[1:], np.iinfo(np.int64).max))
    times = np.concatenate([spans.ends[last], spans.starts])
    states = [*[None] * len(last), *spans.texts]
    order = np.argsort(times, kind="stable")
    return times[order], [states[i] for i in order]


def _log_states(
    recording: rr.RecordingStream,
    entity: str,
    times: Int64,
    states: list[str | None],
    colours: Mapping[str, Colour],
) -> None:
    about = rr.StateConfiguration(
        values=list(colours), labels=list(colours), colors=list(colours.values())
    )
    recording.log(entity, about, static=True)
    column = rr.StateChange.columns(state=pa.array(states, pa.string()))
    recording.send_columns(entity, [_time_column(times)], column)


def _log_lines(
    recording: rr.RecordingStream, entity: str, rows: Rows, colours: Mapping[str, Colour]
) -> None:
    about = rr.SeriesLines(
        names=rows.names,
        colors=[colours[name] for name in rows.names],
        aggregation_policy="average",
    )
    recording.log(entity, about, static=True)
    width = len(rows.names)
    breaks, ends = rows.breaks, rows.ends
    for start in range(0, len(rows.times), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        # A row of NaN ends the lines where frames are missing.
        missing = breaks[(breaks >= part.start) & (breaks < part.stop)]
        times = np.insert(rows.times[part], missing - start, ends[missing - 1])
        values = np.insert(rows.values[part], missing - start, np.nan, axis=0)
        column = rr.Scalars.columns(scalars=values.reshape(-1)).partition([width] * len(values))
        recording.send_columns(entity, [_time_column(times)], column)


def _level(rows: Rows) -> Rows:
    energy = np.maximum(rows.values[:, [rows.names.index(_ENERGY)]], np.float32(_QUIETEST))
    return replace(rows, names=(_ENERGY,), values=np.float32(10.0) * np.log10(energy))


def _log_heat_map(recording: rr.RecordingStream, entity: str, rows: Rows) -> None:
    """Log the mean of each feature over every share of the time, as the colour of a square."""
    count = len(rows.names)
    first, means = _means(rows)
    low, high = np.percentile(means, _HEAT_PERCENTILES, axis=0)
    shade = np.clip((means - low) / np.maximum(high - low, _TINY), 0.0, 1.0)
    grid = np.linspace(0.0, 1.0, len(_DARK_TO_BRIGHT))
    colours = np.stack([np.interp(shade, grid, part) for part in _DARK_TO_BRIGHT.T], axis=-1)
    about = rr.SeriesPoints(
        names=rows.names, markers=["square"] * count, marker_sizes=[_HEAT_SQUARE] * count
    )
    recording.log(entity, about, static=True)
    heights = np.tile(np.arange(count, dtype=np.float64), len(first))
    pixels = colours.round().astype(np.uint8).reshape(-1, 3)
    lengths = [count] * len(first)
    columns = [
        *rr.Scalars.columns(scalars=heights).partition(lengths),
        *rr.SeriesPoints.columns(colors=pixels).partition(lengths),
    ]
    recording.send_columns(entity, [_time_column(rows.times[first])], columns)


def _means(rows: Rows) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Divide the time into equal shares, and further where frames are missing.

    Returns
    -------
    first : np.ndarray [shape=(m,)]
        Index of the first frame of every share that has frames.
    means : np.ndarray [shape=(m, k)], float64
    """
    span = max(rows.times[-1] - rows.times[0], 1)
    share = ((rows.times - rows.times[0]) / span * _HEAT_COLUMNS).astype(np.int64)
    first = np.union1d(np.flatnonzero(np.diff(share, prepend=-1)), rows.breaks)
    size = np.diff(first, append=len(share))
    columns = (np.nan_to_num(column.astype(np.float64)) for column in rows.values.T)
    sums = [np.add.reduceat(column, first) for column in columns]
    return first, np.stack(sums, axis=1) / size[:, np.newaxis]


def _time_column(times: Int64) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, timestamp=times.astype("datetime64[ns]"))


def _time(stamp: int) -> str:
    return str(np.datetime64(stamp, "ns"))
