"""Log data of a home for a report: reviewed segments, gaps, troubles, and scenario minutes."""

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from hearthlog.analyzer.activity.checked_minutes import labelling_of_marks
from hearthlog.analyzer.activity.doubtful_sounds import without_too_doubtful
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.hidden_classes import common_names_of
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs
from hearthlog.analyzer.logs.labelling import (
    MOST_CLASSES,
    Labelling,
    all_classes,
    check_labelling,
    labelling_of,
    overlaid,
    unified,
)
from hearthlog.analyzer.logs.recorder_info import Trouble, gaps_of, troubles_of
from hearthlog.analyzer.logs.selection import LogSelection, array_names, select
from hearthlog.analyzer.logs.spans import NONE, SEGMENT_DELAY, Spans, cut, joined
from hearthlog.analyzer.marks.label_files import find_class_names
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, read_marks, read_reviewed
from hearthlog.models.classes import (
    CLASS_NAME,
    OF_EVERY_SCENARIO,
    OTHER,
    SILENCE,
    TELEVISION,
    UNKNOWN,
    class_name,
    ordered,
)
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, join, read_columns
from hearthlog.schemas.logs.contents import Status, statuses_of
from hearthlog.schemas.logs.files import RELABEL_LAYER, REVIEW_LAYER, log_of_layer
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    DIAGNOSTICS,
    LIVE,
    SCENARIO,
    is_scenario,
    labelling_topic,
    microphone_of,
    parse_topic,
    relabelling,
)

_FIELDS = {"header.stamp", "duration", "label"}
_SEGMENT_FIELDS = {*_FIELDS, "confidence"}
_OF_GAPS = {"header.stamp", "duration", "reason"}
Source = tuple[str, str]  # node, microphone


@dataclass
class HomeData:
    """Data from the logs of a home."""

    # by node and microphone: the labelling, without and with corrections
    labelled: dict[Source, Labelling] = field(default_factory=dict)
    segments: dict[Source, Labelling] = field(default_factory=dict)
    gone_through: dict[Source, Spans] = field(default_factory=dict)  # reviewed spans
    # by node and microphone: possible classes
    classes: dict[Source, list[str]] = field(default_factory=dict)
    # within the reported days
    gaps: list[Trouble] = field(default_factory=list)
    troubles: list[Trouble] = field(default_factory=list)
    nodes: list[str] = field(default_factory=list)
    hidden: frozenset[str] = frozenset()  # classes that are not in `classes` for that
    losses: list[str] = field(default_factory=list)  # read errors with reasons

    def lose(self, line: str) -> None:
        """Record a read error once."""
        if line not in self.losses:
            self.losses.append(line)


def read_home(
    logs: HomeLogs,
    labelling: str,
    since: int,
    close: tuple[int, int],
    progress: Progress = ignore_progress,
) -> HomeData:
    """Read the data of a report, with segments from log time `since` (nanoseconds of UTC) on.

    Gaps and troubles are read only for the reported days, `close` (start and end, in nanoseconds of
    UTC). `progress` receives the share of the logs read, 0 to 1.

    Raise `DataError` if the labelling does not exist, or has no label in these days; `LogError` if
    segments overlap, begin before 1970, are of different types, or have too many labels.
    """
    layer = _layer(logs, labelling)
    home = HomeData(losses=list(logs.losses))
    near = logs.between(*close)
    microphones = _look_closely(home, near, close)
    _read_late_gaps(home, logs, close[1])
    name = labelling if labelling == LIVE else relabelling(labelling)
    topics = {labelling_topic(microphone, name, "segment") for microphone in microphones}
    parts: dict[Source, list[Columns]] = {}
    labelled = logs.between(since, close[1] + SEGMENT_DELAY, layer)
    for i, entry in enumerate(labelled):
        for columns in _segments(home, entry, topics, (since, close[1] + SEGMENT_DELAY)):
            parts.setdefault((entry.node, microphone_of(columns.topic)), []).append(columns)
        progress((i + 1) / len(labelled))
    for source in sorted(parts):
        home.labelled[source] = home.segments[source] = _labelling(home, parts[source])
    marks, reviewed = _reviews(home, logs.between(since, close[1], REVIEW_LAYER), labelling)
    for source in sorted(marks.keys() | reviewed.keys()):
        labels = home.labelled.setdefault(source, labelling_of_marks([]))
        home.segments[source] = overlaid(labels, labelling_of_marks(marks[source]))
        through: list[Mark | ReviewedSpan] = [*marks[source], *reviewed[source]]
        starts, ends = np.array([(span.start, span.end) for span in through]).T
        home.gone_through[source] = joined(starts, ends)
    _check(home, logs, labelling, close)
    _name_classes(home, logs.between(*close, layer), name)
    for source, labels in home.segments.items():
        reviewed_spans = home.gone_through.get(source, NONE)
        home.segments[source] = without_too_doubtful(labels, reviewed_spans)
    try:
        home.hidden = logs.hidden_classes()
    except LogError as error:
        home.lose(str(error))
    home.classes = {
        source: [each for each in classes if each not in home.hidden]
        for source, classes in home.classes.items()
    }
    return home


