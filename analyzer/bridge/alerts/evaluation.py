"""Evaluation of alert rules on the activity of a home: conditions and notifications."""

from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta, tzinfo
from functools import cache
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity import ANY_SOUND
from hearthlog.analyzer.activity.checked_minutes import UNSURE_BELOW
from hearthlog.analyzer.activity.day_anomaly import Routines
from hearthlog.analyzer.activity.day_profile import (
    HomeSegments,
    Profiles,
    television_spans,
)
from hearthlog.analyzer.activity.doubtful_sounds import without_too_doubtful
from hearthlog.analyzer.activity.segments import HomeActivity, is_of_scenario
from hearthlog.analyzer.activity.values import (
    BASELINE_DAYS,
    Clock,
    Count,
    Duration,
    UsualRange,
    usual_range,
)
from hearthlog.analyzer.bridge.alerts.rules import (
    MINUTE,
    AlertRule,
    Condition,
    DailyRule,
    LongerThan,
    MoreThan,
    NoneBy,
    Notification,
    RecorderSilent,
    RuleState,
    SoundRule,
    UnlikeUsual,
    UnusualDay,
    delay_of,
    duration_words,
    pause_of,
)
from hearthlog.analyzer.logs.labelling import Labelling, in_order
from hearthlog.analyzer.logs.local_time import day_span, local_time, night_span
from hearthlog.analyzer.logs.spans import (
    EVENT_PAUSE,
    NONE,
    Spans,
    cut,
    first_of_groups,
    intersection,
    joined,
    lengths,
    rows_at,
)
from hearthlog.analyzer.report.wording import differences_text, rarity_text, short_day
from hearthlog.models.classes import COUNTED_IF_SURE, ON_TELEVISION, SILENCE
from hearthlog.recorder.pause_schedule import QuietHours
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS


class SoundEvents(NamedTuple):
    """Events of a rule: segments joined over short pauses; times in nanoseconds of UTC."""

    starts: Int64
    ends: Int64
    counted: Int64  # [shape=(n,)]; when each event reached the minimum length, and so counts
    coverage: Spans  # joined segments, including those of too short events

    def counted_coverage(self) -> Spans:
        """Return the heard spans of each event from the time at which the event counts."""
        if self.counted is self.starts:
            return self.coverage
        begun = self.counted < self.ends
        return intersection(self.coverage, Spans(self.counted[begun], self.ends[begun]))


def events_of_rule(
    rule: SoundRule, activity: HomeActivity, television: Spans = NONE
) -> SoundEvents:
    """Find the events that a rule counts, without too short ones.

    Segments of all microphones that are at most ten seconds apart form one event, unless the rule
    sets a microphone or pause. Those beside a `television` are left out. All times are later by the
    delay of the rule.
    """
    sounds = activity.of(rule.label)
    rows = sounds.confidences >= np.float32(rule.confidence)
    if rule.microphone:
        rows &= sounds.microphones == rule.microphone
    spans = joined(sounds.starts[rows], sounds.ends[rows])
    if delay := delay_of(rule):
        television = television_spans(home_sound(activity).labels)
    if len(television.starts):
        events = joined(*spans, EVENT_PAUSE)
        own = rows_at(television, events.starts) < 0
        spans = intersection(spans, Spans(events.starts[own], events.ends[own]))
    spans = Spans(spans.starts + delay, spans.ends + delay)
    firsts = first_of_groups(spans.starts, spans.ends, pause_of(rule))
    ends = spans.ends[np.append(firsts[1:], len(spans.ends)) - 1] if len(firsts) else spans.ends
    starts = spans.starts[firsts]
    least = round(rule.least_seconds * NANOSECONDS)
    if not least:
        return SoundEvents(starts, ends, starts, spans)
    counted, long_enough = _listened_times(spans, firsts, least)
    return SoundEvents(starts[long_enough], ends[long_enough], counted[long_enough], spans)


