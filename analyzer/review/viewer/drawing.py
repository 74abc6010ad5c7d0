"""A timeline in Rerun: where everything is drawn, and the views that show it."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.colours import GAP, Colour, colour
from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.analyzer.review.timeline.lanes import changes, clock, disagreements, overview
from hearthlog.analyzer.review.timeline.model import (
    FrameValues,
    MicrophoneTimeline,
    Timeline,
    no_spans,
)
from hearthlog.analyzer.review.viewer.canvas import TIMELINE, Canvas
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.messages.topics import REVIEW

APPLICATION = "hearthlog"
OVERVIEW, DETAIL = "lanes", "exact"
_LINES, _CLIP = "events", "clip"
_CLOSE = "/close_up"
Rows = list[tuple[int, rrb.View | rrb.Container]]

_HOURS: tuple[Colour, Colour] = ((52, 60, 70), (32, 38, 46))
_DIFFERENT: Colour = (222, 165, 32)
_TROUBLE: Colour = (240, 140, 40)
_BRIGHT: Colour = (235, 215, 140)
_NEW: Colour = (160, 200, 255)
# The viewer keeps the range that linked time axes share under this name.
SHARED_AXIS = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"


def draw(timeline: Timeline, canvas: Canvas) -> None:
    """Draw all but the single frames."""
    for root in (OVERVIEW, DETAIL):
        _draw_clock(timeline, canvas, root)
    for microphone in timeline.microphones.values():
        _draw_lanes(timeline, microphone, canvas)
        _draw_plots(timeline, microphone, canvas)
        for clip in microphone.clips:
            canvas.show_clip(f"{microphone.name}/{_CLIP}", clip)
    canvas.write_lines(_LINES, timeline.lines)


def draw_frames(
    timeline: Timeline, canvas: Canvas, start: int | None = None, end: int | None = None
) -> None:
    """Draw what is to be seen close up: the values of every single frame, of a span or of all."""
    for microphone in timeline.microphones.values():
        for labelling in microphone.labellings:
            if labelling.probabilities is not None and labelling.frames:
                entity = f"{microphone.name}/frames/{_word(labelling.name)}"
                names = labelling.probabilities.names
                canvas.configure_lines(entity, names, [colour(name) for name in names])
                canvas.draw_frames(entity, names, _between(labelling.frames, start, end))
        if microphone.level_frames:
            entity = f"{microphone.name}/frames/level"
            canvas.configure_lines(entity, ["level"], [_BRIGHT])
            canvas.draw_frames(entity, ["level"], _between(microphone.level_frames, start, end))


def _between(parts: Sequence[FrameValues], start: int | None, end: int | None) -> list[FrameValues]:
    """Return the frames that begin in a span of time."""
    found = []
    for names, times, values in parts:
        first = 0 if start is None else int(np.searchsorted(times, start))
        last = len(times) if end is None else int(np.searchsorted(times, end))
        if first < last:
            found.append(FrameValues(names, times[first:last], values[first:last]))
    return found


def draw_close_up(timeline: Timeline, canvas: Canvas) -> None:
    """Draw a short timeline where it can be seen beside the one that it is a part of."""
    for microphone in timeline.microphones.values():
        _draw_plots(timeline, microphone, canvas, _CLOSE)


def lane(root: str, microphone: str, place: int, name: str) -> str:
    """Name the entity of a lane; they are shown in the order of their names."""
    return f"{root}/{microphone}/{place}_{_word(name)}"


def review_lanes(microphone: str) -> list[str]:
    """Name the lanes that show a reviewer's marks."""
    return [lane(root, microphone, 8, REVIEW) for root in (OVERVIEW, DETAIL)]


def _draw_clock(timeline: Timeline, canvas: Canvas, root: str) -> None:
    hours = clock(timeline.grid, home_zone(timeline.zone))
    entity = f"{root}/0_{_word(timeline.zone)}"
    texts = list(dict.fromkeys(hours.texts))
    canvas.configure_lane(entity, {text: _HOURS[i % 2] for i, text in enumerate(texts)})
    canvas.change_states(entity, *changes(hours))


def _draw_lanes(timeline: Timeline, microphone: MicrophoneTimeline, canvas: Canvas) -> None:
    classes = _classes(microphone)
    colours = {name: colour(name) for name in classes}
    for place, labelling in enumerate(microphone.labellings, 1):
        place_ = 8 if labelling.name == REVIEW else min(place, 7)
        for root in (OVERVIEW, DETAIL):
            entity = lane(root, microphone.name, place_, labelling.name)
            canvas.configure_lane(entity, colours)
            exact = root == DETAIL or labelling.name == REVIEW
            spans = labelling.spans if exact else no_spans()
            if not len(spans) and labelling.name != REVIEW:
                spans = overview(labelling, timeline.grid)
            canvas.change_states(entity, *changes(spans))
    if all(labelling.name != REVIEW for labelling in microphone.labellings):
        start = np.array([timeline.grid.start])
        for entity in review_lanes(microphone.name):
            canvas.configure_lane(entity, colours)
            canvas.change_states(entity, start, [None])
    _draw_differences(timeline, microphone, canvas)
    for place, name, spans, tint in (
        (9, "not_heard", microphone.gaps, GAP),
        (9, "trouble", microphone.troubles, _TROUBLE),
    ):
        if len(spans):
            for root in (OVERVIEW, DETAIL):
                entity = lane(root, microphone.name, place, name)
                canvas.configure_lane(entity, dict.fromkeys(spans.texts, tint))
                canvas.change_states(entity, *changes(spans))


