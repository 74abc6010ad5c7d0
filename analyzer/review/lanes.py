"""Lanes and plots of a timeline and of a watch: names, colours and values."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.activity.checked_minutes import (
    UNSURE_BELOW,
    ClassCheck,
    checked_minutes,
    read_reviewed_labels,
)
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.recorder_info import MicrophoneHealth, microphone_states
from hearthlog.analyzer.logs.selection import checked_array_names
from hearthlog.analyzer.logs.sound_vectors import as_vectors, degrees_of
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, joined, overlay, rows_at
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.analyzer.review.timeline import (
    LabelledSpans,
    LabellingTimeline,
    LogLines,
    MicrophoneTimeline,
    Plot,
    PlotKind,
    Style,
    Timeline,
    TimelineGrid,
    labelled_spans,
    no_spans,
)
from hearthlog.models.classes import (
    GAP,
    OF_EVERY_SCENARIO,
    SILENCE,
    Colour,
    class_name,
    colour,
    in_words,
    ordered,
    translation,
)
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    RELABEL,
    TopicName,
    is_review,
    is_scenario,
    parse_topic,
    review_labelling,
    scenario_name,
)

_TROUBLED: Colour = (240, 140, 40)
_TROUBLES = {"warning": _TROUBLED, "error": (230, 60, 60), "stale": (150, 90, 160)}
TROUBLES = tuple(_TROUBLES)  # texts of a live lane, by the level of a diagnostic status minus one
GAP_STATE = "not heard"
NOT_SURE = "not sure"  # after the name of a class
_DOUBT = "?"
BACKGROUND: Colour = (13, 13, 13)  # behind the plots of the viewer


@dataclass(frozen=True, eq=False)
class LaneKind:
    """Appearance of lanes of one kind; the viewer shows kinds in name order."""

    name: str
    colours: Callable[[Iterable[str]], dict[str, Colour]]  # by state
    states: Sequence[str] = ()  # announced to the viewer before they occur, for a watch


def _class_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: _state_colour(state) for state in states}


def _state_colour(state: str) -> Colour:
    """Return the colour of a class in a lane of all classes, in which quiet is faint."""
    name = sure_state(state)
    shade = colour(name)
    if class_name(name) == SILENCE:
        return unsure_colour(unsure_colour(shade))
    return shade if name == state else unsure_colour(shade)


def unsure_state(state: str) -> str:
    """Return the state of a class of which the model is not sure."""
    return f"{state}{_DOUBT}"


def sure_state(state: str) -> str:
    """Return the state without what `unsure_state` adds."""
    return state.removesuffix(_DOUBT)


def _trouble_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: _TROUBLES.get(state, _TROUBLED) for state in states}


RECORDER = LaneKind("Heard", _class_colours)
GAPS = LaneKind("Not_heard", lambda states: dict.fromkeys(states, GAP), [GAP_STATE])
TROUBLE = LaneKind("Trouble", _trouble_colours, TROUBLES)


def scenario_kind(labelling: str) -> LaneKind:
    """Return the lane kind of a scenario, whose segments appear once they are closed."""
    return LaneKind(labelling.replace("/", "_").capitalize(), _class_colours)


class StateLane(NamedTuple):
    """Additions to a lane: times at which it changes, and its new states."""

    kind: LaneKind
    microphone: str
    times: Int64  # [shape=(n,)], in nanoseconds of UTC, ascending
    states: list[str | None]  # None is no state


def state_lane(kind: LaneKind, microphone: str, spans: LabelledSpans) -> StateLane:
    """Convert spans into changes of a lane.

    Each span begins with its text, and ends with None unless the next one follows at once.
    """
    followed = np.append(spans.starts[1:], np.iinfo(np.int64).max)
    last = np.flatnonzero(spans.ends < followed)
    times = np.concatenate([spans.ends[last], spans.starts])
    states = [*[None] * len(last), *spans.texts]
    order = np.argsort(times, kind="stable")
    return StateLane(kind, microphone, times[order], [states[i] for i in order])


def differing_spans(one: LabelledSpans, other: LabelledSpans) -> LabelledSpans:
    """Find the spans in which two labellings differ, with the labels of `other`.

    Two names of one class (see `hearthlog.models.classes`) are no difference, nor is a label of
    only one of the two.
    """
    if not len(one) or not len(other):
        return no_spans()
    parts = overlay([one, other])
    a, b = parts.rows
    differ = (a >= 0) & (b >= 0)
    names = translation(set(other.texts), set(one.texts))
    translated = np.array([names[text] for text in other.texts], object)
    differ[differ] = one.texts[a[differ]] != translated[b[differ]]
    first = differ & (np.diff(np.where(differ, a, -1), prepend=-2) != 0)
    first |= differ & (np.diff(np.where(differ, b, -1), prepend=-2) != 0)
    places = np.flatnonzero(first)
    # A difference ends where either of the two labels ends.
    stops = np.minimum(one.ends[a[places]], other.ends[b[places]])
    ends = np.minimum(stops, parts.ends[-1])
    return LabelledSpans(parts.starts[places], ends, other.texts[b[places]])


REVIEWED = "Reviewed"  # name of the lane, and text of spans without a mark
SELECTED = "Selected"  # name of the lane of the span that a key would mark
UNRECORDED = "Not heard"
_TROUBLE = "Trouble"
_RECURRING = "Recurs"
_VOICES = "Voices"
_REVIEWED_COLOUR: Colour = (58, 70, 92)
SELECTED_COLOUR: Colour = (206, 196, 170)
_MOST_LANES = 12  # of classes, if some were not heard at all


class Lane(NamedTuple):
    """A lane."""

    microphone: str
    labelling: str  # empty for lanes shared by all labellings
    name: str
    spans: LabelledSpans
    colours: Mapping[str, Colour]

    @property
    def title(self) -> str:
        """The name as shown: marks have the colours of classes, also of those without a lane."""
        return f"{REVIEWED} · class colours" if self.name == REVIEWED else self.name


def timeline_lanes(timeline: Timeline, *, marking: bool = False) -> Iterator[Lane]:
    """Make the lanes of a timeline, microphone by microphone, from the top.

    For each labelling there is a lane for each class except silence, the most important class
    first. Then follow the lanes shared by all labellings: each scenario, differences from the first
    labelling, the selected span (with `marking`), reviewed spans (also of scenarios), gaps, and
    trouble. Nothing lies outside of the timeline: it would stretch the viewer's time ruler.
    """
    for microphone in timeline.microphones.values():
        for lane in _lanes_of(microphone, marking=marking):
            yield lane._replace(spans=cut_spans(lane.spans, timeline.grid))


def cut_spans(spans: LabelledSpans, grid: TimelineGrid) -> LabelledSpans:
    """Return the parts of spans within a grid."""
    inside = (spans.ends > grid.start) & (spans.starts < grid.end)
    starts, ends = (np.clip(edge[inside], grid.start, grid.end) for edge in spans[:2])
    return LabelledSpans(starts, ends, spans.texts[inside])


def _lanes_of(microphone: MicrophoneTimeline, *, marking: bool) -> Iterator[Lane]:
    labellings = labellings_of(microphone)
    words = _classes(microphone, labellings)
    for one in labellings:
        for name, shade in words.items():
            spans = _of_class(one.spans, name)
            unsure = _in_unsure_events(spans, np.isin(spans.starts, one.unsure.starts))
            doubted = _not_reviewed(one.unsure, microphone.reviewed)
            unsure &= np.isin(spans.starts, doubted.starts)
            texts = np.where(unsure, f"{name}, {NOT_SURE}", spans.texts)
            shades = {name: shade, f"{name}, {NOT_SURE}": unsure_colour(shade)}
            yield Lane(microphone.name, one.name, name, LabelledSpans(*spans[:2], texts), shades)
    yield from _shared_lanes(microphone, labellings, marking=marking)


def _in_unsure_events(spans: LabelledSpans, unsure: Bool) -> Bool:
    """Return which segments of a class are of events without a sure one, as the report has them."""
    event = rows_at(joined(spans.starts, spans.ends, EVENT_PAUSE), spans.starts)
    return unsure & (np.bincount(event, ~unsure)[event] == 0 if len(event) else unsure)


def unsure_colour(shade: Colour) -> Colour:
    """Return a colour mixed with the background, for labels that the model doubts itself."""
    red, green, blue = ((part + dark) // 2 for part, dark in zip(shade, BACKGROUND, strict=True))
    return red, green, blue


def _not_reviewed(spans: LabelledSpans, reviewed: LabelledSpans) -> LabelledSpans:
    """Drop the spans that a person reviewed completely."""
    done = joined(reviewed.starts, reviewed.ends)
    rows = rows_at(done, spans.starts)
    inside = (rows >= 0) & (spans.ends <= np.append(done.ends, 0)[rows])
    return spans.where(~inside)


def labellings_of(microphone: MicrophoneTimeline) -> list[LabellingTimeline]:
    """Return the labellings of a microphone by models of the home, the recorder's first."""
    models = [one for one in microphone.labellings if not is_review(one.name)]
    return [one for one in models if not is_scenario(one.name)]