def _listened_times(spans: Spans, firsts: Int64, least: int) -> tuple[Int64, Int64]:
    """Return when each group of spans reaches a total length, and the groups that reach it."""
    lengths = spans.ends - spans.starts
    sums = np.cumsum(lengths)
    before = sums[firsts] - lengths[firsts]
    totals = np.append(before[1:], sums[-1:]) - before
    rows = np.minimum(np.searchsorted(sums, before + least), max(len(sums) - 1, 0))
    times = spans.ends[rows] - (sums[rows] - before - least)
    return times, np.flatnonzero(totals >= least)


def more_than_conditions(rule: MoreThan, activity: HomeActivity, until: int) -> list[Condition]:
    """Find when a class exceeded the limit of a rule in the preceding window.

    The activity must begin one window before the first evaluated time; `until` is its end, in
    nanoseconds of UTC.
    """
    events = events_of_rule(rule, activity)
    window = duration_words(rule.window)

    def text(time: int) -> str:
        if rule.minutes is not None:
            return f"{rule.words}: more than {rule.minutes:g} min in the last {window}"
        number = int(((events.counted > time - rule.window) & (events.counted <= time)).sum())
        times = "once" if number == 1 else f"{number} times"
        return f"{rule.words}: {times} in the last {window}, more than {rule.count}"

    spans = _too_many(rule, events) if rule.minutes is None else _too_long(rule, events, until)
    return [Condition(*span, text) for span in spans.pairs()]


def _too_many(rule: MoreThan, events: SoundEvents) -> Spans:
    """Find when the window has too many events; each event counts for one window length."""
    assert rule.count is not None
    times = np.concatenate([events.counted, events.counted + rule.window])
    steps = np.repeat([1, -1], len(events.counted))
    edges, places = np.unique(times, return_inverse=True)
    numbers = np.cumsum(np.bincount(places, steps, len(edges)))
    over = np.flatnonzero(numbers[:-1] > rule.count)
    return joined(edges[over], edges[over + 1])


def _too_long(rule: MoreThan, events: SoundEvents, until: int) -> Spans:
    """Find when the window has too many minutes.

    The total is piecewise linear, so it is measured at every time at which its slope may change.
    """
    assert rule.minutes is not None
    most = round(rule.minutes * MINUTE)
    spans, lump = events.counted_coverage(), round(rule.least_seconds * NANOSECONDS)
    inside = [events.counted, spans.starts, spans.ends]
    edges = np.unique(np.concatenate([*inside, *(times + rule.window for times in inside)]))
    edges = np.append(edges[edges < until], until)
    if len(edges) < 2:
        return joined(edges[:0], edges[:0])
    amounts = _sum_to(spans, edges) - _sum_to(spans, edges - rule.window)
    counted = np.searchsorted(events.counted, edges, side="right")
    gone = np.searchsorted(events.counted, edges - rule.window, side="right")
    amounts, lengths_of = (amounts + lump * (counted - gone))[:-1], np.diff(edges)
    now, earlier = (rows_at(spans, times[:-1]) >= 0 for times in (edges, edges - rule.window))
    slopes = now.astype(np.int64) - earlier
    missing = np.where(slopes > 0, np.maximum(most - amounts, 0), 0)
    missing[(slopes <= 0) & (amounts <= most)] = until
    left = np.where(slopes < 0, np.minimum(amounts - most, lengths_of), lengths_of)
    over = missing < left
    return joined((edges[:-1] + missing)[over], (edges[:-1] + left)[over])


def _sum_to(spans: Spans, times: Int64) -> Int64:
    """Return the total length of spans up to each of several ascending times."""
    first = min(int(times[0]), int(spans.starts[0]) if len(spans.starts) else 0)
    return np.cumsum(lengths(spans, np.concatenate([[first], times])))


def longer_than_conditions(
    rule: LongerThan, activity: HomeActivity, zone: tzinfo
) -> list[Condition]:
    """Find when a class lasted too long, until a pause ends the event."""
    events = events_of_rule(rule, activity)
    limits = events.starts + rule.longer_than
    rows = np.flatnonzero(limits < events.ends)
    # During a pause it is unknown whether the event continues.
    spans = np.searchsorted(events.coverage.ends, limits[rows], side="right")
    times = np.maximum(events.coverage.starts[spans], limits[rows])
    over = events.ends[rows] + rule.pause + 1

    def text(time: int) -> str:
        began = events.starts[np.searchsorted(events.starts, time, side="right") - 1]
        since = f"{local_time(int(began) - delay_of(rule), zone):%H:%M}"
        return f"{rule.words} for longer than {duration_words(rule.longer_than)}, since {since}"

    return [Condition(*span, text) for span in zip(times.tolist(), over.tolist(), strict=True)]


