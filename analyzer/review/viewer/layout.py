"""The views of Rerun that show a timeline, of a review and of a watch."""

from collections.abc import Iterable, Sequence

import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.review.timeline.lanes import (
    labelling_in_words,
    labellings_of,
    timeline_lanes,
)
from hearthlog.analyzer.review.timeline.model import MicrophoneTimeline, Timeline
from hearthlog.analyzer.review.timeline.plots import (
    LEVEL,
    SHARES,
    Plot,
    Style,
    timeline_plots,
)
from hearthlog.analyzer.review.viewer.drawing import (
    ASKED,
    ASKED_WORDS,
    CLIP,
    CLOSE_UP,
    LINES,
    NOTHING,
    LanePlace,
    frames_entity,
    lane_places,
    lanes_entity,
    plot_entity,
    text_entity,
)

APPLICATION = "hearthlog"
# The viewer keeps the range that linked time axes share under this name.
SHARED_AXIS = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
# In points of a screen of 1366 x 768; on others they are in relation to each other.
_LANE, _AROUND_LANES, _LEVEL_HEIGHT, _PLOT_HEIGHT, _ASKED_HEIGHT = 28, 50, 90, 140, 60
_NEAR = -60.0, 300.0  # seconds from the cursor, which stands at the start of what is asked
_BELOW = 0.65  # of a lane: the axis of time
_COLUMNS = (2, 10)  # of words, and of what they stand beside
Boundary = rr.encodings.TimeRangeBoundary
Row = tuple[int, rrb.View | rrb.Container]  # with its height in relation to others


