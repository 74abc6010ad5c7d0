"""A viewer that shows a timeline, and in which the user selects spans with the mouse."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
import rerun as rr

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.review.timeline.lanes import Changes, changes
from hearthlog.analyzer.review.timeline.model import LabelledSpans, Timeline
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.analyzer.review.viewer.drawing import (
    draw,
    draw_close_up,
    draw_frames,
    redraw_marks,
)
from hearthlog.analyzer.review.viewer.file import name_recording
from hearthlog.analyzer.review.viewer.layout import APPLICATION, SHARED_AXIS, review_layout
from hearthlog.analyzer.review.viewer.process import ViewerProcess

_PANEL = "/time_panel"
_WAIT_SECONDS = 60
_FLUSH_SECONDS = 30.0

Blueprint = dict[str, Any]


class ViewerState(NamedTuple):
    """The state of a viewer, as it reports it.

    Attributes
    ----------
    version : str
    views : int
        How many there are.
    errors : list of str
        Those that views report.
    cursor : int or None
        The time cursor, in nanoseconds of UTC.
    """

    version: str
    views: int
    errors: list[str]
    cursor: int | None


class ViewerControl(Protocol):
    """Controls one kind of viewer; all methods may raise ConnectionError or TimeoutError."""

    process: ViewerProcess

    def state(self) -> ViewerState:
        """Return its state."""

    def blueprint(self) -> Blueprint:
        """Return its blueprint, which has the selection of the user."""

    def set_blueprint(self, blueprint: Blueprint) -> None:
        """Replace its blueprint."""

    def set_time(self, nanoseconds: int, *, play: bool) -> None:
        """Put its cursor on a time."""

    def offer(self, keys: Sequence[tuple[str, str]], press: Callable[[str], None]) -> None:
        """Offer buttons (key and text), where there is a page."""

    def say(self, text: str) -> None:
        """Show a line, where there is a page."""

    def close(self) -> None:
        """Stop it."""


class Viewer:
    """A viewer in a window or in a browser.

    Parameters
    ----------
    control : ViewerControl
    address : str
        URL of its page; empty if it opens itself.
    """

    def __init__(self, control: ViewerControl, address: str = "") -> None:
        self.address = address
        self._control = control
        self._recording = rr.RecordingStream(APPLICATION)
        self._canvas = Canvas(self._recording)
        self._times: dict[str, set[int]] = {}  # of changes in review lanes
        self._sent = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._sent and self.is_open():
            self._recording.disconnect()
        self._control.close()

    def is_open(self) -> bool:
        """Tell whether it runs; its user may have closed it."""
        return self._control.process.is_running()

    def check(self) -> None:
        """Raise DataError if it failed."""
        self._control.process.check()

    def draw(self, timeline: Timeline, *, close_up: bool) -> None:
        """Show a timeline.

        Parameters
        ----------
        timeline : Timeline
        close_up : bool
            Whether short spans of it are looked at one after the other.

        Raises
        ------
        DataError
            If the viewer has ended.
        """
        process = self._control.process
        process.wait_until_it_listens()
        rr.set_strict_mode(True)
        self._sent = True
        layout = review_layout(timeline, marking=True, close_up=close_up)
        self._recording.connect_grpc(process.url, default_blueprint=layout)
        name_recording(self._recording, timeline)
        draw(timeline, self._canvas)
        self._flush()

    def draw_frames(self, timeline: Timeline, start: int, end: int) -> None:
        """Draw every frame of a span of the timeline."""
        draw_frames(timeline, self._canvas, start, end)
        self._flush()

    def draw_close_up(self, timeline: Timeline) -> None:
        """Draw a short timeline beside the one that it is a part of."""
        draw_close_up(timeline, self._canvas)
        self._flush()

    def redraw_marks(self, microphone: str, marks: LabelledSpans) -> None:
        """Draw the marks of a microphone again."""
        times, states = changes(marks)
        drawn = self._times.setdefault(microphone, set())
        drawn |= set(times.tolist())
        if not drawn:
            return
        # A later row wins over an earlier one of the same time, and none can be taken away.
        every = np.array(sorted(drawn))
        rows = np.searchsorted(times, every, side="right") - 1
        now = [states[row] if row >= 0 else None for row in rows.tolist()]
        redraw_marks(microphone, Changes(every, now), self._canvas)
        self._flush()

    def wait_until_drawn(self) -> ViewerState:
        """Wait until it shows what was sent to it; for a page, until somebody opens it.

        Raises
        ------
        DataError
            If it ends, takes too long, or is of another version than the package.
        """
        deadline = time.monotonic() + _WAIT_SECONDS
        while self.address or time.monotonic() < deadline:
            try:
                state = self.state()
            except (ConnectionError, TimeoutError):
                if not self.is_open():
                    raise self._control.process.failed() from None
                time.sleep(0.05)
                continue
            check_version(state.version)
            if state.views:
                return state
            time.sleep(0.05)
        raise DataError("Rerun's viewer does not show anything; use --save FILE.rrd")

    def state(self) -> ViewerState:
        """Return its state; raises ConnectionError or TimeoutError, as all that follows."""
        return self._control.state()

    def selection(self) -> tuple[int, int] | None:
        """Return the span that is selected on the time ruler, in nanoseconds of UTC."""
        panel = self._control.blueprint().get(_PANEL, {}).get("TimePanelBlueprint", {})
        return _span(panel.get("time_selection"))

    def cursor(self) -> int | None:
        """Return the time of the cursor, in nanoseconds of UTC."""
        return self.state().cursor

    def show(self, start: int, end: int, margin: int) -> None:
        """Select a span, show it with a margin, and put the cursor on its start."""
        blueprint = self._control.blueprint()
        panel = blueprint.setdefault(_PANEL, {}).setdefault("TimePanelBlueprint", {})
        panel["time_selection"] = {"min": start, "max": end}
        panel["play_state"] = "Paused"
        bounds = {"start": {"Absolute": start - margin}, "end": {"Absolute": end + margin}}
        blueprint[f"/{SHARED_AXIS}"] = {"TimeAxis": {"view_range": bounds}}
        self._control.set_blueprint(blueprint)
        self._control.set_time(start, play=False)

    def play(self, start: int) -> None:
        """Let the cursor run from a time on."""
        self._control.set_time(start, play=True)

    def offer(self, keys: Sequence[tuple[str, str]], press: Callable[[str], None]) -> None:
        """Offer buttons (key and text) in its page, if it has one."""
        self._control.offer(keys, press)

    def say(self, text: str) -> None:
        """Show a line in its page, if it has one."""
        self._control.say(text)

    def _flush(self) -> None:
        if self.is_open():  # or it would wait for ever
            self._recording.flush(timeout_sec=_FLUSH_SECONDS)


def check_version(version: str) -> None:
    """Raise DataError if a viewer is of another version than the package."""
    if version != rr.__version__:
        raise DataError(
            f"the viewer is of Rerun {version or 'an unknown version'}, and hearthlog works with "
            f"{rr.__version__}; `pip install rerun-sdk=={rr.__version__}`"
        )


def _span(selection: Any) -> tuple[int, int] | None:
    if not isinstance(selection, Mapping):
        return None
    start, end = selection.get("min"), selection.get("max")
    if not isinstance(start, int) or not isinstance(end, int) or start >= end:
        return None
    return start, end
