"""Draw a timeline: which entity of a Rerun recording shows what."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.colours import Colour, colour
from hearthlog.analyzer.logs.spans import Spans, rows_at
from hearthlog.analyzer.review.timeline.checked_classes import Checked
from hearthlog.analyzer.review.timeline.lanes import REVIEWED, Lane, timeline_lanes
from hearthlog.analyzer.review.timeline.model import FrameValues, Timeline
from hearthlog.analyzer.review.timeline.plots import LEVEL, SHARES, Plot, Style, timeline_plots
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
