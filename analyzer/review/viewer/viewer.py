"""Timeline viewer, in a window or under another control, with mouse selections."""

import io
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import rerun as rr
from PIL import Image
from rerun.experimental import ViewerClient

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.spans import NONE, joined
from hearthlog.analyzer.review.lanes import (
    SELECTED,
    Checked,
    cut_spans,
    reviewed_lane,
    selected_lane,
)
from hearthlog.analyzer.review.timeline import (
    HomeClock,
    Key,
    LabelledSpans,
    Question,
    Timeline,
    TimelineGrid,
)
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.analyzer.review.viewer.drawing import (
    APPLICATION,
    BELOW,
    COLUMNS,
    HOUR_COLUMNS,
    SHARED_AXIS,
    DrawnLane,
    RequestedSpan,
    clear_sound,
    draw,
    draw_close_up,
    draw_frames,
    review_layout,
    write_checked,
)
from hearthlog.analyzer.review.viewer.process import ViewerProcess, check_display
from hearthlog.analyzer.review.viewer.recording import name_recording
from hearthlog.analyzer.review.viewer.row_heights import (
    AXIS_HEIGHT,
    TAB_BAR,
    Blueprint,
    FittedRows,
    RowHeights,
)

_PANEL, _AXIS, _CONTAINER = "/time_panel", "ScalarAxis", "ContainerBlueprint"
_WAIT_SECONDS = 60
_FLUSH_SECONDS = 30.0
_SIZE_SECONDS = 3.0
_ROUNDING = 1_000_000  # nanoseconds
_FARTHEST = 1 << 62  # nanoseconds: a time from a viewer, in an array with any offset


class ViewerState(NamedTuple):
    """State reported by a viewer."""

    version: str
    views: int
    errors: list[str]
    cursor: int | None  # in nanoseconds of the clock of the home


class ViewerSize(NamedTuple):
    """Size of a viewer, in points of the screen."""

    width: float
    height: float


# Points of the viewer's own parts.
_RULER_LEFT, _RULER_RIGHT = 200.0, 30.0  # from the edges of the viewer to the ends of its ruler
_SCALE_WIDTH = 17.0  # between a view and its plot


