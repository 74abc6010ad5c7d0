"""Headline of a report: what a day or a week was like, in a few short sentences."""

from collections.abc import Iterator, Sequence
from datetime import timedelta
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.daily_metrics import HOUR, MOST, DayMetrics
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.values import Count, Duration, rounded
from hearthlog.analyzer.logs.local_time import EVENING
from hearthlog.analyzer.logs.spans import (
    Spans,
    difference,
    intersection,
    intersection_rows,
    joined,
    lengths,
)
from hearthlog.analyzer.report.report_data import TELEVISION_PAUSE, day_television
from hearthlog.analyzer.report.wording import (
    capital,
    clock_text,
    edge_of_week,
    number_in_words,
    several_in_words,
    short_day,
    times_in_words,
    times_of,
    weekday,
)
from hearthlog.models.classes import (
    SILENCE,
    UNKNOWN,
    WORRYING,
    in_words,
)
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import listed

LIVELY_MINUTES = 5  # minutes with sound of a lively hour
QUIET_HOURS = 6  # most lively hours of a quiet day
_RUNS = 3  # most times of day that are named
_TIMES = 3
_MISSING_HOURS = 1.0  # fewer hours without a record are not in the headline
_ONE_MORE = 2
_PAUSE = 5 * MINUTE  # longest between recorded spans of one stretch
_NAMED = MINUTE // 2  # shortest sound that a partly recorded day is described by
_NAMES = 3
_EXACT_HOURS = 3  # fewer recorded hours are given to the minute


class Headline(NamedTuple):
    """A first sentence, and the others."""

    first: str
    rest: str


def day_headline(day: DayMetrics) -> Headline:
    """Return the headline of a day: coughing, crying and shouting, and whether it was quiet.

    A day is quiet if three quarters of it, and of the time from 07:00 to 22:00, were listened to,
    and if at most six of its hours have five minutes of sound or more. Of a day with less than
    that: what was labelled, and how much is missing. What was counted comes first, if anything.
    """
    counts, quiet = [*map(_sentence, _sounds(day))], f"{_day(day)}."
    first, rest = (" ".join(counts), [quiet]) if counts else (quiet, [])
    return Headline(first, " ".join([*rest, *_steady(day), *_missing(day)]))


def week_headline(days: Sequence[DayMetrics], counted: Sequence[DayMetrics]) -> Headline:
    """Return the headline of a week: coughing, crying and shouting; its quiet days.

    Sounds are those of the `counted` days, which may begin in the evening before.
    """
    recorded = [day for day in days if day.coverage.length]
    complete_days = [day for day in recorded if _is_covered(day)]
    others = [day for day in days if day not in complete_days]
    covered = [day for day in counted if day.coverage.length]
    if complete_days and len(recorded) == len(covered) == 1:
        return _only_day(recorded[0], [text for text, _ in _sounds_of_week(covered, len(days))])
    sounds = " ".join(_sentence(f"{a}{b}") for a, b in _sounds_of_week(covered, len(days)))
    quiet = f"{_quiet_days(complete_days, len(others))}{_too_little(complete_days, others)}."
    return Headline(sounds, quiet) if sounds else Headline(quiet, "")


def _only_day(day: DayMetrics, sounds: Sequence[str]) -> Headline:
    """Return the headline of a week of which a single day was listened to."""
    only = f"Only {weekday(day.day)} was listened to"
    quiet = _day(day, weekday(day.day) if day.before_logs or day.after_logs else "it")
    if sounds:
        return Headline(f"{only}: {'; '.join(sounds)}.", _sentence(quiet))
    return Headline(f"{only}: {quiet}.", "")


def _quiet_days(days: Sequence[DayMetrics], others: int) -> str:
    """Return how many of the judged days of a week were quiet."""
    if not days:
        return f"The box listened too little to judge any of the {number_in_words(others)} days"
    if others and len(days) == 1:
        return _day(days[0])
    quiet = [day for day in days if is_quiet(day)]
    which = {0: "none", len(days): "all" if len(days) > _ONE_MORE else "both"}
    was = capital(which.get(len(quiet), number_in_words(len(quiet))))
    of = f"{number_in_words(len(days))} days{' listened to' * bool(others)}"
    but = " but for a few hours" if any(_lively(day).any() for day in quiet) else ""
    return f"{was} of the {of} {'were' if len(quiet) > 1 else 'was'} quiet{but}"


def _too_little(days: Sequence[DayMetrics], others: Sequence[DayMetrics]) -> str:
    """Return that the other days of a week are not judged."""
    if not days or not others:
        return ""
    number = number_in_words(len(others))
    which = f"other {number} days" if len(others) > 1 else "other day"
    if any(day.logged.length for day in others):
        return f"; of the {which} there is too little"
    return f"; there are no logs of the {which}"


