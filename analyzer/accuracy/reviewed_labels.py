"""Labels that a person has gone through, with what is true in their place."""

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.accuracy.events import AROUND, MINUTE
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.labelling import Labelling, find_labellings, overlaid, unified
from hearthlog.analyzer.logs.recorder_info import model_of
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, joined, overlay
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
    model : str
        SHA-256 of the model that labelled; empty if unknown.
    undecided : Spans
        What a person could not decide: the labels there are neither right nor wrong.
    """

    span: ReviewedSpan
    labels: Labelling
    true: Labelling
    model: str
    undecided: Spans = NONE


def count_unchanged(reviewed: Iterable[ReviewedLabels]) -> tuple[int, int]:
    """Count the spans that a person has looked at, but not because they were drawn at random."""
    spans = [one for one in reviewed if one.span.chosen != RANDOM and not _is_undecided(one)]
    return sum(2 * _changed(one) < one.span.end - one.span.start for one in spans), len(spans)


def _is_undecided(reviewed: ReviewedLabels) -> bool:
    start, end = reviewed.span.start, reviewed.span.end
    return 2 * cut(reviewed.undecided, start, end).length >= end - start


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
    start, end : int
        Nanoseconds of UTC, of the logs whose review layers are read.
    """
    found: list[tuple[Path, ReviewedSpan]] = []
    for layer in logs.between(start, end, REVIEW_LAYER):
        log = log_of_layer(layer.path)
        try:
            spans = [span for span in read_reviewed(log) if span.chosen in chosen]
        except LogError as error:
            _lose(losses, error)
            continue
        found += [(log, span) for span in spans if span.corrects == labelling]
    of_log: dict[Path, list[ReviewedSpan]] = {}
    for log, span in _joined_parts(found):
        of_log.setdefault(log, []).append(span)
    for log, spans in of_log.items():
        try:
            yield from _reviewed_labels(logs, log, spans, labelling)
        except (DataError, LogError) as error:
            _lose(losses, error)


def _lose(losses: list[str], error: Exception) -> None:
    if str(error) not in losses:
        losses.append(str(error))


def _joined_parts(found: list[tuple[Path, ReviewedSpan]]) -> list[tuple[Path, ReviewedSpan]]:
    """Join spans that were cut where one log ends and the next begins."""
    whole: list[tuple[Path, ReviewedSpan]] = []
    open_: dict[ReviewedSpan, tuple[int, Path]] = {}  # by the span that would go on: place, log
    for log, span in found:
        place, before = open_.pop(span._replace(end=0), (len(whole), log))
        if place < len(whole) and before != log and _is_one(whole[place][1], span):
            first, earlier = whole[place]
            whole[place] = first, earlier._replace(end=span.end)
        else:
            place = len(whole)
            whole.append((log, span))
        open_[span._replace(start=span.end, end=0)] = place, log
    return whole


def _is_one(before: ReviewedSpan, after: ReviewedSpan) -> bool:
    """Tell two parts of a drawn minute from two minutes, both of which were drawn."""
    return before.chosen != RANDOM or after.end - before.start <= MINUTE


def _reviewed_labels(
    logs: HomeLogs, log: Path, spans: list[ReviewedSpan], labelling: str
) -> Iterator[ReviewedLabels]:
    near = _logs_around(logs, spans[0].start, max(span.end for span in spans))
    sources = find_labellings(*near)
    name = labelling if labelling == LIVE else relabelling(labelling)
    models = {name: model_of(log, name) for name in {span.microphone for span in spans}}
    marks = [mark for path in near for mark in _marks(path)]
    for span in spans:
        with suppress(LogError):  # nothing is labelled there
            around = span.start - _AROUND, span.end + _AROUND
            labels = unified(sources.read(span.microphone, name, *around).labelling)
            own = [mark for mark in marks if mark.microphone == span.microphone]
            decided = labelling_of_marks(one for one in own if class_name(one.label) != UNKNOWN)
            rest = labelling_of_marks(one for one in own if class_name(one.label) == UNKNOWN)
            yield ReviewedLabels(
                span,
                labels,
                overlaid(labels, decided),
                models[span.microphone].model_sha256,
                joined(rest.starts, rest.ends),
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
    """Make a labelling of marks of one microphone."""
    ordered = sorted(marks)
    return Labelling(
        np.array([mark.start for mark in ordered], np.int64),
        np.array([mark.end for mark in ordered], np.int64),
        np.array([class_name(mark.label) for mark in ordered], object),
    )