def silent_conditions(
    rule: RecorderSilent, activity: HomeActivity, start: int, end: int, since: int
) -> list[Condition]:
    """Find when the recorder had written nothing for too long.

    Times are nanoseconds of UTC. A recorder that wrote nothing within `silent_for` before the start
    counts as silent at the start. The rule came into force at `since`: earlier silence does not
    count.
    """
    starts, ends = activity.written
    before = start - 1 - rule.silent_for
    lasts = (max(last, since) for last in [before, *ends.tolist()])
    silences = zip(lasts, [*starts.tolist(), end], strict=True)
    text = f"Nothing from the recorder for {duration_words(rule.silent_for)}"
    return [
        Condition(last + rule.silent_for, first, lambda _: text)
        for last, first in silences
        if first - last > rule.silent_for
    ]


def wall_times(day: date, minute: int, zone: tzinfo) -> tuple[int, int]:
    """Return first and last time (ns of UTC) when clocks show a minute, 0 to 1439, of a day.

    The two differ if the clock is set back past the minute; both are the moment of the change if
    the clock is set forward past the minute.
    """
    shown = datetime(day.year, day.month, day.day, *divmod(minute, 60), tzinfo=zone)
    first, last = (int(shown.replace(fold=fold).timestamp()) for fold in (0, 1))
    if first > last:  # skipped minute: the old offset gives the later time, the new the earlier
        first = last = _change_between(last, first, zone)
    return first * NANOSECONDS, last * NANOSECONDS


def _change_between(before: int, after: int, zone: tzinfo) -> int:
    """Return the time of the clock change between two times, all in seconds of UTC."""
    offset = datetime.fromtimestamp(before, UTC).astimezone(zone).utcoffset()
    while after - before > 1:
        middle = (before + after) // 2
        if datetime.fromtimestamp(middle, UTC).astimezone(zone).utcoffset() == offset:
            before = middle
        else:
            after = middle
    return after


def days_around(start: int, end: int, zone: tzinfo) -> list[date]:
    """List the local days from the day before `start` to the day of `end`."""
    first = local_time(start, zone).date() - timedelta(days=1)
    last = local_time(end, zone).date()
    return [first + timedelta(days=number) for number in range((last - first).days + 1)]


def end_of_quiet(hours: list[QuietHours], time: int, zone: tzinfo) -> int:
    """Return the end of the quiet hours at a time (nanoseconds of UTC); the time itself if none.

    It is at most a day after the time, even if the complete day is quiet.
    """
    until = time
    for _ in hours:  # adjoining quiet hours
        moment = local_time(until, zone)
        left = max(each.minutes_left(60 * moment.hour + moment.minute) for each in hours)
        if not left:
            break
        day, minute = divmod(60 * moment.hour + moment.minute + left, 24 * 60)
        ends = wall_times(moment.date() + timedelta(days=day), minute, zone)
        until = next(end for end in (*ends, until + left * 60 * NANOSECONDS) if end > until)
    return until


def none_by_conditions(
    rule: NoneBy, activity: HomeActivity, start: int, end: int, zone: tzinfo
) -> list[Condition]:
    """Find the days without a class by the time of a rule, or with too little coverage to tell."""
    windows = [
        (first, last)
        for day in days_around(start, end, zone)
        for first, last in [_window(rule, day, zone)]
        if start <= last < end and first < last
    ]
    if not windows:
        return []
    events = events_of_rule(rule, activity)
    listened = activity.listened(rule.label, rule.microphone)
    conditions = []
    for first, last in windows:
        if ((events.counted < last) & (events.ends > first)).any():
            continue
        share = cut(listened, first, last).length / (last - first)
        hours = f"from {Clock.show(rule.since)} to {Clock.show(rule.by)}"
        is_known = share >= rule.least_share
        text = f"{rule.words}: none {hours}"
        if not is_known:
            why = f"only {int(100 * share)} % of that time was recorded"
            text = f"{rule.words} {hours}: unknown, because {why}"
        conditions.append(_at_once(last, text, is_known=is_known))
    return conditions


