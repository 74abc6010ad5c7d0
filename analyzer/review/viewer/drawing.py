"""Rerun entities of a timeline, and the views that show them."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.logs.local_time import EVENING, MORNING
from hearthlog.analyzer.logs.spans import Spans, rows_at
from hearthlog.analyzer.review.lanes import (
    LEVEL,
    PROBABILITIES,
    REVIEWED,
    SELECTED,
    SELECTED_COLOUR,
    Checked,
    Lane,
    labelling_in_words,
    labellings_of,
    timeline_lanes,
    timeline_plots,
)
from hearthlog.analyzer.review.timeline import (
    MicrophoneTimeline,
    Plot,
    Question,
    Style,
    Timeline,
    no_spans,
    spectrogram,
)
from hearthlog.analyzer.review.viewer.canvas import ROWS_HEIGHT, Canvas
from hearthlog.analyzer.review.viewer.row_heights import RowHeights
from hearthlog.models.classes import Colour, colour, in_words, ordered
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE

LINES, CLIP, WORDS, SPECTRUM = "events", "clip", "words", "spectrum"
HOURS, HOURS_NAME = "Hour", "words/hours"
NOTHING = "words/nothing"  # an empty text
CLOSE_UP = "/close_up"  # suffix of a microphone's name
REQUESTED, REQUESTED_NAME = "requested", "words/requested_name"
QUESTION, ANSWERS = "words/question", "words/asked"
_REQUESTED, _COVERED, _REQUESTED_STROKES = SELECTED_COLOUR, (95, 92, 84), 600  # strokes of a band
_SELECTED_PLACE = 0.65, 0.35  # the lower edge of the row is out of sight

_THICKNESS = 0.5  # of a strip, in lanes, without the width of its lines
_HOUR, _HOURS_FROM = 3600 * NANOSECONDS, 4 * 3600 * NANOSECONDS
_DAY, _NIGHT = (70, 80, 92), (28, 36, 58)
_Strip = tuple[int, int, str]


class DrawnLane:
    """A lane in the viewer; drawn states can be hidden, but not changed."""

    def __init__(self, root: str, height: float, thickness: float) -> None:
        self._root = root
        self._places = height, thickness
        self._parts: dict[str, set[_Strip]] = {}
        self._count = 0

    def show(self, lane: Lane, canvas: Canvas) -> None:
        """Draw new spans and hide removed ones; long sounds lie under short ones."""
        starts, ends, texts = lane.spans
        wanted = set(zip(starts.tolist(), ends.tolist(), texts, strict=True))
        for entity, part in list(self._parts.items()):
            if not part <= wanted:
                canvas.hide(entity)
                del self._parts[entity]
        fresh: dict[str, set[_Strip]] = {}
        for strip in wanted.difference(*self._parts.values()):
            fresh.setdefault(strip[2], set()).add(strip)
        for text, strips in sorted(fresh.items(), key=lambda part: (-_length(part[1]), part[0])):
            layer = 0 if text == REVIEWED else 1  # the viewer draws in name order
            entity = f"{self._root}/{layer}/{self._count:06}"
            times = np.array(sorted(strip[:2] for strip in strips))
            spans = Spans(times[:, 0], times[:, 1])
            canvas.draw_strips(entity, self._places, spans, text, lane.colours[text])
            self._parts[entity] = strips
            self._count += 1


class LanePlace(NamedTuple):
    """Place of a lane: its entity, the entity of its name, and its middle and thickness there."""

    entity: str
    name: str
    height: float
    thickness: float


def placed_lanes(timeline: Timeline, *, marking: bool = False) -> list[tuple[Lane, LanePlace]]:
    """Assign a place to each lane; all labellings of a microphone share the same places."""
    lanes = list(timeline_lanes(timeline, marking=marking))
    names: dict[str, dict[str, None]] = {}
    for lane in lanes:
        names.setdefault(lane.microphone, {})[lane.name] = None
    placed = []
    for lane in lanes:
        own = list(names[lane.microphone])
        number = own.index(lane.name)
        root = lanes_entity(lane.microphone, lane.labelling)
        name = f"{lane.microphone}/{WORDS}/names/{_word(lane.labelling) or 'all'}/{number:02}"
        lane_height = LANES_HEIGHT / len(own)
        middle = (len(own) - number - 0.5) * lane_height
        place = LanePlace(f"{root}/{number:02}", name, middle, _THICKNESS * lane_height)
        placed.append((lane, place))
    return placed


def lanes_entity(microphone: str, labelling: str) -> str:
    """Return the entity of the lanes of a labelling, or, without one, of the shared lanes."""
    return f"{microphone}/lanes/{_word(labelling) or 'all'}"


def draw(
    timeline: Timeline, canvas: Canvas, *, marking: bool = False
) -> dict[tuple[str, str], DrawnLane]:
    """Draw a timeline, except single frames; return the lanes that change, by microphone and name.

    Those are the lanes of reviewed spans, and of the selected span. Raise `DataError` if the
    timeline's time zone is unknown.
    """
    changing = {}
    canvas.fill(NOTHING, timeline.grid.start, timeline.grid.end)
    if _has_hours(timeline):
        _draw_hours(timeline, canvas)
    for lane, place in placed_lanes(timeline, marking=marking):
        canvas.write(place.name, lane.title)
        drawn = DrawnLane(place.entity, place.height, place.thickness)
        drawn.show(lane, canvas)
        if {REVIEWED, SELECTED} & lane.colours.keys():
            changing[lane.microphone, lane.name] = drawn
    for plot in timeline_plots(timeline):
        if len(plot.times):
            draw_plot(plot, plot_entity(plot), canvas)
        canvas.write(text_entity(plot), plot.text)
    for microphone in timeline.microphones.values():
        if microphone.clips:
            canvas.show_clips(f"{microphone.name}/{CLIP}", microphone.clips, timeline.grid.start)
    canvas.write_lines(LINES, timeline.lines)
    return changing


def _has_hours(timeline: Timeline) -> bool:
    """Whether hours are shown: the viewer's own axis of a day has one label or two."""
    return timeline.grid.end - timeline.grid.start > _HOURS_FROM


