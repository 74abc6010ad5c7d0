"""The marks of a review: written to their layers one by one, and undone."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.marks.marks import Mark, MarkedSpan, read_marks, write_marks
from hearthlog.analyzer.review.timeline.model import LabelledSpans


@dataclass
class _Change:
    """The marks of a layer before a change, to undo it."""

    log: Path
    span: MarkedSpan
    before: list[Mark]


@dataclass
class Marking:
    """The review layers of some logs, as one reviewer changes them.

    Parameters
    ----------
    microphone : str
    coverage : Coverage
        Of the microphone.
    reviewer : str
    corrects : str
        The labelling that is reviewed: `live`, or the name of a model.
    labelled : LabelledSpans
        The segments of that labelling.
    """

    microphone: str
    coverage: Coverage
    reviewer: str
    corrects: str
    labelled: LabelledSpans
    _done: list[list[_Change]] = field(default_factory=list)
    _marks: dict[Path, list[Mark]] = field(default_factory=dict)  # by log, as they were read last

    def mark(self, start: int, end: int, label: str) -> list[Mark]:
        """Label a span of time, in place of the marks that it has.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC; what lies before or after all logs is cut off.
        label : str
            A name of a class.

        Returns
        -------
        list of Mark
            The new marks: one for each log of the span.

        Raises
        ------
        DataError
            If a part of the span was not recorded, or the label is invalid.
        LogError
            If a layer is damaged or cannot be written; that layer is unchanged then.
        """
        return self._write(start, end, [(start, end, label)])

    def confirm(self, start: int, end: int) -> list[Mark]:
        """Mark a span with the labels that it has, in place of its marks.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC; what lies before or after all logs is cut off.

        Returns
        -------
        list of Mark
            The new marks: one for each label and log of the span.

        Raises
        ------
        DataError
            If the labelling has no label in this span, or a part of the span was not recorded.
        LogError
            If a layer is damaged or cannot be written; that layer is unchanged then.
        """
        segments = self.labelled
        first = int(np.searchsorted(segments.ends, start, "right"))
        inside = slice(first, int(np.searchsorted(segments.starts, end)))
        spans = zip(
            np.maximum(segments.starts[inside], start).tolist(),
            np.minimum(segments.ends[inside], end).tolist(),
            segments.texts[inside].tolist(),
            strict=True,
        )
        labels = [span for span in spans if span[0] < span[1]]
        if not labels:
            raise DataError(f"{self.corrects} has no label in this span: name what was heard")
        return self._write(start, end, labels)

    def delete(self, start: int, end: int) -> list[Mark]:
        """Delete the marks of a span of time.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC; what lies before or after all logs is cut off.

        Returns
        -------
        list of Mark
            Empty, since there are no new marks.

        Raises
        ------
        DataError
            If a part of the span was not recorded.
        LogError
            If a layer is damaged or cannot be written; that layer is unchanged then.
        """
        return self._write(start, end, [])

    def undo(self) -> tuple[int, int] | None:
        """Undo the last change.

        Returns
        -------
        (int, int) or None
            Its span, in nanoseconds of UTC; None if there is nothing to undo.

        Raises
        ------
        LogError
            If a layer is damaged or cannot be written.
        """
        if not self._done:
            return None
        changes = self._done[-1]
        for change in changes:
            self._change_layer(change.log, change.before, change.span)
        self._done.pop()
        return changes[0].span.start, changes[-1].span.end

    def marks(self) -> LabelledSpans:
        """Return all marks of the microphone in these logs.

        Returns
        -------
        LabelledSpans
            In the order of time.

        Raises
        ------
        LogError
            If a layer is damaged.
        """
        for log in self.coverage.logs:
            if log not in self._marks:
                self._marks[log] = read_marks(log)
        marks = (mark for same in self._marks.values() for mark in same)
        own = sorted(mark for mark in marks if mark.microphone == self.microphone)
        return LabelledSpans(
            np.array([mark.start for mark in own], np.int64),
            np.array([mark.end for mark in own], np.int64),
            np.array([mark.label for mark in own], object),
        )

    def _write(self, start: int, end: int, labels: Iterable[tuple[int, int, str]]) -> list[Mark]:
        """Replace the marks of a span by labels (start, end, label)."""
        start = max([start, *self.coverage.starts[:1]])
        end = min([end, *self.coverage.ends[-1:]])
        pieces = self.coverage.split(start, end) if start < end else []
        if not pieces:
            raise DataError("not all of this span was recorded: mark a part that was")
        now = time.time_ns()
        made = [
            Mark(self.microphone, max(a, first), min(b, last), label, self.reviewer, now,
                 self.corrects)
            for a, b, label in labels
            for _, first, last in pieces
            if max(a, first) < min(b, last)
        ]  # fmt: skip
        changes = [self._change(log, first, last) for log, first, last in pieces]
        for (log, first, last), _ in zip(pieces, changes, strict=True):
            own = [mark for mark in made if first <= mark.start < last]
            self._change_layer(log, own, MarkedSpan(self.microphone, first, last))
        self._done.append(changes)
        return made

    def _change_layer(self, log: Path, marks: Sequence[Mark], instead_of: MarkedSpan) -> None:
        write_marks(log, marks, [instead_of])
        self._marks[log] = read_marks(log)

    def _change(self, log: Path, start: int, end: int) -> _Change:
        """Return the marks that a change will touch, and the span that they reach over."""
        touched = [
            mark
            for mark in read_marks(log)
            if mark.microphone == self.microphone and mark.start < end and mark.end > start
        ]
        first = min([start, *(mark.start for mark in touched)])
        last = max([end, *(mark.end for mark in touched)])
        return _Change(log, MarkedSpan(self.microphone, first, last), touched)
