"""When there was more than so much of a class in a window."""

import numpy as np

from hearthlog.analyzer.bridge.alerts.duration import MINUTE, duration_words
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.ring import Alarm
from hearthlog.analyzer.bridge.alerts.rules import MoreThan
from hearthlog.analyzer.bridge.alerts.sound_events import SoundEvents, events_of_rule
from hearthlog.analyzer.logs.spans import Spans, joined, lengths, rows_at
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS


def more_than_alarms(rule: MoreThan, heard: HomeHeard, until: int) -> list[Alarm]:
    """Find when there was more of a class in the window before than a rule allows.

    Parameters
    ----------
    heard : HomeHeard
        From the length of the window before the first time that matters.
    until : int
        Time up to which it is known, in nanoseconds of UTC.
    """
    events = events_of_rule(rule, heard)
    spans = _too_many(rule, events) if rule.minutes is None else _too_long(rule, events, until)
    return [Alarm(*span) for span in zip(spans.starts.tolist(), spans.ends.tolist(), strict=True)]


def more_than_text(rule: MoreThan, heard: HomeHeard, time: int) -> str:
    """Say how much there was in the window that ends with a time."""
    window = duration_words(rule.window)
    if rule.minutes is not None:
        return f"{rule.words}: more than {rule.minutes:g} min in the last {window}"
    counted = events_of_rule(rule, heard).counted
    number = int(((counted > time - rule.window) & (counted <= time)).sum())
    times = "once" if number == 1 else f"{number} times"
    return f"{rule.words}: {times} in the last {window}, more than {rule.count}"


def _too_many(rule: MoreThan, events: SoundEvents) -> Spans:
    """Each event counts for the length of the window."""
    assert rule.count is not None
    times = np.concatenate([events.counted, events.counted + rule.window])
    steps = np.repeat([1, -1], len(events.counted))
    edges, places = np.unique(times, return_inverse=True)
    numbers = np.cumsum(np.bincount(places, steps, len(edges)))
    over = np.flatnonzero(numbers[:-1] > rule.count)
    return joined(edges[over], edges[over + 1])


def _too_long(rule: MoreThan, events: SoundEvents, until: int) -> Spans:
    """Measure the window at every time at which the measure may begin to grow or to shrink."""
    assert rule.minutes is not None
    most = round(rule.minutes * MINUTE)
    spans, lump = events.heard_counted(), round(rule.least_seconds * NANOSECONDS)
    inside = [events.counted, spans.starts, spans.ends]
    edges = np.unique(np.concatenate([*inside, *(times + rule.window for times in inside)]))
    edges = np.append(edges[edges < until], until)
    if len(edges) < 2:
        return joined(edges[:0], edges[:0])
    amounts = _sum_to(spans, edges) - _sum_to(spans, edges - rule.window)
    known = np.searchsorted(events.counted, edges, side="right")
    gone = np.searchsorted(events.counted, edges - rule.window, side="right")
    amounts, lengths_of = (amounts + lump * (known - gone))[:-1], np.diff(edges)
    now, earlier = (rows_at(spans, times[:-1]) >= 0 for times in (edges, edges - rule.window))
    slopes = now.astype(np.int64) - earlier
    missing = np.where(slopes > 0, np.maximum(most - amounts, 0), 0)
    missing[(slopes <= 0) & (amounts <= most)] = until
    left = np.where(slopes < 0, np.minimum(amounts - most, lengths_of), lengths_of)
    over = missing < left
    return joined((edges[:-1] + missing)[over], (edges[:-1] + left)[over])


def _sum_to(spans: Spans, times: Int64) -> Int64:
    """Measure spans up to each of some ascending times."""
    first = min(int(times[0]), int(spans.starts[0]) if len(spans.starts) else 0)
    return np.cumsum(lengths(spans, np.concatenate([[first], times])))