def _draw_hours(timeline: Timeline, canvas: Canvas) -> None:
    """Draw the hours of the home's clock, those of the night in another colour."""
    clock, grid = timeline.clock, timeline.grid
    first = clock.shown(grid.start) // _HOUR
    hours = np.arange(first, -(-clock.shown(grid.end) // _HOUR) + 1)
    names = [f"{hour % 24:02}" for hour in hours.tolist()]
    night = {f"{hour:02}" for hour in (*range(EVENING, 24), *range(MORNING))}
    shades = {name: _NIGHT if name in night else _DAY for name in sorted(set(names))}
    canvas.write(HOURS_NAME, "Hour of the day")
    canvas.configure_states(HOURS, shades)
    times = np.clip(clock.utc(hours * _HOUR), grid.start, grid.end)
    canvas.change_states(HOURS, times, [*names[:-1], None])


def write_checked(timeline: Timeline, checked: Checked, canvas: Canvas) -> None:
    """Write next to the recorder's classes how many of their sounds were right in this home."""
    for lane, place in placed_lanes(timeline):  # other lanes are below the classes
        check = checked.get((lane.microphone, lane.name))
        if lane.labelling == LIVE and check is not None:
            canvas.write(place.name, f"{lane.name} · {check.right}/{check.labelled} right")


def draw_close_up(timeline: Timeline, before: Spans, canvas: Canvas) -> None:
    """Draw the close-ups of a short timeline next to the longer timeline around it."""
    for plot in timeline_plots(timeline):
        if plot.kind.frame_step:
            new = rows_at(before, plot.times) < 0
            part = plot._replace(times=plot.times[new], values=plot.values[new])
            draw_plot(part, plot_entity(plot, CLOSE_UP), canvas, is_new=not len(before.starts))
    grid = timeline.grid
    for microphone in timeline.microphones.values():
        shade = spectrogram(microphone.clips, grid.start, grid.end, _SPECTRUM_SHAPE)
        if shade is None:
            clear_sound(microphone.name, grid.start, "No sound was kept here", canvas)
        else:
            entity = f"{microphone.name}/{SPECTRUM}"
            canvas.show_image(entity, grid.start, shade, "Kept sound, 0 to 8 kHz")


def clear_sound(microphone: str, time: int, text: str, canvas: Canvas) -> None:
    """Show no spectrogram from a time (ns of UTC) on, next to a text."""
    blank = np.zeros(_SPECTRUM_SHAPE)  # the viewer warns of a picture of another size
    canvas.show_image(f"{microphone}/{SPECTRUM}", time, blank, text)


class RequestedSpan(DrawnLane):
    """The row of the requested span; a selected span is drawn on it, and brighter."""

    def __init__(self) -> None:
        super().__init__(f"{REQUESTED}/selected", *_SELECTED_PLACE)
        self._number, self._span, self._text = 0, (0, 0), ""

    def show_question(self, start: int, end: int, question: Question, canvas: Canvas) -> None:
        """Draw the span (ns of UTC) and its question, in place of the previous ones."""
        if self._number:
            canvas.hide(self._entity)
        self._number += 1
        self._span, self._text = (start, end), question.text
        self._colour(_REQUESTED, canvas)
        middle = np.array([(start + end) // 2])
        canvas.add_bands(self._entity, middle, np.ones((1, 1)), end - start, _REQUESTED_STROKES)
        keys = " · ".join(f"**{_plain(one.cap)}** {_plain(one.text)}" for one in question.keys)
        where = f"{_plain(question.keys_in)}: " if question.keys_in else ""
        canvas.write(QUESTION, f"# {_plain(question.text)}", rr.MediaType.MARKDOWN)
        canvas.write(ANSWERS, f"{_plain(question.place)}\\\n{where}{keys}", rr.MediaType.MARKDOWN)
        canvas.write(REQUESTED_NAME, "Asked about")

    @staticmethod
    def clear(canvas: Canvas) -> None:
        """Remove the question, so that nobody answers it while the next span is drawn."""
        canvas.write(QUESTION, "# …", rr.MediaType.MARKDOWN)
        canvas.write(ANSWERS, " ")

    def show(self, lane: Lane, canvas: Canvas) -> None:
        """Draw a selected span, unless it is the requested one."""
        starts, ends, _ = spans = lane.spans
        if (*starts.tolist(), *ends.tolist()) == self._span:
            spans = no_spans()
        super().show(lane._replace(spans=spans), canvas)
        self._colour(_COVERED if len(spans) else _REQUESTED, canvas)
        canvas.write(REQUESTED_NAME, "Light: selected" if len(spans) else "Asked about")

    @property
    def _entity(self) -> str:
        return f"{REQUESTED}/{self._number}"

    def _colour(self, shade: Colour, canvas: Canvas) -> None:
        canvas.configure(self._entity, Style.BANDS, [self._text], [shade])


def _plain(text: str) -> str:
    """Escape what Markdown would take for marks."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def draw_frames(
    timeline: Timeline, canvas: Canvas, start: int | None = None, end: int | None = None
) -> None:
    """Draw the frames of a span: all probabilities, and the level five times a second.

    Start and end (excluded) are nanoseconds of UTC, of the first samples of frames; by default all.
    """
    for microphone in timeline.microphones.values():
        for key, frames in microphone.frames.items():
            plot = microphone.plots[key]
            entity = frames_entity(plot)
            near = (part.between(start, end) for part in frames)
            parts = (part for part in near if len(part.times))
            configure_plot(plot, entity, canvas, Style.LINE)
            if plot.kind is LEVEL:
                parts = (part.fifths() for part in parts)
            canvas.draw_frames(entity, plot.names, parts, plot.kind.frame_step)


def draw_plot(plot: Plot, entity: str, canvas: Canvas, *, is_new: bool = True) -> None:
    """Draw a plot, or add to it: bands fall apart where one zooms in, so shares are rows."""
    if plot.kind is not PROBABILITIES:
        if is_new:
            configure_plot(plot, entity, canvas)
        _add_to_plot(plot, entity, canvas)
        return
    names = ordered(plot.names)
    shades = [*map(colour, names)]
    if is_new:
        canvas.configure(entity, Style.ROWS, [in_words(name) for name in names])
    values = plot.values[:, [plot.names.index(name) for name in names]]
    canvas.add_rows(entity, plot.times, values, plot.length, shades)


def configure_plot(plot: Plot, entity: str, canvas: Canvas, style: Style | None = None) -> None:
    """Set the names and colours of the series of a plot, drawn in its own or another style."""
    names: Sequence[str] = plot.names
    colours = [plot.kind.colour]
    if plot.kind.style is Style.BANDS:
        names, colours = [in_words(name) for name in plot.names], [*map(colour, plot.names)]
    canvas.configure(entity, style or plot.kind.style, names, colours)


def _add_to_plot(plot: Plot, entity: str, canvas: Canvas) -> None:
    """Draw values into a configured plot, but not shares."""
    if plot.kind.style is Style.HEAT_MAP:
        canvas.add_shades(entity, plot.times, plot.values)
    else:
        canvas.draw_lines(entity, plot.times, plot.values)


def plot_entity(plot: Plot, close_up: str = "") -> str:
    """Return the entity of a plot."""
    labelling = f"/{_word(plot.labelling)}" if plot.labelling else ""
    return f"{plot.microphone}{close_up}{labelling}/{plot.kind.name}"


def text_entity(plot: Plot) -> str:
    """Return the entity of the text next to a plot; plots in the same view share it."""
    labelling = f"/{_word(plot.labelling)}" if plot.kind.style is Style.BANDS else ""
    return f"{plot.microphone}/{WORDS}/{_word(plot.kind.view)}{labelling}"


def frames_entity(plot: Plot) -> str:
    """Return the entity of the frames of a plot."""
    return f"{plot.microphone}/frames/{_word(plot.labelling or plot.kind.name)}"


def _length(strips: Iterable[_Strip]) -> int:
    return sum(end - start for start, end, _ in strips)


def _word(name: str) -> str:
    """Replace the characters that need escaping in the name of an entity."""
    return name.removeprefix("relabel/").replace("/", "-").replace(" ", "_")


APPLICATION = "hearthlog"
# The viewer keeps the shared range of linked time axes under this name.
SHARED_AXIS = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
# In points of a screen of 1366 x 768; on other screens they are relative heights.
_LANE, _CLOSE_LANE, _AROUND_LANES = 29, 27, 50
_LEVEL_HEIGHT, _PLOT_HEIGHT, _CLOSE_PLOT, _REQUESTED_HEIGHT = 90, 140, 117, 27
_QUESTION_HEIGHT = 62  # of a heading, with the space that the viewer leaves above it
_NEAR = -60.0, 300.0  # seconds from the cursor, which is at the start of the requested span
BELOW = 0.5  # height of the time axis, in lanes, until the height of the window is known
# Of all lanes. Rerun 0.41 cannot hide the numbers of an axis, and writes one every 20 points or
# more: so these are few, 0 to 3, and as wide as the 0 of the other plots, which begin at one place.
LANES_HEIGHT = 3.9
_HOURS_HEIGHT, _SPECTRUM_HEIGHT = 62, 66
_SPECTRUM_SHAPE = (96, 1920)  # as flat as its row in a window of 16 : 9
_BLACK: Colour = (0, 0, 4)
# Widths of a text and a plot, until that of the window is known; the hours have no axis.
COLUMNS, HOUR_COLUMNS, _QUESTION_COLUMNS = (2, 10), (2, 11), (3, 7)
Boundary = rr.encodings.TimeRangeBoundary
Row = tuple[int, rrb.View | rrb.Container]  # with its relative height


class TimelineBlueprint(rrb.Blueprint):
    """Blueprint with linked time axes that start at some times, or seconds from the cursor."""

    def __init__(
        self,
        rows: Sequence[Row],
        panel: rrb.TimePanel,
        start: Boundary,
        end: Boundary,
        *,
        heights: RowHeights | None = None,
    ) -> None:
        super().__init__(stack(rows), panel, collapse_panels=True)
        self._range = rr.encodings.TimeRange(start, end)
        self.heights = heights

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        stream.log(SHARED_AXIS, rrb.TimeAxis(view_range=self._range))


def stack(rows: Sequence[Row], name: str | None = None) -> rrb.Vertical:
    """Stack views vertically."""
    heights = [height for height, _ in rows]
    return rrb.Vertical(*(view for _, view in rows), row_shares=heights, name=name)


def tabs(views: Iterable[rrb.View | rrb.Container]) -> rrb.View | rrb.Container:
    """Put views into tabs; a single view needs no tab."""
    views = list(views)
    return views[0] if len(views) == 1 else rrb.Tabs(*views)


def states_view(root: str, name: str) -> rrb.View:
    """Make a view of all state lanes below an entity."""
    return rrb.StateTimelineView(origin=root, name=name, titlebar=False, time_view=_axis())


def lines_view() -> rrb.View:
    """Make a view of the lines logged by the recorder."""
    return rrb.TextLogView(origin=LINES, name="Events")


def plot_view(plots: Sequence[Plot], entities: Sequence[str], *, live: bool = False) -> rrb.View:
    """Show one or more plots of one kind, or of kinds with the same title, in one view.

    The last of the plots with the most names sets the names.
    """
    plot = max(reversed(plots), key=lambda one: len(one.names))
    kind = plots[0].kind
    scale = kind.live_scale or kind.scale if live else kind.scale
    if kind.style is Style.HEAT_MAP:
        scale = (-0.5, len(plot.names) - 0.5)
    elif kind is PROBABILITIES:
        scale = (0.0, ROWS_HEIGHT)
    return _time_series(plot.title, entities, scale, legend=live and len(entities) > 1)


def _time_series(
    name: str,
    entities: Sequence[str],
    scale: tuple[float, float] | None,
    *,
    legend: bool = False,
) -> rrb.View:
    is_one = len(entities) == 1
    return rrb.TimeSeriesView(
        origin=entities[0] if is_one else "/",
        contents="$origin/**" if is_one else [f"{entity}/**" for entity in entities],
        name=name,
        titlebar=False,
        axis_x=_axis(),
        # The wheel zooms in time alone: names of lanes do not move with their lanes.
        axis_y=rrb.ScalarAxis(range=scale, zoom_lock=True),
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
    )


def _axis() -> rrb.TimeAxis:
    return rrb.TimeAxis(link="LinkToGlobal")


def review_layout(
    timeline: Timeline, *, marking: bool = False, close_up: bool = False, has_question: bool = False
) -> TimelineBlueprint:
    """Lay out the views of a review; with `has_question`, the question of a span is above all.

    Raise `DataError` if the timeline's time zone is unknown.
    """
    clock = timeline.clock
    plots: dict[str, list[Plot]] = {name: [] for name in timeline.microphones}
    for plot in timeline_plots(timeline):
        plots[plot.microphone].append(plot)
    places = placed_lanes(timeline, marking=marking and not close_up)
    sampled = "" if timeline.every == 1 else f"; a sample: one part in {timeline.every}"
    stacks: dict[str, list[Row]] = {}
    has_sound = close_up and timeline.has_sound
    below_lanes: list[bool] = []
    for name, microphone in timeline.microphones.items():
        own = [(lane.labelling, place) for lane, place in places if lane.microphone == name]
        count = len({place.height for _, place in own})
        views = _lane_views(microphone, own, count, f"{clock.name}{sampled}")
        height = (_CLOSE_LANE if close_up else _LANE) * count + _AROUND_LANES
        rows: list[Row] = [(height, rrb.Tabs(*views, lines_view()))]
        more = _plot_views(microphone, plots[name], timeline, close_up=close_up)
        level = [_all(same) for same in _by_title(plots[name]) if same[0].kind is LEVEL]
        if close_up:
            if has_sound:
                rows.insert(0, (_SPECTRUM_HEIGHT, _spectrum_view(microphone.name)))
        elif marking or not more:
            more[1:1] = level
        else:
            rows += [(_LEVEL_HEIGHT, view) for view in level]
        below = _CLOSE_PLOT if close_up else _PLOT_HEIGHT
        stacks[name] = [*rows, (below, tabs(more))] if more else rows
        below_lanes.append(bool(more))
    panel = rrb.TimePanel(
        state="expanded" if marking else "collapsed", timeline=clock.name, play_state="paused"
    )
    start, end = (
        Boundary.absolute(nanos=clock.shown(time))
        for time in (timeline.grid.start, timeline.grid.end)
    )
    height = max(sum(height for height, _ in rows) for rows in stacks.values())
    words = rrb.Horizontal(text_view(QUESTION), text_view(ANSWERS), column_shares=_QUESTION_COLUMNS)
    question: list[Row] = [(_QUESTION_HEIGHT, words)] if has_question else []
    question.append((_REQUESTED_HEIGHT, _requested_view()))
    homes = (height, tabs(stack(rows, name) for name, rows in stacks.items()))
    hours: list[Row] = [(_HOURS_HEIGHT, _hours_view())] if _has_hours(timeline) else []
    above = question if close_up else hours
    heights = RowHeights(
        tuple(height for height, _ in above),
        tuple(tuple(height for height, _ in rows) for rows in stacks.values()),
        int(has_sound),
        all(below_lanes),
        close_up,
    )
    return TimelineBlueprint([*above, homes], panel, start, end, heights=heights)


def _lane_views(
    microphone: MicrophoneTimeline, places: Sequence[tuple[str, LanePlace]], count: int, note: str
) -> list[rrb.Horizontal]:
    """Show the lanes of each labelling next to their names."""
    labellings = [(one.name, labelling_in_words(one.name)) for one in labellings_of(microphone)]
    views = []
    for labelling, words in labellings or [("", "")]:
        entities = [lanes_entity(microphone.name, each) for each in dict.fromkeys((labelling, ""))]
        names = [place.name for own, place in places if own in {labelling, ""}]
        lanes = _time_series(words, entities, (0.0, LANES_HEIGHT))
        texts = names_view(names, count)
        by = f" by {words}" if words else ""
        title = f"What was heard{by}: {note}"
        views.append(rrb.Horizontal(texts, lanes, column_shares=COLUMNS, name=title))
    return views


def names_view(names: Sequence[str], count: int) -> rrb.Vertical:
    """Show the names of rows, each next to its own."""
    views = (text_view(name) for name in names)
    return rrb.Vertical(*views, text_view(NOTHING), row_shares=[*[1.0] * count, BELOW])


def text_view(entity: str) -> rrb.View:
    """Make a view of a text."""
    return rrb.TextDocumentView(origin=entity, titlebar=False)


def _plot_views(
    microphone: MicrophoneTimeline, plots: Sequence[Plot], timeline: Timeline, *, close_up: bool
) -> list[rrb.View | rrb.Container]:
    """Show the plots of a microphone except the level; for close-ups, their drawn part."""
    first = [plot for plot in plots if plot.kind is PROBABILITIES]
    if close_up:
        first += [plot for plot in plots if plot.kind is LEVEL]
    others = [same for same in _by_title(plots) if same[0].kind not in {LEVEL, PROBABILITIES}]
    return [
        *(_close_up(plot, timeline.clock.name) if close_up else _all([plot]) for plot in first),
        *map(_all, reversed(others)),
        *([] if close_up else [*_sounds(microphone), *_frame_views(microphone, timeline.every)]),
    ]


def _by_title(plots: Sequence[Plot]) -> list[list[Plot]]:
    titles = dict.fromkeys(plot.kind.title for plot in plots)
    return [[plot for plot in plots if plot.kind.title == title] for title in titles]


def _hours_view() -> rrb.Container:
    view = states_view(HOURS, "Hours")
    return rrb.Horizontal(text_view(HOURS_NAME), view, column_shares=HOUR_COLUMNS)


def _spectrum_view(microphone: str) -> rrb.Container:
    """Show the spectrogram exactly as wide as the lanes, whatever the shape of its view."""
    rows, columns = _SPECTRUM_SHAPE
    middle = rows / 2
    entity = f"{microphone}/{SPECTRUM}"
    view = rrb.Spatial2DView(
        origin=entity,
        name="Sound",
        titlebar=False,
        visual_bounds=rrb.VisualBounds2D(x_range=[0, columns], y_range=[middle - 1, middle + 1]),
        background=_BLACK,
    )
    return rrb.Horizontal(text_view(f"{entity}/text"), view, column_shares=HOUR_COLUMNS)


def _requested_view() -> rrb.Container:
    lane = _time_series("Which span is asked", [REQUESTED], (0.0, 1.0))
    return rrb.Horizontal(text_view(REQUESTED_NAME), lane, column_shares=COLUMNS)


def _close_up(plot: Plot, clock: str) -> rrb.Container:
    """Show a close-up only near the cursor: a complete one makes the viewer grow."""
    view = plot_view([plot], [plot_entity(plot, CLOSE_UP)])
    before, after = (Boundary.cursor_relative(seconds=seconds) for seconds in _NEAR)
    near = rr.VisibleTimeRange(clock, start=before, end=after)
    view.properties["VisibleTimeRanges"] = rrb.VisibleTimeRanges(near)
    return _with_text([plot], view, ", close up")


def _all(plots: Sequence[Plot]) -> rrb.Container:
    return _with_text(plots, plot_view(plots, [plot_entity(plot) for plot in plots]))


def _with_text(plots: Sequence[Plot], view: rrb.View, note: str = "") -> rrb.Container:
    """Put a view of plots with one title next to a text that explains them."""
    labelling = (
        f": {labelling_in_words(plots[0].labelling)}" if plots[0].kind is PROBABILITIES else ""
    )
    return rrb.Horizontal(
        text_view(text_entity(plots[0])),
        view,
        column_shares=COLUMNS,
        name=f"{plots[0].kind.view}{labelling}{note}",
    )


def _sounds(microphone: MicrophoneTimeline) -> list[rrb.View | rrb.Container]:
    view = rrb.AudioView(origin=f"{microphone.name}/{CLIP}", name="Sound that was kept")
    return [view] if microphone.clips else []


def _frame_views(microphone: MicrophoneTimeline, every: int) -> list[rrb.View | rrb.Container]:
    """Show frames, unless only a sample is read."""
    plots = [plot for plot in microphone.plots.values() if plot.kind.frame_step and every == 1]
    names = [labelling_in_words(plot.labelling or plot.kind.name) for plot in plots]
    return [
        _time_series(f"{name}, frame by frame: zoom in", [frames_entity(plot)], plot.kind.scale)
        for name, plot in zip(names, plots, strict=True)
    ]
