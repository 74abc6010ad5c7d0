"""What the logs of a home say: segments, with what a reviewer says; gaps; trouble."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.logs.health import Status, Trouble, gaps_of, statuses_of, troubles_of
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs
from hearthlog.analyzer.logs.selection import Selection, select
from hearthlog.analyzer.logs.spans import Spans, common, joined, one, remains
from hearthlog.analyzer.logs.typed_columns import is_compatible
from hearthlog.analyzer.marks.marks import Mark, read_marks
from hearthlog.models.classes import class_name
from hearthlog.models.classifiers.description import CLASS_NAME, class_metrics
from hearthlog.models.modelfile.card import DESCRIPTION
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import RELABEL_LAYER, REVIEW_LAYER, log_of_layer
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    DIAGNOSTICS,
    LIVE,
    labelling_topic,
    microphone_of,
    relabelling,
)
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.times import NANOSECONDS

_LATE = 12 * 3600 * NANOSECONDS  # a segment is in the log when it has ended, a long silence late
_LATEST = 1 << 61
_MOST_CLASSES = 100
_FIELDS = {"header.stamp", "duration", "label", "confidence"}
_OF_GAPS = {"header.stamp", "duration", "reason"}
Source = tuple[str, str]  # node, microphone


class Segments(NamedTuple):
    """What was heard by one microphone, in the order of time.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC; they do not overlap.
    labels : np.ndarray [shape=(n,)], str objects
    confidences : np.ndarray [shape=(n,)], float64
        1 where a person said it.
    """

    starts: Int64
    ends: Int64
    labels: NDArray[Any]
    confidences: NDArray[np.float64]

    @property
    def spans(self) -> Spans:
        """When something was heard."""
        return joined(self.starts, self.ends)


@dataclass
class Heard:
    """What was heard in a home.

    Attributes
    ----------
    segments : dict of (str, str) to Segments
        By node and microphone.
    known : dict of (str, str) to list of str
        By node and microphone: the classes that there may be.
    gaps, troubles : list of Trouble
        In the part of time that was to be looked at closely.
    precisions : dict of str to float
        How often the model was right with a class, by its own figures.
    nodes : list of str
    losses : list of str
        What could not be read, and why.
    """

    segments: dict[Source, Segments] = field(default_factory=dict)
    known: dict[Source, list[str]] = field(default_factory=dict)
    gaps: list[Trouble] = field(default_factory=list)
    troubles: list[Trouble] = field(default_factory=list)
    precisions: dict[str, float] = field(default_factory=dict)
    nodes: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)


def read_heard(
    shelf: HomeLogs,
    labelling: str,
    since: int,
    close: tuple[int, int],
    progress: Progress = ignore_progress,
) -> Heard:
    """Read what was heard.

    Parameters
    ----------
    shelf : HomeLogs
    labelling : str
        `live`, or the model of relabel layers.
    since : int
        From when on segments are wanted, in nanoseconds of UTC.
    close : (int, int)
        The days that are reported: of them gaps and troubles are wanted too.
    progress : callable, optional
        Is called with the share that is done.

    Raises
    ------
    DataError
        If there is no such labelling, or no label at all in these days.
    LogError
        If segments overlap, or cannot be.
    """
    layer = _layer(shelf, labelling)
    heard = Heard(losses=list(shelf.losses))
    near = shelf.between(*close)
    microphones = _look_closely(heard, near, close)
    _read_late_gaps(heard, shelf, close[1])
    name = labelling if labelling == LIVE else relabelling(labelling)
    topics = {labelling_topic(microphone, name, "segment") for microphone in microphones}
    found: dict[Source, list[Columns]] = {}
    wanted = shelf.between(since, close[1] + _LATE, layer)
    for i, entry in enumerate(wanted):
        for columns in _segments(heard, entry, topics, (since, close[1] + _LATE)):
            found.setdefault((entry.node, columns.topic.split("/")[1]), []).append(columns)
        progress((i + 1) / len(wanted))
    for source, parts in sorted(found.items()):
        heard.segments[source] = _in_order(source, parts)
    marks = _marks(heard, shelf.between(since, close[1], REVIEW_LAYER))
    for source, own in marks.items():
        before = heard.segments.get(source, _of_marks([]))
        heard.segments[source] = _corrected(before, _of_marks(own))
    _check(heard, shelf, labelling, close)
    _name_classes(heard, shelf.between(*close, layer), name)
    if labelling == LIVE:
        heard.precisions = _precisions(near)
    return heard


def _layer(shelf: HomeLogs, labelling: str) -> str:
    if labelling == LIVE:
        return ""
    if labelling not in shelf.layers:
        there = ", ".join([LIVE, *shelf.layers])
        raise DataError(f"no labelling {labelling[:64]!r} beside these logs; there is {there}")
    return RELABEL_LAYER + labelling


def _look_closely(heard: Heard, entries: Sequence[HomeLog], close: tuple[int, int]) -> set[str]:
    """Read gaps and diagnostics of the days that are reported, and return the microphones."""
    microphones: set[str] = set()
    nodes: dict[str, None] = {}
    said: list[Status] = []
    for entry in entries:
        try:
            selection = select([entry.path])
            gaps = _topics_of(selection, message_types.GAP, _OF_GAPS)
            health = _topics_of(selection, message_types.DIAGNOSTICS, {"status"})
            columns = read_columns([entry.path], {*gaps, *health}, *close)
        except LogError as error:
            _lose(heard, str(error))
            continue
        if not selection.logs and not _is_complete(entry.path):
            _lose(heard, f"{entry.path}: unfinished, and nothing of it is whole")
        if selection.unfinished:
            _lose(heard, f"unfinished, read up to the last whole chunk: {entry.path}")
        for topic in (*gaps, *_topics_of(selection, message_types.STREAM_INFO, ())):
            microphones |= {microphone_of(topic)} - {""}
        nodes |= dict.fromkeys(record["node"] for record in selection.metadata if "node" in record)
        for topic in set(gaps) & columns.keys():
            heard.gaps += gaps_of(entry.node, columns[topic])
        if DIAGNOSTICS in columns:
            said += statuses_of(columns[DIAGNOSTICS])
    heard.nodes = list(nodes)
    heard.troubles = list(troubles_of(said, close[1]))
    return microphones


def _is_complete(path: Path) -> bool:
    with LogFile(path) as file:
        return file.complete


def _read_late_gaps(heard: Heard, shelf: HomeLogs, end: int) -> None:
    """Read gaps that end after the days that are reported: they are in later logs."""
    later = [entry for entry in shelf.between(end, _LATEST) if entry.start >= end]
    for number, entry in enumerate(later):
        if number and entry.start > end + _LATE:
            return
        try:
            topics = _topics_of(select([entry.path]), message_types.GAP, _OF_GAPS)
            for columns in read_columns([entry.path], topics).values():
                heard.gaps += [gap for gap in gaps_of(entry.node, columns) if gap.start < end]
        except LogError:
            continue  # it is not of these days


def _topics_of(selection: Selection, kind: str, fields: Collection[str]) -> list[str]:
    channels = selection.channels.items()
    return [t for t, same in channels if all(is_compatible(*d, kind, fields) for d in same)]


def _segments(
    heard: Heard, entry: HomeLog, topics: set[str], limits: tuple[int, int]
) -> Iterator[Columns]:
    try:
        selection = select([entry.path])
        segments = topics.intersection(_topics_of(selection, message_types.SEGMENT, _FIELDS))
        for topic in topics & selection.channels.keys() - segments:
            kinds = {
                "" if schema is None else schema.name for _, schema in selection.channels[topic]
            }
            _lose(heard, f"{entry.path}: {topic} is of type {', '.join(sorted(kinds))}")
        yield from read_columns([entry.path], segments, *limits, fields=_FIELDS).values()
    except LogError as error:
        _lose(heard, str(error))


def _in_order(source: Source, parts: Sequence[Columns]) -> Segments:
    """Join the segments of a microphone.

    Raises
    ------
    LogError
        If they overlap, or cannot be.
    """
    starts, lasting, labels, confidences = (
        np.concatenate([columns[name] for columns in parts])
        for name in ("header.stamp", "duration", "label", "confidence")
    )
    order = np.argsort(starts, kind="stable")
    order = order[lasting[order] > 0]
    starts, ends = starts[order], (starts + lasting)[order]
    name = parts[0].topic
    if len(starts) and (starts[0] < 0 or starts[-1] > _LATEST):
        raise LogError(f"{name}: has segments at times that cannot be")
    if (starts[1:] < ends[:-1]).any():
        raise LogError(
            f"{name}: segments of {source[0] or 'a microphone'} overlap; is a log there twice, or "
            "those of two homes? name the folder of one"
        )
    return Segments(starts, ends, _known(name, labels[order]), _chances(confidences[order]))


def _known(topic: str, labels: NDArray[Any]) -> NDArray[Any]:
    """Give each class one name, whatever logs call it; raise LogError if one cannot be."""
    names = {label: class_name(label) for label in set(labels.tolist())}
    if len(names) > _MOST_CLASSES:
        raise LogError(f"{topic}: has {len(names)} different labels; no classifier has so many")
    for label in names:
        if not CLASS_NAME.fullmatch(label):
            raise LogError(f"{topic}: {label[:64]!r} cannot be the name of a class")
    return np.array([names[label] for label in labels.tolist()], object)


def _chances(confidences: NDArray[Any]) -> NDArray[np.float64]:
    return np.clip(np.nan_to_num(confidences.astype(np.float64)), 0.0, 1.0)


def _marks(heard: Heard, layers: Iterable[HomeLog]) -> dict[Source, list[Mark]]:
    found: dict[Source, list[Mark]] = {}
    for entry in layers:
        try:
            for mark in read_marks(log_of_layer(entry.path)):
                found.setdefault((entry.node, mark.microphone), []).append(mark)
        except LogError as error:
            _lose(heard, str(error))
    return found


def _of_marks(marks: Sequence[Mark]) -> Segments:
    ordered = sorted(marks, key=lambda mark: mark.start)
    return Segments(
        np.array([mark.start for mark in ordered], np.int64),
        np.array([mark.end for mark in ordered], np.int64),
        np.array([class_name(mark.label) for mark in ordered], object),
        np.ones(len(ordered)),
    )


def _corrected(segments: Segments, marks: Segments) -> Segments:
    """Put what a person says in the place of what a model said."""
    left, rows = remains(segments, marks.spans)
    starts = np.concatenate([left.starts, marks.starts])
    order = np.argsort(starts, kind="stable")
    return Segments(
        starts[order],
        np.concatenate([left.ends, marks.ends])[order],
        np.concatenate([segments.labels[rows], marks.labels])[order],
        np.concatenate([segments.confidences[rows], marks.confidences])[order],
    )


def _check(heard: Heard, shelf: HomeLogs, labelling: str, close: tuple[int, int]) -> None:
    """Raise DataError unless something was heard in the days that are reported."""
    if any(common(segments.spans, one(*close)).length for segments in heard.segments.values()):
        return
    if labelling != LIVE:
        advice = f"`hearthlog relabel LOGS --model {labelling}.safetensors` makes them"
    elif shelf.layers:
        advice = f"there is --labels {' or '.join(shelf.layers)}"
    else:
        advice = "`hearthlog relabel LOGS --model MODEL`, then --labels with the name of the model"
    loss = f"; {heard.losses[0]}" if heard.losses else ""
    raise DataError(f"no labels of {labelling} in the logs of that time: {advice}{loss}")


def _name_classes(heard: Heard, entries: Iterable[HomeLog], labelling: str) -> None:
    """Find which classes there may be: those that logs name, and those that there are."""
    names: dict[Source, dict[str, None]] = {source: {} for source in heard.segments}
    for entry in entries:
        try:
            selection = select([entry.path])
        except LogError:
            continue  # it has been named
        for node, microphone in heard.segments:
            topic = labelling_topic(microphone, labelling, "label")
            for channel, _ in selection.channels.get(topic, ()) if node == entry.node else ():
                said = array_names(channel.metadata, "probabilities")
                names[node, microphone] |= dict.fromkeys(said)
    for source, segments in heard.segments.items():
        names[source] |= dict.fromkeys(sorted(set(segments.labels.tolist())))
        sound = [class_name(name) for name in names[source] if CLASS_NAME.fullmatch(name)]
        heard.known[source] = list(dict.fromkeys(sound))[:_MOST_CLASSES]


def _precisions(entries: Iterable[HomeLog]) -> dict[str, float]:
    """Read from the models that logs name how often a class was right; the last log counts."""
    found: Mapping[str, float] = {}
    for entry in entries:
        try:
            found = {**found, **_precisions_of(entry.path)}
        except LogError:
            continue  # it has been named
    return dict(found)


def _precisions_of(path: Path) -> dict[str, float]:
    with LogFile(path) as file:
        places = [place for place in file.record_locations if place.opcode == Opcode.ATTACHMENT]
        records = [file.record(place) for place in places]
    texts = [r.data for r in records if isinstance(r, Attachment) and r.name == DESCRIPTION]
    precisions: dict[str, float] = {}
    for text in texts:
        for label, metrics in class_metrics(text).items():
            name = class_name(label)
            precisions[name] = min(precisions.get(name, 1.0), metrics.precision)
    return precisions


def _lose(heard: Heard, line: str) -> None:
    if line not in heard.losses:
        heard.losses.append(line)