def labelling_in_words(name: str) -> str:
    """Return the displayed name of a labelling: `the recorder`, the scenario, or the model."""
    if is_scenario(name):
        return name.replace("/", " ")
    return "the recorder" if name == LIVE else name.removeprefix(f"{RELABEL}/")


def scenario_sounds(spans: LabelledSpans) -> LabelledSpans:
    """Drop the spans of a scenario that name no class of it."""
    named = np.array([class_name(text) not in OF_EVERY_SCENARIO for text in spans.texts], bool)
    return LabelledSpans(spans.starts[named], spans.ends[named], spans.texts[named])


def reviewed_lane(
    microphone: str, scenario: str, marks: LabelledSpans, reviewed: LabelledSpans
) -> Lane:
    """Make the lane of reviewed spans; the scenario is empty for the sounds of the home."""
    name = f"{in_words(scenario)} reviewed" if scenario else REVIEWED
    marked = _lane_in_words(microphone, name, marks)
    texts = np.concatenate([np.full(len(reviewed), REVIEWED, object), marked.spans.texts])
    starts = np.concatenate([reviewed.starts, marks.starts])
    ends = np.concatenate([reviewed.ends, marks.ends])
    spans, colours = (
        LabelledSpans(starts, ends, texts),
        {REVIEWED: _REVIEWED_COLOUR, **marked.colours},
    )
    return marked._replace(spans=spans, colours=colours)


