"""The views of Rerun that show a timeline, of a review and of a watch."""

from collections.abc import Iterable, Sequence

import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.review.timeline.lanes import timeline_lanes
from hearthlog.analyzer.review.timeline.model import MicrophoneTimeline, Timeline
from hearthlog.analyzer.review.timeline.plots import (
    LEVEL,
    PLOTS,
    SHARES,
    Plot,
    PlotKind,
    Style,
    timeline_plots,
)
from hearthlog.analyzer.review.viewer.canvas import TIMELINE
from hearthlog.analyzer.review.viewer.drawing import (
    CLIP,
    CLOSE_UP,
    DETAIL,
    LINES,
    OVERVIEW,
    frames_entity,
    plot_entity,
)

APPLICATION = "hearthlog"
# The viewer keeps the range that linked time axes share under this name.
SHARED_AXIS = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
_HEAD_HEIGHT, _LANE_HEIGHT = 90, 48
Boundary = rr.encodings.TimeRangeBoundary
Row = tuple[int, rrb.View | rrb.Container]  # with its height in relation to others


class TimelineBlueprint(rrb.Blueprint):
    """Views, whose linked time axes begin with a range.

    Parameters
    ----------
    rows : sequence of (int, View or Container)
        From above, with their heights in relation to each other.
    panel : rrb.TimePanel
    start, end : Boundary
        The range: times, or seconds from the cursor.
    """

    def __init__(
        self, rows: Sequence[Row], panel: rrb.TimePanel, start: Boundary, end: Boundary
    ) -> None:
        super().__init__(stack(rows), panel, collapse_panels=True)
        self._range = rr.encodings.TimeRange(start, end)

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        stream.log(SHARED_AXIS, rrb.TimeAxis(view_range=self._range))


def stack(rows: Sequence[Row], name: str | None = None) -> rrb.Vertical:
    """Put views one below the other.

    Parameters
    ----------
    rows : sequence of (int, View or Container)
        From above, with their heights in relation to each other.
    name : str, optional
        Of the tab that they are in.
    """
    heights = [height for height, _ in rows]
    return rrb.Vertical(*(view for _, view in rows), row_shares=heights, name=name)


def tabs(views: Iterable[rrb.View | rrb.Container]) -> rrb.View | rrb.Container:
    """Put views one behind the other; a single one needs no tab.

    Parameters
    ----------
    views : iterable of (View or Container)
        The one in front first.
    """
    views = list(views)
    return views[0] if len(views) == 1 else rrb.Tabs(*views)


def lanes_height(count: int) -> int:
    """Return the height of a view of some lanes, in relation to that of other views.

    Parameters
    ----------
    count : int
        Number of lanes.
    """
    return _HEAD_HEIGHT + _LANE_HEIGHT * count


def lanes_view(root: str, name: str) -> rrb.View:
    """Make a view of all lanes below an entity.

    Parameters
    ----------
    root : str
        `OVERVIEW` or `DETAIL`.
    name : str
        Its title.
    """
    return rrb.StateTimelineView(origin=root, name=name, time_view=_axis())


def lines_view() -> rrb.View:
    """Make a view of the lines that the recorder logged."""
    return rrb.TextLogView(origin=LINES, name="Events")


def plot_view(
    kind: PlotKind,
    entities: Sequence[str],
    names: Sequence[str],
    note: str = "",
    *,
    live: bool = False,
) -> rrb.View:
    """Show plots of one kind, or of kinds with the same title, in one view.

    Parameters
    ----------
    kind : PlotKind
    entities : sequence of str
        Of the plots, at least one.
    names : sequence of str
        Of the columns, at least one.
    note : str, optional
        Behind the title.
    live : bool, optional
        Whether new values come from the right.
    """
    last = len(names) - 1
    title = kind.title.format(first=names[0], last=names[-1], end=last) + note
    scale = kind.live_scale or kind.scale if live else kind.scale
    if kind.style is Style.HEAT_MAP:
        scale = (-0.5, last + 0.5)
    legend = rrb.PlotLegend(
        corner="LeftTop" if live else "RightTop",
        visible=kind.style is Style.BANDS or len(entities) > 1,
    )
    return _time_series(title, entities, scale, legend)


def _time_series(
    name: str, entities: Sequence[str], scale: tuple[float, float] | None, legend: rrb.PlotLegend
) -> rrb.View:
    is_one = len(entities) == 1
    return rrb.TimeSeriesView(
        origin=entities[0] if is_one else "/",
        contents="$origin/**" if is_one else [f"{entity}/**" for entity in entities],
        name=name,
        axis_x=_axis(),
        axis_y=None if scale is None else rrb.ScalarAxis(range=scale),
        plot_legend=legend,
    )


def _axis() -> rrb.TimeAxis:
    return rrb.TimeAxis(link="LinkToGlobal")


