"""From what was heard to rings: the same ones whether a month is looked at, or second by second."""

from collections.abc import Sequence
from datetime import tzinfo

from hearthlog.analyzer.bridge.alerts.amounts import more_than_alarms, more_than_text
from hearthlog.analyzer.bridge.alerts.clock import end_of_quiet
from hearthlog.analyzer.bridge.alerts.daily import none_by_alarms, unlike_alarms
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.long_sounds import (
    longer_than_alarms,
    longer_than_start,
    longer_than_text,
    silent_alarms,
    silent_text,
)
from hearthlog.analyzer.bridge.alerts.ring import Alarm, Ring, RuleState
from hearthlog.analyzer.bridge.alerts.rules import (
    AlertRule,
    LongerThan,
    MoreThan,
    NoneBy,
    RecorderSilent,
    UnusualDay,
)
from hearthlog.analyzer.bridge.alerts.unusual_days import unusual_alarms
from hearthlog.analyzer.logs.local_time import local_time

NEW = RuleState()


def rings(  # noqa: PLR0913, PLR0917
    rule: AlertRule,
    heard: HomeHeard,
    start: int,
    end: int,
    zone: tzinfo,
    state: RuleState = NEW,
) -> tuple[list[Ring], RuleState]:
    """Find when a rule rings.

    It rings when what it looks for begins to be the case, and not again while it stays so. Where
    that begins too soon after the ring before, it rings when the cooldown is over, if it is still
    the case then.

    Parameters
    ----------
    start, end : int
        In nanoseconds of UTC: from the start on, before the end.
    state : RuleState, optional
        What an evaluation up to the start has returned; by default there was none.
    """
    found: list[Ring] = []
    last, has_rung = state.last, False
    for alarm in _alarms(rule, heard, start, end, zone, state.since):
        if alarm.end <= start or alarm.start >= end:
            continue
        goes_on = alarm.start < start
        rung = goes_on and state.has_rung
        time = max(alarm.start, start, last + rule.cooldown)
        if not rung and time < min(alarm.end, end):
            found.append(_ring(rule, heard, alarm, time, zone))
            last, rung = time, True
        has_rung = rung and alarm.end >= end
    return found, RuleState(last, has_rung, state.since)


def _alarms(  # noqa: PLR0913, PLR0917
    rule: AlertRule, heard: HomeHeard, start: int, end: int, zone: tzinfo, since: int
) -> Sequence[Alarm]:
    """Find when what a rule looks for is the case; ascending, and apart from each other."""
    if isinstance(rule, MoreThan):
        return more_than_alarms(rule, heard, end)
    if isinstance(rule, LongerThan):
        return longer_than_alarms(rule, heard)
    if isinstance(rule, RecorderSilent):
        return silent_alarms(rule, heard, start, end, since)
    if isinstance(rule, NoneBy):
        return none_by_alarms(rule, heard, start, end, zone)
    if isinstance(rule, UnusualDay):
        return unusual_alarms(rule, heard, start, end, zone)
    return unlike_alarms(rule, heard, start, end, zone)


def _ring(rule: AlertRule, heard: HomeHeard, alarm: Alarm, time: int, zone: tzinfo) -> Ring:
    due = end_of_quiet(rule.hours(), time, zone)
    return Ring(rule.name, time, _text(rule, heard, alarm, time, zone), alarm.is_known, due)


def _text(rule: AlertRule, heard: HomeHeard, alarm: Alarm, time: int, zone: tzinfo) -> str:
    if isinstance(rule, MoreThan):
        return more_than_text(rule, heard, time)
    if isinstance(rule, LongerThan):
        began = longer_than_start(rule, heard, time)
        return longer_than_text(rule, f"{local_time(began, zone):%H:%M}")
    return silent_text(rule) if isinstance(rule, RecorderSilent) else alarm.text
