"""A timeline that goes on: a server that viewers connect to, and leave, as they like."""

from collections.abc import Iterable
from typing import Self

import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.colours import Colour
from hearthlog.analyzer.review.timeline.lanes import Lane
from hearthlog.analyzer.review.timeline.live import Update
from hearthlog.analyzer.review.timeline.model import LogLines
from hearthlog.analyzer.review.timeline.plots import PLOTS, Plot
from hearthlog.analyzer.review.viewer.canvas import TIMELINE, Canvas
from hearthlog.analyzer.review.viewer.drawing import (
    LINES,
    OVERVIEW,
    add_to_plot,
    configure_plot,
    lane_entity,
    plot_entity,
)
from hearthlog.analyzer.review.viewer.layout import (
    Boundary,
    Row,
    TimelineBlueprint,
    lanes_height,
    lanes_view,
    lines_view,
    plot_view,
    stack,
    tabs,
)
from hearthlog.analyzer.review.viewer.process import free_port

PORT = 9876  # where Rerun's viewer looks for a server if it is not told
_APPLICATION = "hearthlog_watch"  # of its own: viewers keep the layout of each
_MEMORY = "200MB"
_MOST_STATES = 2_000  # of a lane that get the colours of their own

Plots = dict[str, list[Plot]]  # by entity: the first plot of each set of names that it shows


class LiveServer:
    """Draws updates for all viewers that connect, and keeps the last of them for later ones.

    Parameters
    ----------
    port : int
        To listen on.
    bind : str
        Address to listen on; nothing is sent anywhere but to viewers that connect.
    minutes : float
        Length of the time axes, which end with the newest data.
    memory : str, optional
        How much is kept for viewers that come later, as `200MB`; then the oldest is dropped.

    Attributes
    ----------
    url : str
        Where viewers connect to.

    Raises
    ------
    DataError
        If it cannot listen there.
    """

    def __init__(self, port: int, bind: str, minutes: float, memory: str = _MEMORY) -> None:
        free_port(port, bind)
        rr.set_strict_mode(True)  # or its mistakes become warnings
        self._recording = rr.RecordingStream(_APPLICATION)
        sink = rr.GrpcServerSink(bind_ip=bind, port=port, server_memory_limit=memory)
        self.url = sink.uri
        self._recording.set_sinks(sink)
        self._recording.send_recording_name("live")
        self._canvas = Canvas(self._recording)
        self._minutes = minutes
        self._plots: Plots = {}
        self._lanes: dict[str, dict[str, Colour]] = {}
        self._is_laid_out = True  # there is nothing to lay out

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._recording.disconnect()

    def show(self, updates: Iterable[Update]) -> None:
        """Draw updates, and lay out the views anew where there is a new plot.

        Parameters
        ----------
        updates : iterable of (Plot, Lane or LogLines)
            From `LiveTimeline.take`, in the order of time.
        """
        for update in updates:
            if isinstance(update, LogLines):
                self._canvas.write_lines(LINES, update)
            elif isinstance(update, Lane):
                self._show_lane(update)
            elif len(update.times):
                self._show_plot(update)
        if not self._is_laid_out:
            layout = _layout(self._plots, self._minutes)
            self._recording.send_blueprint(layout, make_active=True, make_default=True)
            self._is_laid_out = True

    def _show_lane(self, lane: Lane) -> None:
        entity = lane_entity(OVERVIEW, lane)
        states = {state for state in lane.changes.states if state is not None}
        if entity not in self._lanes and not states:
            return  # a lane is there once it has something to show
        colours = self._lanes.get(entity) or lane.kind.colours(lane.kind.states)
        if entity not in self._lanes or (states - colours.keys() and len(colours) < _MOST_STATES):
            self._lanes[entity] = lane.kind.colours(sorted(states)) | colours
            self._canvas.configure_lane(entity, self._lanes[entity])
        self._canvas.change_states(entity, *lane.changes)

    def _show_plot(self, plot: Plot) -> None:
        """Draw into the entity of the names; another model or feature set gets one of its own."""
        root = plot_entity(plot)
        same = self._plots.setdefault(root, [])
        names = [each.names for each in same]
        is_new = plot.names not in names
        entity = f"{root}/{len(names) if is_new else names.index(plot.names)}"
        if is_new:
            same.append(plot._replace(times=plot.times[:0], values=plot.values[:0]))
            configure_plot(plot, entity, self._canvas)
            self._is_laid_out = False
        add_to_plot(plot, entity, self._canvas)


def _layout(plots: Plots, minutes: float) -> TimelineBlueprint:
    """Lay out the views, whose time axes end with the newest data."""
    microphones = sorted({same[0].microphone for same in plots.values()})
    rows: list[Row] = [
        (lanes_height(1 + len(microphones)), lanes_view(OVERVIEW, "What is heard")),
        (580, tabs(_stack_plots(name, plots) for name in microphones)),
        (160, lines_view()),
    ]
    panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following")
    ends = (Boundary.cursor_relative(seconds=seconds) for seconds in (-60 * minutes, 0.0))
    return TimelineBlueprint(rows, panel, *ends)


def _stack_plots(microphone: str, plots: Plots) -> rrb.Container:
    """Show the plots of a microphone; those whose kinds have one title share a view."""
    rows: list[Row] = []
    for title in dict.fromkeys(kind.title for kind in PLOTS):
        shown = {
            root: same
            for root, same in plots.items()
            if same[0].kind.title == title and same[0].microphone == microphone
        }
        if shown:
            kind = next(iter(shown.values()))[0].kind
            names = max((plot.names for same in shown.values() for plot in same[::-1]), key=len)
            rows.append((kind.height, plot_view(kind, list(shown), names, live=True)))
    return stack(rows, microphone)