def _sounds_of_week(recorded: Sequence[DayMetrics], number: int) -> Iterator[tuple[str, str]]:
    """Yield the counts of coughing, crying and shouting of some of a number of days; and when."""
    for name in WORRYING:
        counts = [(count, day) for day in recorded if (count := day.count(name)) and count.labelled]
        if not counts:
            continue
        total = sum((count for count, _ in counts), Count())
        most, day = max(counts, key=lambda pair: pair[0].labelled)
        when = f" on {len(counts)} days" if len(counts) > 1 else f" on {short_day(day.day)}"
        if len(counts) > 1 and most.labelled > total.labelled / number:
            when += f"; most on {short_day(day.day)}: {most.labelled}"
        yield amount(name, total), when


def is_quiet(day: DayMetrics) -> bool:
    """Whether a day was quiet; false if too little of it was recorded."""
    return _is_covered(day) and int(_lively(day).sum()) <= QUIET_HOURS


def amount(name: str, count: Count, when: str = "", *, named: bool = True) -> str:
    """Return a number of events, as labelled: `2 toilet flushes`, `coughing once`.

    Without the name of the class, just `2`, `once`. With events that are not sure, `coughing twice,
    perhaps 3 more`, or `perhaps coughing 3 times`. `when` goes after the name.
    """
    perhaps, number, more = _amounts(count)
    several, sound = several_in_words(name).lower(), in_words(name).lower()
    if several.startswith("times of "):
        text = f"{perhaps}{sound} {times_of(number)}" if named else f"{perhaps}{times_of(number)}"
    else:
        text = f"{perhaps}{number} {sound if number == 1 else several}"
        text = text if named else f"{perhaps}{number}"
    return f"{text} {when}".strip() + more


def _amounts(count: Count) -> tuple[str, int, str]:
    """Return `perhaps ` if no event is sure, the number, and how many more there may be."""
    unsure = count.unsure if count.range is None else 0
    sure = count.labelled - unsure
    if unsure and not sure:
        return "perhaps ", unsure, ""
    return "", sure, f", perhaps {unsure} more" if unsure else ""


def _day(day: DayMetrics, name: str = "") -> str:
    """Return whether a day was quiet, and how much of it is known, without a full stop."""
    name = name or weekday(day.day)
    hours = rounded(day.coverage.length / MINUTE) / 60  # as the page says it
    hours_of_day = rounded(day.logged.length / HOUR)
    if states_missing_time(day):
        return _recorded_part(day)
    lively = _lively(day)
    start, end = (clock_text(int(edge[0]), day.zone) for edge in day.logged)
    name += f" from {start}" * bool(day.before_logs)
    name += f" {'to' if day.before_logs else 'until'} {end}" * bool(day.after_logs)
    partly = ""
    if day.missing.length / HOUR >= _MISSING_HOURS:
        partly = f" (listened to {int(hours)} of {hours_of_day} hours)"
    if not is_quiet(day):
        return f"{name} had sound in {lively.sum()} of {hours_of_day} hours{partly}"
    but = _exceptions(day, lively) if lively.any() else ""
    return f"{name} was quiet{' but for ' * bool(but)}{but}{partly}"


def _exceptions(day: DayMetrics, lively: Bool) -> str:
    """Return the lively hours of a quiet day, and the television that made some of them lively."""
    apart = difference(day.home.sound, day_television(day))
    due = lively & (lengths(apart, day.hours) < LIVELY_MINUTES * MINUTE)
    runs, spans = _runs(day, lively & ~due), day_television(day, TELEVISION_PAUSE)
    rows = np.unique(intersection_rows(spans, _hours(day, due))[1])
    television = _times(day, Spans(spans.starts[rows], spans.ends[rows]))
    if len(runs) + len(television) > _RUNS:
        return f"{number_in_words(int(lively.sum()))} hours"
    if television:
        runs.append(f"something like a television from {listed(television, 'and')}")
    return listed(runs, "and")


def _steady(day: DayMetrics) -> Iterator[str]:
    """Yield when a quiet day had steady sound that no label names, if it was not short."""
    spans = intersection(day.home.steady, day.span)
    if not is_quiet(day) or spans.length < LIVELY_MINUTES * MINUTE:
        return
    times = _times(day, spans)
    if len(times) > _ONE_MORE:
        yield f"Steady sound at {number_in_words(len(times))} times."
    else:
        yield f"Steady sound from {listed(times, 'and')}."


def states_missing_time(day: DayMetrics) -> bool:
    """Whether the headline says how much was not recorded, and what was labelled in the rest."""
    return not _is_covered(day)


def _recorded_part(day: DayMetrics) -> str:
    """Return when a partly recorded day was recorded, and what was labelled then."""
    name = weekday(day.day)
    if day.coverage.length < MINUTE:
        return f"The box listened for less than a minute of {name}"
    stretches = joined(*day.coverage, _PAUSE)
    hours = rounded(day.coverage.length / HOUR)
    if len(stretches.starts) == 1:
        start, end = (clock_text(int(edge[0]), day.zone) for edge in stretches)
        when = f"{name} from {start} to {'24:00' if end == '00:00' else end}"
    elif hours >= _EXACT_HOURS:
        when = f"In the {hours} hours that the box listened on {name}"
    else:
        lasting = Duration(day.coverage.length / MINUTE).text
        when = f"In the {lasting} that the box listened on {name}"
    return f"{when}: {_labelled(day)}"


