"""Scores of a labelled log against a reference labelling of the same time."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.event_counts import events_of
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import (
    Detections,
    Events,
    detect,
    indexed_events,
    laid_out,
)
from hearthlog.analyzer.logs.labelling import SEGMENT_FIELDS, Labelling, all_classes, labelling_of
from hearthlog.analyzer.logs.layers import find_coverage, with_layers
from hearthlog.analyzer.logs.selection import LogSelection, array_names, select
from hearthlog.analyzer.logs.spans import Spans, intersection, intersection_rows, joined
from hearthlog.analyzer.marks.label_files import read_lines
from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.analyzer.training.scores import Scores, score
from hearthlog.models.classes import SILENCE, ordered
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import REVIEW, microphone_of, parse_topic, scenario_name

_BLOCK = 300 * NANOSECONDS
_MOST_BLOCKS = 1000
_LATEST = 1 << 62  # nanoseconds


@dataclass(frozen=True)
class LogEvaluation:
    """Scores of a labelled log against a reference."""

    # of frames of 50 ms; the groups are blocks of five minutes, or more in long references
    scores: Scores
    detections: Detections
    reference_seconds: float  # labelled by the reference
    evaluated_seconds: float  # labelled by both
    # evaluated seconds with two reference labels; excluded from frame scores
    ambiguous_seconds: float
    # evaluated seconds by reference label outside the log's classes; excluded from frame
    # scores; any prediction there is a false alarm
    unknown_labels: Mapping[str, float]
    events: Mapping[str, "EventCount"]  # of the classes that occur in the evaluated time


class EventCount(NamedTuple):
    """Events of a class: spans, merged across pauses of at most ten seconds."""

    reference: int
    labelled: int


def evaluate_labelling(
    reference: Labelling, predicted: Labelling, classes: Sequence[str]
) -> LogEvaluation:
    """Compare labels where both the reference and the log have some.

    Raise `DataError` if the two have no time in common, if the reference has no label in the log's
    classes or no frame with a single label, or if too many events start together for a labelling.
    """
    covered = joined(reference.starts, reference.ends, FRAME_NANOSECONDS)
    spans = intersection(covered, joined(predicted.starts, predicted.ends, FRAME_NANOSECONDS))
    if not spans.length:
        raise DataError(
            f"the reference ({_between(reference)}) and what is labelled in the log "
            f"({_between(predicted)}) have no time in common"
        )
    reference = reference.called_as(classes)
    names = [*classes, *sorted(set(reference.labels) - set(classes))]
    target, output = (
        laid_out(indexed_events(each, names), spans) for each in (reference, predicted)
    )
    lengths = np.bincount(target.labels, target.ends - target.starts, len(names)) / NANOSECONDS
    unknown = {
        name: float(length)
        for name, length in zip(names[len(classes) :], lengths[len(classes) :], strict=True)
        if length
    }
    named = target.select(target.labels < len(classes))
    if not len(named):
        raise DataError(
            f"the reference has none of the labels of the log ({', '.join(classes)}) where they "
            f"have time in common, but {', '.join(unknown)[:200]}"
        )
    scores, ambiguous = _frames(target, output, classes)
    return LogEvaluation(
        scores=scores,
        detections=detect(named, output, classes, spans.length),
        reference_seconds=covered.length / NANOSECONDS,
        evaluated_seconds=spans.length / NANOSECONDS,
        ambiguous_seconds=ambiguous * FRAME_NANOSECONDS / NANOSECONDS,
        unknown_labels=unknown,
        events=_event_counts(reference, predicted, spans),
    )


def _event_counts(
    reference: Labelling, predicted: Labelling, spans: Spans
) -> dict[str, EventCount]:
    """Count the events of each class, as the report does."""

    def counts(labelling: Labelling) -> Counter[str]:
        inside, rows, _ = intersection_rows(labelling, spans)
        within = Labelling(inside.starts, inside.ends, labelling.labels[rows])
        names = set(within.labels) - {SILENCE}
        return Counter({name: len(events_of(within, name).starts) for name in names})

    sides = counts(reference), counts(predicted)
    names = ordered(set(sides[0] | sides[1]))
    return {name: EventCount(*(side[name] for side in sides)) for name in names}


def _frames(
    reference: Events, predicted_events: Events, classes: Sequence[str]
) -> tuple[Scores, int]:
    """Score the frames; also return the number of frames with several reference labels.

    Labels are constant between two successive change times, so frames are counted, not created.
    """
    end = int(reference.ends.max())
    block = max(_BLOCK, -(-end // _MOST_BLOCKS))
    edges = [times for each in (reference, predicted_events) for times in (each.starts, each.ends)]
    times = np.unique(np.concatenate([*edges, np.arange(0, end + block, block)]))
    target, several = _single(reference, times, len(classes))
    predicted, _ = _single(predicted_events, times, len(classes))
    # A frame belongs to the interval that contains its middle.
    weight = np.diff((times + FRAME_NANOSECONDS // 2 - 1) // FRAME_NANOSECONDS)
    ambiguous = int(weight[several & (predicted >= 0)].sum())
    rows = (target >= 0) & (target < len(classes)) & ~several & (predicted >= 0) & (weight > 0)
    group = times[:-1][rows] // block
    return score(target[rows], predicted[rows], group, classes, weight[rows]), ambiguous


def _single(events: Events, times: Int64, classes: int) -> tuple[Int64, Bool]:
    """Return the label between successive times, and where there are several.

    -1 means no label; the number of classes means a label outside the classes.
    """
    events = replace(events, labels=np.minimum(events.labels, classes))
    label = np.full(len(times) - 1, -1)
    count = np.zeros(len(times) - 1, np.int64)
    for value in np.unique(events.labels).tolist():
        same = events.of(value)
        change = np.bincount(np.searchsorted(times, same.starts), minlength=len(times))
        change -= np.bincount(np.searchsorted(times, same.ends), minlength=len(times))
        active = np.cumsum(change)[:-1] > 0
        label[active] = value
        count += active
    return label, count > 1


def _between(labelling: Labelling) -> str:
    first, last = (
        np.datetime64(int(t) // NANOSECONDS, "s")
        for t in (labelling.starts.min(), labelling.ends.max())
    )
    return f"{first}Z to {last}Z"


@dataclass(frozen=True)
class TopicLabelling:
    """Labelling of some logs from one topic of segments."""

    topic: str
    classes: tuple[str, ...]  # possible labels
    labelling: Labelling
    unfinished: tuple[Path, ...]  # incomplete logs

    @property
    def microphone(self) -> str:
        """Name of the microphone."""
        return microphone_of(self.topic)

    @property
    def scenario(self) -> str:
        """Name of the scenario; empty for the sounds of the home."""
        parts = parse_topic(self.topic)
        return "" if parts is None else scenario_name(parts.labelling)


def read_labelling(path: Path, topic: str | None = None) -> TopicLabelling:
    """Read the segments of a log, or of a folder of logs, and of their layers.

    The topic, such as `/mic/segment`, is by default that of the only microphone. `Labellings.read`
    skips a damaged log; here it is an error, because scores would not show the gap. Raise
    `LogError` if there is no log, if one is damaged, if there are no such segments, if they
    overlap, or if `topic` is None and there are several microphones.
    """
    selection = select(with_layers(path))
    topic = _segment_topic(selection, topic)
    columns = read_columns(selection.logs, {topic}, fields=SEGMENT_FIELDS).get(topic)
    if columns is None or not (columns["duration"] > 0).any():
        raise LogError(f"{path}: there is no segment on {topic}")
    labelling = labelling_of(columns)
    channels = selection.channels.get(f"{topic.removesuffix('/segment')}/label", ())
    named = [array_names(channel.metadata, "probabilities") for channel, _ in channels]
    classes = all_classes(topic, named, labelling.labels)
    return TopicLabelling(topic, classes, labelling, tuple(selection.unfinished))


def _segment_topic(selection: LogSelection, requested: str | None) -> str:
    """Find the topic of a recorder's segments."""
    topics = sorted(selection.topics_of(message_types.SEGMENT, SEGMENT_FIELDS))
    recorded = [topic for topic in topics if topic.count("/") == 2]
    if not topics:
        raise LogError("no segments; if the log was recorded without a model, relabel it with one")
    if requested is None and len(recorded) != 1:
        raise LogError(f"choose one with --topic: {', '.join(topics)}")
    topic = recorded[0] if requested is None else requested
    if topic not in topics:
        raise LogError(f"{topic}: no such segments; there are {', '.join(topics)}")
    return topic


