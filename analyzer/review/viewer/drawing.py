"""Entities of a Rerun recording for a timeline, and the views that show them."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.colours import Colour, colour
from hearthlog.analyzer.logs.spans import Spans, rows_at
from hearthlog.analyzer.review.lanes import (
    LEVEL,
    REVIEWED,
    SHARES,
    Checked,
    Lane,
    Plot,
    Style,
    labelling_in_words,
    labellings_of,
    timeline_lanes,
    timeline_plots,
)
from hearthlog.analyzer.review.timeline import FrameValues, MicrophoneTimeline, Timeline
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.models.classes import in_words
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE

LINES, CLIP, WORDS = "events", "clip", "words"
NOTHING = "words/nothing"  # an empty text
CLOSE_UP = "/close_up"  # behind the name of a microphone
ASKED, ASKED_WORDS = "asked", "words/asked"
_CLOSE_KINDS = SHARES, LEVEL  # of plots
_SHARE_STEP, _LEVEL_STEP = 0.01, 0.1  # less is not seen
_CLOSE_STROKES, _ASKED_STROKES = 1_200, 600  # of a band
_ASKED: Colour = (245, 240, 225)

_THICK, _THIN = 12.0, 8.0  # in points of the screen
_Strip = tuple[int, int, str]


class DrawnLane:
    """A lane as it is drawn; what is drawn can be hidden, but not changed.

    Parameters
    ----------
    long : int
        Nanoseconds: what is shorter is drawn thinner, or many short sounds look like a long one.
    """

    def __init__(self, root: str, height: float, long: int) -> None:
        self._root, self._height, self._long = root, height, long
        self._parts: dict[str, set[_Strip]] = {}
        self._count = 0

    def show(self, lane: Lane, canvas: Canvas) -> None:
        """Draw what is new, and hide what is gone; long sounds lie under short ones."""
        starts, ends, texts = lane.spans
        wanted = set(zip(starts.tolist(), ends.tolist(), texts, strict=True))
        for entity, part in list(self._parts.items()):
            if not part <= wanted:
                canvas.hide(entity)
                del self._parts[entity]
        fresh = wanted.difference(*self._parts.values())
        parts = self._divide(fresh).items()
        for (is_long, text), strips in sorted(parts, key=lambda part: -_length(part[1])):
            layer = 0 if text == REVIEWED else 1  # the viewer draws in the order of names
            places = self._height, _THICK if is_long else _THIN
            entity = f"{self._root}/{layer}/{self._count:06}"
            times = np.array(sorted(strip[:2] for strip in strips))
            spans = Spans(times[:, 0], times[:, 1])
            canvas.draw_strips(entity, places, spans, text, lane.colours[text])
            self._parts[entity] = strips
            self._count += 1

    def _divide(self, strips: Iterable[_Strip]) -> dict[tuple[bool, str], set[_Strip]]:
        found: dict[tuple[bool, str], set[_Strip]] = {}
        for start, end, text in strips:
            found.setdefault((end - start >= self._long, text), set()).add((start, end, text))
        return found


class LanePlace(NamedTuple):
    """Where a lane is: its entity, that of its name, and its height in the view, a unit each."""

    entity: str
    name: str
    height: float


def lane_places(lanes: Sequence[Lane]) -> list[LanePlace]:
    """Find a place for each lane: those of the labellings of a microphone are in the same ones."""
    names: dict[str, dict[str, None]] = {}
    for lane in lanes:
        names.setdefault(lane.microphone, {})[lane.name] = None
    places = []
    for lane in lanes:
        own = list(names[lane.microphone])
        number = own.index(lane.name)
        root = lanes_entity(lane.microphone, lane.labelling)
        name = f"{lane.microphone}/{WORDS}/names/{_word(lane.labelling) or 'all'}/{number:02}"
        places.append(LanePlace(f"{root}/{number:02}", name, len(own) - number - 0.5))
    return places


def lanes_entity(microphone: str, labelling: str) -> str:
    """Name the entity of the lanes of a labelling, or, without one, of those beside all."""
    return f"{microphone}/lanes/{_word(labelling) or 'all'}"


def draw(timeline: Timeline, canvas: Canvas) -> dict[tuple[str, str], DrawnLane]:
    """Draw all of a timeline but the single frames.

    Returns
    -------
    dict of (str, str) to DrawnLane
        By microphone and name: what is reviewed, to show it again when there is more of it.

    Raises
    ------
    DataError
        If there is no such time zone as the timeline's.
    """
    reviewed = {}
    lanes = list(timeline_lanes(timeline))
    canvas.begin(NOTHING, timeline.grid.start)
    for lane, place in zip(lanes, lane_places(lanes), strict=True):
        canvas.write(place.name, lane.name)
        drawn = DrawnLane(place.entity, place.height, timeline.grid.step)
        drawn.show(lane, canvas)
        if REVIEWED in lane.colours:
            reviewed[lane.microphone, lane.name] = drawn
    _draw_plots(timeline, canvas)
    for plot in timeline_plots(timeline):
        canvas.write(text_entity(plot), plot.text)
    for microphone in timeline.microphones.values():
        if microphone.clips:
            canvas.show_clips(f"{microphone.name}/{CLIP}", microphone.clips, timeline.grid.start)
    canvas.write_lines(LINES, timeline.lines)
    return reviewed


def write_checked(timeline: Timeline, checked: Checked, canvas: Canvas) -> None:
    """Write beside the classes of the recorder how many of its sounds were right in this home."""
    lanes = list(timeline_lanes(timeline))
    for lane, place in zip(lanes, lane_places(lanes), strict=True):
        known = checked.get((lane.microphone, lane.name))
        if lane.labelling == LIVE and known is not None:
            canvas.write(place.name, f"{lane.name} · {known.right}/{known.labelled} right")


def draw_close_up(timeline: Timeline, before: Spans, canvas: Canvas) -> None:
    """Draw what close-ups show of a short timeline beside the longer timeline around it."""
    strokes = -(-_CLOSE_STROKES // timeline.grid.count)
    for plot in timeline_plots(timeline):
        if plot.kind in _CLOSE_KINDS:
            entity = plot_entity(plot, CLOSE_UP)
            if not len(before.starts):
                configure_plot(plot, entity, canvas)
            new = rows_at(before, plot.times) < 0
            part = plot._replace(times=plot.times[new], values=plot.values[new])
            add_to_plot(part, entity, canvas, strokes)


def draw_asked(number: int, start: int, end: int, text: str, canvas: Canvas) -> None:
    """Draw which span is asked, in place of the one before.

    Parameters
    ----------
    start, end : int
        Of the span, in nanoseconds of UTC.
    """
    if number:
        canvas.hide(f"{ASKED}/{number - 1}")
    entity, middle = f"{ASKED}/{number}", np.array([(start + end) // 2])
    canvas.configure_bands(entity, [text], [_ASKED])
    canvas.add_bands(entity, middle, np.ones((1, 1)), end - start, _ASKED_STROKES)
    canvas.write(ASKED_WORDS, text)


def draw_frames(
    timeline: Timeline, canvas: Canvas, start: int | None = None, end: int | None = None
) -> None:
    """Draw the frames of a span: all probabilities, and the level five times a second.

    Parameters
    ----------
    start, end : int, optional
        In nanoseconds of UTC: frames that begin from `start` on, before `end`; by default all.
    """
    for microphone in timeline.microphones.values():
        for labelling in microphone.labellings:
            if labelling.probabilities is not None and labelling.frames:
                entity = frames_entity(microphone.name, labelling.name)
                names = labelling.probabilities.names
                words = [in_words(name) for name in names]
                canvas.configure_lines(entity, words, [colour(name) for name in names])
                parts = _between(labelling.frames, start, end)
                canvas.draw_frames(entity, names, parts, _SHARE_STEP)
        if microphone.level_frames:
            entity = frames_entity(microphone.name, LEVEL.name)
            canvas.configure_lines(entity, ["level"], [LEVEL.colour])
            parts = map(_level_means, _between(microphone.level_frames, start, end))
            canvas.draw_frames(entity, ["level"], parts, _LEVEL_STEP)


def configure_plot(plot: Plot, entity: str, canvas: Canvas) -> None:
    """Set names and colours of what a plot shows."""
    if plot.kind.style is Style.BANDS:
        words = [in_words(name) for name in plot.names]
        canvas.configure_bands(entity, words, [colour(name) for name in plot.names])
    elif plot.kind.style is Style.HEAT_MAP:
        canvas.configure_heat_map(entity, plot.names)
    elif plot.kind.style is Style.POINTS:
        canvas.configure_points(entity, plot.names[0], plot.kind.colour)
    else:
        canvas.configure_lines(entity, plot.names, [plot.kind.colour])


def add_to_plot(plot: Plot, entity: str, canvas: Canvas, strokes: int = 1) -> None:
    """Draw values into a plot that is configured."""
    if plot.kind.style is Style.BANDS:
        canvas.add_bands(entity, plot.times, plot.values, plot.length, strokes)
    elif plot.kind.style is Style.HEAT_MAP:
        canvas.add_shades(entity, plot.times, plot.values)
    else:
        canvas.draw_lines(entity, plot.times, plot.values)


def plot_entity(plot: Plot, close_up: str = "") -> str:
    """Name the entity of a plot."""
    labelling = f"/{_word(plot.labelling)}" if plot.labelling else ""
    return f"{plot.microphone}{close_up}{labelling}/{plot.kind.name}"


def text_entity(plot: Plot) -> str:
    """Name the entity of the words beside a plot, and beside others in the same view."""
    labelling = f"/{_word(plot.labelling)}" if plot.kind.style is Style.BANDS else ""
    return f"{plot.microphone}/{WORDS}/{_word(plot.kind.view)}{labelling}"


def frames_entity(microphone: str, name: str) -> str:
    """Name the entity of the frames of a labelling, or of the level."""
    return f"{microphone}/frames/{_word(name)}"


def _length(strips: Iterable[_Strip]) -> int:
    return sum(end - start for start, end, _ in strips)


def _draw_plots(timeline: Timeline, canvas: Canvas) -> None:
    for plot in timeline_plots(timeline):
        if len(plot.times):
            entity = plot_entity(plot)
            configure_plot(plot, entity, canvas)
            add_to_plot(plot, entity, canvas)


def _between(
    parts: Sequence[FrameValues], start: int | None, end: int | None
) -> Iterator[FrameValues]:
    """Yield the frames that begin in a span of time."""
    for names, times, values in parts:
        first = 0 if start is None else int(np.searchsorted(times, start))
        last = len(times) if end is None else int(np.searchsorted(times, end))
        if first < last:
            yield FrameValues(names, times[first:last], values[first:last])


def _level_means(part: FrameValues) -> FrameValues:
    """Average the level over each fifth of a second: a room's noise has no use for more."""
    fifths = part.times // (NANOSECONDS // 5)
    first = np.flatnonzero(np.diff(fifths, prepend=-1))
    sizes = np.diff(first, append=len(part.times))
    means = np.add.reduceat(part.values, first, axis=0) / sizes[:, np.newaxis]
    return FrameValues(part.names, part.times[first], means.astype(np.float32))


def _word(name: str) -> str:
    """Replace the characters that would have to be escaped in the name of an entity."""
    return name.removeprefix("relabel/").replace("/", "-").replace(" ", "_")


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