def _window(rule: NoneBy, day: date, zone: tzinfo) -> tuple[int, int]:
    """Return the window that ends on a day; the longest one if a clock time occurs twice."""
    began = day if rule.since < rule.by else day - timedelta(days=1)
    return wall_times(began, rule.since, zone)[0], wall_times(day, rule.by, zone)[1]


def _at_once(time: int, text: str, *, is_known: bool = True) -> Condition:
    return Condition(time, time + 1, lambda _: text, is_known)


def unlike_conditions(
    rule: UnlikeUsual, activity: HomeActivity, start: int, end: int, zone: tzinfo
) -> list[Condition]:
    """Find the days or nights outside the range of the four weeks before.

    The activity must begin 31 days before the start.
    """
    days = judged_days(rule, start, end, zone)
    if not days:
        return []
    sure = UNSURE_BELOW if rule.label in COUNTED_IF_SURE else 0.0
    rule = rule.model_copy(update={"confidence": max(rule.confidence, sure)})
    labelled = counted = events_of_rule(rule, activity)
    if rule.label in ON_TELEVISION:  # counted as in the report
        television = television_spans(home_sound(activity).labels)
        counted = events_of_rule(rule, activity, television)
    listened = activity.listened(rule.label, rule.microphone)

    def amounts(events: SoundEvents, day: date) -> tuple[int, float]:
        """Return the number of events of a day, and their minutes."""
        start, end = _part(rule, day, zone)
        number = int(np.diff(np.searchsorted(events.counted, [start, end]))[0])
        lump = rule.least_seconds / 60 * number
        return number, cut(events.counted_coverage(), start, end).length / MINUTE + lump

    @cache
    def figure(day: date) -> Count | Duration | None:
        """Return the figure that is evaluated on a day; None if coverage is too low."""
        start, end = _part(rule, day, zone)
        if cut(listened, start, end).length < rule.least_share * (end - start):
            return None
        number, minutes = amounts(counted, day)
        return Count(number) if rule.of == "count" else Duration(minutes)

    def most(day: date) -> float:
        """Return the figure of a day with all that may have sounded beside a television."""
        (number, minutes), (every, in_all) = amounts(counted, day), amounts(labelled, day)
        return max(every, number + in_all - minutes) if rule.of == "count" else in_all

    conditions = []
    for day, time in days:
        own = figure(day)
        baseline = usual_range(
            [figure(day - timedelta(days=ago)) for ago in range(1, BASELINE_DAYS + 1)]
        )
        if own is None or baseline is None:
            continue
        # Who watches television all day is not missed.
        if _is_unlike(rule, (own.middle, most(day)), baseline):
            conditions.append(_at_once(time, _unlike_text(rule, day, own, baseline)))
    return conditions


def _is_unlike(rule: UnlikeUsual, values: tuple[float, float], baseline: UsualRange) -> bool:
    """Whether the least value is above the usual range, or the most is below it."""
    more = values[0] > baseline.highest * (1 + rule.margin)
    less = values[1] < baseline.lowest * (1 - rule.margin)
    return (more and rule.which != "less") or (less and rule.which != "more")


def judged_days(rule: DailyRule, start: int, end: int, zone: tzinfo) -> list[tuple[date, int]]:
    """List the days on which a rule is evaluated in a time span, with times in ns of UTC."""
    times = [(day, wall_times(day, rule.at, zone)[1]) for day in days_around(start, end, zone)]
    return [(day, time) for day, time in times if start <= time < end]


def _part(rule: UnlikeUsual, day: date, zone: tzinfo) -> tuple[int, int]:
    if rule.part == "day":
        return day_span(day - timedelta(days=1), zone)
    return night_span(day, zone)