def selected_lane(microphone: str, span: tuple[int, int] | None = None) -> Lane:
    """Make the lane of the selected span (ns of UTC), if there is one."""
    spans = labelled_spans([] if span is None else [(*span, SELECTED)])
    return Lane(microphone, "", SELECTED, spans, {SELECTED: SELECTED_COLOUR})


def _classes(
    microphone: MicrophoneTimeline, labellings: list[LabellingTimeline]
) -> dict[str, Colour]:
    """Return the displayed names of classes with their colours, the most important first.

    Those that were heard, and as many others as there are lanes left.
    """
    labels = {name for one in labellings for name in (*one.classes, *one.spans.texts)}
    own = [name for name in microphone.classes if name in labels and class_name(name) != SILENCE]
    names = ordered(own)
    seconds: Counter[str] = Counter()
    for one in labellings:
        for name in names:
            rows = one.spans.texts == name
            seconds[in_words(name)] += int((one.spans.ends - one.spans.starts)[rows].sum())
    shades = {in_words(name): colour(name) for name in reversed(names)}
    sounding = [name for name in shades if seconds[name]]
    silent = [in_words(name) for name in names if not seconds[in_words(name)]]
    room = max(_MOST_LANES - len(sounding), 0)
    shown = {*sounding, *silent[:room]}
    return {name: shades[name] for name in map(in_words, names) if name in shown}