def _labelled(day: DayMetrics) -> str:
    """Return the classes labelled longest, but those with a sentence of their own; a television."""
    lengths: list[tuple[int, str]] = []
    for name in set(day.home.classes) - {SILENCE, UNKNOWN, *WORRYING}:
        length = day.spans_of(name).length
        if length >= _NAMED:
            lengths.append((-length, in_words(name).lower()))
    television = ["something like a television"] * bool(day_television(day).length)
    if lengths or television:
        return listed([*(words for _, words in sorted(lengths)[:_NAMES]), *television], "and")
    sound = intersection(day.home.sound, day.span).length
    return f"{Duration(sound / MINUTE).text} of sound" if sound else "nothing but quiet"


def _missing(day: DayMetrics) -> Iterator[str]:
    """Yield how much of a partly recorded day was not recorded, or is in no log."""
    if not states_missing_time(day) or day.coverage.length < MINUTE:
        return
    if not (day.before_logs or day.after_logs):
        hours = rounded(day.coverage.length / HOUR)
        other = f"other {rounded(day.span.length / HOUR) - hours} hours"
        yield f"The box did not listen in the {other if hours else 'rest of the day'}."
        return
    yield unlogged([day])
    if day.missing.length >= MINUTE:
        yield f"In between, it did not listen for {Duration(day.missing.length / MINUTE).text}."


def unlogged(days: Sequence[DayMetrics], *, with_day: bool = False) -> str:
    """Return when the logs of successive days begin and end; empty if they have all of the time."""
    logged = [day for day in days if day.logged.length]
    if not logged:
        return ""
    zone, edges = days[0].zone, (int(logged[0].logged.starts[0]), int(logged[-1].logged.ends[0]))
    first, last = (
        edge_of_week(edge, zone, is_end=is_end) if with_day else clock_text(edge, zone)
        for edge, is_end in zip(edges, (False, True), strict=True)
    )
    begins, ends = bool(days[0].before_logs), bool(days[-1].after_logs)
    span = {
        (True, True): f"from {first} to {last}",
        (True, False): f"from {first} on",
        (False, True): f"up to {last}",
    }.get((begins, ends))
    return "" if span is None else f"There are logs only {span}."


def _is_covered(day: DayMetrics) -> bool:
    """Whether three quarters of the day, and of its waking hours, were recorded."""
    waking = intersection(day.coverage, day.waking).length / day.waking.length
    return min(day.share, waking) >= MOST


def _lively(day: DayMetrics) -> Bool:
    lively: Bool = day.sound_by_hour >= LIVELY_MINUTES
    return lively


def _runs(day: DayMetrics, lively: Bool) -> list[str]:
    """Return the times of successive lively hours: `19:00 to 22:00`."""
    return _times(day, _hours(day, lively))


def _hours(day: DayMetrics, which: Bool) -> Spans:
    return joined(day.hours[:-1][which], day.hours[1:][which])


def _times(day: DayMetrics, spans: Spans) -> list[str]:
    """Return spans of a day in words: `19:00 to 22:00`."""
    edges = [[clock_text(time, day.zone) for time in pair] for pair in spans.pairs()]
    return [f"{start} to {'24:00' if end == '00:00' else end}" for start, end in edges]


def _sounds(day: DayMetrics) -> Iterator[str]:
    """Yield the counts of coughing, crying and shouting.

    Those of the 24 hours to 22:00, with those of the night among them, and of the evening after
    that. The table has the times of all; here are those of a few, if all are in one part.
    """
    before = day.to_evening
    for name in WORRYING:
        parts = {
            when: starts
            for when, span in (("in the night", day.night), ("by day", day.waking))
            if len(starts := day.counted_events(name, span))
        }
        texts = []
        if len(parts) == 1:
            (when,), (starts,) = parts, parts.values()
            count = before.count_in(name, before.span)
            texts.append(amount(name, count, when) + times_of_events(day, name, starts))
        elif parts:
            perhaps, number, more = _amounts(day.count_in(name, day.night))
            at_night = f" ({perhaps}{number} at night{more})"
            texts.append(amount(name, before.count_in(name, before.span)) + at_night)
        late = day.counted_events(name, day.evening)
        if len(late):
            count = day.count_in(name, day.evening)
            text = amount(name, count, f"after {EVENING}:00", named=not texts)
            texts.append(text + times_of_events(day, name, late))
        if texts:
            yield "; ".join(texts)


def times_of_events(day: DayMetrics, name: str, starts: Int64) -> str:
    """Return in brackets the times of a few events; of more, how many were on the day before."""
    if len(starts) <= _TIMES:
        times = times_in_words(starts, day.zone, first=day.day, unsure=day.unsure_events(name))
        return f" ({times})" if times else ""
    number, before = int((starts < day.span.starts[0]).sum()), day.day - timedelta(days=1)
    which = f"{number} of them" if number < len(starts) else "all"
    return f" ({which} on {weekday(before)})" if number else ""


def _sentence(text: str) -> str:
    return f"{capital(text)}."
