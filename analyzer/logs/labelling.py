"""A labelling: labelled spans of time by one source, as arrays, and how segments become one."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.spans import joined, remains
from hearthlog.models.classes import CLASS_NAME, class_name, translation
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns

SEGMENT_FIELDS = {"header.stamp", "duration", "label"}
MOST_CLASSES = 100


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
        """Give each label the name that its class has among some classes.

        Parameters
        ----------
        classes : sequence of str
            A label that means exactly one of these, by another name, gets its name; others stay.
        """
        names = translation(set(self.labels), classes)
        return replace(self, labels=np.array([names[label] for label in self.labels], object))


def overlaid(labels: Labelling, above: Labelling) -> Labelling:
    """Lay a labelling over another one."""
    left, rows = remains(labels, joined(above.starts, above.ends))
    starts = np.concatenate([left.starts, above.starts])
    order = np.argsort(starts, kind="stable")
    return Labelling(
        starts[order],
        np.concatenate([left.ends, above.ends])[order],
        np.concatenate([labels.labels[rows], above.labels])[order],
    )


def unified(labels: Labelling) -> Labelling:
    """Give each label the name of its class."""
    names = {label: class_name(label) for label in set(labels.labels)}
    unique = np.array([names[label] for label in labels.labels], object)
    return replace(labels, labels=unique)


def labelling_of(segments: Columns) -> Labelling:
    """Make a labelling of segments.

    Raise `LogError` if a field is missing, or if segments overlap.
    """
    segments = segments_in_order(segments)
    starts = segments["header.stamp"]
    return Labelling(starts, starts + segments["duration"], segments["label"])


def segments_in_order(segments: Columns) -> Columns:
    """Sort segments by their stamps, and leave out those without a duration.

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
    return segments


def all_classes(
    topic: str, named: Iterable[Sequence[str]], labels: Iterable[str]
) -> tuple[str, ...]:
    """List the labels that there may be: those that logs name, and those that occur.

    Parameters
    ----------
    named : iterable of sequence of str
        The names that channels of labels have for their probabilities.

    Raises
    ------
    LogError
        If there are more than 100.
    """
    classes = tuple(dict.fromkeys([*(name for names in named for name in names), *labels]))
    if len(classes) > MOST_CLASSES:
        raise LogError(f"{topic}: has {len(classes)} different labels; no classifier has so many")
    return classes


def check_labelling(topic: str, starts: Int64, labels: Iterable[str]) -> None:
    """Check that labels can be names of classes, and that no segment begins before 1970.

    Parameters
    ----------
    starts : np.ndarray [shape=(n,)], int64
        Nanoseconds of UTC, ascending.

    Raises
    ------
    LogError
        If a label cannot be the name of a class, or the first start is negative.
    """
    for label in labels:
        if not CLASS_NAME.fullmatch(label):
            raise LogError(f"{topic}: {label[:64]!r} cannot be the name of a class")
    if len(starts) and starts[0] < 0:
        raise LogError(f"{topic}: has a segment before 1970")