def _of_class(spans: LabelledSpans, name: str) -> LabelledSpans:
    labels = {text for text in dict.fromkeys(spans.texts) if in_words(text) == name}
    own = np.isin(spans.texts, list(labels)) if labels else np.zeros(len(spans), bool)
    return LabelledSpans(spans.starts[own], spans.ends[own], np.full(own.sum(), name, object))


def _shared_lanes(
    microphone: MicrophoneTimeline, labellings: list[LabellingTimeline], *, marking: bool
) -> Iterator[Lane]:
    for one in microphone.labellings:
        if is_scenario(one.name):
            name = in_words(scenario_name(one.name))
            yield _lane_in_words(microphone.name, name, scenario_sounds(one.spans))
    for other in labellings[1:]:
        spans = differing_spans(labellings[0].spans, other.spans)
        name = f"{labelling_in_words(other.name)} differs"
        yield _lane_in_words(microphone.name, name, spans)
    for name, spans in ((_RECURRING, microphone.recurring), (_VOICES, microphone.spoken)):
        if len(spans):
            yield _lane_in_words(microphone.name, name, spans)
    if marking:
        yield selected_lane(microphone.name)
    marks = {one.name: one.spans for one in microphone.labellings if is_review(one.name)}
    for scenario, reviewed in {"": microphone.reviewed, **microphone.reviewed_scenarios}.items():
        own = marks.get(review_labelling(scenario), no_spans())
        yield reviewed_lane(microphone.name, scenario, own, reviewed)
    kinds = (UNRECORDED, microphone.gaps, GAP), (_TROUBLE, microphone.troubles, _TROUBLED)
    for name, spans, shade in kinds:
        if len(spans):
            texts = np.full(len(spans), name, object)
            named = LabelledSpans(*spans[:2], texts)
            yield Lane(microphone.name, "", name, named, {name: shade})


def _lane_in_words(microphone: str, lane: str, spans: LabelledSpans) -> Lane:
    """Make a lane of all classes of some spans, by their displayed names."""
    names = {text: in_words(text) for text in dict.fromkeys(spans.texts)}
    shades = {name: colour(text) for text, name in names.items()}
    texts = np.array([names[text] for text in spans.texts], object)
    return Lane(microphone, "", lane, LabelledSpans(*spans[:2], texts), shades)


Checked = Mapping[tuple[str, str], ClassCheck]  # by microphone and displayed class name
_AROUND = 28 * 86_400 * NANOSECONDS


def class_precision(timeline: Timeline, logs: HomeLogs) -> Checked:
    """Count the recorder's sounds, and the correct ones, in minutes drawn at random.

    Minutes of the home up to four weeks before and after the timeline count. Counts are by
    microphone and displayed class name; without classes that have no sound in these minutes.
    """
    start, end = timeline.grid.start - _AROUND, timeline.grid.end + _AROUND
    near = read_reviewed_labels(logs, LIVE, start, end, [], {RANDOM})
    reviewed = [one for one in near if start <= one.span.start < end]
    checked: dict[tuple[str, str], ClassCheck] = {}
    for microphone in timeline.microphones:
        minutes = checked_minutes(one for one in reviewed if one.span.microphone == microphone)
        checks = ((name, minutes.check(name)) for name in minutes.events)
        checked |= {(microphone, in_words(name)): one for name, one in checks if one.labelled}
    return checked


_GROUND: Colour = (200, 120, 90)
_NEW: Colour = (160, 200, 255)
_TOWARDS: Colour = (150, 215, 150)
_HEAT_COLUMNS = 600  # maximum: each value is a square, which costs the viewer about ten kilobytes
_HEAT_PERCENTILES = (2, 98)
_TINY = np.finfo(np.float64).tiny
_QUIETEST = 1e-10  # mean square: -100 dB