def review_layout(
    timeline: Timeline, *, marking: bool = False, close_up: bool = False
) -> TimelineBlueprint:
    """Lay out the views of a review.

    Parameters
    ----------
    timeline : Timeline
        The time axes begin with the whole of it.
    marking : bool, optional
        Whether the time panel is open, on whose ruler spans are marked with the mouse.
    close_up : bool, optional
        Whether short spans are looked at: there is room for what is drawn of them.

    Raises
    ------
    DataError
        If there is no such time zone as the timeline's.
    """
    sampled = "" if timeline.every == 1 else f" (a sample: one part in {timeline.every})"
    lanes = rrb.Tabs(
        lanes_view(OVERVIEW, f"What was heard, from afar{sampled}: clock of the home, axes in UTC"),
        lanes_view(DETAIL, "What was heard, exactly"),
        active_tab=1 if close_up else 0,
    )
    height = lanes_height(sum(1 for _ in timeline_lanes(timeline, detail=False)))
    plots: dict[str, list[Plot]] = {name: [] for name in timeline.microphones}
    for plot in timeline_plots(timeline):
        plots[plot.microphone].append(plot)
    stacks = [_stack_plots(name, each, sampled, close_up=close_up) for name, each in plots.items()]
    rows: list[Row] = [
        (height, lanes),
        (320 if close_up else 540, tabs(stacks)),
        (120 if close_up else 160, _details(timeline, plots, close_up=close_up)),
    ]
    panel = rrb.TimePanel(
        state="expanded" if marking else "collapsed", timeline=TIMELINE, play_state="paused"
    )
    ends = (Boundary.absolute(nanos=time) for time in (timeline.grid.start, timeline.grid.end))
    return TimelineBlueprint(rows, panel, *ends)


def _stack_plots(
    microphone: str, plots: Sequence[Plot], sampled: str, *, close_up: bool
) -> rrb.Vertical:
    """Show the plots of a microphone; for close-ups its shares, and those of a short span."""
    shares = [plot for plot in plots if plot.kind is SHARES]
    rows: list[Row] = []
    if shares:
        rows.append((SHARES.height, tabs(_view(plot, sampled) for plot in shares)))
    if shares and close_up:
        rows.append((240, tabs(_view(plot, ", close up", CLOSE_UP) for plot in shares)))
    if not close_up:
        rows += _other_rows(plots)
    return stack(rows or [(1, lines_view())], microphone)


def _view(plot: Plot, note: str = "", close_up: str = "") -> rrb.View:
    name = f": {plot.labelling}" if plot.labelling else ""
    return plot_view(plot.kind, [plot_entity(plot, close_up)], plot.names, name + note)


def _other_rows(plots: Sequence[Plot]) -> list[Row]:
    """Show all but the shares; plots whose kinds have one title share a view."""
    rows: list[Row] = []
    for title in dict.fromkeys(kind.title for kind in PLOTS if kind is not SHARES):
        same = [plot for plot in plots if plot.kind.title == title]
        if same:
            kind = same[0].kind
            view = plot_view(kind, [plot_entity(plot) for plot in same], same[0].names)
            rows.append((kind.height, view))
    return rows


def _details(
    timeline: Timeline, plots: dict[str, list[Plot]], *, close_up: bool
) -> rrb.View | rrb.Container:
    microphones = timeline.microphones.values()
    lines: rrb.View | rrb.Container = lines_view()
    clips = [
        rrb.AudioView(origin=f"{one.name}/{CLIP}", name=f"Sound that was kept: {one.name}")
        for one in microphones
        if one.clips
    ]
    if clips:
        lines = rrb.Horizontal(*clips, lines, name="Sound and events")
    views = [
        view
        for one in microphones
        for view in (_close_views(plots[one.name]) if close_up else _frame_views(one))
    ]
    # Where spans are marked one after the other their sound comes first, else their level.
    return rrb.Tabs(lines, *views) if clips or not close_up else rrb.Tabs(*views, lines)


def _close_views(plots: Sequence[Plot]) -> list[rrb.View | rrb.Container]:
    levels = [_view(plot, ", close up", CLOSE_UP) for plot in plots if plot.kind is LEVEL]
    return [*levels, *(view for _, view in _other_rows(plots))]


def _frame_views(microphone: MicrophoneTimeline) -> list[rrb.View]:
    """Show every frame."""
    scales = {one.name: SHARES.scale for one in microphone.labellings if one.frames}
    if microphone.level_frames:
        scales[LEVEL.name] = LEVEL.scale
    rows = [(name, frames_entity(microphone.name, name), scales[name]) for name in scales]
    no_legend = rrb.PlotLegend(visible=False)
    return [
        _time_series(f"{name}, 20 a second: zoom in", [entity], scale, no_legend)
        for name, entity, scale in rows
    ]
