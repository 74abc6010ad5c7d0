"""Lanes and plots of a timeline and of a watch: names, colours and values."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.accuracy.checked_minutes import (
    ClassCheck,
    checked_minutes,
    read_reviewed_labels,
)
from hearthlog.analyzer.colours import GAP, Colour, colour
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.spans import overlay
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.analyzer.review.timeline import (
    LabelledSpans,
    LabellingTimeline,
    MicrophoneTimeline,
    Timeline,
    no_spans,
)
from hearthlog.models.classes import OF_EVERY_SCENARIO, SILENCE, class_name, in_words, translation
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import (
    LIVE,
    RELABEL,
    is_review,
    is_scenario,
    review_labelling,
    scenario_name,
)

_TROUBLED: Colour = (240, 140, 40)
_TROUBLES = {"warning": _TROUBLED, "error": (230, 60, 60), "stale": (150, 90, 160)}
TROUBLES = tuple(_TROUBLES)  # texts of a live lane, by the level of a diagnostic status minus one
GAP_STATE = "not heard"


@dataclass(frozen=True)
class LaneKind:
    """Appearance of lanes of one kind; the viewer shows kinds in name order."""

    name: str
    colours: Callable[[Iterable[str]], dict[str, Colour]]  # by state
    states: Sequence[str] = ()  # announced to the viewer before they occur, for a watch


def _class_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: colour(state) for state in states}


def _trouble_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: _TROUBLES.get(state, _TROUBLED) for state in states}


RECORDER = LaneKind("Heard", _class_colours)
GAPS = LaneKind("Not_heard", lambda states: dict.fromkeys(states, GAP), [GAP_STATE])
TROUBLE = LaneKind("Trouble", _trouble_colours, TROUBLES)


def scenario_kind(labelling: str) -> LaneKind:
    """Return the lane kind of a scenario, whose segments appear once they are closed."""
    return LaneKind(labelling.replace("/", "_").capitalize(), _class_colours)


class StateChanges(NamedTuple):
    """Times at which a lane changes, and its new states.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    states : list of (str or None)
        None is no state.
    """

    times: Int64
    states: list[str | None]


class StateLane(NamedTuple):
    """Additions to a lane."""

    kind: LaneKind
    microphone: str
    changes: StateChanges


def state_changes(spans: LabelledSpans) -> StateChanges:
    """Convert spans into changes of a lane.

    Returns
    -------
    StateChanges
        Each span begins with its text, and ends with None unless the next one follows at once.
    """
    followed = np.append(spans.starts[1:], np.iinfo(np.int64).max)
    last = np.flatnonzero(spans.ends < followed)
    times = np.concatenate([spans.ends[last], spans.starts])
    states = [*[None] * len(last), *spans.texts]
    order = np.argsort(times, kind="stable")
    return StateChanges(times[order], [states[i] for i in order])


def disagreements(one: LabelledSpans, other: LabelledSpans) -> LabelledSpans:
    """Find the spans in which two labellings differ.

    Two names of one class (see `hearthlog.models.classes`) are no difference.

    Returns
    -------
    LabelledSpans
        With the labels of `other`; empty where only one of the two has a label.
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
NOT_HEARD = "Not heard"
_TROUBLE = "Trouble"
_RECURRING = "Recurs"
_VOICES = "Voices"
_LOOKED_AT: Colour = (58, 70, 92)
_MOST_LANES = 12  # of classes, if some were not heard at all


class Lane(NamedTuple):
    """A lane.

    Attributes
    ----------
    labelling : str
        The labelling it shows; empty for lanes shared by all labellings.
    """

    microphone: str
    labelling: str
    name: str
    spans: LabelledSpans
    colours: Mapping[str, Colour]


def timeline_lanes(timeline: Timeline) -> Iterator[Lane]:
    """Make the lanes of a timeline, microphone by microphone, from the top.

    Yields
    ------
    Lane
        For each labelling a lane for each class except silence: the class heard for the shortest
        time first, classes not heard last. Then the lanes shared by all labellings: each scenario,
        differences from the first labelling, reviewed spans (also of scenarios), gaps, and trouble.
    """
    for microphone in timeline.microphones.values():
        labellings = labellings_of(microphone)
        words = _classes(microphone, labellings)
        for one in labellings:
            for name, shade in words.items():
                spans = _of_class(one.spans, name)
                yield Lane(microphone.name, one.name, name, spans, {name: shade})
        yield from _beside(microphone, labellings)


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
    """Make the lane of reviewed spans.

    Parameters
    ----------
    scenario : str
        Its name; empty for the sounds of the home.
    """
    names = {text: in_words(text) for text in dict.fromkeys(marks.texts)}
    shades = {name: colour(text) for text, name in names.items()}
    texts = np.array([*[REVIEWED] * len(reviewed), *(names[t] for t in marks.texts)], object)
    starts = np.concatenate([reviewed.starts, marks.starts])
    ends = np.concatenate([reviewed.ends, marks.ends])
    spans = LabelledSpans(starts, ends, texts)
    name = f"{in_words(scenario)} reviewed" if scenario else REVIEWED
    return Lane(microphone, "", name, spans, {REVIEWED: _LOOKED_AT, **shades})


