"""When a class went on for too long, and when the recorder wrote nothing for too long."""

import numpy as np

from hearthlog.analyzer.bridge.alerts.duration import duration_words
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.ring import Alarm
from hearthlog.analyzer.bridge.alerts.rules import LongerThan, RecorderSilent
from hearthlog.analyzer.bridge.alerts.sound_events import events_of_rule


def longer_than_alarms(rule: LongerThan, heard: HomeHeard) -> list[Alarm]:
    """Find when a class had gone on for too long, until its pause is longer than one may be."""
    events = events_of_rule(rule, heard)
    limits = events.starts + rule.longer_than
    rows = np.flatnonzero(limits < events.ends)
    # In a pause it is not known whether the event goes on.
    spans = np.searchsorted(events.heard.ends, limits[rows], side="right")
    times = np.maximum(events.heard.starts[spans], limits[rows])
    over = events.ends[rows] + rule.pause + 1
    return [Alarm(*span) for span in zip(times.tolist(), over.tolist(), strict=True)]


def longer_than_start(rule: LongerThan, heard: HomeHeard, time: int) -> int:
    """Return when the sound began that goes on at a time, in nanoseconds of UTC.

    Parameters
    ----------
    time : int
        In nanoseconds of UTC, at which one does.
    """
    starts = events_of_rule(rule, heard).starts
    return int(starts[np.searchsorted(starts, time, side="right") - 1])


def longer_than_text(rule: LongerThan, since: str) -> str:
    """Say what went on for too long.

    Parameters
    ----------
    since : str
        Time of day.
    """
    return f"{rule.words} for longer than {duration_words(rule.longer_than)}, since {since}"


def silent_alarms(
    rule: RecorderSilent, heard: HomeHeard, start: int, end: int, since: int
) -> list[Alarm]:
    """Find when the recorder had written nothing for too long.

    Parameters
    ----------
    start, end : int
        In nanoseconds of UTC; where nothing was written in as long before the start, nothing was
        from ever on.
    since : int
        From when on the rule is in force, in nanoseconds of UTC: earlier silence does not count.
    """
    starts, ends = heard.written
    before = start - 1 - rule.silent_for
    lasts = (max(last, since) for last in [before, *ends.tolist()])
    silences = zip(lasts, [*starts.tolist(), end], strict=True)
    return [
        Alarm(last + rule.silent_for, first)
        for last, first in silences
        if first - last > rule.silent_for
    ]


def silent_text(rule: RecorderSilent) -> str:
    """Say that the recorder is silent."""
    return f"Nothing from the recorder for {duration_words(rule.silent_for)}"
