"""The segments of a home: what a model heard, and what a reviewer says in its place."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.labelling import all_classes, check_labelling, segments_in_order
from hearthlog.analyzer.logs.spans import Spans, joined, remains
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.models.classes import class_name
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.logs.columns import Columns, join


class Segments(NamedTuple):
    """The segments of one microphone, in the order of time."""

    starts: Int64  # shape (n,), in nanoseconds of UTC; they do not overlap
    ends: Int64
    labels: NDArray[Any]  # shape (n,)
    confidences: NDArray[np.float64]  # shape (n,), 1 where a person said it

    @property
    def spans(self) -> Spans:
        """When something was heard."""
        return joined(self.starts, self.ends)


def segments_of(parts: Sequence[Columns]) -> Segments:
    """Join the segments of a microphone; each class has one name, whatever logs call it.

    Parameters
    ----------
    parts : sequence of Columns
        Segments of one topic, with stamp, duration, label and confidence; at least one part.

    Raises
    ------
    LogError
        If they overlap, begin before 1970, are of different types, or have labels that are too many
        or cannot be names of classes.
    """
    columns = segments_in_order(join(parts))
    starts, labels = columns["header.stamp"], columns["label"]
    names = {label: class_name(label) for label in set(labels.tolist())}
    check_labelling(columns.topic, starts, all_classes(columns.topic, (), names))
    confidences = np.nan_to_num(columns["confidence"].astype(np.float64))
    return Segments(
        starts,
        starts + columns["duration"],
        np.array([names[label] for label in labels.tolist()], object),
        np.clip(confidences, 0.0, 1.0),
    )


def segments_of_marks(marks: Sequence[Mark]) -> Segments:
    """Make segments of marks, in the order of time.

    Parameters
    ----------
    marks : sequence of Mark
        Of one microphone, in any order.

    Returns
    -------
    Segments
        With a confidence of 1.
    """
    ordered = sorted(marks, key=lambda mark: mark.start)
    return Segments(
        np.array([mark.start for mark in ordered], np.int64),
        np.array([mark.end for mark in ordered], np.int64),
        np.array([class_name(mark.label) for mark in ordered], object),
        np.ones(len(ordered)),
    )


def corrected(segments: Segments, marks: Segments) -> Segments:
    """Put what a reviewer says in the place of what a model said.

    Parameters
    ----------
    segments, marks : Segments
        Of one microphone.

    Returns
    -------
    Segments
        All marks, and the parts of segments outside of them.
    """
    left, rows = remains(segments, marks.spans)
    starts = np.concatenate([left.starts, marks.starts])
    order = np.argsort(starts, kind="stable")
    return Segments(
        starts[order],
        np.concatenate([left.ends, marks.ends])[order],
        np.concatenate([segments.labels[rows], marks.labels])[order],
        np.concatenate([segments.confidences[rows], marks.confidences])[order],
    )
