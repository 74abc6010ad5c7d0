"""Marks made one after the other, each in its layer before the next; and undone."""

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
    """What was in a layer where something was marked, for undoing."""

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
        Which log has what.
    reviewer : str
    corrects : str
        The labelling that is reviewed: `live`, or the name of a model.
    labelled : LabelledSpans
        What it says.
    """

    microphone: str
    coverage: Coverage
    reviewer: str
    corrects: str
    labelled: LabelledSpans
    _done: list[list[_Change]] = field(default_factory=list)
    _known: dict[Path, list[Mark]] = field(default_factory=dict)  # by log, as they were read last

    def mark(self, start: int, end: int, label: str) -> list[Mark]:
        """Say what was heard in a span of time, in nanoseconds of UTC.

        Returns
        -------
        list of Mark
            As they are in the layers now.

        Raises
        ------
        DataError
            If not all of it was heard, or the label cannot be.
        LogError
            If a layer cannot be written; what was there is still there.
        """
        return self._write(start, end, [(start, end, label)])

    def confirm(self, start: int, end: int) -> list[Mark]:
        """Say that the labelling is right in a span of time; as `mark` otherwise."""
        said = self.labelled
        first, last = np.searchsorted(said.ends, start, "right"), np.searchsorted(said.starts, end)
        inside = slice(int(first), int(last))
        spans = zip(
            np.maximum(said.starts[inside], start).tolist(),
            np.minimum(said.ends[inside], end).tolist(),
            said.texts[inside].tolist(),
            strict=True,
        )
        found = [span for span in spans if span[0] < span[1]]
        if not found:
            raise DataError(f"{self.corrects} says nothing about this span: name what was heard")
        return self._write(start, end, found)

    def delete(self, start: int, end: int) -> list[Mark]:
        """Take the marks of a span of time away; as `mark` otherwise."""
        return self._write(start, end, [])

    def undo(self) -> tuple[int, int] | None:
        """Take the last change back.

        Returns
        -------
        (int, int) or None
            The span that it was about; None if there is nothing to undo.
        """
        if not self._done:
            return None
        changes = self._done[-1]
        for change in changes:
            self._change_layer(change.log, change.before, change.span)
        self._done.pop()
        return changes[0].span.start, changes[-1].span.end

    def marks(self) -> LabelledSpans:
        """Return all marks of the microphone in these logs."""
        for log in self.coverage.logs:
            if log not in self._known:
                self._known[log] = read_marks(log)
        marks = (mark for known in self._known.values() for mark in known)
        found = sorted(mark for mark in marks if mark.microphone == self.microphone)
        return LabelledSpans(
            np.array([mark.start for mark in found], np.int64),
            np.array([mark.end for mark in found], np.int64),
            np.array([mark.label for mark in found], object),
        )

    def _write(self, start: int, end: int, said: Iterable[tuple[int, int, str]]) -> list[Mark]:
        start = max([start, *self.coverage.starts[:1]])
        end = min([end, *self.coverage.ends[-1:]])
        pieces = self.coverage.split(start, end) if start < end else []
        if not pieces:
            raise DataError("not all of this span was recorded: mark a part that was")
        now = time.time_ns()
        made = [
            Mark(self.microphone, max(a, first), min(b, last), label, self.reviewer, now,
                 self.corrects)
            for a, b, label in said
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
        self._known[log] = read_marks(log)

    def _change(self, log: Path, start: int, end: int) -> _Change:
        """Note the marks that a change will touch, and how far they reach."""
        touched = [
            mark
            for mark in read_marks(log)
            if mark.microphone == self.microphone and mark.start < end and mark.end > start
        ]
        first = min([start, *(mark.start for mark in touched)])
        last = max([end, *(mark.end for mark in touched)])
        return _Change(log, MarkedSpan(self.microphone, first, last), touched)
