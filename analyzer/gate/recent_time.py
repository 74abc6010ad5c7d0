"""The recent time of a home that a model has not learned from, and parts of it to judge it by."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import SEGMENT_FIELDS
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, joined, without
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, parse_topic

_DAY = 86_400 * NANOSECONDS
_RECENT = 14 * _DAY
_LOUD = 36, 75 * NANOSECONDS  # number of spans that are labelled, and their length
_QUIET = 16, 120 * NANOSECONDS
_AROUND = 10 * NANOSECONDS  # a sound
_SHORTEST = 30 * NANOSECONDS  # time that is worth a look into a log
_SEED = 7


class RecentLog(NamedTuple):
    """A log, and when its messages are (ns of UTC)."""

    path: Path
    start: int
    end: int


class Part(NamedTuple):
    """A span of a log, in nanoseconds of UTC."""

    log: Path
    start: int
    end: int
    microphone: str | None = None  # None for all of them


class WeightedPart(NamedTuple):
    """A part that stands for more time like it."""

    part: Part
    weight: float  # how much more


def recent_logs(folders: Iterable[Path]) -> list[RecentLog]:
    """Find the logs of the last two weeks of a home, in the order of time."""
    try:
        entries = find_home_logs(folders).between()
    except LogError:  # no log at all
        return []
    newest = max((entry.start for entry in entries), default=0)
    logs = []
    for entry in entries:
        if newest - entry.start <= _RECENT:
            with suppress(LogError, OSError):
                span = time_span(entry.path)
                if span is not None and span[1] > span[0]:
                    logs.append(RecentLog(entry.path, *span))
    return logs


def sounding_time(logs: Sequence[RecentLog]) -> Spans:
    """Return when something else than silence was labelled by who recorded the logs."""
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
    """Return the time of a home that a model has learned from, as far as that is known.

    Parameters
    ----------
    marked : Spans
        Marks of the home, from all of which an adapted model that says no time is taken to have
        learned.
    """
    training = model.description.training_data
    if training.home_spans:
        times = np.array(training.home_spans, np.int64)
        return joined(times[:, 0], times[:, 1])
    return marked if any(amount.segments for amount in training.home.values()) else NONE


def unlearned_time(logs: Sequence[RecentLog], learned: Spans) -> list[Part]:
    """Return the time of logs that nothing was learned from, in the order of the logs."""
    parts = []
    for log in logs:
        whole = Spans(np.array([log.start]), np.array([log.end]))
        rest = without(whole, cut(learned, log.start, log.end))
        times = zip(rest.starts.tolist(), rest.ends.tolist(), strict=True)
        parts += [Part(log.path, *span) for span in times if span[1] - span[0] >= _SHORTEST]
    return parts


def choose(parts: Sequence[Part], sounding: Spans, seed: int = _SEED) -> list[WeightedPart]:
    """Choose parts of the time to judge by: 45 minutes with sound at most, and 32 without."""
    near = joined(sounding.starts - _AROUND, sounding.ends + _AROUND, _AROUND)
    loud: list[Part] = []
    quiet: list[Part] = []
    for part in parts:
        whole = Spans(np.array([part.start]), np.array([part.end]))
        inside = cut(near, part.start, part.end)
        for chosen, spans in ((loud, inside), (quiet, without(whole, inside))):
            times = zip(spans.starts.tolist(), spans.ends.tolist(), strict=True)
            chosen += [part._replace(start=start, end=end) for start, end in times]
    return [*_weighted(loud, *_LOUD, seed), *_weighted(quiet, *_QUIET, seed)]


def sample(parts: Sequence[Part], count: int, longest: int, seed: int = _SEED) -> list[Part]:
    """Choose spans of time, so many at most.

    One begins in each of as many equal shares of the time, at a moment that is drawn: so they are
    of all days and of all times of day. The same time gives the same spans.

    Parameters
    ----------
    longest : int
        Nanoseconds of each; one ends earlier where its part does.
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
        # Back from the end of its part, where it would else be cut short.
        start = max(min(part.start + moment - int(begins[row]), part.end - longest), part.start)
        chosen.append(part._replace(start=start, end=min(start + longest, part.end)))
    return chosen


def _weighted(parts: Sequence[Part], count: int, longest: int, seed: int) -> list[WeightedPart]:
    chosen = sample(parts, count, longest, seed)
    whole, sampled = (sum(part.end - part.start for part in some) for some in (parts, chosen))
    return [WeightedPart(part, whole / sampled) for part in chosen]


def recorded_minutes(logs: Sequence[RecentLog]) -> float:
    """Return how much is recorded."""
    return sum(log.end - log.start for log in logs) / (60 * NANOSECONDS)


def minutes_a_day(logs: Sequence[RecentLog]) -> float | None:
    """Return how much is recorded in a mean day on which there are logs, at most 24 hours.

    None if less than a day is recorded in all, which says nothing of a mean day.
    """
    days = {log.start // _DAY for log in logs} | {(log.end - 1) // _DAY for log in logs}
    total, day = recorded_minutes(logs), _DAY / (60 * NANOSECONDS)
    return None if total < day else min(total / len(days), day)
