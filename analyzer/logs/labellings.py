"""The labellings that some logs have: what the recorder said, relabellings, a reviewer's marks."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.logs.labelling import FIELDS, Labelling, all_classes, labelling_of
from hearthlog.analyzer.logs.layers import find_with_layers
from hearthlog.analyzer.logs.selection import Selection, select
from hearthlog.analyzer.logs.typed_columns import is_compatible
from hearthlog.models.classes import translation
from hearthlog.models.classifiers.description import CLASS_NAME
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, join, read_columns
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    RELABEL,
    REVIEW,
    TopicName,
    labelling_topic,
    parse_topic,
    relabelling,
)
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.storage.byte_ranges import map_logs

LABEL_FIELDS = {"header.stamp", "novelty", "probabilities"}


class Log(NamedTuple):
    """A log or a layer, and what labels it has.

    Attributes
    ----------
    path : Path
    first, last : int
        Log times in nanoseconds.
    complete : bool
    segments : frozenset of str
        Topics of segments.
    classes : dict of str to list of str
        By topic of labels: the names of their probabilities.
    """

    path: Path
    first: int
    last: int
    complete: bool
    segments: frozenset[str]
    classes: Mapping[str, Sequence[str]]


class Side(NamedTuple):
    """One labelling of one microphone.

    Attributes
    ----------
    name : str
        `live`, `review`, or `relabel/<model>`.
    classes : tuple of str
        The labels that there may be.
    labelling : Labelling
        In the order of time, one label at a time.
    """

    name: str
    classes: tuple[str, ...]
    labelling: Labelling

    def called_as(self, classes: Sequence[str]) -> "Side":
        """Give classes that are among some by another name the name that they have there."""
        names = translation(self.classes, classes)
        own = tuple(dict.fromkeys(names.values()))
        return Side(self.name, own, self.labelling.called_as(classes))


@dataclass
class Sources:
    """The labellings of a log, or of a folder of logs.

    Attributes
    ----------
    logs : list of Log
        With their layers, in the order of time.
    losses : list of str
        What could not be used, and why.
    """

    logs: Sequence[Log]
    losses: list[str] = field(default_factory=list)

    def microphone(self, wanted: str | None) -> str:
        """Return the only microphone, or check the one that is wanted."""
        found = {topic.microphone for topic in self._topics()}
        known = ", ".join(sorted(found))
        if not found:
            raise LogError(
                "no segments; if the log was recorded without a model, relabel it with one"
                f"{self._first_loss()}"
            )
        if wanted is None and len(found) > 1:
            raise DataError(f"choose one with --microphone: {known}")
        if wanted is not None and wanted not in found:
            raise DataError(
                f"no segments of a microphone {wanted[:64]!r}; there is {known}{self._first_loss()}"
            )
        return wanted or found.pop()

    def names(self, microphone: str) -> list[str]:
        """List the labellings of a microphone; what the recorder said comes first."""
        found = {t.labelling for t in self._topics() if t.microphone == microphone}
        return sorted(found, key=lambda name: (name != LIVE, name))

    def find(self, microphone: str, wanted: str) -> str:
        """Find the labelling that a user means.

        Parameters
        ----------
        microphone : str
        wanted : str
            `live`, `review`, the name of a model, or `relabel` if there is only one.

        Raises
        ------
        DataError
            If it is none of them.
        """
        known = self.names(microphone)
        layers = [name for name in known if name.startswith(f"{RELABEL}/")]
        if wanted == RELABEL and len(layers) == 1:
            return layers[0]
        for name in (wanted, relabelling(wanted.removeprefix(f"{RELABEL}/"))):
            if name in known:
                return name
        there = f"there is {', '.join(known)}{self._first_loss()}"
        raise DataError(f"{microphone}: no labelling {wanted[:64]!r}; {there}")

    def read(
        self,
        microphone: str,
        name: str,
        start: int | None = None,
        end: int | None = None,
        progress: Progress = ignore_progress,
    ) -> Side:
        """Read the segments of a labelling; of a log that is damaged `losses` tell.

        Parameters
        ----------
        microphone : str
        name : str
            As `find` returns it.
        start, end : int, optional
            In nanoseconds: what is before and after is cut off.
        progress : callable, optional
            Is called with the share that is done.

        Raises
        ------
        LogError
            If there is none in this span of time, or if segments overlap or cannot be.
        """
        topic = labelling_topic(microphone, name, "segment")
        labelling = self._labelling(topic, start, end, progress)
        if labelling is None:
            limited = "" if start is None and end is None else " in this span of time"
            raise LogError(f"{topic}: there is no segment{limited}{self._first_loss()}")
        labels = labelling_topic(microphone, name, "label")
        named = [log.classes.get(labels, ()) for log in self.logs]
        classes = all_classes(topic, named, labelling)
        for label in classes:
            if not CLASS_NAME.fullmatch(label):
                raise LogError(f"{topic}: {label[:64]!r} cannot be the name of a class")
        if labelling.starts[0] < 0:
            raise LogError(f"{topic}: has a segment before 1970")
        return Side(name, classes, labelling)

    def marks(self, microphone: str, start: int | None, end: int | None) -> Labelling | None:
        """Read what was reviewed in a span of time, if anything was; as `read` otherwise."""
        topic = labelling_topic(microphone, REVIEW, "segment")
        return self._labelling(topic, start, end, lambda _: None)

    def with_topic(self, topic: str, start: int | None = None, end: int | None = None) -> list[Log]:
        """List the logs that have a topic, and messages at a span of time."""
        return [
            log
            for log in self.logs
            if (topic in log.segments or topic in log.classes)
            and (start is None or log.last >= start)
            and (end is None or log.first < end)
        ]

    def unfinished(self, topics: Sequence[str]) -> list[Path]:
        """List the logs with one of some topics that were not completed."""
        return [log.path for log in self.logs if not log.complete and log.segments & set(topics)]

    def lose(self, error: LogError) -> None:
        """Note what could not be read."""
        if str(error) not in self.losses:
            self.losses.append(str(error))

    def _first_loss(self) -> str:
        return f"; {self.losses[0]}" if self.losses else ""

    def _labelling(
        self, topic: str, start: int | None, end: int | None, progress: Progress
    ) -> Labelling | None:
        parts = list(self._segments(topic, start, end, progress))
        found = _cut(labelling_of(join(parts)), start, end) if parts else None
        return found or None

    def _segments(
        self, topic: str, start: int | None, end: int | None, progress: Progress
    ) -> Iterator[Columns]:
        logs = self.with_topic(topic, start)
        for i, log in enumerate(logs):
            progress(i / len(logs))
            try:
                columns = read_columns([log.path], {topic}, start, fields=FIELDS).get(topic)
            except LogError as error:
                self.lose(error)
                continue
            if columns is not None:
                yield columns
                if end is not None and columns.log_times[-1] >= end:
                    return  # not before: what begins in the span may end, and be logged, later

    def _topics(self) -> list[TopicName]:
        names = {name for log in self.logs for name in log.segments}
        topics = [topic for name in names if (topic := parse_topic(name)) is not None]
        return [topic for topic in topics if topic.kind == "segment"]


def find_sources(*paths: Path) -> Sources:
    """Look what labellings there are in logs and their layers, or in folders of logs.

    Raises
    ------
    LogError
        If there is no log, or none that can be read.
    """
    opened = list(map_logs(_opened, sorted(find_with_layers(paths))))
    logs = [log for log in opened if isinstance(log, Log)]
    losses = [str(error) for error in opened if isinstance(error, LogError)]
    if not logs:
        raise LogError(losses[0] if losses else f"{paths[0]}: there is no message in these logs")
    return Sources(sorted(logs, key=lambda log: log.first), losses)


def _opened(path: Path) -> Log | LogError | None:
    """Look into a log; None if it is sound, and empty."""
    try:
        selection = select([path])
        if selection.logs:
            return _log(path, selection)
        with LogFile(path) as file:
            complete = file.complete
    except LogError as error:
        return error
    return None if complete else LogError(f"{path}: unfinished, and nothing of it is whole")


def _log(path: Path, selection: Selection) -> Log:
    segments, classes = set(), {}
    for topic, same in selection.channels.items():
        if all(is_compatible(*described, message_types.SEGMENT, FIELDS) for described in same):
            segments.add(topic)
        elif all(
            is_compatible(*described, message_types.LABEL, LABEL_FIELDS) for described in same
        ):
            names = [array_names(channel.metadata, "probabilities") for channel, _ in same]
            classes[topic] = [name for each in names for name in each]
    return Log(path, *selection.span, not selection.unfinished, frozenset(segments), classes)


def _cut(labelling: Labelling, start: int | None, end: int | None) -> Labelling:
    """Leave of a labelling what is in a span of time."""
    starts, ends = labelling.starts, labelling.ends
    starts = starts if start is None else np.maximum(starts, start)
    ends = ends if end is None else np.minimum(ends, end)
    left = starts < ends
    return Labelling(starts[left], ends[left], labelling.labels[left])