def _layer(logs: HomeLogs, labelling: str) -> str:
    if labelling == LIVE:
        return ""
    if labelling not in logs.layers:
        there = ", ".join([LIVE, *logs.layers])
        raise DataError(f"no labelling {labelling[:64]!r} beside these logs; there is {there}")
    return RELABEL_LAYER + labelling


def _look_closely(home: HomeData, entries: Sequence[HomeLog], close: tuple[int, int]) -> set[str]:
    """Read gaps and diagnostics of the reported days; return the microphones."""
    microphones: set[str] = set()
    nodes: dict[str, None] = {}
    statuses: list[Status] = []
    for entry in entries:
        try:
            selection = select([entry.path])
            gaps = selection.topics_of(message_types.GAP, _OF_GAPS)
            health = selection.topics_of(message_types.DIAGNOSTICS, {"status"})
            columns = read_columns([entry.path], {*gaps, *health}, *close)
        except LogError as error:
            home.lose(str(error))
            continue
        _lose_unfinished(home, entry, selection)
        for topic in (*gaps, *selection.topics_of(message_types.STREAM_INFO, ())):
            microphones |= {microphone_of(topic)} - {""}
        nodes |= dict.fromkeys(record["node"] for record in selection.metadata if "node" in record)
        for topic in sorted(set(gaps) & columns.keys()):
            home.gaps += gaps_of(entry.node, columns[topic])
        if DIAGNOSTICS in columns:
            statuses += statuses_of(columns[DIAGNOSTICS])
    home.nodes = list(nodes)
    home.troubles = list(troubles_of(statuses, close[1]))
    return microphones


def _read_late_gaps(home: HomeData, logs: HomeLogs, end: int) -> None:
    """Read gaps that end after the reported days, from later logs."""
    later = [entry for entry in logs.between(end) if entry.start >= end]
    for number, entry in enumerate(later):
        if number and entry.start > end + SEGMENT_DELAY:
            return
        try:
            topics = select([entry.path]).topics_of(message_types.GAP, _OF_GAPS)
            for columns in read_columns([entry.path], topics).values():
                home.gaps += [gap for gap in gaps_of(entry.node, columns) if gap.start < end]
        except LogError:
            continue  # outside the reported days


def _lose_unfinished(home: HomeData, entry: HomeLog, selection: LogSelection) -> None:
    if selection.unfinished and not selection.logs:
        home.lose(f"{entry.path}: unfinished, and nothing of it is whole")
    elif selection.unfinished:
        home.lose(f"unfinished, read up to the last whole chunk: {entry.path}")


def _segments(
    home: HomeData, entry: HomeLog, topics: set[str], limits: tuple[int, int]
) -> Iterator[Columns]:
    try:
        selection = select([entry.path])
        if entry.layer:
            _lose_unfinished(home, entry, selection)
        segments = topics.intersection(selection.topics_of(message_types.SEGMENT, _FIELDS))
        for topic in sorted(topics & selection.channels.keys() - segments):
            kinds = {
                "" if schema is None else schema.name for _, schema in selection.channels[topic]
            }
            home.lose(f"{entry.path}: {topic} is of type {', '.join(sorted(kinds))}")
        for columns in read_columns(
            [entry.path], segments, *limits, fields=_SEGMENT_FIELDS
        ).values():
            names = common_names_of(entry.path, columns["label"])
            own = np.array([names.get(label, label) for label in columns["label"]], object)
            yield replace(columns, fields=columns.fields | {"label": own}) if names else columns
    except LogError as error:
        home.lose(str(error))


def _labelling(home: HomeData, parts: Sequence[Columns]) -> Labelling:
    """Join the segments of a microphone, with one name per class across logs."""
    segments = join(parts)
    labels = _as_classes(home, segments.topic, unified(labelling_of(segments)))
    classes = all_classes(segments.topic, (), labels.labels)
    check_labelling(segments.topic, labels.starts, classes)
    return labels


def _as_classes(home: HomeData, topic: str, labels: Labelling) -> Labelling:
    """Map labels that are not valid class names to the nearest valid names."""
    odd = sorted(label for label in set(labels.labels) if not CLASS_NAME.fullmatch(label))
    if not odd:
        return labels
    near = find_class_names(odd, None).folded
    names = {label: near.get(label, OTHER) for label in odd}
    more = f", and {len(odd) - 1} more so" if len(odd) > 1 else ""
    home.lose(f"{topic}: {odd[0][:64]!r} is called {names[odd[0]]} here{more}: no name of a class")
    return labels.renamed(names)


def _reviews(
    home: HomeData, layers: Iterable[HomeLog], labelling: str
) -> tuple[dict[Source, list[Mark]], dict[Source, list[ReviewedSpan]]]:
    """Read marks and reviewed spans of a labelling; sources without any have empty lists."""
    marks: defaultdict[Source, list[Mark]] = defaultdict(list)
    reviewed: defaultdict[Source, list[ReviewedSpan]] = defaultdict(list)
    for entry in layers:
        try:
            log = log_of_layer(entry.path)
            for mark in read_marks(log):
                marks[entry.node, mark.microphone].append(mark)
            for span in read_reviewed(log):
                if span.corrects == labelling:
                    reviewed[entry.node, span.microphone].append(span)
        except LogError as error:
            home.lose(str(error))
    return marks, reviewed


