"""Recent time of a home outside a model's training set, and its sounds of known label."""

from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import SEGMENT_FIELDS, Labellings, find_labellings
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    cut,
    difference,
    difference_rows,
    joined,
    single_span,
)
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, read_marks, read_reviewed
from hearthlog.models.classes import SILENCE, UNDECIDED, class_name
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, parse_topic, relabelling

_DAY = 86_400 * NANOSECONDS
_LOUD = 36, 75 * NANOSECONDS  # number and length of the spans to label
_QUIET = 16, 120 * NANOSECONDS
_AROUND = 10 * NANOSECONDS  # around a sound
_SHORTEST_PART = 30 * NANOSECONDS  # shortest time worth opening a log
_SEED = 7


class RecentLog(NamedTuple):
    """A log, and the time of its messages (ns of UTC)."""

    path: Path
    start: int
    end: int


class LogSpan(NamedTuple):
    """A span of a log, in nanoseconds of UTC, which may represent more time of the same kind."""

    log: Path
    start: int
    end: int
    microphone: str | None = None  # None for all of them
    weight: float = 1.0  # represented time per time of the span


def recent_logs(folders: Iterable[Path]) -> list[RecentLog]:
    """Return the logs of the last two weeks of a home, in order of time."""
    try:
        entries = find_home_logs(folders).recent()
    except LogError:  # no log at all
        return []
    logs = []
    for entry in entries:
        with suppress(LogError, OSError):
            span = time_span(entry.path)
            if span is not None and span[1] > span[0]:
                logs.append(RecentLog(entry.path, *span))
    return logs


def sounding_time(logs: Sequence[RecentLog]) -> Spans:
    """Return the time that the recording models labelled as other than silence."""
    starts, ends = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for log in logs:
        with suppress(LogError):
            names = select([log.path]).topics_of(message_types.SEGMENT, SEGMENT_FIELDS)
            live = {name for name in names if (t := parse_topic(name)) and t.labelling == LIVE}
            for columns in read_columns([log.path], live, fields=SEGMENT_FIELDS).values():
                sounds = columns["label"] != SILENCE
                starts.append(columns["header.stamp"][sounds])
                ends.append(starts[-1] + columns["duration"][sounds])
    return joined(np.concatenate(starts), np.concatenate(ends))


def learned_time(model: Model, marked: Spans) -> Spans:
    """Return the time of a home in a model's training set, as far as recorded.

    An adapted model without recorded times is assumed to have used all `marked` time.
    """
    training = model.description.training_data
    if training.home_spans:
        times = np.array(training.home_spans, np.int64)
        return joined(times[:, 0], times[:, 1])
    return marked if any(amount.segments for amount in training.home.values()) else NONE


def unlearned_time(logs: Sequence[RecentLog], learned: Spans) -> list[LogSpan]:
    """Return the time of logs outside the training set, in the order of the logs."""
    parts = []
    for log in logs:
        rest = difference(single_span(log.start, log.end), cut(learned, log.start, log.end))
        spans = (span for span in rest.pairs() if span[1] - span[0] >= _SHORTEST_PART)
        parts += [LogSpan(log.path, *span) for span in spans]
    return parts


def choose(parts: Sequence[LogSpan], sounding: Spans, seed: int = _SEED) -> list[LogSpan]:
    """Choose parts of the time for the check: at most 45 minutes with sound, and 32 without."""
    near = joined(sounding.starts - _AROUND, sounding.ends + _AROUND, _AROUND)
    loud: list[LogSpan] = []
    quiet: list[LogSpan] = []
    for part in parts:
        inside = cut(near, part.start, part.end)
        rest = difference(single_span(part.start, part.end), inside)
        for chosen, spans in ((loud, inside), (quiet, rest)):
            chosen += [part._replace(start=start, end=end) for start, end in spans.pairs()]
    return [*_weighted(loud, *_LOUD, seed), *_weighted(quiet, *_QUIET, seed)]


def sample(parts: Sequence[LogSpan], count: int, longest: int, seed: int = _SEED) -> list[LogSpan]:
    """Choose a limited number of spans of time, `longest` ns or up to the end of their part.

    One span starts at a random moment in each of as many equal shares of the time, so that all days
    and times of day are covered. Deterministic for the same time.
    """
    lengths = np.array([part.end - part.start for part in parts], np.int64)
    total = int(lengths.sum())
    if total <= count * longest:
        return list(parts)
    drawn = np.random.default_rng(seed).random(count)
    moments = ((np.arange(count) + drawn) * (total / count)).astype(np.int64)
    begins = np.concatenate([[0], np.cumsum(lengths)])
    rows = np.searchsorted(begins, moments, side="right") - 1
    chosen = []
    for row, moment in zip(rows.tolist(), moments.tolist(), strict=True):
        part = parts[row]
        # Moved back from the end of its part, so that it is not cut short.
        start = max(min(part.start + moment - int(begins[row]), part.end - longest), part.start)
        chosen.append(part._replace(start=start, end=min(start + longest, part.end)))
    return chosen


def _weighted(parts: Sequence[LogSpan], count: int, longest: int, seed: int) -> list[LogSpan]:
    chosen = sample(parts, count, longest, seed)
    total, sampled = (sum(part.end - part.start for part in some) for some in (parts, chosen))
    return [part._replace(weight=total / sampled) for part in chosen]