def decibel(energy: Any) -> Any:
    """Return the level of a mean square of samples from -1 to 1, in dBFS: 10 log10(energy).

    It is at least -100, and 0 for a square wave of full scale.
    """
    return 10 * np.log10(np.maximum(energy, _QUIETEST))


def _degrees(vectors: NDArray[np.floating]) -> Float64:
    return degrees_of(vectors.astype(np.float64))[:, np.newaxis]


PROBABILITIES = PlotKind(
    "shares", "How probable each class is", 280, Style.BANDS, scale=(0.0, 1.0), frame_step=0.01
)
_LEVELS = "Level, and floor of the room, in dBFS"
LEVEL = PlotKind(
    "level", _LEVELS, 100, Style.LINE, live_scale=(-100.0, 0.0), frame_step=0.1, of_means=decibel
)
FLOOR = PlotKind("floor", _LEVELS, 100, Style.LINE, _GROUND, live_scale=(-100.0, 0.0))
NOVELTY = PlotKind(
    "novelty", "Novelty: how doubtful labels are", 90, Style.LINE, _NEW, live_scale=(0.0, 1.0)
)
FEATURES = PlotKind(
    "features", "Features: 0 ({first}) to {end} ({last}), dark is low", 180, Style.HEAT_MAP
)
DIRECTION = PlotKind(
    "direction",
    "Direction of the sound, in degrees: 0 ahead, 90 left",
    110,
    Style.POINTS,
    _TOWARDS,
    scale=(-180.0, 180.0),
    of_means=_degrees,
)
PLOTS = (PROBABILITIES, LEVEL, FLOOR, DIRECTION, NOVELTY, FEATURES)  # in the order of the views


_ENERGY = "energy"
_SEGMENT_LINE = re.compile(r"^(\w+) for(?= [\d.]+ s \(\d+ %\)$)")
FIELDS = {
    message_types.FEATURES: ("header.stamp", "values"),
    message_types.LABEL: ("header.stamp", "novelty", "probabilities"),
    message_types.SEGMENT: ("header.stamp", "duration", "label", "confidence"),
    message_types.GAP: ("header.stamp", "duration", "reason"),
    message_types.DIRECTION: ("header.stamp", "azimuth", "confidence"),
    message_types.DIAGNOSTICS: ("header.stamp", "header.frame_id", "status"),
    message_types.LOG: ("stamp", "level", "msg"),
}
_KINDS = {"features", "label", "segment", "gap", "direction"}


class LaneRows(NamedTuple):
    """Logged spans of a lane: segments of a labelling (`RECORDER`), or gaps with their reasons."""

    kind: LaneKind
    microphone: str
    labelling: str
    spans: LabelledSpans
    unsure: Bool  # [shape=(n,)], which are segments of a low confidence


class StateRows(NamedTuple):
    """Health of a microphone, from the diagnostics."""

    microphone: str
    states: list[MicrophoneHealth]


Rows = Plot | LaneRows | StateRows | LogLines


def read_rows(path: Path, columns: Columns) -> Iterator[Rows]:
    """Extract the rows of lanes and plots from the messages, with `FIELDS`, of one topic.

    Raise `LogError` if a channel does not name its values, or names another number of them.
    """
    if not len(columns):
        return
    if columns.type == message_types.LOG:
        texts = np.array([worded(text) for text in columns["msg"]], object)
        yield LogLines(columns["stamp"], columns["level"], texts)
    elif columns.type == message_types.DIAGNOSTICS:
        by_microphone: dict[str, list[MicrophoneHealth]] = {}
        for state in microphone_states(columns):
            by_microphone.setdefault(state.microphone, []).append(state)
        for name, states in sorted(by_microphone.items()):
            yield StateRows(name, states)
    elif (topic := shown_topic(columns.topic)) is not None:
        yield from _microphone_rows(path, columns, topic.microphone, topic.labelling)