def _classes(
    microphone: MicrophoneTimeline, labellings: list[LabellingTimeline]
) -> dict[str, Colour]:
    """Return the displayed names of classes, the one heard for the shortest time first."""
    models = {name for one in labellings if one.probabilities for name in one.probabilities.names}
    known = {name for one in labellings for name in one.spans.texts} | models
    names = [name for name in microphone.classes if name in known and class_name(name) != SILENCE]
    seconds: Counter[str] = Counter()
    for one in labellings:
        for name in names:
            own = one.spans.texts == name
            seconds[in_words(name)] += int((one.spans.ends - one.spans.starts)[own].sum())
    shades = {in_words(name): colour(name) for name in reversed(names)}
    heard = sorted((name for name in shades if seconds[name]), key=lambda name: seconds[name])
    silent = [in_words(name) for name in names if not seconds[in_words(name)]]
    room = max(_MOST_LANES - len(heard), 0)
    return {name: shades[name] for name in dict.fromkeys([*heard, *silent[:room]])}


def _of_class(spans: LabelledSpans, name: str) -> LabelledSpans:
    labels = {text for text in dict.fromkeys(spans.texts) if in_words(text) == name}
    own = np.isin(spans.texts, list(labels)) if labels else np.zeros(len(spans), bool)
    return LabelledSpans(spans.starts[own], spans.ends[own], np.full(own.sum(), name, object))


def _beside(microphone: MicrophoneTimeline, labellings: list[LabellingTimeline]) -> Iterator[Lane]:
    for one in (each for each in microphone.labellings if is_scenario(each.name)):
        yield _scenario_lane(microphone.name, one)
    for other in labellings[1:]:
        spans = disagreements(labellings[0].spans, other.spans)
        shades = {in_words(text): colour(text) for text in dict.fromkeys(spans.texts)}
        texts = np.array([in_words(text) for text in spans.texts], object)
        name = f"{labelling_in_words(other.name)} differs"
        yield Lane(microphone.name, "", name, LabelledSpans(*spans[:2], texts), shades)
    for name, named in ((_RECURRING, microphone.recurring), (_VOICES, microphone.spoken)):
        if len(named):
            yield _named_lane(microphone.name, name, named)
    marks = {one.name: one.spans for one in microphone.labellings if is_review(one.name)}
    for scenario, looked_at in {"": microphone.reviewed, **microphone.reviewed_scenarios}.items():
        own = marks.get(review_labelling(scenario), no_spans())
        yield reviewed_lane(microphone.name, scenario, own, looked_at)
    kinds = (NOT_HEARD, microphone.gaps, GAP), (_TROUBLE, microphone.troubles, _TROUBLED)
    for name, spans, shade in kinds:
        if len(spans):
            texts = np.full(len(spans), name, object)
            named = LabelledSpans(*spans[:2], texts)
            yield Lane(microphone.name, "", name, named, {name: shade})


def _scenario_lane(microphone: str, labelling: LabellingTimeline) -> Lane:
    """Make one lane of all classes of a scenario, without spans that name none."""
    spans = scenario_sounds(labelling.spans)
    shades = {in_words(text): colour(text) for text in dict.fromkeys(spans.texts)}
    words = np.array([in_words(text) for text in spans.texts], object)
    own = LabelledSpans(*spans[:2], words)
    name = in_words(scenario_name(labelling.name))
    return Lane(microphone, "", name, own, shades)


def _named_lane(microphone: str, lane: str, named: LabelledSpans) -> Lane:
    names = {text: in_words(text) for text in dict.fromkeys(named.texts)}
    shades = {name: colour(text) for text, name in names.items()}
    texts = np.array([names[text] for text in named.texts], object)
    return Lane(microphone, "", lane, LabelledSpans(*named[:2], texts), shades)


Checked = Mapping[tuple[str, str], ClassCheck]  # by microphone and displayed class name
_AROUND = 28 * 86_400 * NANOSECONDS


def class_precision(timeline: Timeline, logs: HomeLogs) -> Checked:
    """Count the recorder's sounds, and the correct ones, in minutes drawn at random.

    Parameters
    ----------
    logs : HomeLogs
        Of its home; minutes up to four weeks before and after the timeline count.

    Returns
    -------
    mapping
        By microphone and displayed class name; without classes that have no sound in these minutes.
    """
    start, end = timeline.grid.start - _AROUND, timeline.grid.end + _AROUND
    near = read_reviewed_labels(logs, LIVE, start, end, [], {RANDOM})
    reviewed = [one for one in near if start <= one.span.start < end]
    checked: dict[tuple[str, str], ClassCheck] = {}
    for microphone in timeline.microphones:
        minutes = checked_minutes(one for one in reviewed if one.span.microphone == microphone)
        checks = ((name, minutes.check(name)) for name in minutes.labelled)
        checked |= {(microphone, in_words(name)): one for name, one in checks if one.labelled}
    return checked


