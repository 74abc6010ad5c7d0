"""Headline of a report: what a day or a week was like, in two or three short sentences."""

from collections.abc import Callable, Iterator, Sequence
from datetime import timedelta

import numpy as np

from hearthlog.analyzer.activity.daily_metrics import HOUR, MOST, DayMetrics
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.values import Count, Duration, rounded
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour
from hearthlog.analyzer.logs.spans import difference, intersection, joined, single_span
from hearthlog.analyzer.report.report_data import counted_events, television_spans
from hearthlog.analyzer.report.wording import (
    clock_text,
    clock_with_day,
    number_in_words,
    several_in_words,
    short_day,
    weekday,
)
from hearthlog.models.classes import (
    ON_TELEVISION,
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


def day_headline(day: DayMetrics) -> str:
    """Return the headline of a day: whether it was quiet, coughing, crying and shouting.

    A day is quiet if three quarters of it, and of the time from 07:00 to 22:00, were recorded,
    and if at most six of its hours have five minutes of sound or more. Of a day with less than
    that: what was labelled, and how much is missing.
    """
    return " ".join([_day(day), *_by_sound(list(_sounds(day))), *_missing(day)])


def week_headline(days: Sequence[DayMetrics]) -> str:
    """Return the headline of a week: its quiet days; coughing, crying and shouting."""
    recorded = [day for day in days if day.coverage.length]
    complete_days = [day for day in recorded if _is_covered(day)]
    quiet = sum(is_quiet(day) for day in complete_days)
    number, of = number_in_words(len(complete_days)), number_in_words(len(days))
    which = {0: "none", len(complete_days): "all" if len(complete_days) > _ONE_MORE else "both"}
    was = _capital(which.get(quiet, number_in_words(quiet)))
    rest = f"too little was recorded of the other {number_in_words(len(days) - len(complete_days))}"
    if len(complete_days) == len(days):
        parts = [f"{was} of the {of} days {_were(quiet)} quiet."]
    elif len(complete_days) > 1:
        parts = [f"{was} of the {number} recorded days {_were(quiet)} quiet; {rest}."]
    elif complete_days:
        (day,) = complete_days
        parts = [f"{weekday(day.day)} was {'' if quiet else 'not '}quiet; {rest} days."]
    else:
        parts = [f"Too little was recorded to judge any of the {of} days."]
    sounds: list[tuple[str, bool]] = []
    for name in WORRYING:
        counts = [(count, day) for day in recorded if (count := day.count(name)) and count.labelled]
        if counts:
            total = sum((count for count, _ in counts), Count())
            on = f"{number_in_words(len(counts))} day{'s' * (len(counts) > 1)}"
            text = f"{amount(name, total)} on {on}"
            most, day = max(counts, key=lambda pair: pair[0].labelled)
            if len(counts) > 1 and most.labelled > total.labelled / len(days):
                text += f", most on {short_day(day.day)} ({most.labelled})"
            sounds.append((text, total.certain == total.labelled))
    return " ".join([*parts, *_by_sound(sounds)])


def _by_sound(sounds: Sequence[tuple[str, bool]]) -> Iterator[str]:
    """Yield sentences of counts: what is known, and what is only labelled so.

    A count of a class in words comes with whether a person reviewed all of it.
    """
    yield from (f"{_capital(text)}." for text, is_checked in sounds if is_checked)
    if labelled := [text for text, is_checked in sounds if not is_checked]:
        yield f"By the sound of it, {'; '.join(labelled)}."


def is_quiet(day: DayMetrics) -> bool:
    """Whether a day was quiet; false if too little of it was recorded."""
    return _is_covered(day) and int(_lively(day).sum()) <= QUIET_HOURS


def amount(name: str, count: Count, *, named: bool = True) -> str:
    """Return a number of events in words, as labelled: `two bouts of coughing`, `crying once`.

    Without the name of the class, just `two`, `once`. With events that are not sure, `two (perhaps
    four) bouts of coughing`, or `four bouts of something like coughing`.
    """
    sure = count.labelled - (count.unsure if count.range is None else 0)
    several, sound = several_in_words(name).lower(), in_words(name).lower()
    if named and not sure and count.labelled:
        several = several.replace(sound, f"something like {sound}")
        sound, sure = f"something like {sound}", count.labelled
    if several.startswith("times of "):
        often = _with_unsure(sure, count.labelled, _often)
        return f"{sound} {often}" if named else often
    number = _with_unsure(sure, count.labelled, number_in_words)
    if count.labelled == 1:
        bouts = several.startswith("bouts ")
        several = several.replace("bouts", "bout", 1) if bouts else sound
    return f"{number} {several}" if named else number


def _with_unsure(sure: int, labelled: int, words: Callable[[int], str]) -> str:
    if sure == labelled:
        return words(labelled)
    return f"{words(sure)} (perhaps {words(labelled)})" if sure else f"perhaps {words(labelled)}"


def _often(number: int) -> str:
    return {1: "once", 2: "twice"}.get(number, f"{number_in_words(number)} times")


def _day(day: DayMetrics) -> str:
    """Return whether a day was quiet, and how much of it is known."""
    name = weekday(day.day)
    hours = rounded(day.coverage.length / MINUTE) / 60  # as the page says it
    hours_of_day = rounded(day.over.length / HOUR)
    if states_missing_time(day):
        return _recorded_part(day)
    lively = _lively(day)
    if day.coming:
        name += f" until {clock_text(int(day.over.ends[0]), day.zone)}"
    partly = ""
    if day.missing.length / HOUR >= _MISSING_HOURS:
        partly = f" ({int(hours)} of {hours_of_day} hours recorded)"
    if not is_quiet(day):
        return f"{name} had sound in {lively.sum()} of {hours_of_day} hours{partly}."
    if not lively.any():
        return f"{name} was quiet{partly}."
    runs = _runs(day, lively)
    but = (
        listed(runs, "and") if len(runs) <= _RUNS else f"{number_in_words(int(lively.sum()))} hours"
    )
    return f"{name} was quiet but for {but}{partly}."


def states_missing_time(day: DayMetrics) -> bool:
    """Whether the headline says how much was not recorded, and what was labelled in the rest."""
    return not _is_covered(day)


def _recorded_part(day: DayMetrics) -> str:
    """Return when a partly recorded day was recorded, and what was labelled then."""
    name = weekday(day.day)
    if day.coverage.length < MINUTE:
        return f"Less than a minute of {name} was recorded."
    stretches = joined(*day.coverage, _PAUSE)
    hours = rounded(day.coverage.length / HOUR)
    if len(stretches.starts) == 1:
        start, end = (clock_text(int(edge[0]), day.zone) for edge in stretches)
        when = f"{name} from {start} to {'24:00' if end == '00:00' else end}"
    elif hours >= _EXACT_HOURS:
        when = f"In the {hours} recorded hours of {name}"
    else:
        when = f"In the recorded {Duration(day.coverage.length / MINUTE).text} of {name}"
    return f"{when}: {_labelled(day)}."


def _labelled(day: DayMetrics) -> str:
    """Return the classes labelled longest, but those that have a sentence of their own."""
    lengths: list[tuple[int, str]] = []
    for name in set(day.home.classes) - {SILENCE, UNKNOWN, *WORRYING}:
        spans = intersection(day.home.spans[name], day.span)
        if name in ON_TELEVISION:
            spans = difference(spans, television_spans(day))
        if spans.length >= _NAMED:
            lengths.append((-spans.length, in_words(name).lower()))
    if lengths:
        return listed([words for _, words in sorted(lengths)[:_NAMES]], "and")
    sound = intersection(day.home.sound, day.span).length
    return f"{Duration(sound / MINUTE).text} of sound" if sound else "nothing but quiet"


def _missing(day: DayMetrics) -> Iterator[str]:
    """Yield how much of a partly recorded day was not recorded."""
    if not states_missing_time(day) or day.coverage.length < MINUTE:
        return
    hours = rounded(day.coverage.length / HOUR)
    number = rounded(day.over.length / HOUR) - hours
    if day.coming:
        if day.missing.length >= MINUTE:
            missing, end = Duration(day.missing.length / MINUTE).text, int(day.over.ends[0])
            yield f"{missing} before {clock_text(end, day.zone)} were not recorded."
        yield "The rest of the day is not recorded yet."
    else:
        other = f"other {number} hours were"
        yield f"The {other if hours else 'rest of the day was'} not recorded."


def _is_covered(day: DayMetrics) -> bool:
    """Whether three quarters of the day, and of its waking hours, were recorded."""
    waking = single_span(*(at_hour(day.day, hour, day.zone) for hour in (MORNING, EVENING)))
    return min(day.share, intersection(day.coverage, waking).length / waking.length) >= MOST


def _lively(day: DayMetrics) -> Bool:
    lively: Bool = day.sound_by_hour >= LIVELY_MINUTES
    return lively


def _runs(day: DayMetrics, lively: Bool) -> list[str]:
    """Return the times of successive lively hours: `19:00 to 22:00`."""
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], lively, [False]]).astype(int)))
    texts = [clock_text(int(day.hours[place]), day.zone) for place in bounds.tolist()]
    texts[1::2] = ["24:00" if text == "00:00" else text for text in texts[1::2]]
    return [f"{a} to {b}" for a, b in zip(texts[::2], texts[1::2], strict=True)]


