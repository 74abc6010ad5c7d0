"""Writing and undoing of review marks, one by one, in their layers."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.marks.marks import (
    RANDOM,
    Mark,
    MarkedSpan,
    ReviewedSpan,
    read_marks,
    read_reviewed,
    write_marks,
)
from hearthlog.analyzer.review.timeline import LabelledSpans, labelled_spans
from hearthlog.schemas.frames import NANOSECONDS


@dataclass
class _Change:
    """Marks and reviewed spans of a layer before a change, to undo it."""

    log: Path
    span: MarkedSpan
    before: list[Mark]
    reviewed: list[ReviewedSpan] = field(default_factory=list)  # added by the change
    not_reviewed: list[ReviewedSpan] = field(default_factory=list)  # removed by the change


@dataclass
class Marking:
    """Review layers of some logs, edited by one reviewer."""

    microphone: str
    coverage: Coverage
    reviewer: str
    corrects: str
    labelled: LabelledSpans
    scenario: str = ""
    _done: list[list[_Change]] = field(default_factory=list)
    _last: int = 0  # time at which this object made its last mark
    _marks: dict[Path, list[Mark]] = field(default_factory=dict)  # by log, as last read
    _reviewed: dict[Path, list[ReviewedSpan]] = field(default_factory=dict)

    def mark(self, start: int, end: int, label: str, chosen: str = "") -> list[Mark]:
        """Label a span in nanoseconds of UTC, replacing its marks; cut it to the logs.

        `chosen` is as in `ReviewedSpan`, if the span counts as reviewed; otherwise empty. Raise
        `DataError` if a part of the span was not recorded, or the label is invalid; `LogError` if a
        layer is damaged or cannot be written: that layer is unchanged then.
        """
        return self._write(start, end, [(start, end, label)], chosen)

    def review(self, start: int, end: int, chosen: str) -> None:
        """Record a span, cut to the logs, as reviewed: its unmarked labels are correct.

        The span is in nanoseconds of UTC. Raise `DataError` and `LogError` as `mark` does.
        """
        now = time.time_ns()
        changes = [self._change(*piece, now, chosen) for piece in self._pieces(start, end)]
        for change in changes:
            self._change_layer(change.log, [], [], change.reviewed)
        self._done.append(changes)

    def confirm(self, start: int, end: int) -> list[Mark]:
        """Mark a span in nanoseconds of UTC, cut to the logs, with its labels, replacing its marks.

        Raise `DataError` if the labelling has no label in this span, else errors as `mark` does.
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
            raise DataError("no label to confirm in this span: press the key of its class")
        return self._write(start, end, labels)

    def delete(self, start: int, end: int) -> list[Mark]:
        """Delete the marks of a span, cut to the logs, which then no longer counts as reviewed.

        The span is in nanoseconds of UTC. Return no marks, since there are no new ones. Raise
        `DataError` and `LogError` as `mark` does.
        """
        return self._write(start, end, [], deleted=True)

    def move(self, start: int, end: int) -> list[Mark]:
        """Move a mark to a span: the mark that overlaps it most, else the last one made.

        Other marks in the span, in nanoseconds of UTC and cut to the logs, are replaced. A mark is
        written at its new place before it is removed from the log of its old place. Return the mark
        at its new place, in the part of each log. Raise `DataError` if there is no such mark or it
        has these ends, else errors as `mark` does.
        """
        old, pieces, now = self._mark_near(start, end), self._pieces(start, end), time.time_ns()
        if (old[0].start, old[-1].end) == (pieces[0][1], pieces[-1][2]):
            raise DataError("the mark has these ends already: drag its new span")
        new = {
            log: old[0]._replace(start=first, end=last, reviewer=self.reviewer, made=now)
            for log, first, last in pieces
        }
        before = {log: [one for one in own if one in old] for log, own in self._marks.items()}
        logs = [*new, *(log for log, own in before.items() if own and log not in new)]
        # A judged item of a queue is reviewed from end to end: this follows the mark.
        reviewed = {
            log: [one for one in self._reviewed[log] if _is_of(one, before[log])] for log in logs
        }
        chosen = next((one for own in reviewed.values() for one in own), None)
        changes = []
        for log in logs:
            spans = [*before[log], *([new[log]] if log in new else [])]
            edges = min(one.start for one in spans), max(one.end for one in spans)
            change = self._change(log, *edges, now, "")
            change.not_reviewed += reviewed[log]
            if chosen is not None and log in new:
                own = chosen._replace(start=new[log].start, end=new[log].end, made=now)
                change.reviewed.append(own)
            instead_of = [MarkedSpan(*one[:3]) for one in before[log]]
            placed = [new[log]] if log in new else []
            self._change_layer(log, placed, instead_of, change.reviewed, change.not_reviewed)
            changes.append(change)
        self._done.append(changes)
        self._last = now
        return [*new.values()]

    def _mark_near(self, start: int, end: int) -> list[Mark]:
        """Return the mark that overlaps a span most, or the last one made, in all of its logs."""
        self._read()
        found = [(one, log) for log, own in self._marks.items() for one in own]
        parts: list[list[Mark]] = []
        last = None
        for mark, log in sorted(found, key=lambda each: each[0]):
            if mark.microphone != self.microphone:
                continue
            if last is not None and log != last and _is_continued(parts[-1][-1], mark):
                parts[-1].append(mark)
            else:
                parts.append([mark])
            last = log
        common = [min(one[-1].end, end) - max(one[0].start, start) for one in parts]
        if common and max(common) > 0:
            return parts[int(np.argmax(common))]
        made = [one for one in parts if one[0].made == self._last]
        if not made:
            raise DataError("no mark in the selection: drag over the mark")
        return made[-1]

    def undo(self) -> tuple[int, int] | None:
        """Undo the last change; return its span in nanoseconds of UTC, or None without a change.

        Raise `LogError` if a layer is damaged or cannot be written.
        """
        if not self._done:
            return None
        changes = self._done[-1]
        for change in reversed(changes):  # a moved mark is back before it is removed elsewhere
            kept, added = change.not_reviewed, change.reviewed
            self._change_layer(change.log, change.before, [change.span], kept, added)
        self._done.pop()
        spans = [change.span for change in changes]
        return min(span.start for span in spans), max(span.end for span in spans)

    def marks(self) -> LabelledSpans:
        """Return all marks of the microphone in these logs.

        Raise `LogError` if a layer is damaged.
        """
        self._read()
        marks = (mark for same in self._marks.values() for mark in same)
        own = sorted(mark for mark in marks if mark.microphone == self.microphone)
        return labelled_spans((mark.start, mark.end, mark.label) for mark in own)

    def reviewed(self) -> LabelledSpans:
        """Return the reviewed spans of the microphone in these logs, with how they were chosen.

        Raise `LogError` if a layer is damaged.
        """
        self._read()
        spans = (span for same in self._reviewed.values() for span in same)
        own = sorted(span for span in spans if span.microphone == self.microphone)
        return labelled_spans((span.start, span.end, span.chosen) for span in own)

    def _read(self) -> None:
        for log in self.coverage.logs:
            if log not in self._marks:
                self._read_layer(log)

    def _read_layer(self, log: Path) -> None:
        self._marks[log] = read_marks(log, self.scenario)
        self._reviewed[log] = read_reviewed(log, self.scenario)

    def _pieces(self, start: int, end: int) -> list[tuple[Path, int, int]]:
        """Split a span of time by log, each part with its start and end."""
        start = max([start, *self.coverage.starts[:1]])
        end = min([end, *self.coverage.ends[-1:]])
        pieces = self.coverage.split(start, end) if start < end else []
        if not pieces:
            raise DataError("part of this span was not recorded: select a recorded part")
        return pieces

    def _write(
        self,
        start: int,
        end: int,
        labels: Iterable[tuple[int, int, str]],
        chosen: str = "",
        *,
        deleted: bool = False,
    ) -> list[Mark]:
        """Replace the marks of a span by labels (start, end, label)."""
        pieces, now = self._pieces(start, end), time.time_ns()
        made = [
            Mark(self.microphone, max(a, first), min(b, last), label, self.reviewer, now,
                 self.corrects)
            for a, b, label in labels
            for _, first, last in pieces
            if max(a, first) < min(b, last)
        ]  # fmt: skip
        changes = [self._change(*piece, now, chosen, deleted=deleted) for piece in pieces]
        for (_, first, last), change in zip(pieces, changes, strict=True):
            own = [mark for mark in made if first <= mark.start < last]
            span = MarkedSpan(self.microphone, first, last)
            self._change_layer(change.log, own, [span], change.reviewed, change.not_reviewed)
        self._done.append(changes)
        self._last = now
        return made

    def _change_layer(
        self,
        log: Path,
        marks: Sequence[Mark],
        instead_of: Sequence[MarkedSpan],
        reviewed: Sequence[ReviewedSpan],
        not_reviewed: Sequence[ReviewedSpan] = (),
    ) -> None:
        scenario = self.scenario
        write_marks(
            log, marks, instead_of, reviewed=reviewed, not_reviewed=not_reviewed, scenario=scenario
        )
        self._read_layer(log)

    def _change(  # noqa: PLR0913
        self, log: Path, start: int, end: int, now: int, chosen: str, *, deleted: bool = False
    ) -> _Change:
        """Return the marks affected by a change, and their total span."""
        touched = [
            mark
            for mark in read_marks(log, self.scenario)
            if mark.microphone == self.microphone and mark.start < end and mark.end > start
        ]
        first = min([start, *(mark.start for mark in touched)])
        last = max([end, *(mark.end for mark in touched)])
        span = MarkedSpan(self.microphone, first, last)
        change = _Change(log, span, touched)
        if chosen:
            origin = self.reviewer, now, self.corrects, chosen
            change.reviewed.append(ReviewedSpan(self.microphone, start, end, *origin))
        if deleted:
            for one in read_reviewed(log, self.scenario):
                if one.microphone == self.microphone and one.start < end and one.end > start:
                    change.not_reviewed.append(one)
                    change.reviewed += _outside(one, start, end)
        return change


def _is_continued(mark: Mark, other: Mark) -> bool:
    """Return whether a mark goes on in the next log."""
    same = mark._replace(start=0, end=0) == other._replace(start=0, end=0)
    return same and other.start - mark.end < NANOSECONDS


def _is_of(span: ReviewedSpan, marks: Sequence[Mark]) -> bool:
    """Return whether a span was reviewed by one of these marks."""
    places = {(mark.start, mark.end, mark.made) for mark in marks}
    return (span.start, span.end, span.made) in places and span.chosen != RANDOM


def _outside(span: ReviewedSpan, start: int, end: int) -> list[ReviewedSpan]:
    """Cut a reviewed span; a part of a random minute is not random, so it is dropped."""
    if span.chosen == RANDOM:
        return []
    parts = span._replace(end=min(span.end, start)), span._replace(start=max(span.start, end))
    return [part for part in parts if part.start < part.end]