class Viewer(ABC):
    """A viewer in a window or in a browser; the address of its page is empty if it opens itself."""

    def __init__(self, process: ViewerProcess, address: str = "") -> None:
        self.address = address
        self._process = process
        self._recording = rr.RecordingStream(APPLICATION)
        self._canvas = Canvas(self._recording, HomeClock("", 0))
        self._lanes: dict[tuple[str, str], DrawnLane] = {}  # those that change
        self._grid: TimelineGrid | None = None
        self._rows = FittedRows(RowHeights((), ((1,),), 0, has_plots=False, is_close_up=False))
        # Containers in the blueprint: of a text and a plot, and of the names of lanes.
        self._columns: dict[str, float] = {}  # with the width of the text, in points
        self._names: list[str] = []
        self._aligned: ViewerSize | None = None
        self._size_due = 0.0  # of the next look at the size, by CLOCK_MONOTONIC
        self._shown: tuple[int, int, int, bool] | None = None  # arguments of the last `show`
        self._opening: Any = None  # range of the time axes
        self._latest: Any = None  # that of the last span that was shown
        self._axes: dict[str, list[float]] = {}  # vertical ranges, by component of the blueprint
        self._selected: tuple[int, int] | None = None  # as drawn
        self._requested = RequestedSpan()
        self._close = NONE  # spans of the close-ups
        self._sent = False

    @abstractmethod
    def state(self) -> ViewerState:
        """Return the state of the viewer.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """

    @abstractmethod
    def _blueprint(self) -> Blueprint:
        """Return the blueprint of the viewer, which holds the user's selection."""

    @abstractmethod
    def _set_blueprint(self, blueprint: Blueprint) -> None:
        """Replace the blueprint of the viewer."""

    @abstractmethod
    def _set_time(self, nanoseconds: int, *, play: bool) -> None:
        """Set the time cursor, in nanoseconds of the clock of the home, and let it run."""

    def offer(  # noqa: B027 - in a window, the keys are typed in the terminal
        self,
        keys: Sequence[Key],
        press: Callable[[str], None],
        sound: Callable[[], bytes] | None = None,
    ) -> None:
        """Show buttons in the page of the viewer, if it has one.

        `sound` returns the sound of the current span as a WAV file, for the page to play, or raises
        `HearthlogError` if there is none.
        """

    def announce(self, text: str) -> None:  # noqa: B027 - lines are printed in the terminal, too
        """Show a line in the page of the viewer, if it has one."""

    def close(self) -> None:
        """Stop the viewer."""
        self._process.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._sent and self.is_open():
            self._recording.disconnect()
        self.close()

    def is_open(self) -> bool:
        """Return whether the viewer runs; its user may have closed it."""
        return self._process.is_running()

    def check(self) -> None:
        """Raise DataError if the viewer ended with an error."""
        self._process.check()

    def draw(self, timeline: Timeline, *, close_up: bool) -> None:
        """Show a timeline.

        Raise `DataError` if the viewer has ended, does not take data within a minute, or the
        timeline's time zone is unknown.
        """
        self._process.wait_until_it_listens()
        rr.set_strict_mode(True)
        self._sent = True
        has_question = close_up and not self.address  # a page has the question next to its buttons
        layout = review_layout(timeline, marking=True, close_up=close_up, has_question=has_question)
        assert layout.heights is not None
        self._rows = FittedRows(layout.heights)
        self._recording.connect_grpc(self._process.url, default_blueprint=layout)
        name_recording(self._recording, timeline)
        self._canvas = Canvas(self._recording, timeline.clock)
        self._grid = timeline.grid
        self._lanes = draw(timeline, self._canvas, marking=not close_up)
        if close_up:
            self._lanes["", SELECTED] = self._requested
            for name in timeline.microphones if timeline.has_sound else ():  # until one is asked
                clear_sound(name, timeline.grid.start, " ", self._canvas)
        self._flush()

    def write_checked(self, timeline: Timeline, checked: Checked) -> None:
        """Draw the precision of each class of a timeline next to its name."""
        write_checked(timeline, checked, self._canvas)
        self._flush()

    def draw_frames(self, timeline: Timeline, start: int, end: int) -> None:
        """Draw every frame of a span of the timeline.

        Start and end (excluded) are nanoseconds of UTC, of the first samples of frames.
        """
        draw_frames(timeline, self._canvas, start, end)
        self._flush()

    def draw_close_up(self, timeline: Timeline) -> None:
        """Draw a short timeline next to the longer timeline that contains it.

        Earlier close-ups are not drawn again: a viewer keeps all data, and would draw both.
        """
        draw_close_up(timeline, self._close, self._canvas)
        starts, ends = self._close
        grid = timeline.grid
        self._close = joined(np.append(starts, grid.start), np.append(ends, grid.end))
        self._flush()

    def show_question(self, start: int, end: int, question: Question) -> None:
        """Draw the requested span, in place of the previous one."""
        if not self.address:
            question = question._replace(keys_in="Press in the terminal")
        self._requested.show_question(start, end, question, self._canvas)
        self._flush()

    def clear_question(self) -> None:
        """Remove the question of the previous span."""
        self._requested.clear(self._canvas)
        self._flush()

    def redraw_marks(
        self, microphone: str, scenario: str, marks: LabelledSpans, reviewed: LabelledSpans
    ) -> None:
        """Redraw the reviewed spans of a microphone; earlier ones that are missing here are hidden.

        The scenario is empty for the sounds of the home.
        """
        assert self._grid is not None
        lane = reviewed_lane(microphone, scenario, marks, reviewed)
        lane = lane._replace(spans=cut_spans(lane.spans, self._grid))
        self._lanes[microphone, lane.name].show(lane, self._canvas)
        self._flush()

    def refresh(self) -> None:
        """Draw the selected span in the lanes, and put the lanes beside their names again.

        The wheel and a drag move the lanes vertically, and a window may have a new size.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """
        blueprint = self._blueprint()
        ranges = {path: _component(blueprint, path, _AXIS).get("range") for path in self._axes}
        moved = [path for path, span in self._axes.items() if ranges[path] != span]
        for path in moved:
            blueprint.setdefault(path, {}).setdefault(_AXIS, {})["range"] = self._axes[path]
        is_changed = bool(moved) or self._undo_reset(blueprint)
        if time.monotonic() >= self._size_due:
            self._size_due = time.monotonic() + _SIZE_SECONDS
            is_changed |= self._align(blueprint)
        if is_changed:
            self._set_blueprint(blueprint)
        self._draw_selection(self._selection_in(blueprint))

    def _undo_reset(self, blueprint: Blueprint) -> bool:
        """Show the last span again after a double click, which shows all data; return whether."""
        grid = self._grid
        if grid is None or self._latest is None:
            return False
        data = self._clock.shown(grid.start), self._clock.shown(grid.end)
        if not _is_near(_view(blueprint), data) or _is_near(self._latest, data):
            return False
        _set_view(blueprint, self._latest)
        return True

    def _draw_selection(self, selection: tuple[int, int] | None) -> None:
        if selection == self._selected:
            return
        self._selected = selection
        assert self._grid is not None
        for (microphone, name), drawn in self._lanes.items():
            if name == SELECTED:
                lane = selected_lane(microphone, selection)
                drawn.show(lane._replace(spans=cut_spans(lane.spans, self._grid)), self._canvas)
        self._flush()

    def wait_until_drawn(self, is_over: Callable[[], bool] = bool) -> ViewerState | None:
        """Wait until the viewer has drawn its data; for a page, until somebody opens it.

        None if the wait was ended by `is_over`. Raise `DataError` if the viewer ends, if a window
        takes longer than a minute, or if the viewer's version differs from the package's.
        """
        deadline = time.monotonic() + _WAIT_SECONDS
        while self.address or time.monotonic() < deadline:
            if self.address and is_over():
                return None
            try:
                state = self.state()
            except (ConnectionError, TimeoutError):
                if not self.is_open():
                    raise self._process.failed() from None
                time.sleep(0.05)
                continue
            check_version(state.version)
            if state.views:
                self._take_layout()
                return state
            time.sleep(0.05)
        raise DataError("Rerun's viewer does not show anything; use --save FILE.rrd")

    def selection(self) -> tuple[int, int] | None:
        """Return the span selected on the time ruler, if any, in nanoseconds of UTC.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """
        return self._selection_in(self._blueprint())

    def _selection_in(self, blueprint: Blueprint) -> tuple[int, int] | None:
        span = _span(_component(blueprint, _PANEL, "TimePanelBlueprint").get("time_selection"))
        return span and (self._clock.utc(span[0]), self._clock.utc(span[1]))

    def cursor(self) -> int | None:
        """Return the time of the cursor, in nanoseconds of UTC; None without a cursor.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """
        cursor = self.state().cursor
        return None if cursor is None or cursor > _FARTHEST else self._clock.utc(cursor)

    def _take_layout(self) -> None:
        """Remember the layout as it was opened."""
        with suppress(ConnectionError, TimeoutError):
            blueprint = self._blueprint()
            found = {path: _component(blueprint, path, _AXIS).get("range") for path in blueprint}
            self._axes = {path: span for path, span in found.items() if span is not None}
            self._opening = self._latest = _view(blueprint)
            shares = {path: _component(blueprint, path, _CONTAINER) for path in blueprint}
            for columns, left in (
                (COLUMNS, _RULER_LEFT - _SCALE_WIDTH),
                (HOUR_COLUMNS, _RULER_LEFT),
            ):
                own = [*map(float, columns)]
                self._columns |= {
                    k: left for k, one in shares.items() if one.get("col_shares") == own
                }
            self._names = [
                path
                for path, own in shares.items()
                if isinstance(heights := own.get("row_shares"), list) and heights[-1:] == [BELOW]
            ]
            self.refresh()

    @abstractmethod
    def _size(self) -> ViewerSize | None:
        """Return the size of the viewer; None if unknown."""

    def _align(self, blueprint: Blueprint) -> bool:
        """Put the lanes beside their names and above the time ruler; return whether anything moved.

        The viewer has another size than before then.
        """
        size, grid = self._size(), self._grid
        if size is None or grid is None or size == self._aligned:
            return False
        rows = [_component(blueprint, path, _CONTAINER).get("row_shares") for path in self._names]
        if not all(isinstance(one, list) and one for one in rows):
            return False  # a viewer that opened anew has no layout yet
        self._aligned = size
        self._set_shares(blueprint, size)
        if _view(blueprint) == self._opening:  # else the user looks at another span
            start, end = self._clock.shown(grid.start), self._clock.shown(grid.end)
            beyond = _RULER_RIGHT / max(size.width - _RULER_RIGHT - _RULER_LEFT, 1.0)
            self._opening = self._latest = _range(start, end + round((end - start) * beyond))
            _set_view(blueprint, self._opening)
        return True

    def _set_shares(self, blueprint: Blueprint, size: ViewerSize) -> None:
        """Set the widths and heights of the names of lanes."""
        counts = [
            len(_component(blueprint, path, _CONTAINER)["row_shares"]) - 1 for path in self._names
        ]
        lanes = self._rows.fit(blueprint, size.height, max(counts, default=1))
        lanes -= TAB_BAR + AXIS_HEIGHT
        for path, left in self._columns.items():
            _component(blueprint, path, _CONTAINER)["col_shares"] = [left, size.width - left]
        for path in self._names:
            heights = _component(blueprint, path, _CONTAINER)["row_shares"]
            below = AXIS_HEIGHT * (len(heights) - 1) / max(lanes, AXIS_HEIGHT)
            _component(blueprint, path, _CONTAINER)["row_shares"] = [*heights[:-1], below]

    def show(self, start: int, end: int, margin: int, *, select: bool = True) -> None:
        """Show a span with a margin (ns), put the cursor on its start; select the span or nothing.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """
        self._shown = start, end, margin, select
        start, end = self._clock.shown(start), self._clock.shown(end)
        blueprint = self._blueprint()
        panel = blueprint.setdefault(_PANEL, {}).setdefault("TimePanelBlueprint", {})
        if select:
            panel["time_selection"] = {"min": start, "max": end}
        else:
            panel.pop("time_selection", None)
            panel["loop_mode"] = "Off"  # else the viewer selects something itself
        panel["play_state"] = "Paused"
        self._latest = _range(start - margin, end + margin)
        _set_view(blueprint, self._latest)
        self._set_blueprint(blueprint)
        self._set_time(start, play=False)

    def _show_again(self) -> None:
        """Show in a viewer that opened anew what the one before showed."""
        self._aligned, self._size_due = None, 0.0
        self._rows.reset()
        if self._shown is not None:
            start, end, margin, select = self._shown
            self.show(start, end, margin, select=select)

    def play(self, start: int) -> None:
        """Start the cursor running from a time.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """
        self._set_time(self._clock.shown(start), play=True)

    @property
    def _clock(self) -> HomeClock:
        return self._canvas.clock

    def _flush(self) -> None:
        if self.is_open():  # otherwise it would wait for ever
            self._recording.flush(timeout_sec=_FLUSH_SECONDS)