def read_reference(source: str, path: Path, microphone: str, scenario: str = "") -> Labelling:
    """Read the reference for a log.

    The scenario of the marks in the review layers is empty for the sounds of the home. Raise
    `DataError` if there is no such file, it is no label file, it has no label of the microphone or
    a time that no log has, the logs have no features, or nobody has reviewed them; `LogError` if
    there is no log, or a log or a layer is damaged.
    """
    if source == REVIEW:
        marks = [mark for log in find_logs(path) for mark in read_marks(log, scenario)]
        of, option = (f"{scenario} of ", f" --scenario {scenario}") if scenario else ("", "")
        do = f"`hearthlog annotate import{option}` does it"
        where = f"{path}: nothing of {of}{microphone} is reviewed; {do}"
    else:
        marks = [mark for _, mark in read_lines(Path(source), find_coverage(path), microphone)]
        where = f"{source}: has no label of {microphone}"
    marks = [mark for mark in marks if mark.microphone == microphone]
    if not marks:
        raise DataError(where)
    if max(abs(time) for mark in marks for time in (mark.start, mark.end)) > _LATEST:
        raise DataError(f"{source}: has a time that no log has")
    starts, ends, labels = zip(*((m.start, m.end, m.label) for m in marks), strict=True)
    return Labelling(np.array(starts), np.array(ends), np.array(labels, object))
