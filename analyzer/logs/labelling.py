"""Labellings: labelled spans of time by a recorder, a model or a reviewer."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import find_with_layers
from hearthlog.analyzer.logs.selection import LogSelection, array_names, select
from hearthlog.analyzer.logs.spans import (
    NEVER,
    Rows,
    Spans,
    difference_rows,
    intersection_rows,
    joined,
    single_span,
)
from hearthlog.models.classes import CLASS_NAME, class_name, translation
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.logs.columns import Columns, join, read_columns
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    RELABEL,
    TopicName,
    labelling_topic,
    parse_topic,
    relabelling,
    scenario_labelling,
)

SEGMENT_FIELDS = {"header.stamp", "duration", "label"}
MOST_CLASSES = 100


@dataclass(frozen=True)
class Labelling:
    """Labelled spans of time.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        Nanoseconds of UTC; every end is after its start.
    labels : np.ndarray [shape=(n,)] of str
    confidences : np.ndarray [shape=(n,)], float32
        0 to 1; 1 where none is known, such as of marks.
    """

    starts: Int64
    ends: Int64
    labels: NDArray[np.object_]
    confidences: Float32 = field(default_factory=lambda: np.empty(0, np.float32))

    def __post_init__(self) -> None:
        if len(self.confidences) != len(self.starts):
            object.__setattr__(self, "confidences", np.ones(len(self.starts), np.float32))

    def __len__(self) -> int:
        return len(self.starts)

    def rows(self, which: Bool | Rows) -> "Labelling":
        """Select spans."""
        return Labelling(
            self.starts[which], self.ends[which], self.labels[which], self.confidences[which]
        )

    def spans(self, which: Bool | None = None, pause: int = 0) -> Spans:
        """Return the time of all labels, or of the chosen ones, with pauses up to a length closed.

        The pause is in nanoseconds.
        """
        own = self if which is None else self.rows(which)
        return joined(own.starts, own.ends, pause)

    def called_as(self, classes: Sequence[str]) -> "Labelling":
        """Rename labels to the equivalent names in a list of classes.

        Parameters
        ----------
        classes : sequence of str
            A label with the same meaning as exactly one of these gets its name; other labels stay.
        """
        return self.renamed(translation(set(self.labels), classes))

    def renamed(self, names: Mapping[str, str]) -> "Labelling":
        """Rename some labels; the others stay."""
        labels = [names.get(label, label) for label in self.labels]
        return replace(self, labels=np.array(labels, object))


def overlaid(labels: Labelling, above: Labelling) -> Labelling:
    """Overlay a labelling on another one; the upper labels replace the lower ones."""
    left, rows = difference_rows(labels, above.spans())
    return in_order([Labelling(*left, labels.labels[rows], labels.confidences[rows]), above])


def in_order(parts: Iterable[Labelling]) -> Labelling:
    """Join at least one labelling in order of start; the spans may overlap."""
    parts, names = list(parts), [column.name for column in fields(Labelling)]
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    together = Labelling(*columns)
    return together.rows(np.argsort(together.starts, kind="stable"))


def unified(labels: Labelling) -> Labelling:
    """Rename each label to the name of its class."""
    return labels.renamed({label: class_name(label) for label in set(labels.labels)})


def labelling_of(segments: Columns) -> Labelling:
    """Build a labelling from segments, in order of stamp, without segments of no duration.

    Raise `LogError` if a field is missing, or if segments overlap.
    """
    segments = segments.take(np.flatnonzero(segments["duration"] > 0))
    segments = segments.take(np.argsort(segments["header.stamp"], kind="stable"))
    starts, ends = segments["header.stamp"], segments["header.stamp"] + segments["duration"]
    if (starts[1:] < ends[:-1]).any():
        raise LogError(
            f"{segments.topic}: segments overlap; is a log there twice, or those of two homes? "
            "name the folder of one"
        )
    confidences = segments.fields.get("confidence", np.ones(len(starts), np.float32))
    return Labelling(starts, ends, segments["label"], confidences)


def all_classes(
    topic: str, named: Iterable[Sequence[str]], labels: Iterable[str]
) -> tuple[str, ...]:
    """List the possible labels: class names stated by logs, then labels that occur.

    `named` are the names of the probabilities, per label channel. Raise `LogError` if there are
    more than 100.
    """
    classes = tuple(dict.fromkeys([*(name for names in named for name in names), *labels]))
    if len(classes) > MOST_CLASSES:
        raise LogError(f"{topic}: has {len(classes)} different labels; no classifier has so many")
    return classes


def check_labelling(topic: str, starts: Int64, labels: Iterable[str]) -> None:
    """Raise `LogError` if a label is no valid class name, or the first start is before 1970.

    Starts are nanoseconds of UTC, ascending.
    """
    for label in labels:
        if not CLASS_NAME.fullmatch(label):
            raise LogError(f"{topic}: {label[:64]!r} cannot be the name of a class")
    if len(starts) and starts[0] < 0:
        raise LogError(f"{topic}: has a segment before 1970")


LABEL_FIELDS = {"header.stamp", "novelty", "probabilities"}


class LabelledFile(NamedTuple):
    """Segment and label topics of a log or a layer."""

    path: Path
    first: int  # log times in nanoseconds
    last: int
    complete: bool
    segments: frozenset[str]  # topics with segments
    classes: Mapping[str, Sequence[str]]  # names of the probabilities, by label topic


class NamedLabelling(NamedTuple):
    """One labelling of one microphone."""

    name: str  # `live`, `review`, `scenario/<name>` or `relabel/<model>`
    classes: tuple[str, ...]  # possible labels
    labelling: Labelling  # in order of time, without overlaps

    def called_as(self, classes: Sequence[str]) -> "NamedLabelling":
        """Rename labels to the equivalent names in a list of classes."""
        names = translation(self.classes, classes)
        own = tuple(dict.fromkeys(names.values()))
        return NamedLabelling(self.name, own, self.labelling.called_as(classes))


@dataclass
class Labellings:
    """The labellings of a log, or of a folder of logs."""

    logs: Sequence[LabelledFile]  # with their layers, in order of time
    losses: list[str] = field(default_factory=list)  # errors of unusable logs

    def microphone(self, name: str | None) -> str:
        """Return the named microphone, or the only one.

        Raise `LogError` if there are no segments; `DataError` if there are several microphones and
        `name` is None, or if no microphone has this name.
        """
        names = {topic.microphone for topic in self._topics()}
        there = ", ".join(sorted(names))
        if not names:
            raise LogError(
                "no segments; if the log was recorded without a model, relabel it with one"
                f"{self._first_loss()}"
            )
        if name is None and len(names) > 1:
            raise DataError(f"choose one with --microphone: {there}")
        if name is not None and name not in names:
            raise DataError(
                f"no segments of a microphone {name[:64]!r}; there is {there}{self._first_loss()}"
            )
        return name or names.pop()

    def names(self, microphone: str) -> list[str]:
        """List the labellings of a microphone: `live`, then the others in alphabetical order."""
        names = {t.labelling for t in self._topics() if t.microphone == microphone}
        return sorted(names, key=lambda name: (name != LIVE, name))

    def find(self, microphone: str, text: str) -> str:
        """Find `live`, `review`, `scenario/<name>` or `relabel/<model>` by its full or short name.

        A short name is that of a scenario or of a model, or `relabel` if there is only one. Raise
        `DataError` if the microphone has no such labelling, or if a scenario and a model share the
        name.
        """
        names = self.names(microphone)
        layers = [name for name in names if name.startswith(f"{RELABEL}/")]
        if text == RELABEL and len(layers) == 1:
            return layers[0]
        if text in names:
            return text
        layer = relabelling(text.removeprefix(f"{RELABEL}/"))
        matching = [name for name in (layer, scenario_labelling(text)) if name in names]
        if len(matching) == 1:
            return matching[0]
        if matching:
            raise DataError(f"{microphone}: which {text[:64]!r}? There is {' and '.join(matching)}")
        there = f"there is {', '.join(names)}{self._first_loss()}"
        raise DataError(f"{microphone}: no labelling {text[:64]!r}; {there}")

    def read(
        self,
        microphone: str,
        name: str,
        start: int | None = None,
        end: int | None = None,
        progress: Progress = ignore_progress,
    ) -> NamedLabelling:
        """Read the segments of a labelling, as named by `microphone` and `find`, cut to a span.

        The span is from `start` to `end` in nanoseconds of UTC; by default there is no limit.
        `progress` receives the share of the logs that is done, 0 to 1. Unreadable parts of a
        damaged log are skipped and added to `losses`.

        Raise `LogError` if there is no segment in this span of time, if segments overlap, if the
        first begins before 1970, or if labels are too many or no valid class names.
        """
        topic = labelling_topic(microphone, name, "segment")
        labelling = self._labelling(topic, start, end, progress)
        if labelling is None:
            limited = "" if start is None and end is None else " in this span of time"
            raise LogError(f"{topic}: there is no segment{limited}{self._first_loss()}")
        labels = labelling_topic(microphone, name, "label")
        named = [log.classes.get(labels, ()) for log in self.logs]
        classes = all_classes(topic, named, labelling.labels)
        check_labelling(topic, labelling.starts, classes)
        return NamedLabelling(name, classes, labelling)

    def with_topic(
        self, topic: str, start: int | None = None, end: int | None = None
    ) -> list[LabelledFile]:
        """List, in order of time, the logs that have a topic and may have messages in a span.

        The topic is of segments or labels; log times are nanoseconds of UTC, from `start` on,
        before `end`. By default there is no limit.
        """
        return [
            log
            for log in self.logs
            if (topic in log.segments or topic in log.classes)
            and (start is None or log.last >= start)
            and (end is None or log.first < end)
        ]

    def unfinished(self, topics: Sequence[str]) -> list[Path]:
        """List the unfinished logs with one of the given topics of segments."""
        return [log.path for log in self.logs if not log.complete and log.segments & set(topics)]

    def lose(self, error: LogError) -> None:
        """Append the text of an error to `losses`, without duplicates."""
        if str(error) not in self.losses:
            self.losses.append(str(error))

    def _first_loss(self) -> str:
        return f"; {self.losses[0]}" if self.losses else ""

    def _labelling(
        self, topic: str, start: int | None, end: int | None, progress: Progress
    ) -> Labelling | None:
        parts = list(self._segments(topic, start, end, progress))
        if not parts:
            return None
        together = labelling_of(join(parts))
        span = single_span(-NEVER if start is None else start, NEVER if end is None else end)
        spans, rows, _ = intersection_rows(together, span)
        if not len(rows):
            return None
        return Labelling(*spans, together.labels[rows], together.confidences[rows])

    def _segments(
        self, topic: str, start: int | None, end: int | None, progress: Progress
    ) -> Iterator[Columns]:
        logs = self.with_topic(topic, start)
        for i, log in enumerate(logs):
            progress(i / len(logs))
            try:
                fields = {*SEGMENT_FIELDS, "confidence"}
                columns = read_columns([log.path], {topic}, start, fields=fields).get(topic)
            except LogError as error:
                self.lose(error)
                continue
            if columns is not None:
                yield columns
                if end is not None and columns.log_times[-1] >= end:
                    return  # no earlier: a segment in the span may be logged later

    def _topics(self) -> list[TopicName]:
        names = sorted({name for log in self.logs for name in log.segments})
        topics = [topic for name in names if (topic := parse_topic(name)) is not None]
        return [topic for topic in topics if topic.kind == "segment"]


def find_labellings(*paths: Path) -> Labellings:
    """Find the labellings of logs and their layers, or of folders of logs.

    Its `losses` name the unreadable logs. Raise `LogError` if there is no log, if no log can be
    read, or if no log has a message.
    """
    opened = list(map_logs(_opened, sorted(find_with_layers(paths))))
    logs = [log for log in opened if isinstance(log, LabelledFile)]
    losses = [str(error) for error in opened if isinstance(error, LogError)]
    if not logs:
        raise LogError(losses[0] if losses else f"{paths[0]}: there is no message in these logs")
    return Labellings(sorted(logs, key=lambda log: log.first), losses)


def _opened(path: Path) -> LabelledFile | LogError | None:
    """Read the topics of a log; None if the log is intact and empty."""
    try:
        selection = select([path])
        if selection.logs:
            return _log(path, selection)
        with LogFile(path) as file:
            complete = file.complete
    except LogError as error:
        return error
    return None if complete else LogError(f"{path}: unfinished, and nothing of it is whole")


def _log(path: Path, selection: LogSelection) -> LabelledFile:
    classes = {
        topic: [
            name
            for channel, _ in selection.channels[topic]
            for name in array_names(channel.metadata, "probabilities")
        ]
        for topic in selection.topics_of(message_types.LABEL, LABEL_FIELDS)
    }
    segments = frozenset(selection.topics_of(message_types.SEGMENT, SEGMENT_FIELDS))
    return LabelledFile(path, *selection.span, not selection.unfinished, segments, classes)