def check_version(version: str) -> None:
    """Raise `DataError` if a viewer's version, or empty, differs from the installed `rerun`'s."""
    if version != rr.__version__:
        raise DataError(
            f"the viewer is of Rerun {version or 'an unknown version'}, and hearthlog works with "
            f"{rr.__version__}; `pip install rerun-sdk=={rr.__version__}`"
        )


def _range(start: int, end: int) -> Any:
    return {"start": {"Absolute": start}, "end": {"Absolute": end}}


def _is_near(bounds: Any, span: tuple[int, int]) -> bool:
    """Return whether a range of the axes is a span; the viewer rounds some nanoseconds."""
    ends = [bounds.get(edge) for edge in ("start", "end")] if isinstance(bounds, Mapping) else []
    edges = [edge.get("Absolute") for edge in ends if isinstance(edge, Mapping)]
    return len(edges) == len(span) and all(
        isinstance(edge, int) and abs(edge - time) < _ROUNDING
        for edge, time in zip(edges, span, strict=True)
    )


def _set_view(blueprint: Blueprint, bounds: Any) -> None:
    blueprint[f"/{SHARED_AXIS}"] = {"TimeAxis": {"view_range": bounds}}


def _component(blueprint: Blueprint, path: str, name: str) -> dict[str, Any]:
    """Return a component of an entity of a blueprint; empty without one."""
    return blueprint.get(path, {}).get(name, {})