def _check(home: HomeData, logs: HomeLogs, labelling: str, close: tuple[int, int]) -> None:
    """Raise DataError unless the reported days have labels."""
    if any(cut(labels.spans(), *close).length for labels in home.segments.values()):
        return
    if labelling != LIVE:
        advice = f"`hearthlog relabel LOGS --model {labelling}.safetensors` makes them"
    elif logs.layers:
        advice = f"there is --labels {' or '.join(logs.layers)}"
    else:
        advice = "`hearthlog relabel LOGS --model MODEL`, then --labels with the name of the model"
    loss = f"; {home.losses[0]}" if home.losses else ""
    raise DataError(f"no labels of {labelling} in the logs of that time: {advice}{loss}")


def _name_classes(home: HomeData, entries: Iterable[HomeLog], labelling: str) -> None:
    """Set the possible classes: the classes named by logs, and the labelled ones.

    Classes with marks only are excluded, since no model can label them elsewhere, unless nothing is
    labelled.
    """
    names: dict[Source, dict[str, None]] = {source: {} for source in home.segments}
    for entry in entries:
        try:
            selection = select([entry.path])
        except LogError:
            continue  # already named
        for node, microphone in home.segments:
            topic = labelling_topic(microphone, labelling, "label")
            for channel, _ in selection.channels.get(topic, ()) if node == entry.node else ():
                own = array_names(channel.metadata, "probabilities")
                common = common_names_of(entry.path, own)
                names[node, microphone] |= dict.fromkeys(common.get(n, n) for n in own)
    for source, segments in home.segments.items():
        labels = set(home.labelled[source].labels.tolist()) or set(segments.labels.tolist())
        names[source] |= dict.fromkeys(sorted(labels))
        classes = [class_name(name) for name in names[source] if CLASS_NAME.fullmatch(name)]
        home.classes[source] = list(dict.fromkeys(classes))[:MOST_CLASSES]


_MINUTE = 60 * NANOSECONDS
_MOST_CLASSES = 256

# By scenario name: for each day, the minutes of each class.
ScenarioMinutes = Mapping[str, Sequence[Mapping[str, float]]]


def read_scenario_minutes(
    logs: HomeLogs,
    days: Sequence[tuple[int, int]],
    lose: Callable[[str], None],
    hidden: Collection[str] = (),
) -> ScenarioMinutes:
    """Read the duration of each scenario class, over all microphones.

    `days` have starts and ends in nanoseconds of UTC, in time order.
    """
    found: dict[str, list[Counter[str]]] = {}
    left_out = OF_EVERY_SCENARIO.union(hidden)
    start, end = days[0][0], days[-1][1]
    for entry in logs.between(start, end + SEGMENT_DELAY):
        try:
            selection = select([entry.path])
            topics = [
                topic
                for topic in selection.topics_of(message_types.SEGMENT, _FIELDS)
                if (name := parse_topic(topic)) is not None and is_scenario(name.labelling)
            ]
            columns = read_columns([entry.path], topics, start, end + SEGMENT_DELAY, _FIELDS)
        except LogError as error:
            lose(str(error))
            continue
        for topic in topics:
            scenario = topic.partition(f"/{SCENARIO}/")[2].partition("/")[0]
            own = found.setdefault(scenario, [Counter() for _ in days])
            if topic in columns:
                _add(own, columns[topic], days, left_out)
    return {name: found[name] for name in sorted(found)}


def _add(
    minutes: list[Counter[str]],
    columns: Columns,
    days: Sequence[tuple[int, int]],
    left_out: Collection[str],
) -> None:
    starts, ends = columns["header.stamp"], columns["header.stamp"] + columns["duration"]
    names, numbers = np.unique(columns["label"], return_inverse=True)
    for counted, (begin, end) in zip(minutes, days, strict=True):
        lengths = np.maximum(np.minimum(ends, end) - np.maximum(starts, begin), 0)
        sums = np.bincount(numbers, lengths, len(names)) / _MINUTE
        for name, length in zip(names.tolist(), sums.tolist(), strict=True):
            has_room = name in counted or len(counted) < _MOST_CLASSES
            if length and has_room and class_name(name) not in left_out:
                counted[name] += length


_NO_EVENTS = {SILENCE, TELEVISION, UNKNOWN}


def marked_classes(data: HomeData) -> list[str]:
    """Return the classes that have marks of people only, because the model does not know them.

    A report has no row for them, because they are not complete.
    """
    marked = {name for own in data.segments.values() for name in np.unique(own.labels).tolist()}
    labelled = set(chain.from_iterable(data.classes.values()))
    return ordered(marked - labelled - data.hidden - _NO_EVENTS)
