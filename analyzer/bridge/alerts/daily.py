"""Rules that have an answer once a day: none by a time, and a day unlike those before it."""

from datetime import date, timedelta, tzinfo

import numpy as np

from hearthlog.analyzer.bridge.alerts.clock import days_around, wall_times
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.ring import Alarm
from hearthlog.analyzer.bridge.alerts.rules import DailyRule, NoneBy, UnlikeUsual
from hearthlog.analyzer.bridge.alerts.sound_events import events_of_rule
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour, day_span
from hearthlog.analyzer.logs.spans import cut
from hearthlog.analyzer.report.values import BASELINE_DAYS, Count, Duration, UsualRange, usual_range
from hearthlog.schemas.frames import NANOSECONDS

_MINUTE = 60 * NANOSECONDS


def none_by_alarms(
    rule: NoneBy, heard: HomeHeard, start: int, end: int, zone: tzinfo
) -> list[Alarm]:
    """Find the days on which nothing of a class was heard by a time, or too little to tell."""
    windows = [
        (first, last)
        for day in days_around(start, end, zone)
        for first, last in [_window(rule, day, zone)]
        if start <= last < end and first < last
    ]
    if not windows:
        return []
    events = events_of_rule(rule, heard)
    listened = heard.listened(rule.label, rule.microphone)
    alarms = []
    for first, last in windows:
        if ((events.counted < last) & (events.ends > first)).any():
            continue
        share = cut(listened, first, last).length / (last - first)
        is_known = share >= rule.least_share
        alarms.append(Alarm(last, last + 1, _none_text(rule, share, is_known=is_known), is_known))
    return alarms


def _window(rule: NoneBy, day: date, zone: tzinfo) -> tuple[int, int]:
    """Return the window that ends on a day: the longest one that the clock may mean."""
    began = day if rule.since < rule.by else day - timedelta(days=1)
    return wall_times(began, rule.since, zone)[0], wall_times(day, rule.by, zone)[1]


def _none_text(rule: NoneBy, share: float, *, is_known: bool) -> str:
    hours = f"from {_clock(rule.since)} to {_clock(rule.by)}"
    if is_known:
        return f"{rule.words}: none {hours}"
    heard = f"{int(100 * share)} %"
    return f"{rule.words} {hours}: not known, for only {heard} of that time was heard"


def _clock(minute: int) -> str:
    hours, minutes = divmod(minute, 60)
    return f"{hours:02}:{minutes:02}"


def unlike_alarms(
    rule: UnlikeUsual, heard: HomeHeard, start: int, end: int, zone: tzinfo
) -> list[Alarm]:
    """Find the days, or nights, that were outside of what the four weeks before them had.

    Parameters
    ----------
    heard : HomeHeard
        From 31 days before the start on.
    """
    days = judged_days(rule, start, end, zone)
    if not days:
        return []
    figures = _Figures(rule, heard, zone)
    alarms = []
    for day, time in days:
        own = figures.of(day)
        baseline = usual_range(
            [figures.of(day - timedelta(days=ago)) for ago in range(1, BASELINE_DAYS + 1)]
        )
        if own is not None and baseline is not None and _is_unlike(rule, own.middle, baseline):
            alarms.append(Alarm(time, time + 1, _unlike_text(rule, day, own, baseline)))
    return alarms


def judged_days(rule: DailyRule, start: int, end: int, zone: tzinfo) -> list[tuple[date, int]]:
    """List the days on which a rule is to be evaluated in a span of time, and when.

    Returns
    -------
    list of (date, int)
        The times are in nanoseconds of UTC.
    """
    times = [(day, wall_times(day, rule.at, zone)[1]) for day in days_around(start, end, zone)]
    return [(day, time) for day, time in times if start <= time < end]


class _Figures:
    """The figure that is compared, of each day that was heard for the most part."""

    def __init__(self, rule: UnlikeUsual, heard: HomeHeard, zone: tzinfo) -> None:
        self._rule = rule
        self._zone = zone
        self._events = events_of_rule(rule, heard)
        self._heard = self._events.heard_counted()
        self._listened = heard.listened(rule.label, rule.microphone)
        self._known: dict[date, Count | Duration | None] = {}

    def of(self, day: date) -> Count | Duration | None:
        """Return the figure that is judged on a day."""
        if day not in self._known:
            self._known[day] = self._figure(*_part(self._rule, day, self._zone))
        return self._known[day]

    def _figure(self, start: int, end: int) -> Count | Duration | None:
        listened = cut(self._listened, start, end).length
        if listened < self._rule.least_share * (end - start):
            return None
        counted = self._events.counted
        events = int(np.searchsorted(counted, end) - np.searchsorted(counted, start))
        if self._rule.of == "count":
            return Count(events)
        lump = self._rule.least_seconds / 60 * events
        return Duration(cut(self._heard, start, end).length / _MINUTE + lump)


def _part(rule: UnlikeUsual, day: date, zone: tzinfo) -> tuple[int, int]:
    before = day - timedelta(days=1)
    if rule.part == "day":
        return day_span(before, zone)
    return at_hour(before, EVENING, zone), at_hour(day, MORNING, zone)


def _is_unlike(rule: UnlikeUsual, value: float, baseline: UsualRange) -> bool:
    more = value > baseline.highest * (1 + rule.margin)
    less = value < baseline.lowest * (1 - rule.margin)
    return (more and rule.which != "less") or (less and rule.which != "more")


def _unlike_text(rule: UnlikeUsual, day: date, own: Count | Duration, baseline: UsualRange) -> str:
    when = f"on {day - timedelta(days=1)}" if rule.part == "day" else f"in the night to {day}"
    times = " times" if rule.of == "count" else ""
    usually = own.spread(*baseline)
    return f"{rule.words} {when}: {own.show(own.middle)}{times}, usually {usually}"