class TimelineBlueprint(rrb.Blueprint):
    """Views, whose linked time axes begin with a range.

    Parameters
    ----------
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
    """Put views one below the other."""
    heights = [height for height, _ in rows]
    return rrb.Vertical(*(view for _, view in rows), row_shares=heights, name=name)


def tabs(views: Iterable[rrb.View | rrb.Container]) -> rrb.View | rrb.Container:
    """Put views one behind the other; a single one needs no tab."""
    views = list(views)
    return views[0] if len(views) == 1 else rrb.Tabs(*views)


def states_view(root: str, name: str) -> rrb.View:
    """Make a view of all lanes of states below an entity."""
    return rrb.StateTimelineView(origin=root, name=name, time_view=_axis())


def lines_view() -> rrb.View:
    """Make a view of the lines that the recorder logged."""
    return rrb.TextLogView(origin=LINES, name="Events")


def plot_view(plots: Sequence[Plot], entities: Sequence[str], *, live: bool = False) -> rrb.View:
    """Show plots of one kind, or of kinds with the same title, in one view.

    Parameters
    ----------
    plots : sequence of Plot
        At least one; the names of the last with the most of them count.
    entities : sequence of str
        Of the plots, at least one.
    """
    plot = max(reversed(plots), key=lambda one: len(one.names))
    kind = plots[0].kind
    scale = kind.live_scale or kind.scale if live else kind.scale
    if kind.style is Style.HEAT_MAP:
        scale = (-0.5, len(plot.names) - 0.5)
    legend = live and (kind.style is Style.BANDS or len(entities) > 1)
    return _time_series(plot.title, entities, scale, titlebar=live, legend=legend)


def _time_series(
    name: str,
    entities: Sequence[str],
    scale: tuple[float, float] | None,
    *,
    titlebar: bool = False,
    legend: bool = False,
) -> rrb.View:
    is_one = len(entities) == 1
    return rrb.TimeSeriesView(
        origin=entities[0] if is_one else "/",
        contents="$origin/**" if is_one else [f"{entity}/**" for entity in entities],
        name=name,
        titlebar=titlebar,
        axis_x=_axis(),
        axis_y=None if scale is None else rrb.ScalarAxis(range=scale),
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
    )


def _axis() -> rrb.TimeAxis:
    return rrb.TimeAxis(link="LinkToGlobal")


def review_layout(
    timeline: Timeline, *, marking: bool = False, close_up: bool = False
) -> TimelineBlueprint:
    """Lay out the views of a review.

    Raise `DataError` if there is no such time zone as the timeline's.
    """
    clock = timeline.clock
    plots: dict[str, list[Plot]] = {name: [] for name in timeline.microphones}
    for plot in timeline_plots(timeline):
        plots[plot.microphone].append(plot)
    lanes = list(timeline_lanes(timeline))
    places = list(zip(lanes, lane_places(lanes), strict=True))
    stacks: dict[str, list[Row]] = {}
    for name, microphone in timeline.microphones.items():
        own = [(lane.labelling, place) for lane, place in places if lane.microphone == name]
        count = len({place.height for _, place in own})
        views = _lane_views(microphone, own, count, _note(timeline))
        rows: list[Row] = [(_LANE * count + _AROUND_LANES, rrb.Tabs(*views, lines_view()))]
        more = _plot_views(microphone, plots[name], timeline, close_up=close_up)
        level = [_all(same) for same in _by_title(plots[name]) if same[0].kind is LEVEL]
        if close_up:
            rows += [(_LEVEL_HEIGHT, view) for view in _sounds(microphone)]
        elif marking or not more:
            more[1:1] = level
        else:
            rows += [(_LEVEL_HEIGHT, view) for view in level]
        stacks[name] = [*rows, (_PLOT_HEIGHT, tabs(more))] if more else rows
    panel = rrb.TimePanel(
        state="expanded" if marking else "collapsed", timeline=clock.name, play_state="paused"
    )
    ends = (clock.shown(time) for time in (timeline.grid.start, timeline.grid.end))
    boundaries = (Boundary.absolute(nanos=time) for time in ends)
    height = max(sum(height for height, _ in rows) for rows in stacks.values())
    asked: list[Row] = [(_ASKED_HEIGHT, _asked_view())]
    whole = (height, tabs(stack(rows, name) for name, rows in stacks.items()))
    return TimelineBlueprint([*(asked if close_up else []), whole], panel, *boundaries)


def _note(timeline: Timeline) -> str:
    sampled = "" if timeline.every == 1 else f"; a sample: one part in {timeline.every}"
    return f"{timeline.clock.name}{sampled}"


def _lane_views(
    microphone: MicrophoneTimeline, places: Sequence[tuple[str, LanePlace]], count: int, note: str
) -> list[rrb.Horizontal]:
    """Show the lanes of each labelling, beside their names."""
    labellings = [(one.name, labelling_in_words(one.name)) for one in labellings_of(microphone)]
    views = []
    for labelling, words in labellings or [("", "")]:
        entities = [lanes_entity(microphone.name, each) for each in dict.fromkeys((labelling, ""))]
        names = [place.name for own, place in places if own in {labelling, ""}]
        lanes = _time_series(words, entities, (0.0, float(count)))
        beside = rrb.Vertical(
            *(_text(name) for name in names), _text(NOTHING), row_shares=[*[1.0] * count, _BELOW]
        )
        by = f" by {words}" if words else ""
        title = f"What was heard{by}: {note}"
        views.append(rrb.Horizontal(beside, lanes, column_shares=_COLUMNS, name=title))
    return views


def _text(entity: str) -> rrb.View:
    return rrb.TextDocumentView(origin=entity, titlebar=False)


def _plot_views(
    microphone: MicrophoneTimeline, plots: Sequence[Plot], timeline: Timeline, *, close_up: bool
) -> list[rrb.View | rrb.Container]:
    """Show the plots of a microphone but the level; of close-ups what is drawn of them."""
    first = [plot for plot in plots if plot.kind is SHARES]
    if close_up:
        first += [plot for plot in plots if plot.kind is LEVEL]
    others = [same for same in _by_title(plots) if same[0].kind not in {LEVEL, SHARES}]
    return [
        *(_close_up(plot, timeline.clock.name) if close_up else _all([plot]) for plot in first),
        *map(_all, reversed(others)),
        *([] if close_up else [*_sounds(microphone), *_frame_views(microphone, timeline.every)]),
    ]


def _by_title(plots: Sequence[Plot]) -> list[list[Plot]]:
    titles = dict.fromkeys(plot.kind.title for plot in plots)
    return [[plot for plot in plots if plot.kind.title == title] for title in titles]


def _asked_view() -> rrb.Container:
    lane = _time_series("Which span is asked", [ASKED], (0.0, 1.0))
    return rrb.Horizontal(_text(ASKED_WORDS), lane, column_shares=_COLUMNS)


def _close_up(plot: Plot, clock: str) -> rrb.Container:
    """Show what is drawn close up near the cursor only: all of it makes the viewer grow."""
    view = plot_view([plot], [plot_entity(plot, CLOSE_UP)])
    before, after = (Boundary.cursor_relative(seconds=seconds) for seconds in _NEAR)
    near = rr.VisibleTimeRange(clock, start=before, end=after)
    view.properties["VisibleTimeRanges"] = rrb.VisibleTimeRanges(near)
    return _beside([plot], view, ", close up")


def _all(plots: Sequence[Plot]) -> rrb.Container:
    return _beside(plots, plot_view(plots, [plot_entity(plot) for plot in plots]))


def _beside(plots: Sequence[Plot], view: rrb.View, note: str = "") -> rrb.Container:
    """Put a view of plots of one title beside words on what they show."""
    labelling = f": {labelling_in_words(plots[0].labelling)}" if plots[0].kind is SHARES else ""
    return rrb.Horizontal(
        _text(text_entity(plots[0])),
        view,
        column_shares=_COLUMNS,
        name=f"{plots[0].kind.view}{labelling}{note}",
    )


def _sounds(microphone: MicrophoneTimeline) -> list[rrb.View | rrb.Container]:
    view = rrb.AudioView(origin=f"{microphone.name}/{CLIP}", name="Sound that was kept")
    return [view] if microphone.clips else []


def _frame_views(microphone: MicrophoneTimeline, every: int) -> list[rrb.View | rrb.Container]:
    """Show frames, unless only a sample is read."""
    known = [one for one in microphone.labellings if one.probabilities is not None]
    scales = {one.name: SHARES.scale for one in known}
    if microphone.level is not None:
        scales[LEVEL.name] = LEVEL.scale
    if every > 1:
        return []
    rows = [(name, frames_entity(microphone.name, name), scales[name]) for name in scales]
    return [
        _time_series(f"{labelling_in_words(name)}, frame by frame: zoom in", [entity], scale)
        for name, entity, scale in rows
    ]