def _view(blueprint: Blueprint) -> Any:
    """Return the range of the time axes in a blueprint; None without one."""
    return _component(blueprint, f"/{SHARED_AXIS}", "TimeAxis").get("view_range")


def _span(selection: Any) -> tuple[int, int] | None:
    if not isinstance(selection, Mapping):
        return None
    start, end = selection.get("min"), selection.get("max")
    if not isinstance(start, int) or not isinstance(end, int):
        return None
    return (start, end) if -_FARTHEST < start < end < _FARTHEST else None


_LIGHT = 140  # of 255: brightness of the time cursor
_SHORTEST = 40  # pixels of the time cursor
_SCALE_STEP, _SCALE_ERROR = 0.25, 0.03  # of the scales of screens
_MEMORY = "800MB"  # of a viewer with days of incoming data; then it drops the oldest


class WindowViewer(Viewer):
    """A viewer in its own window, controlled over gRPC with Rerun's own client."""

    _scale = 1.0  # pixels of a point of the screen

    @cached_property
    def _client(self) -> ViewerClient:
        return ViewerClient.connect(self._process.url)

    def state(self) -> ViewerState:
        """Return the state of the viewer."""
        state = self._client.get_state()
        errors = [
            f"{view.name}: {report.summary}" for view in state.views for report in view.reports
        ]
        cursors = [
            each.current_time
            for each in state.recordings
            if each.store_id == state.active_recording
        ]
        cursor = cursors[0] if cursors else None
        return ViewerState(state.viewer_version or "", len(state.views), errors, cursor)

    def picture(self) -> bytes:
        """Return a picture of the window as PNG.

        Raise `ConnectionError, TimeoutError` if the viewer does not answer.
        """
        return self._client.take_screenshot()

    def _size(self) -> ViewerSize | None:
        with Image.open(io.BytesIO(self._client.take_screenshot())) as image:
            if self._is_at_start():
                self._scale = _scale_of(image) or self._scale
            return ViewerSize(image.width / self._scale, image.height / self._scale)

    def _is_at_start(self) -> bool:
        """Whether the time cursor is where the timeline starts."""
        cursor, grid = self.cursor(), self._grid
        return cursor is not None and grid is not None and abs(cursor - grid.start) < grid.step

    def _blueprint(self) -> Blueprint:
        return self._client.get_blueprint().blueprint

    def _set_blueprint(self, blueprint: Blueprint) -> None:
        self._client.set_blueprint(blueprint, of="recording")

    def _set_time(self, nanoseconds: int, *, play: bool) -> None:
        self._client.set_time(
            self._clock.name,
            timestamp=np.datetime64(nanoseconds, "ns"),
            play_state="playing" if play else "paused",
        )


