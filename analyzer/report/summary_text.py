"""Summary of a report in sentences, with missing coverage and troubles."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from hearthlog.analyzer.activity.daily_metrics import HOUR, MOST, RISING, DayMetrics
from hearthlog.analyzer.activity.day_anomaly import FEWEST
from hearthlog.analyzer.activity.doubtful_sounds import DoubtfulSound, perhaps
from hearthlog.analyzer.activity.values import Duration, rounded
from hearthlog.analyzer.logs.local_time import at_hour, local_time
from hearthlog.analyzer.logs.recorder_info import Trouble
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    cut,
    difference,
    intersection,
    joined,
    rows_at,
    single_span,
    union,
)
from hearthlog.analyzer.report.headline import (
    amount,
    states_missing_time,
    times_of_events,
    unlogged,
)
from hearthlog.analyzer.report.report_data import (
    NIGHT_HOURS,
    TELEVISION_PAUSE,
    ReportData,
    day_television,
)
from hearthlog.analyzer.report.wording import (
    WEEK,
    capital,
    clock_text,
    judgement_text,
    short_day,
    too_few_text,
    weekday,
)
from hearthlog.models.classes import (
    COUGHING,
    FLUSHING_WATER,
    SHOWER,
    SILENCE,
    UNKNOWN,
    WORRYING,
    class_name,
    in_words,
)
from hearthlog.schemas.errors import listed

_MOST = 6  # kinds of gaps or troubles
_MINUTE, _SECOND = HOUR // 60, HOUR // 3600
_MOST_SECONDS = 90  # more are minutes
_TIMES = 3
_MOST_LABELS = 3  # of one doubtful time
_BREAK = 5 * _MINUTE  # longest pause between doubtful sounds of one time
_MOST_DOUBTS = 5  # times
_HALF = 0.5  # hours
_MORNING, _MIDNIGHT = 4 * 60 + 30, 23 * 60 + 30  # minutes


def summarize_day(data: ReportData, day: DayMetrics) -> Iterator[str]:
    """Summarise a day in a few sentences, compared with earlier days."""
    if states_missing_time(day):  # and what sounded
        yield _off_for_the_rest(data)
    else:
        is_partly = day.missing.length >= _MINUTE  # `not_recorded` says so
        complete = unlogged([day]) or "The box listened all day."
        yield f"{'' if is_partly else complete} {_loudest(day)}".strip()
    yield _television(day)
    if data.comparable:
        yield _changes(data, day)
    if day.night_hours:
        yield _night(day)
    yield _steady(day)
    yield _still(day)


def summarize_week(data: ReportData) -> Iterator[str]:
    """Summarise a week in a few sentences, compared with earlier days."""
    days = [day for day in data.days if day.coverage.length]
    share = sum(day.coverage.length for day in days) / sum(day.span.length for day in data.days)
    logs = unlogged(data.days, with_day=True)
    yield f"Listened on {len(days)} of {len(data.days)} days, {percent(share)} of the time. {logs}"
    if not data.comparable:
        return
    if max(data.baseline_days.values()) < FEWEST:
        yield too_few_text(max(data.baseline_days.values()))
        return
    judgements = [(day.day, judged) for day in days if (judged := data.judged[day.day])]
    unusual = [(day, judged) for day, judged in judgements if judged.once_in >= WEEK]
    if not unusual:
        yield f"None of the {len(judgements)} days that can be judged was unlike those before it."
    for day, judged in unusual:
        yield f"{short_day(day)}: {judgement_text(judged)}"


def sounds_to_review(data: ReportData) -> Iterator[str]:
    """Yield the times of loud or possibly worrying sounds that the model is not sure of.

    `Needs a look, 14:02 and 14:05: loud, and the model is not sure; it might be shouting.` At most
    five times, the loud ones first.
    """
    runs: list[list[DoubtfulSound]] = []
    for sound in sorted(data.doubts, key=lambda sound: sound.start):
        if runs and sound.start <= runs[-1][-1].end + _BREAK:
            runs[-1].append(sound)
        else:
            runs.append([sound])
    shown = sorted(runs, key=lambda run: -max(sound.level_db for sound in run))[:_MOST_DOUBTS]
    lines: dict[str, list[str]] = {}
    for run in sorted(shown, key=lambda run: run[0].start):
        labels = perhaps(run, data.hidden) or _labels_of(run)
        names = [in_words(name).lower() for name in labels]
        text = "the model is not sure" + (f"; it might be {listed(names, 'or')}" if names else "")
        loud = "loud, and " if any(sound.is_loud for sound in run) else ""
        lines.setdefault(loud + text, []).append(_clocks(data, run[0].start, run[-1].end))
    for text, times in lines.items():
        yield f"Needs a look, {listed(times, 'and')}: {text}."


def _labels_of(sounds: Iterable[DoubtfulSound]) -> list[str]:
    """Return the labels of doubtful sounds, the longest in all first."""
    lengths = Counter[str]()
    for sound in sounds:
        if class_name(sound.label) != UNKNOWN:
            lengths[sound.label] += sound.end - sound.start
    return [label for label, _ in lengths.most_common(_MOST_LABELS)]


def not_recorded(data: ReportData) -> Iterator[str]:
    """Yield a sentence or two on missing coverage, if any, and its reasons.

    The total comes first, unless the headline has it.
    """
    length = sum(day.logged.length for day in data.days)
    missing = sum(day.missing.length for day in data.days)
    is_stated = len(data.days) == 1 and states_missing_time(data.days[0])
    if missing >= _MINUTE and not is_stated:
        text = Duration(missing / _MINUTE).text
        share = percent(missing / length)
        yield f"Not listening: {text} ({share}). The report knows nothing about that time."
    for microphone, hours in data.uncovered.items():
        if hours * HOUR > missing + _MINUTE:  # another microphone covers this time
            text = Duration(hours * 60).text
            yield f"The microphone {plain(microphone)} was not listening for {text}."
    unexplained = _unexplained(data)
    is_explained = missing - unexplained >= _MINUTE
    if unexplained >= _MINUTE and (is_explained or not is_stated):
        text = Duration(unexplained / _MINUTE).text
        which = f"for {text} of the time not listened to" if is_explained else "then"
        yield f"The box was off {which}, or its logs are not here."
    for reason, same in _by_lasting(data.gaps, lambda gap: gap.text):
        yield f"{reason[:1].upper()}{reason[1:]}: {_when(data, same)}."
    if data.unread:
        logs = "1 log" if data.unread == 1 else f"{data.unread} logs"
        yield f"{logs} could not be read, or only in part."
    for line in data.networks:
        yield f"{plain(line)}."


def recorder_problems(data: ReportData) -> Iterator[str]:
    """Yield the troubles reported by the recorder that gaps do not explain.

    If there are any, an introduction, then a line for each kind of trouble, the longest first.
    """
    reported = {gap.text for gap in data.gaps}
    troubles = [trouble for trouble in data.troubles if trouble.text not in reported]
    if troubles:
        yield "The box reported problems; have it checked if this goes on."
    for name, same in _by_lasting(troubles, lambda t: f"{t.source.split(': ')[-1]}: {t.text}"):
        yield f"{plain(name)}: {_when(data, same)}."


def longest_quiet_text(day: DayMetrics) -> str:
    """Return when the longest quiet stretch of the day was; empty if under a minute."""
    quiet = day.longest_quiet
    if day.quiet is None or day.quiet.minutes < 1:
        return ""
    start, end = (clock_text(int(edge[0]), day.zone) for edge in quiet)
    return f"The longest quiet stretch by day lasted from {start} to {end}."


def percent(share: float) -> str:
    """Format a share (0 to 1): `12 %`."""
    if 0 < share < 0.005:
        return "less than 1 %"
    return "more than 99 %" if 0.995 <= share < 1 else f"{100 * share:.0f} %"


def plain(name: str) -> str:
    """Return a name with spaces for `_`."""
    return name.replace("_", " ")


def _off_for_the_rest(data: ReportData) -> str:
    """Return why the time missing in the headline was not recorded, if no gap explains it."""
    missing = sum(day.missing.length for day in data.days)
    if missing < _MINUTE or missing - _unexplained(data) >= _MINUTE:
        return ""
    day = data.days[0]
    rest = "Then" if day.before_logs or day.after_logs else "In the rest of the day"
    return f"{rest} the box was off, or its logs are not here."


def _loudest(day: DayMetrics) -> str:
    names, before = [name for name in day.home.classes if name != SILENCE], day.to_evening
    lasting = ((minutes.minutes, name) for name in names if (minutes := before.minutes(name)))
    most = [
        in_words(name).lower() for minutes, name in sorted(lasting, reverse=True) if minutes >= 1
    ]
    sounds = listed(most[:3], "and")
    quiet = "It was quiet." if day.share >= MOST else ""
    television = ", a television aside" if day_television(day).length else ""
    return f"Most of the sound{television}: {sounds}." if most else quiet * (not television)


def _television(day: DayMetrics) -> str:
    """Return when something like a television sounded."""
    when = _longest(day_television(day, TELEVISION_PAUSE), day)
    return f"Something like a television, a radio or company sounded {when}." if when else ""


def _longest(spans: Spans, day: DayMetrics) -> str:
    """Return the longest of some spans in words: `at other times and from 07:17 to 07:24`."""
    if not len(spans.starts):
        return ""
    longest = np.sort(np.argsort(spans.starts - spans.ends, kind="stable")[:_TIMES])
    times = [
        f"{clock_text(int(spans.starts[row]), day.zone)} to "
        f"{clock_text(int(spans.ends[row]), day.zone)}"
        for row in longest.tolist()
    ]
    more = "at other times and " if len(spans.starts) > _TIMES else ""
    return f"{more}from {listed(times, 'and')}"


def _steady(day: DayMetrics) -> str:
    """Return when there was steady sound that is labelled quiet."""
    spans = intersection(day.home.steady, day.span)
    times = _longest(spans, day)
    what = "Steady sound that no label names, such as water, a fan or a machine"
    return f"{what}, was louder than the quiet around it {times}." if times else ""


def _still(day: DayMetrics) -> str:
    """Return the time before the first and after the last longer sounds, and what was in it."""
    if day.first is None or day.last is None:
        return ""
    rising, (end,) = at_hour(day.day, RISING, day.zone), day.span.ends
    first, last = int(day.active[0]), int(day.active[-1]) + 10 * _MINUTE
    times, spans = [], [NONE]
    if day.first.minutes > _MORNING:
        times.append(f"from {RISING:02}:00 to {day.first.text}")
        spans.append(single_span(rising, first))
    if day.last.minutes < _MIDNIGHT:
        times.append(f"after {day.last.text}")
        spans.append(single_span(last, int(end)))
    if not times:
        return ""
    partly = day.span.length - day.coverage.length >= _MINUTE
    when = f"{listed(times, 'and')}{', as far as the box listened' * partly}"
    water = "" if SHOWER in day.home.classes else " or a shower's"
    steady = f"Steady sound, such as a fan's{water}, counts as quiet."
    longest = _longest_sound(day, union(*spans))
    if not longest:
        return f"Nothing was labelled {when}. {steady}"
    short = "less than a minute of sound in each ten minutes"
    return f"{capital(when)}: {short}; the longest was {longest}. {steady}"


def _longest_sound(day: DayMetrics, spans: Spans) -> str:
    """Return the longest sound in some spans: `talking, 50 s at 19:17`; empty without one."""
    found: list[tuple[int, int, str]] = []
    for name in (each for each in day.home.classes if each != SILENCE):
        unsure = day.home.unsure.get(name, NONE.starts)
        words = "a sound not recognised" if name == UNKNOWN else in_words(name).lower()
        for events in day.joined_events(name):
            inside = intersection(events, spans)
            doubts = np.isin(events.starts, unsure)[rows_at(events, inside.starts)].tolist()
            found += [
                (cut(day.home.spans[name], start, end).length, -start, "perhaps " * doubt + words)
                for (start, end), doubt in zip(inside.pairs(), doubts, strict=True)
            ]
    if not found:
        return ""
    length, start, words = max(found)
    seconds = max(1, rounded(length / _SECOND))
    lasting = f"{seconds} s" if seconds < _MOST_SECONDS else Duration(length / _MINUTE).text
    return f"{words}, {lasting} at {clock_text(-start, day.zone)}"


def _changes(data: ReportData, day: DayMetrics) -> str:
    judged = data.judged[day.day]
    if judged is not None:
        return judgement_text(judged)
    if data.baseline_days[day.day] < FEWEST:
        return too_few_text(data.baseline_days[day.day])
    return "The box listened too little to compare the day with others."


def _night(day: DayMetrics) -> str:
    parts = []
    for name in (FLUSHING_WATER, COUGHING):
        count = day.night_count(name)
        if count is not None:
            times = times_of_events(day, name, day.night_events(name)) * (name in WORRYING)
            none = f"no {in_words(name).lower()} labelled"
            parts.append(amount(name, count) + times if count.labelled else none)
    if day.night_sound is not None:
        parts.append(f"{day.night_sound.text} of sound in all")
    if not parts:
        return "The box listened too little in the night to say anything about it."
    hours = day.night.length / HOUR
    partly = ""
    if day.night_hours < hours - _HALF:
        partly = f" Only {day.night_hours:.1f} of its {hours:.0f} hours were listened to."
    return f"In the night to {weekday(day.day)}, {NIGHT_HOURS}: {'; '.join(parts)}.{partly}"


def _unexplained(data: ReportData) -> int:
    """Return the missing coverage without a gap message, in nanoseconds."""
    starts = np.array([gap.start for gap in data.gaps], np.int64)
    ends = np.array([gap.end for gap in data.gaps], np.int64)
    explained = joined(starts, ends)
    missing = (difference(day.missing, explained) for day in data.days)
    return sum(spans.length for spans in missing)


def _by_lasting(
    troubles: Iterable[Trouble], name: Callable[[Trouble], str]
) -> list[tuple[str, list[Trouble]]]:
    """Group troubles by name, the longest total first."""
    groups: dict[str, list[Trouble]] = {}
    for trouble in troubles:
        groups.setdefault(name(trouble), []).append(trouble)
    return sorted(groups.items(), key=lambda pair: (-_lasting(pair[1]), pair[0]))[:_MOST]


def _lasting(troubles: Sequence[Trouble]) -> int:
    return sum(trouble.end - trouble.start for trouble in troubles)


def _when(data: ReportData, troubles: Sequence[Trouble]) -> str:
    """Return time and duration of troubles: `12 min, once (03:10 to 03:22)`."""
    how_often = "once" if len(troubles) == 1 else f"{len(troubles)} times"
    first = sorted(troubles, key=lambda trouble: trouble.start)[:3]
    shown = [_clocks(data, trouble.start, trouble.end) for trouble in first]
    more = " …" if len(troubles) > len(shown) else ""
    length = Duration(_lasting(troubles) / _MINUTE).text
    return f"{length}, {how_often} ({', '.join(shown)}{more})"


def _clocks(data: ReportData, start: int, end: int) -> str:
    """Format a time span: `03:10 to 03:22`, in a week with its day."""
    times = dict.fromkeys(clock_text(time, data.zone) for time in (start, end))
    day = local_time(start, data.zone).date()
    return (f"{short_day(day)} " if len(data.days) > 1 else "") + " to ".join(times)