def _draw_differences(timeline: Timeline, microphone: MicrophoneTimeline, canvas: Canvas) -> None:
    """Show where a model says something else than the recorder did."""
    first = microphone.labellings[0] if microphone.labellings else None
    if first is None or first.name == REVIEW:
        return
    others = [one for one in microphone.labellings[1:] if one.name != REVIEW]
    for other in others:
        exact = disagreements(first.spans, other.spans)
        spans = {
            DETAIL: exact,
            OVERVIEW: disagreements(*(overview(one, timeline.grid) for one in (first, other))),
        }
        for root, found in spans.items():
            entity = lane(root, microphone.name, 9, f"differs {other.name}")
            canvas.configure_lane(entity, dict.fromkeys(found.texts, _DIFFERENT))
            canvas.change_states(entity, *changes(found))


def _draw_plots(
    timeline: Timeline, microphone: MicrophoneTimeline, canvas: Canvas, scale: str = ""
) -> None:
    times = _middles(timeline)
    name = f"{microphone.name}{scale}"
    for labelling in microphone.labellings:
        root = f"{name}/{_word(labelling.name)}"
        if labelling.probabilities is not None:
            names, values = labelling.probabilities
            canvas.draw_bands(f"{root}/shares", names, [colour(n) for n in names], times, values)
        if labelling.novelty is not None:
            canvas.configure_lines(f"{root}/novelty", [f"novelty, {labelling.name}"], [_NEW])
            canvas.draw_lines(f"{root}/novelty", times, labelling.novelty[:, np.newaxis])
    if microphone.level is not None:
        entity = f"{name}/level"
        canvas.configure_lines(entity, ["level"], [_BRIGHT])
        canvas.draw_lines(entity, times, microphone.level[:, np.newaxis])
    if microphone.features is not None:
        names, values = microphone.features
        canvas.draw_heat_map(f"{name}/features", names, times, values)


def _middles(timeline: Timeline) -> Int64:
    edges = timeline.grid.edges
    return edges[:-1] + (edges[1:] - edges[:-1]) // 2


def _classes(microphone: MicrophoneTimeline) -> list[str]:
    names = [
        n for one in microphone.labellings if one.probabilities for n in one.probabilities.names
    ]
    texts = [text for one in microphone.labellings for text in one.spans.texts]
    return list(dict.fromkeys([*names, *texts]))


def _word(name: str) -> str:
    """Make of a name what an entity may be called without marks of escape."""
    return name.removeprefix("relabel/").replace("/", "-").replace(" ", "_")


class Layout(rrb.Blueprint):
    """The views of a timeline, whose linked time axes begin with the whole of it.

    Parameters
    ----------
    timeline : Timeline
    marking : bool
        Whether the time panel is open, on whose ruler spans are marked with the mouse.
    close_up : bool
        Whether short spans are looked at: there is room for what is drawn of them.
    """

    def __init__(
        self, timeline: Timeline, *, marking: bool = False, close_up: bool = False
    ) -> None:
        panel = rrb.TimePanel(
            state="expanded" if marking else "collapsed", timeline=TIMELINE, play_state="paused"
        )
        super().__init__(_views(timeline, close_up=close_up), panel, collapse_panels=True)
        ends = (timeline.grid.start, timeline.grid.end)
        bounds = [rr.encodings.TimeRangeBoundary.absolute(nanos=time) for time in ends]
        self._range = rr.encodings.TimeRange(*bounds)

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        stream.log(SHARED_AXIS, rrb.TimeAxis(view_range=self._range))


def _views(timeline: Timeline, *, close_up: bool) -> rrb.Vertical:
    microphones = list(timeline.microphones.values())
    sampled = "" if timeline.every == 1 else f" (a sample: one part in {timeline.every})"
    lanes = rrb.Tabs(
        _lane_view(OVERVIEW, f"What was heard, from afar{sampled}: clock of the home, axes in UTC"),
        _lane_view(DETAIL, "What was heard, exactly"),
        active_tab=1 if close_up else 0,
    )
    count = sum(_lanes(microphone) for microphone in microphones) + 1
    plots = [_plots(microphone, sampled, close_up=close_up) for microphone in microphones]
    rows: Rows = [
        (90 + 48 * count, lanes),
        (320 if close_up else 540, plots[0] if len(plots) == 1 else rrb.Tabs(*plots)),
        (120 if close_up else 160, _details(timeline, close_up=close_up)),
    ]
    return _stacked(rows)