def _sounds(day: DayMetrics) -> Iterator[tuple[str, bool]]:
    """Yield the counts of coughing, crying and shouting, and whether a person reviewed them.

    Those of the night that ends on the day, of 07:00 to 22:00, and of the evening after that.
    """
    morning, evening = (at_hour(day.day, hour, day.zone) for hour in (MORNING, EVENING))
    times_of_day = (
        (day.night, "in the night"),
        (single_span(morning, evening), "by day"),
        (single_span(evening, int(day.span.ends[0])), f"after {EVENING}:00"),
    )
    for name in WORRYING:
        parts: list[str] = []
        is_checked = True
        for span, when in times_of_day:
            starts = counted_events(day, name, span)
            if len(starts):
                count = day.home.minutes.between(span).count(name, day.home.rates.get(name))
                times = f" ({_when(day, starts)})" if _when(day, starts) else ""
                parts.append(f"{amount(name, count, named=not parts)} {when}{times}")
                is_checked &= count.certain == count.labelled
        if parts:
            yield listed(parts, "and"), is_checked


def _when(day: DayMetrics, starts: Int64) -> str:
    """Return the times of a few events; of more, how many were on the day before, if any."""
    if len(starts) <= _TIMES:
        clocks = [clock_with_day(start, day.zone, day.day) for start in np.sort(starts).tolist()]
        return listed(clocks, "and")
    number, before = int((starts < day.span.starts[0]).sum()), day.day - timedelta(days=1)
    which = f"{number_in_words(number)} of them" if number < len(starts) else "all"
    return f"{which} on {weekday(before)}" if number else ""


def _were(number: int) -> str:
    return "were" if number > 1 else "was"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