def worded(line: str) -> str:
    """Return a line about a segment, with the class name replaced by its lane's name."""
    return _SEGMENT_LINE.sub(lambda found: f"{in_words(found[1])} for", line)


def _microphone_rows(
    path: Path, columns: Columns, microphone: str, labelling: str
) -> Iterator[Plot | LaneRows]:
    times = columns["header.stamp"]
    match columns.type:
        case message_types.FEATURES:
            names, values = checked_array_names(path, columns, "values"), columns["values"]
            if _ENERGY in names:
                energy = values[:, [names.index(_ENERGY)]]
                yield Plot(LEVEL, microphone, "", ("level",), times, energy)
            yield Plot(FEATURES, microphone, "", names, times, values)
        case message_types.LABEL:
            names = checked_array_names(path, columns, "probabilities")
            yield Plot(PROBABILITIES, microphone, labelling, names, times, columns["probabilities"])
            novelty = columns["novelty"][:, np.newaxis]
            new = np.isfinite(novelty[:, 0])
            if new.any():
                yield Plot(NOVELTY, microphone, labelling, ("novelty",), times[new], novelty[new])
        case message_types.DIRECTION:
            towards = as_vectors(columns["azimuth"], columns["confidence"])
            yield Plot(DIRECTION, microphone, "", ("direction",), times, towards)
        case message_types.SEGMENT:
            spans = LabelledSpans(times, times + columns["duration"], columns["label"])
            unsure = columns["confidence"] < UNSURE_BELOW
            yield LaneRows(RECORDER, microphone, labelling, spans, unsure)
        case message_types.GAP:
            spans = LabelledSpans(times, times + columns["duration"], columns["reason"])
            yield LaneRows(GAPS, microphone, "", spans, np.zeros(len(spans), bool))


def shown_topic(name: str) -> TopicName | None:
    """Parse a topic shown in a timeline; None for any other topic.

    Marks are read from their layers, not shown by topic.
    """
    topic = parse_topic(name)
    if topic is None or topic.kind not in _KINDS or is_review(topic.labelling):
        return None
    return topic


def timeline_plots(timeline: Timeline) -> Iterator[Plot]:
    """Make the plots of a timeline, microphone by microphone in the order of `PLOTS`."""
    for microphone in timeline.microphones.values():
        for plot in microphone.plots.values():
            yield _shaded(plot) if plot.kind.style is Style.HEAT_MAP else plot


def _shades(values: NDArray[np.floating]) -> Float64:
    """Scale each column from its low values (0) to its high values (1); NaN stays."""
    present = values[~np.isnan(values).all(axis=1)]
    lowest = np.nanmin(present, axis=0)
    low, high = np.percentile(
        np.where(np.isnan(present), lowest, present), _HEAT_PERCENTILES, axis=0
    )
    return np.clip((values - low) / np.maximum(high - low, _TINY), 0.0, 1.0)


def _shaded(plot: Plot) -> Plot:
    """Scale each column from its low values (0) to its high values (1), and limit the rows."""
    present = ~np.isnan(plot.values[:, 0])
    times, values = plot.times[present], plot.values[present]
    if not len(times):
        return plot._replace(times=times, values=values)
    absent = np.isnan(values)  # where the logs have another feature set
    times, values = _thin(times, np.where(absent, np.nanmin(values, axis=0), values))
    return plot._replace(times=times, values=_shades(values))


def _thin(times: Int64, values: Float64) -> tuple[Int64, Float64]:
    """Average successive rows to at most `_HEAT_COLUMNS`."""
    size = -(-len(times) // _HEAT_COLUMNS)
    first = np.arange(0, len(times), size)
    sizes = np.diff(first, append=len(times))
    return times[first + sizes // 2], np.add.reduceat(values, first) / sizes[:, np.newaxis]