def recorded_minutes(logs: Sequence[RecentLog]) -> float:
    """Return the recorded time in minutes."""
    return sum(log.end - log.start for log in logs) / (60 * NANOSECONDS)


def minutes_a_day(logs: Sequence[RecentLog]) -> float | None:
    """Return the recorded minutes of a mean day with logs, at most 24 hours.

    None if less than a day is recorded in total, which is too little for a mean day.
    """
    days = {log.start // _DAY for log in logs} | {(log.end - 1) // _DAY for log in logs}
    total, day = recorded_minutes(logs), _DAY / (60 * NANOSECONDS)
    return None if total < day else min(total / len(days), day)


_SHORTEST_SOUND = NANOSECONDS // 2  # shortest sound that counts
_REMAINS = 2 * NANOSECONDS  # a shorter rest next to a mark belongs to the marked sound
_FOLLOWING = 3  # logs: a segment is in the one in which it ends


class ReferenceSound(NamedTuple):
    """A sound of known label."""

    start: int
    end: int
    label: str
    random: bool  # whether its time was drawn at random rather than chosen
    microphone: str


def reference(log: Path, following: Sequence[Path] = ()) -> list[ReferenceSound]:
    """Return the sounds of known label, half a second or more, of a log; random time first.

    They are sorted by start. Raise `LogError` if its review layer is damaged, or the reviewed
    labelling is missing.
    """
    marks = read_marks(log)
    drawn = [span for span in read_reviewed(log) if span.chosen == RANDOM]
    labellings = find_labellings(log, *following[:_FOLLOWING]) if drawn else Labellings([])
    inside = [sound for span in drawn for sound in _true(labellings, span, marks)]
    others = [
        ReferenceSound(mark.start, mark.end, mark.label, random=False, microphone=mark.microphone)
        for mark in marks
        if class_name(mark.label) not in UNDECIDED
        and not any(_inside(mark, span) for span in drawn)
    ]
    return [sound for sound in [*inside, *others] if sound.end - sound.start >= _SHORTEST_SOUND]


def left_alone(log: Path) -> list[ReferenceSound]:
    """Return the sounds of a log with confirmed labels: reviewed, not at random, and unmarked.

    They last half a second or more, two seconds next to a mark; unreadable labels are skipped.
    """
    sounds: list[ReferenceSound] = []
    with suppress(DataError, LogError):
        marks = read_marks(log)
        spans = [span for span in read_reviewed(log) if span.chosen != RANDOM]
        labellings = find_labellings(log) if spans else Labellings([])
        marked = {(mark.start, mark.end) for mark in marks}
        edges = {edge for mark in marked for edge in mark}
        for span in spans:
            with suppress(DataError, LogError):
                sounds += [
                    sound._replace(random=False)
                    for sound in _parts(labellings, span, marks)
                    if (sound.start, sound.end) not in marked
                    and sound.end - sound.start >= _least(sound, edges)
                ]
    return sounds


def _least(sound: ReferenceSound, edges: AbstractSet[int]) -> int:
    """Return the minimum length of a sound."""
    return _SHORTEST_SOUND if edges.isdisjoint((sound.start, sound.end)) else _REMAINS


def _true(
    labellings: Labellings, span: ReviewedSpan, marks: Iterable[Mark]
) -> Iterator[ReferenceSound]:
    """Yield the true labels of a reviewed span: the labelling, overlaid with the marks.

    Touching spans with one label are one sound, independent of the marks.
    """
    parts: dict[str, list[ReferenceSound]] = {}
    for part in _parts(labellings, span, marks):
        parts.setdefault(class_name(part.label), []).append(part)
    for same in parts.values():
        for start, end in spans_of([(part.start, part.end) for part in same]).pairs():
            yield same[0]._replace(start=start, end=end)


def _parts(
    labellings: Labellings, span: ReviewedSpan, marks: Iterable[Mark]
) -> Iterator[ReferenceSound]:
    sound = partial(ReferenceSound, random=True, microphone=span.microphone)
    own = [m for m in marks if m.microphone == span.microphone and _inside(m, span)]
    for mark in own:
        if class_name(mark.label) not in UNDECIDED:
            yield sound(max(mark.start, span.start), min(mark.end, span.end), mark.label)
    corrects = LIVE if span.corrects == LIVE else relabelling(span.corrects)
    name = labellings.find(span.microphone, corrects)
    labels = labellings.read(span.microphone, name, span.start, span.end).labelling
    rest, row = difference_rows(labels, spans_of([(mark.start, mark.end) for mark in own]))
    for start, end, label in zip(rest.starts, rest.ends, labels.labels[row], strict=True):
        yield sound(int(start), int(end), str(label))


def _inside(mark: Mark, span: ReviewedSpan) -> bool:
    return mark.start < span.end and mark.end > span.start


def spans_of(times: Sequence[tuple[int, int]], pause: int = 0) -> Spans:
    """Merge spans of time that overlap or are no more than a pause apart."""
    array = np.array(times, np.int64).reshape(-1, 2)
    return joined(array[:, 0], array[:, 1], pause)
