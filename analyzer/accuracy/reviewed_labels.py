"""Labels that a person has gone through, with what is true in their place."""

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.accuracy.events import AROUND, MINUTE
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.labelled_by import model_of
from hearthlog.analyzer.logs.labelling import Labelling, overlaid, unified
from hearthlog.analyzer.logs.labellings import find_labellings
from hearthlog.analyzer.logs.spans import Spans, cut, overlay
from hearthlog.analyzer.marks.marks import (
    CHOICES,
    RANDOM,
    Mark,
    ReviewedSpan,
    read_marks,
    read_reviewed,
)
from hearthlog.models.classes import UNKNOWN, class_name
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import REVIEW_LAYER, log_of_layer
from hearthlog.schemas.messages.topics import LIVE, relabelling

_AROUND = AROUND * MINUTE
_FOLLOWING = 3  # logs: a segment is in the one in which it ends


class ReviewedLabels(NamedTuple):
    """A reviewed span, and the labels in it and in the ten minutes before and after.

    Attributes
    ----------
    span : ReviewedSpan
    labels : Labelling
        As they were looked at.
    true : Labelling
        The same, overlaid with the marks.
    model : str
        SHA-256 of the model that labelled; empty if unknown.
    """

    span: ReviewedSpan
    labels: Labelling
    true: Labelling
    model: str


def count_unchanged(reviewed: Iterable[ReviewedLabels]) -> tuple[int, int]:
    """Count the spans that a person has looked at, but not because they were drawn at random.

    Parameters
    ----------
    reviewed : iterable of ReviewedLabels

    Returns
    -------
    unchanged, number : int
        Spans that marks change in less than half, and all.
    """
    spans = [one for one in reviewed if one.span.chosen != RANDOM]
    return sum(2 * _changed(one) < one.span.end - one.span.start for one in spans), len(spans)


def _changed(reviewed: ReviewedLabels) -> int:
    """Measure for how long another label is true in a span than was labelled."""
    parts = overlay([reviewed.labels, reviewed.true]).in_all()
    differs = reviewed.labels.labels[parts.rows[0]] != reviewed.true.labels[parts.rows[1]]
    spans = Spans(parts.starts[differs], parts.ends[differs])
    return cut(spans, reviewed.span.start, reviewed.span.end).length


def read_reviewed_labels(  # noqa: PLR0913, PLR0917
    logs: HomeLogs,
    labelling: str,
    start: int,
    end: int,
    losses: list[str],
    chosen: Collection[str] = CHOICES,
) -> Iterator[ReviewedLabels]:
    """Read the labels of the spans that a person has gone through.

    Parameters
    ----------
    logs : HomeLogs
    labelling : str
        `live`, or the name of the model of relabel layers.
    start, end : int
        Nanoseconds of UTC, of the logs whose review layers are read.
    losses : list of str
        What cannot be read is appended.
    chosen : collection of str, optional
        How spans were chosen; others are left out, which takes less time.
    """
    for layer in logs.between(start, end, REVIEW_LAYER):
        try:
            yield from _reviewed_labels(logs, log_of_layer(layer.path), labelling, chosen)
        except (DataError, LogError) as error:
            if str(error) not in losses:
                losses.append(str(error))


def _reviewed_labels(
    logs: HomeLogs, log: Path, labelling: str, chosen: Collection[str]
) -> Iterator[ReviewedLabels]:
    reviewed = (span for span in read_reviewed(log) if span.chosen in chosen)
    spans = [span for span in reviewed if span.corrects == labelling]
    if not spans:
        return
    near = _logs_around(logs, spans[0].start, max(span.end for span in spans))
    sources = find_labellings(*near)
    name = labelling if labelling == LIVE else relabelling(labelling)
    models = {name: model_of(log, name) for name in {span.microphone for span in spans}}
    marks = [mark for path in near for mark in _marks(path) if class_name(mark.label) != UNKNOWN]
    for span in spans:
        with suppress(LogError):  # nothing is labelled there
            around = span.start - _AROUND, span.end + _AROUND
            labels = unified(sources.read(span.microphone, name, *around).labelling)
            own = labelling_of_marks(mark for mark in marks if mark.microphone == span.microphone)
            yield ReviewedLabels(
                span, labels, overlaid(labels, own), models[span.microphone].model_sha256
            )


def _logs_around(logs: HomeLogs, start: int, end: int) -> list[Path]:
    near = logs.between(start - _AROUND, end)
    later = logs.between(start)[:_FOLLOWING]
    paths = dict.fromkeys(entry.path for entry in [*near, *later])
    return [path for path in paths if path.exists()]


def _marks(log: Path) -> list[Mark]:
    with suppress(LogError):
        return read_marks(log)
    return []


def labelling_of_marks(marks: Iterable[Mark]) -> Labelling:
    """Make a labelling of marks of one microphone.

    Parameters
    ----------
    marks : iterable of Mark
        In any order.
    """
    ordered = sorted(marks)
    return Labelling(
        np.array([mark.start for mark in ordered], np.int64),
        np.array([mark.end for mark in ordered], np.int64),
        np.array([class_name(mark.label) for mark in ordered], object),
    )
