"""Labellings of a log: its own segments, a layer's, a reviewer's, or those of a label file."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.logs.layers import with_layers
from hearthlog.analyzer.logs.selection import Selection, select
from hearthlog.analyzer.logs.typed_columns import is_compatible
from hearthlog.models.classes import translation
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.messages import message_types

FIELDS = {"header.stamp", "duration", "label"}
_MOST_CLASSES = 100


@dataclass(frozen=True)
class Labelling:
    """Spans of time and their labels.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        Nanoseconds of UTC; every end is after its start.
    labels : np.ndarray [shape=(n,)] of str
    """

    starts: Int64
    ends: Int64
    labels: NDArray[np.object_]

    def __len__(self) -> int:
        return len(self.starts)

    def called_as(self, classes: Sequence[str]) -> "Labelling":
        """Give labels that mean one of some classes, by another name, the name of that class."""
        names = translation(set(self.labels), classes)
        return replace(self, labels=np.array([names[label] for label in self.labels], object))


@dataclass(frozen=True)
class Labelled:
    """What a log is labelled with.

    Attributes
    ----------
    topic : str
    classes : tuple of str
        The labels there may be.
    labelling : Labelling
    unfinished : tuple of Path
        Logs that were not completed.
    """

    topic: str
    classes: tuple[str, ...]
    labelling: Labelling
    unfinished: tuple[Path, ...]

    @property
    def microphone(self) -> str:
        """Name of the microphone."""
        return self.topic.strip("/").split("/")[0]


def read_labelled(path: Path, topic: str | None = None) -> Labelled:
    """Read the segments of a log, or of a folder of logs, and of their layers.

    Parameters
    ----------
    path : Path
    topic : str, optional
        By default that of the only microphone.

    Raises
    ------
    LogError
        If a log is damaged, or has no such segments.
    """
    selection = select(with_layers(path))
    topic = _segment_topic(selection, topic)
    columns = read_columns(selection.logs, {topic}, fields=FIELDS).get(topic)
    if columns is None or not (columns["duration"] > 0).any():
        raise LogError(f"{path}: there is no segment on {topic}")
    labelling = labelling_of(columns)
    channels = selection.channels.get(f"{topic.removesuffix('/segment')}/label", ())
    named = [array_names(channel.metadata, "probabilities") for channel, _ in channels]
    classes = all_classes(topic, named, labelling)
    return Labelled(topic, classes, labelling, tuple(selection.unfinished))


def labelling_of(segments: Columns) -> Labelling:
    """Put segments in the order of time; those that are over at once are left out.

    Raises
    ------
    LogError
        If they overlap.
    """
    segments = segments.take(np.flatnonzero(segments["duration"] > 0))
    segments = segments.take(np.argsort(segments["header.stamp"], kind="stable"))
    starts = segments["header.stamp"]
    ends = starts + segments["duration"]
    if (starts[1:] < ends[:-1]).any():
        raise LogError(
            f"{segments.topic}: segments overlap; is a log there twice, or those of two homes?"
        )
    return Labelling(starts, ends, segments["label"])


def all_classes(
    topic: str, named: Iterable[Sequence[str]], labelling: Labelling
) -> tuple[str, ...]:
    """List the labels that there may be: those that logs name, and those that there are.

    Raises
    ------
    LogError
        If they are too many.
    """
    names = [name for names in named for name in names]
    classes = tuple(dict.fromkeys([*names, *labelling.labels]))
    if len(classes) > _MOST_CLASSES:
        raise LogError(f"{topic}: has {len(classes)} different labels; no classifier has so many")
    return classes


def _segment_topic(selection: Selection, wanted: str | None) -> str:
    """Find the topic of a recorder's segments."""
    known = sorted(
        topic
        for topic, channels in selection.channels.items()
        if all(is_compatible(*described, message_types.SEGMENT, FIELDS) for described in channels)
    )
    recorded = [topic for topic in known if topic.count("/") == 2]
    if not known:
        raise LogError("no segments; if the log was recorded without a model, relabel it with one")
    if wanted is None and len(recorded) != 1:
        raise LogError(f"choose one with --topic: {', '.join(known)}")
    topic = recorded[0] if wanted is None else wanted
    if topic not in known:
        raise LogError(f"{topic}: no such segments; there are {', '.join(known)}")
    return topic