def _scale_of(image: Image.Image) -> float | None:
    """Return the pixels of a point, from a picture with the time cursor at the start.

    None if the cursor is not where a screen would have it: the picture is not all drawn.
    """
    light = np.asarray(image.convert("L"))[:-6, : image.width // 2] > _LIGHT
    # The cursor is a line from the ruler's left end down to the lower edge.
    lengths = np.argmin(light[::-1], axis=0)
    left = int(np.argmax(lengths))
    if lengths[left] <= _SHORTEST:
        return None
    scale = left / _RULER_LEFT
    nearest = max(round(scale / _SCALE_STEP), 1 / _SCALE_STEP) * _SCALE_STEP
    return scale if abs(scale - nearest) < _SCALE_ERROR * nearest else None


def open_window(port: int | None = None, data: str | None = None) -> WindowViewer:
    """Open Rerun's viewer in a window.

    Raise `DataError` if there is no display, the viewer is not installed, or the port is in
    use.
    """
    check_display(
        "--save FILE.rrd to make a file that Rerun opens elsewhere, with --queue FILE.txt to "
        "correct it by hand"
        if data is None
        else "--serve to open it on another machine"
    )
    if data is None:
        return _opened(port, "--expect-data-soon")
    return _opened(port, "--connect", data, "--memory-limit", _MEMORY)


def open_hidden(size: tuple[int, int] = (1920, 1080)) -> WindowViewer:
    """Run the viewer without a window, for pictures of a width and height.

    Raise `DataError` if the viewer is not installed.
    """
    width, height = size
    window = "--window-size", f"{width}x{height}"
    return _opened(None, "--expect-data-soon", "--headless", *window)


def _opened(port: int | None, *more: str) -> WindowViewer:
    limit = ["--server-memory-limit", "32MB"]  # no other viewer connects later
    return WindowViewer(ViewerProcess(["--hide-welcome-screen", *limit, *more], port))
