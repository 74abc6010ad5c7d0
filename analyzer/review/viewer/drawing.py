"""Draw a timeline: which entity of a Rerun recording shows what."""

from collections.abc import Iterator, Sequence

import numpy as np

from hearthlog.analyzer.colours import colour
from hearthlog.analyzer.review.timeline.lanes import MARKS, Changes, Lane, timeline_lanes
from hearthlog.analyzer.review.timeline.model import FrameValues, Timeline
from hearthlog.analyzer.review.timeline.plots import LEVEL, Plot, Style, timeline_plots
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.schemas.messages.topics import REVIEW

OVERVIEW, DETAIL = "lanes", "exact"  # entities of all lanes
LINES, CLIP = "events", "clip"
CLOSE_UP = "/close_up"  # behind the name of a microphone


def draw(timeline: Timeline, canvas: Canvas) -> None:
    """Draw all of a timeline but the single frames.

    Parameters
    ----------
    timeline : Timeline
    canvas : Canvas
        Is drawn on.

    Raises
    ------
    DataError
        If there is no such time zone as the timeline's.
    """
    for root in (OVERVIEW, DETAIL):
        for lane in timeline_lanes(timeline, detail=root == DETAIL):
            _draw_lane(lane, root, canvas)
    _draw_plots(timeline, canvas)
    for microphone in timeline.microphones.values():
        for clip in microphone.clips:
            canvas.show_clip(f"{microphone.name}/{CLIP}", clip)
    canvas.write_lines(LINES, timeline.lines)


def draw_close_up(timeline: Timeline, canvas: Canvas) -> None:
    """Draw the plots of a short timeline beside those of the longer timeline around it.

    Parameters
    ----------
    timeline : Timeline
        The short one.
    canvas : Canvas
        Is drawn on.
    """
    _draw_plots(timeline, canvas, CLOSE_UP)


def draw_frames(
    timeline: Timeline, canvas: Canvas, start: int | None = None, end: int | None = None
) -> None:
    """Draw every frame of a span of a timeline.

    Parameters
    ----------
    timeline : Timeline
    canvas : Canvas
        Is drawn on.
    start, end : int, optional
        In nanoseconds of UTC: frames that begin from `start` on, before `end`; by default all.
    """
    for microphone in timeline.microphones.values():
        for labelling in microphone.labellings:
            if labelling.probabilities is not None and labelling.frames:
                entity = frames_entity(microphone.name, labelling.name)
                names = labelling.probabilities.names
                canvas.configure_lines(entity, names, [colour(name) for name in names])
                canvas.draw_frames(entity, names, _between(labelling.frames, start, end))
        if microphone.level_frames:
            entity = frames_entity(microphone.name, LEVEL.name)
            canvas.configure_lines(entity, ["level"], [LEVEL.colour])
            canvas.draw_frames(entity, ["level"], _between(microphone.level_frames, start, end))


def redraw_marks(microphone: str, changes: Changes, canvas: Canvas) -> None:
    """Draw the marks of a microphone again, in both lanes that show them.

    Parameters
    ----------
    microphone : str
    changes : Changes
        The label at each time, None for no mark.
    canvas : Canvas
        Is drawn on.
    """
    for root in (OVERVIEW, DETAIL):
        _draw_lane(Lane(MARKS, microphone, REVIEW, changes), root, canvas)


def configure_plot(plot: Plot, entity: str, canvas: Canvas) -> None:
    """Set names and colours of what a plot shows.

    Parameters
    ----------
    plot : Plot
        Its kind and names count.
    entity : str
        From `plot_entity`, or a child of it.
    canvas : Canvas
        Is drawn on.
    """
    if plot.kind.style is Style.BANDS:
        canvas.configure_bands(entity, plot.names, [colour(name) for name in plot.names])
    elif plot.kind.style is Style.HEAT_MAP:
        canvas.configure_heat_map(entity, plot.names)
    else:
        canvas.configure_lines(entity, plot.names, [plot.kind.colour])


def add_to_plot(plot: Plot, entity: str, canvas: Canvas) -> None:
    """Draw values into a plot that is configured.

    Parameters
    ----------
    plot : Plot
        Of the same kind and names.
    entity : str
        Configured by `configure_plot`.
    canvas : Canvas
        Is drawn on.
    """
    if plot.kind.style is Style.BANDS:
        canvas.add_bands(entity, plot.times, plot.values)
    elif plot.kind.style is Style.HEAT_MAP:
        canvas.add_shades(entity, plot.times, plot.values)
    else:
        canvas.draw_lines(entity, plot.times, plot.values)


def lane_entity(root: str, lane: Lane) -> str:
    """Name the entity of a lane; the viewer shows lanes in the order of their names.

    Parameters
    ----------
    root : str
        `OVERVIEW` or `DETAIL`.
    lane : Lane

    Returns
    -------
    str
        As `lanes/<microphone>/1_live`; the clock is in no microphone.
    """
    folder = f"{root}/{lane.microphone}" if lane.microphone else root
    return f"{folder}/{lane.kind.place}_{_word(lane.name)}"


def plot_entity(plot: Plot, close_up: str = "") -> str:
    """Name the entity of a plot.

    Parameters
    ----------
    plot : Plot
    close_up : str, optional
        `CLOSE_UP` for a plot of a short span.

    Returns
    -------
    str
        As `<microphone>/live/shares`, or `<microphone>/level` for a plot of no labelling.
    """
    labelling = f"/{_word(plot.labelling)}" if plot.labelling else ""
    return f"{plot.microphone}{close_up}{labelling}/{plot.kind.name}"


def frames_entity(microphone: str, name: str) -> str:
    """Name the entity of the frames of a labelling, or of the level.

    Parameters
    ----------
    microphone : str
    name : str
        Of the labelling (`live`, `relabel/<model>`), or `level`.
    """
    return f"{microphone}/frames/{_word(name)}"


def _draw_lane(lane: Lane, root: str, canvas: Canvas) -> None:
    entity = lane_entity(root, lane)
    canvas.configure_lane(entity, lane.colours)
    canvas.change_states(entity, *lane.changes)


def _draw_plots(timeline: Timeline, canvas: Canvas, close_up: str = "") -> None:
    for plot in timeline_plots(timeline):
        if len(plot.times):
            entity = plot_entity(plot, close_up)
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


def _word(name: str) -> str:
    """Replace the characters that would have to be escaped in the name of an entity."""
    return name.removeprefix("relabel/").replace("/", "-").replace(" ", "_")