def _unlike_text(rule: UnlikeUsual, day: date, own: Count | Duration, baseline: UsualRange) -> str:
    when = f"on {day - timedelta(days=1)}" if rule.part == "day" else f"in the night to {day}"
    times = " times" if rule.of == "count" else ""
    usually = own.spread(*baseline)
    return f"{rule.words} {when}: {own.show(own.middle)}{times}, usually {usually}"


def unusual_conditions(
    rule: UnusualDay, activity: HomeActivity, start: int, end: int, zone: tzinfo
) -> list[Condition]:
    """Find the days unlike the four weeks before, each reported on the next morning.

    The activity must begin 34 days before the start.
    """
    mornings = judged_days(rule, start, end, zone)
    if not mornings:
        return []
    routines = Routines(Profiles(home_sound(activity), zone, night_after=True))
    conditions = []
    for morning, time in mornings:
        judged = routines.judge(morning - timedelta(days=1))
        if judged is not None and judged.once_in >= rule.once_in:
            day = short_day(judged.day)
            why = differences_text(judged)
            text = f"{day} and the night after it, {rarity_text(judged)}: {why}"
            conditions.append(_at_once(time, text))
    return conditions


def home_sound(activity: HomeActivity) -> HomeSegments:
    """Return the segments and coverage from which routines are fitted."""
    sounds = {name: own for (name, of_scenario), own in activity.sounds.items() if not of_scenario}
    quiet = activity.listened(ANY_SOUND, "")
    parts = [Labelling(*quiet, np.full(len(quiet.starts), SILENCE, object))]
    for name, own in sounds.items():
        label = np.full(len(own.starts), name, object)
        parts.append(Labelling(own.starts, own.ends, label, own.confidences))
    labels = without_too_doubtful(in_order(parts))
    of_home = [own for name, own in activity.classes.items() if not is_of_scenario(name)]
    names = sorted(set(sounds).union(*of_home))
    return HomeSegments(labels, {name: activity.listened(name, "") for name in names})


NEW = RuleState()


def notifications(  # noqa: PLR0913, PLR0917
    rule: AlertRule,
    activity: HomeActivity,
    start: int,
    end: int,
    zone: tzinfo,
    state: RuleState = NEW,
) -> tuple[list[Notification], RuleState]:
    """Find the notifications of a rule in a span (ns of UTC, end exclusive), and its new state.

    A condition gives one notification, at its start. If the condition starts within the cooldown of
    the previous notification, the notification is delayed to the end of the cooldown, and omitted
    if the condition has ended by then. `state` is that returned by the evaluation up to the start.
    """
    found: list[Notification] = []
    last, has_rung = state.last, False
    for condition in _conditions(rule, activity, start, end, zone, state.since):
        if condition.end <= start or condition.start >= end:
            continue
        continues = condition.start < start
        notified = continues and state.has_rung
        time = max(condition.start, start, last + rule.cooldown)
        if not notified and time < min(condition.end, end):
            due = end_of_quiet(rule.hours(), time, zone)
            text, is_known = condition.text(time), condition.is_known
            found.append(Notification(rule.name, time, text, is_known, due))
            last, notified = time, True
        has_rung = notified and condition.end >= end
    return found, RuleState(last, has_rung, state.since, end)


def _conditions(  # noqa: PLR0913, PLR0917
    rule: AlertRule, activity: HomeActivity, start: int, end: int, zone: tzinfo, since: int
) -> Sequence[Condition]:
    """Find the conditions of a rule, in ascending order and disjoint."""
    if isinstance(rule, MoreThan):
        return more_than_conditions(rule, activity, end)
    if isinstance(rule, LongerThan):
        return longer_than_conditions(rule, activity, zone)
    if isinstance(rule, RecorderSilent):
        return silent_conditions(rule, activity, start, end, since)
    if isinstance(rule, NoneBy):
        return none_by_conditions(rule, activity, start, end, zone)
    if isinstance(rule, UnusualDay):
        return unusual_conditions(rule, activity, start, end, zone)
    return unlike_conditions(rule, activity, start, end, zone)
