"""The events that a rule counts, and from when on each of them counts."""

from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.rules import SoundRule, pause_of
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, first_of_groups, joined
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS


class SoundEvents(NamedTuple):
    """Events of the segments that a rule counts: those with short pauses between them.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    counted : np.ndarray [shape=(n,)], int64
        When each had lasted as long as it must: from then on it counts.
    """

    starts: Int64
    ends: Int64
    counted: Int64
    heard: Spans

    def heard_counted(self) -> Spans:
        """Return what was heard of each event from when on it counts."""
        if self.counted is self.starts:
            return self.heard
        parts = [
            cut(self.heard, start, end)
            for start, end in zip(self.counted.tolist(), self.ends.tolist(), strict=True)
            if start < end
        ]
        if not parts:
            return NONE
        return Spans(*(np.concatenate(edges) for edges in zip(*parts, strict=True)))


def events_of_rule(rule: SoundRule, heard: HomeHeard) -> SoundEvents:
    """Find the events that a rule counts.

    Returns
    -------
    SoundEvents
        Without those that are too short. Segments of all microphones that are at most ten seconds
        apart are one event, unless the rule says otherwise.
    """
    sounds = heard.of(rule.label)
    rows = sounds.confidences >= np.float32(rule.confidence)
    if rule.microphone:
        rows &= sounds.microphones == rule.microphone
    spans = joined(sounds.starts[rows], sounds.ends[rows])
    firsts = first_of_groups(spans.starts, spans.ends, pause_of(rule))
    ends = spans.ends[np.append(firsts[1:], len(spans.ends)) - 1] if len(firsts) else spans.ends
    starts = spans.starts[firsts]
    least = round(rule.least_seconds * NANOSECONDS)
    if not least:
        return SoundEvents(starts, ends, starts, spans)
    counted, long_enough = _times_heard(spans, firsts, least)
    return SoundEvents(starts[long_enough], ends[long_enough], counted[long_enough], spans)


def _times_heard(spans: Spans, firsts: Int64, least: int) -> tuple[Int64, Int64]:
    """Return when each group of spans has so much in it, and which ones ever have."""
    lengths = spans.ends - spans.starts
    sums = np.cumsum(lengths)
    before = sums[firsts] - lengths[firsts]
    totals = np.append(before[1:], sums[-1:]) - before
    rows = np.minimum(np.searchsorted(sums, before + least), max(len(sums) - 1, 0))
    times = spans.ends[rows] - (sums[rows] - before - least)
    return times, np.flatnonzero(totals >= least)