_BRIGHT: Colour = (235, 215, 140)
_GROUND: Colour = (200, 120, 90)
_NEW: Colour = (160, 200, 255)
_TOWARDS: Colour = (150, 215, 150)
_HEAT_COLUMNS = 600  # maximum: each value is a square, which costs the viewer about ten kilobytes
_HEAT_PERCENTILES = (2, 98)
_TINY = np.finfo(np.float64).tiny


class Style(Enum):
    """Drawing of values: stacked bands (shares of one), dark to bright (0 to 1), line, points."""

    BANDS = auto()
    HEAT_MAP = auto()
    LINE = auto()
    POINTS = auto()


@dataclass(frozen=True)
class PlotKind:
    """Appearance of plots of one kind; they are shown in the order of `PLOTS`."""

    name: str  # of the entity
    # Title of the view, shared by all kinds with the same title. Placeholders: {first} and {last}
    # are names of columns, {end} is the last number.
    title: str
    height: int  # relative to other views
    style: Style
    colour: Colour = _BRIGHT  # of a line, or of points
    scale: tuple[float, float] | None = None  # None fits the values
    live_scale: tuple[float, float] | None = None  # replaces `scale` where values are added live

    @property
    def view(self) -> str:
        """Short name of the view."""
        return re.split("[:,]", self.title)[0]


SHARES = PlotKind("shares", "How probable each class is", 280, Style.BANDS, scale=(0.0, 1.0))
_LEVELS = "Level, and floor of the room, in dBFS"
LEVEL = PlotKind("level", _LEVELS, 100, Style.LINE, live_scale=(-100.0, 0.0))
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
)
PLOTS = (SHARES, LEVEL, FLOOR, DIRECTION, NOVELTY, FEATURES)


class Plot(NamedTuple):
    """A plot, or an addition to it: means over spans of time.

    Attributes
    ----------
    labelling : str
        Empty if the plot belongs to none.
    times : np.ndarray [shape=(n,)], int64
        Middles of the spans, in nanoseconds of UTC.
    values : np.ndarray [shape=(n, k)], float64
        NaN where nothing was recorded.
    length : int
        Of a span, in nanoseconds.
    """

    kind: PlotKind
    microphone: str
    labelling: str
    names: tuple[str, ...]
    times: Int64
    values: Float64
    length: int = NANOSECONDS

    @property
    def title(self) -> str:
        """Title of the plot's view."""
        last = len(self.names) - 1
        return self.kind.title.format(first=self.names[0], last=self.names[-1], end=last)

    @property
    def text(self) -> str:
        """Text next to the plot: its title, or the names of bands from the bottom."""
        if self.kind.style is not Style.BANDS:
            return self.title
        return f"From below: {', '.join(map(in_words, self.names))}"


def timeline_plots(timeline: Timeline) -> Iterator[Plot]:
    """Make the plots of a timeline, microphone by microphone in the order of `PLOTS`."""
    grid = timeline.grid
    times, length = grid.middles, grid.step
    for microphone in timeline.microphones.values():
        for kind, labelling, names, values in _values(microphone):
            rows = _shades(times, values) if kind is FEATURES else (times, values)
            yield Plot(kind, microphone.name, labelling, names, *rows, length)


def _values(
    microphone: MicrophoneTimeline,
) -> Iterator[tuple[PlotKind, str, tuple[str, ...], Float64]]:
    for one in microphone.labellings:
        if one.probabilities is not None:
            yield SHARES, one.name, *one.probabilities
    if microphone.level is not None:
        yield LEVEL, "", ("level",), microphone.level[:, np.newaxis]
    if microphone.floor is not None:
        yield FLOOR, "", ("floor",), microphone.floor[:, np.newaxis]
    if microphone.direction is not None:
        yield DIRECTION, "", ("direction",), microphone.direction[:, np.newaxis]
    for one in microphone.labellings:
        if one.novelty is not None:
            yield NOVELTY, one.name, (f"novelty, {one.name}",), one.novelty[:, np.newaxis]
    if microphone.features is not None:
        yield FEATURES, "", *microphone.features


def _shades(times: Int64, values: Float64) -> tuple[Int64, Float64]:
    """Scale each column from its low values (0) to its high values (1), and limit the rows."""
    present = ~np.isnan(values[:, 0])
    if not present.any():
        return times[:0], values[:0]
    times, values = times[present], values[present]
    absent = np.isnan(values)  # where the logs have another feature set
    times, values = _thin(times, np.where(absent, np.nanmin(values, axis=0), values))
    low, high = np.percentile(values, _HEAT_PERCENTILES, axis=0)
    return times, np.clip((values - low) / np.maximum(high - low, _TINY), 0.0, 1.0)


def _thin(times: Int64, values: Float64) -> tuple[Int64, Float64]:
    """Average successive rows to at most `_HEAT_COLUMNS`."""
    size = -(-len(times) // _HEAT_COLUMNS)
    first = np.arange(0, len(times), size)
    sizes = np.diff(first, append=len(times))
    return times[first + sizes // 2], np.add.reduceat(values, first) / sizes[:, np.newaxis]