def _stacked(rows: Rows, name: str | None = None) -> rrb.Vertical:
    return rrb.Vertical(
        *(view for _, view in rows), row_shares=[share for share, _ in rows], name=name
    )


def _lanes(microphone: MicrophoneTimeline) -> int:
    names = [labelling.name for labelling in microphone.labellings if labelling.name != REVIEW]
    more = [microphone.gaps, microphone.troubles]
    return len(names) + 1 + max(len(names) - 1, 0) + sum(1 for spans in more if len(spans))


def _axis() -> rrb.TimeAxis:
    return rrb.TimeAxis(link="LinkToGlobal")


def _lane_view(root: str, name: str) -> rrb.View:
    return rrb.StateTimelineView(origin=root, name=name, time_view=_axis())


def _plots(microphone: MicrophoneTimeline, sampled: str, *, close_up: bool) -> rrb.Vertical:
    """Show what a microphone heard; where spans are marked there is room for them, close up."""
    probable = [one.name for one in microphone.labellings if one.probabilities is not None]
    rows: Rows = []
    if probable:
        rows.append((280, _tabs(_share_view(microphone, name, sampled) for name in probable)))
    if close_up and probable:
        near = (_share_view(microphone, name, ", close up", _CLOSE) for name in probable)
        rows.append((240, _tabs(near)))
    if not close_up:
        rows += _rest(microphone)
    if not rows:
        rows.append((1, rrb.TextLogView(origin=_LINES, name="Events")))
    return _stacked(rows, microphone.name)


def _rest(microphone: MicrophoneTimeline) -> Rows:
    """Show what is not a label: level, novelty, features."""
    rows: Rows = []
    if microphone.level is not None:
        rows.append((100, _plot(f"{microphone.name}/level", "Level in dBFS")))
    novelty = [
        f"{microphone.name}/{_word(one.name)}/novelty"
        for one in microphone.labellings
        if one.novelty is not None
    ]
    if novelty:
        view = _plot("/", "Novelty: 0 as learnt, 1 never heard", contents=novelty)
        rows.append((90, view))
    if microphone.features is not None:
        names = microphone.features.names
        title = f"Features: 0 ({names[0]}) to {len(names) - 1} ({names[-1]}), dark is low"
        rows.append((180, _plot(f"{microphone.name}/features", title, (-0.5, len(names) - 0.5))))
    return rows


def _tabs(views: Iterable[rrb.View]) -> rrb.View | rrb.Container:
    found = list(views)
    return found[0] if len(found) == 1 else rrb.Tabs(*found)


def _share_view(microphone: MicrophoneTimeline, name: str, note: str, scale: str = "") -> rrb.View:
    return _plot(
        f"{microphone.name}{scale}/{_word(name)}/shares",
        f"How probable each class is: {name}{note}",
        (0.0, 1.0),
        legend=True,
    )


def _plot(
    origin: str,
    name: str,
    scale: tuple[float, float] | None = None,
    *,
    legend: bool = False,
    contents: Sequence[str] | None = None,
) -> rrb.View:
    return rrb.TimeSeriesView(
        origin=origin,
        contents="$origin/**" if contents is None else list(contents),
        name=name,
        axis_x=_axis(),
        axis_y=None if scale is None else rrb.ScalarAxis(range=scale),
        plot_legend=rrb.PlotLegend(visible=legend, corner="RightTop"),
    )


def _details(timeline: Timeline, *, close_up: bool) -> rrb.Tabs:
    microphones = timeline.microphones.values()
    events: rrb.View | rrb.Container = rrb.TextLogView(origin=_LINES, name="Events")
    clips = [
        rrb.AudioView(origin=f"{one.name}/{_CLIP}", name=f"Sound that was kept: {one.name}")
        for one in microphones
        if one.clips
    ]
    if clips:
        events = rrb.Horizontal(*clips, events, name="Sound and events")
    views = [view for one in microphones for view in _more(one, close_up=close_up)]
    # Where spans are marked their sound is wanted first, else how loud they were.
    return rrb.Tabs(events, *views) if clips or not close_up else rrb.Tabs(*views, events)


def _more(microphone: MicrophoneTimeline, *, close_up: bool) -> list[rrb.View]:
    if close_up:
        rest: list[Any] = [view for _, view in _rest(microphone)]
        if microphone.level is not None:
            entity = f"{microphone.name}{_CLOSE}/level"
            rest.insert(0, _plot(entity, "Level in dBFS, close up"))
        return rest
    names: list[tuple[str, tuple[float, float] | None]] = [
        (one.name, (0.0, 1.0)) for one in microphone.labellings if one.frames
    ]
    if microphone.level_frames:
        names.append(("level", None))
    return [
        _plot(f"{microphone.name}/frames/{_word(name)}", f"{name}, 20 a second: zoom in", scale)
        for name, scale in names
    ]
