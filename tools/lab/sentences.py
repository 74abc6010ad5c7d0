"""`python -m hearthlog.tools.lab.sentences HOME …`: whether statements about a day are true.

Each statement of the report of a day, of the page of the home and of `info` is compared with the
table of the true sounds of a composed home, `events.csv`: start, end, label, and from whom.

A statement holds if the truth is within its range, for a count with one; within a fifth or within
one of it, for another count, minutes or hours; within a minute, for a time; and without sounds that
count, for a quiet stretch. What is only said to be labelled so is not false; it is counted apart.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from datetime import UTC, date
from html.parser import HTMLParser
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hearthlog.analyzer.activity.checked_minutes import UNMEASURED, Sureness, read_sureness
from hearthlog.analyzer.activity.daily_metrics import HOUR, DayMetrics
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.home_events import NO_EVENTS, sounds_of_day
from hearthlog.analyzer.bridge.page import ENGLISH
from hearthlog.analyzer.bridge.page.day import HomeDay, picture_of
from hearthlog.analyzer.bridge.page.past_days import PastDays
from hearthlog.analyzer.bridge.page.sounds import ShownBouts, bouts, events_between
from hearthlog.analyzer.bridge.settings import RecorderAddress
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import MORNING, at_hour, local_time
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    cut,
    intersection,
    joined,
    lengths,
    single_span,
)
from hearthlog.analyzer.report.headline import LIVELY_MINUTES
from hearthlog.analyzer.report.page import day_page
from hearthlog.analyzer.report.report import Period, read_report_data
from hearthlog.analyzer.report.report_data import (
    ASSESSED_ITEMS,
    ReportData,
    day_parts,
    day_sections,
    minutes_figure,
)
from hearthlog.analyzer.report.wording import several_in_words
from hearthlog.models.classes import (
    COUGHING,
    SILENCE,
    UNKNOWN,
    in_words,
)
from hearthlog.tools.cli.tables import AS_LABELLED, sound_rows
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.statements import (
    FALSE,
    HOLDS,
    INFO,
    LABELLED,
    NUMBER,
    PAGE,
    REPORT,
    TOLERANCE,
    Statement,
    is_close,
    is_modest,
    judge,
    judge_count,
    judge_length,
    judge_times,
    read_count,
    read_minutes,
    read_number,
    time_at,
)
from hearthlog.tools.lab.true_day import NEAR, TrueDay, TrueSound, read_sounds, true_day

_COMPANY = 15 * MINUTE  # a television is known by the ten minutes around
_SURE = 0.9
_NO_SOUNDS = {SILENCE, UNKNOWN}
_IS_BY_SOUND = is_modest(ENGLISH.text("page.by sound"))  # of each sentence of the page
_IS_AS_LABELLED = is_modest(AS_LABELLED)  # the table of `info`
_SHORTEST = MINUTE // 60  # of a sound that breaks a quiet stretch
_CLOCK = re.compile(r"\b([0-2]\d:[0-5]\d)\b")
_RUN = re.compile(r"\b([0-2]\d:[0-5]\d) to ([0-2]\d:[0-5]\d)\b")


class _Page(HTMLParser):
    """The texts of a page: its headline, paragraphs, and rows of its tables below their titles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.paragraphs: list[tuple[str, str]] = []  # class of the paragraph or its section; text
        self.rows: list[tuple[str, list[str], list[str]]] = []  # title, heads, cells
        self._open: list[tuple[str, str]] = []
        self._text: list[str] = []
        self._title, self._heads, self._cells = "", list[str](), list[str]()
        self.feed(text.split("</figure>", 1)[0].split("<figure", 1)[0])
        self.feed(text.split("</figure>", 1)[-1])

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Begin an element."""
        kind = dict(attrs).get("class") or ""
        if tag in {"section", "footer"}:
            self._open.append((tag, kind or tag))
        elif tag in {"p", "h2", "th", "td"}:
            self._text = []
            self._open.append((tag, kind))
        elif tag == "small":
            self._text.append(" | ")

    def handle_data(self, data: str) -> None:
        """Add text."""
        self._text.append(data)

    def handle_endtag(self, tag: str) -> None:
        """End an element."""
        if not self._open or self._open[-1][0] != tag:
            if tag == "thead":
                self._heads, self._cells = self._cells, []
            elif tag == "tr" and self._cells and self._open[-1:] != [("table", "")]:
                if self._heads:
                    self.rows.append((self._title, self._heads, self._cells))
                    self._cells = []
            elif tag == "table":
                self._heads = []
            return
        _, kind = self._open.pop()
        text = " ".join("".join(self._text).split())
        if tag == "h2":
            self._title = text
        elif tag == "p":
            outer = self._open[-1][1] if self._open else ""
            self.paragraphs.append((kind or outer or self._title, text))
        elif tag in {"th", "td"}:
            self._cells.append(text)


def report_statements(
    data: ReportData, truth: TrueDay, before: Sequence[TrueDay]
) -> Iterator[Statement]:
    """Yield the statements of the report of a day.

    The foot of a report says that all but its headline and its ranges is as labelled.

    Parameters
    ----------
    before : sequence of TrueDay
        The days before, as far as they are heard, for the assessment of three days.
    """
    page = _Page(day_page(data))
    is_labelled = any("are as labelled" in text for _, text in page.paragraphs)
    for number, statement in enumerate(_statements_of(page, data.days[0], truth, before)):
        is_modest = is_labelled and number and not statement.is_range
        is_wrong = is_modest and statement.verdict == FALSE
        yield statement._replace(verdict=LABELLED) if is_wrong else statement


def _statements_of(
    page: _Page, day: DayMetrics, truth: TrueDay, before: Sequence[TrueDay]
) -> Iterator[Statement]:
    """Yield the statements of a page: first that of its headline."""
    for kind, text in page.paragraphs:
        yield from _paragraph(kind, text, day, truth)
    figures = {
        (part.title, figure.title): figure for part in day_sections() for figure in part.figures
    }
    for title, heads, cells in page.rows:
        if title == "What was heard":
            yield from _sound_counts(heads, cells, day, truth)
        elif (figure := figures.get((title, cells[0].partition(" | ")[0]))) is not None:
            yield from _figure(figure.value(truth.metrics), title, heads, cells)
        elif title.startswith("For the interRAI"):
            yield from _assessed(heads, cells, [*before, truth])


def _paragraph(kind: str, text: str, day: DayMetrics, truth: TrueDay) -> Iterator[Statement]:
    if kind == "headline":
        yield from _headline(text, truth)
    elif kind == "gist":
        yield from _summary(text, day, truth)
    elif text.startswith("The longest quiet stretch"):
        yield _quiet(text, truth)
    elif text.startswith("Coughing in the night"):
        yield from _night_coughs(text, truth)
    elif text.startswith("Not once"):
        names = [n for n in day.home.classes if _mentions(text.partition(":")[2], n)]
        for name in names:
            yield judge_count(
                REPORT,
                f"never counted: {in_words(name)}",
                (0, 0),
                _count(truth, name),
                modest=True,
            )


def _sounds_of(day: DayMetrics) -> list[str]:
    return [name for name in day.home.classes if name not in _NO_SOUNDS]


def _mentions(text: str, name: str) -> bool:
    words = {in_words(name), several_in_words(name)}
    return any(re.search(rf"\b{re.escape(each.lower())}\b", text.lower()) for each in words)


def _count(truth: TrueDay, name: str) -> float:
    value = truth.metrics.to_evening.count(name)
    return 0 if value is None else value.labelled


def _headline(text: str, truth: TrueDay) -> Iterator[Statement]:
    """Yield the statement on the hours of the day first, then those of counts and steady sound."""
    day, sentences = truth.metrics, re.split(r"(?<=\.) ", text)
    # Not of a part of the day, which has a colon.
    first = next(
        (s for s in sentences if re.search(r"was quiet|had sound", s) and ": " not in s), ""
    )
    hours, modest = day.sound_by_hour, is_modest(first)
    lively = hours >= LIVELY_MINUTES
    steady = next((each for each in sentences if each.startswith("Steady sound from")), "")
    but, _, television = first.partition("something like a television")
    if _RUN.search(first):
        has_sound, may_have = np.zeros(len(hours), bool), np.zeros(len(hours), bool)
        for start, end in _RUN.findall(but):
            has_sound[int(start[:2]) : int(end[:2])] = True
        for start, end in _RUN.findall(television + steady):  # to the minute
            may_have[int(start[:2]) : int(end[:2]) + 1] = True
        slack = 1 + TOLERANCE
        wrong = (has_sound & (hours * slack < LIVELY_MINUTES)) | (
            ~has_sound & ~may_have & (hours > LIVELY_MINUTES * slack)
        )
        yield judge(
            REPORT,
            first,
            f"wrong at {np.flatnonzero(wrong).tolist()} h",
            right=not wrong.any(),
            modest=modest,
        )
        yield from _televisions(REPORT, _RUN.findall(television), truth, modest=modest)
        yield from _steady_sounds(_RUN.findall(steady), truth, modest=modest)
    elif match := re.search(r"sound in (\d+) of|for (\w+) hours", first):
        stated = read_number(match[1] or match[2])
        yield judge_count(REPORT, first, (stated, stated), int(lively.sum()), modest=modest)
    elif "quiet" in first:
        yield judge(
            REPORT, first, f"{lively.sum()} hours with sound", right=not lively.any(), modest=modest
        )
    for sentence in sentences:
        if sentence not in {first, steady}:
            yield from _counts_in(REPORT, sentence, truth)


def _steady_sounds(
    runs: Sequence[tuple[str, str]], truth: TrueDay, *, modest: bool
) -> Iterator[Statement]:
    """Check that there was sound where a steady one is stated."""
    for run_ in runs:
        start, end = (time_at(truth.metrics, each) for each in run_)
        inside = cut(truth.metrics.home.sound, start, end).length / max(end - start, 1)
        right = inside >= 1 - TOLERANCE
        statement = f"steady sound from {' to '.join(run_)}"
        yield judge(REPORT, statement, f"{inside:.0%} of it", right=right, modest=modest)


def _televisions(
    surface: str, runs: Sequence[tuple[str, str]], truth: TrueDay, *, modest: bool
) -> Iterator[Statement]:
    """Check the times of a television."""
    for run_ in runs:
        start, end = (time_at(truth.metrics, each) for each in run_)
        end += 24 * HOUR * (end < start)
        wide = joined(truth.television.starts - _COMPANY, truth.television.ends + _COMPANY)
        inside = cut(wide, start, end).length / max(end - start, 1)
        right = inside >= 1 - TOLERANCE
        statement = f"something like a television from {' to '.join(run_)}"
        yield judge(surface, statement, f"{inside:.0%} of it", right=right, modest=modest)


def _counts_in(surface: str, sentence: str, truth: TrueDay) -> Iterator[Statement]:
    """Check counts of classes in a sentence: of night, day and evening, or of the whole day."""
    day = truth.metrics
    parts = {"night": day.night, "by day": day.waking, "22:00": day.evening}
    modest = is_modest(re.sub(r"\(\d+ labelled\)", "", sentence))
    name = None
    for part in sentence.split("; "):
        name = next((each for each in _sounds_of(day) if _mentions(part, each)), name)
        if name is None:
            continue
        known = {in_words(name).lower(), several_in_words(name).lower()}
        words = f"(?:{'|'.join(map(re.escape, sorted(known)))})"
        after_number = rf"(?:times of )?{words}|by day|after|in the night"
        bare = re.sub(r"\([^)]*\)", "", part).lower()
        at_night = re.search(r"\((perhaps )?(\d+) at night(?:, perhaps (\d+) more)?\)", part)
        match = re.search(rf"{words} ({NUMBER})", bare) or re.search(
            rf"({NUMBER})(?: to ({NUMBER}))? (?={after_number})", bare
        )
        if match is None:
            continue
        low = read_number(match[1])
        high = read_number(match[2]) if match.lastindex == 2 else low
        where = sentence if sentence.startswith("In the night") else part
        where = where.replace(at_night[0], "") if at_night else where
        span = next((own for when, own in parts.items() if when in where), day.to_evening.span)
        true = day.count_in(name, span).labelled
        if "perhaps" in bare:
            more = re.search(rf"perhaps ({NUMBER}) more", bare)
            least, most = (low, low + read_number(more[1])) if more else (0, low)
            right = least <= true <= most or is_close(least, true) or is_close(most, true)
            yield judge(surface, part, f"{true:g}", right=right, modest=modest)
        else:
            yield judge_count(surface, part, (low, high), true, modest=modest)
        if clocks := _CLOCK.findall("".join(re.findall(r"\([^)]*\)", part))):
            yield judge_times(surface, part, name, clocks, truth, modest=modest)
        if at_night:
            perhaps, stated, more = at_night.groups(default="")
            sure = 0 if perhaps else int(stated)
            most, true = int(stated) + int(more or 0), day.count_in(name, day.night).labelled
            right = sure <= true <= most or is_close(sure, true) or is_close(most, true)
            text = f"{in_words(name)} {at_night[0]}"
            yield judge(surface, text, f"{true:g}", right=right, modest=modest)


def _summary(text: str, day: DayMetrics, truth: TrueDay) -> Iterator[Statement]:
    true, modest = truth.metrics, is_modest(text)
    if match := re.search(r"Most of the sound[^:]*: (.*)\.", text):
        names = [name for name in day.home.classes if name != SILENCE]
        lasting = sorted(names, key=lambda name: -_counted_minutes(true.to_evening, name))
        stated = [name for name in names if _mentions(match[1], name)]
        most = lasting[: len(stated)]
        shown = ", ".join(f"{in_words(n)} {_counted_minutes(true.to_evening, n):.0f}" for n in most)
        yield judge(REPORT, text, shown, right={*stated} == {*most}, modest=modest)
    elif "It was quiet." in text:
        yield judge(REPORT, text, f"{_sound(true):.1f} min", right=_sound(true) <= 2, modest=modest)
    elif "television" in text and _RUN.search(text):
        yield from _televisions(REPORT, _RUN.findall(text), truth, modest=modest)
    elif text.startswith("In the night"):
        yield from _counts_in(REPORT, text, truth)
        if (stated := read_minutes(text)) is not None and true.night_sound is not None:
            yield judge_length(REPORT, text, stated, true.night_sound.minutes, modest=modest)
    elif match := re.search(r"[Ll]ess than a minute of sound|Nothing was labelled", text):
        before = re.search(r"rom (\d\d:\d\d) to (\d\d:\d\d)", text)
        after = re.search(r"[Aa]fter (\d\d:\d\d)", text)
        spans = [(time_at(true, before[1]), time_at(true, before[2]))] if before else []
        spans += [(time_at(true, after[1]) + MINUTE, int(true.span.ends[0]))] if after else []
        most = max(_busiest(true.home.sound, start, end) for start, end in spans)
        yield judge(
            REPORT,
            text,
            f"at most {most:.1f} of ten minutes",
            right=most <= 1 + TOLERANCE,
            modest=modest,
        )


def _busiest(sound: Spans, start: int, end: int) -> float:
    """Return the most minutes of sound in ten minutes of a span."""
    edges = np.arange(start, max(end, start + 1), 10 * MINUTE)
    return float(max(lengths(sound, np.append(edges, end)) / MINUTE)) if end > start else 0.0


def _counted_minutes(day: DayMetrics, name: str) -> float:
    return day.spans_of(name).length / MINUTE


def _sound(day: DayMetrics) -> float:
    return intersection(day.home.sound, day.span).length / MINUTE


def _quiet(text: str, truth: TrueDay) -> Statement:
    """Check that no sound of a second lies in a quiet stretch, a minute at its ends aside."""
    day = truth.metrics
    start, end = (time_at(day, each) for each in _CLOCK.findall(text)[:2])
    inside = cut(day.home.sound, start + NEAR, end - NEAR)
    long = int((inside.ends - inside.starts >= _SHORTEST).sum())
    return judge(
        REPORT,
        text,
        f"{long} sounds, {inside.length / MINUTE:.1f} min",
        right=not long,
        modest=is_modest(text),
    )


def _night_coughs(text: str, truth: TrueDay) -> Iterator[Statement]:
    modest = is_modest(text)
    if hours := re.findall(r"(\d+) after (\d\d):00", text):
        for number, hour in hours:
            start = time_at(truth.metrics, f"{hour}:00") - 24 * HOUR * (int(hour) >= 22)
            starts = truth.everywhere.home.events.get(COUGHING, NONE.starts)
            true = int(((starts >= start) & (starts < start + HOUR)).sum())
            yield judge_count(
                REPORT, f"{number} after {hour}:00", (int(number),) * 2, true, modest=modest
            )
    else:
        yield judge_times(REPORT, text, COUGHING, _CLOCK.findall(text)[-16:], truth, modest=modest)


def _sound_counts(
    heads: Sequence[str], cells: Sequence[str], day: DayMetrics, truth: TrueDay
) -> Iterator[Statement]:
    """Check a row of the table of sounds: how often in each part of the day, when, how long."""
    name = next(
        (n for n in [*_sounds_of(day), SILENCE] if in_words(n) == cells[0].partition(" | ")[0]),
        None,
    )
    if name is None:
        return
    by_head, with_night = dict(zip(heads, cells, strict=True)), truth.metrics.with_night
    for part, span in day_parts(day.day).items():
        often = by_head.get(part, "")
        if (stated := read_count(often.partition(" | ")[0])) is not None:
            where = f"{cells[0]}, {part}: {often}"
            modest = is_modest(re.sub(r"\(\d+ labelled\)", "", where))
            true = with_night.count_in(name, span(with_night)).labelled
            yield judge_count(REPORT, where, stated, true, modest=modest)
    when, lasting = by_head["When"], by_head["How long"]
    if clocks := _CLOCK.findall(when):
        where = f"{cells[0]}: {when}"
        yield judge_times(REPORT, where, name, clocks, truth, modest=is_modest(where))
    if (minutes := read_minutes(lasting.partition(" | ")[0])) is not None:
        value = minutes_figure(name).value(truth.metrics)
        true = 0 if value is None else value.middle
        where = f"{cells[0]}: {lasting}"
        yield judge_length(REPORT, where, minutes, true, modest=is_modest(where))


def _figure(
    value: object, title: str, heads: Sequence[str], cells: Sequence[str]
) -> Iterator[Statement]:
    text, shown = f"{title}, {cells[0]}: {cells[1]}", cells[1].partition(" | ")[0]
    modest = is_modest(heads[1] + cells[0] + re.sub(r"\(\d+ labelled\)", "", cells[1]))
    shown = shown or cells[-1].partition(" | ")[0]  # a time after 22:00
    shown = "0" if shown == "never" else shown
    middle = getattr(value, "middle", 0)
    if _CLOCK.fullmatch(shown):
        hours, minutes = map(int, shown.split(":"))
        right = abs(60 * hours + minutes - middle) <= 10
        yield judge(REPORT, text, getattr(value, "text", "never"), right=right, modest=modest)
    elif (lasting := read_minutes(shown)) is not None:
        yield judge_length(REPORT, text, lasting, middle, modest=modest)
    elif (stated := read_count(shown)) is not None:
        yield judge_count(REPORT, text, stated, middle, modest=modest)


def _assessed(
    heads: Sequence[str], cells: Sequence[str], days: Sequence[TrueDay]
) -> Iterator[Statement]:
    item = next((each for each in ASSESSED_ITEMS if each.topic == cells[0]), None)
    if item is None:
        return
    values = [item.value(day.metrics.to_evening) for day in days]
    true = sum(value.middle for value in values if value is not None)
    text = f"interRAI, {cells[0]}: {cells[2]}"
    modest = is_modest(heads[2] + re.sub(r"\(\d+ labelled\)", "", cells[2]))
    if (lasting := read_minutes(cells[2])) is not None:
        yield judge_length(REPORT, text, lasting, true, modest=modest)
    elif (stated := read_count(cells[2])) is not None:
        yield judge_count(REPORT, text, stated, true, modest=modest)


def page_statements(
    home: HomeDay, truth: TrueDay, sureness: Sureness = UNMEASURED
) -> Iterator[Statement]:
    """Yield the statements of the page of the home about a past day, and of its morning."""
    picture = picture_of(home)
    night, day = (single_span(part.start, part.end) for part in home.times_of_day())
    both = single_span(int(night.starts[0]), int(day.ends[0]))
    sentence = picture["sentence"]
    for part in re.split(r"(?<=\.) (?=By day)", sentence):
        span = night if "In the night" in part else day if "By day" in part else both
        yield from _page_sentence(part, home, truth, span, apart=picture["more"])
    yield from _page_sentence(picture["more"], home, truth, both)
    morning = home._replace(
        moment=home.moment._replace(now=at_hour(truth.metrics.day, MORNING, home.zone) + HOUR),
        is_past=False,
    )
    sentence, last_night = picture_of(morning)["sentence"], truth.everywhere.night
    yield from _page_sentence(sentence, home, truth, last_night)
    for lane in (each for each in picture["rooms"][0]["lanes"] if each["label"] != UNKNOWN):
        name, modest = lane["label"], is_modest(lane["told"])
        for count, span, what in zip(lane["counts"], (night, day), picture["columns"], strict=True):
            if count is not None:
                text = f"{lane['words']}, {what}: {count}"
                true = _of_page(truth, lane, name, span)
                yield judge_count(PAGE, text, (count, count), true, modest=modest)
        times = [time for time, *_ in lane["times"][0]["times"]]
        if times and len(times) <= 5:
            text = f"{lane['words']} at {', '.join(times)}"
            yield judge_times(PAGE, text, name, times, truth, modest=modest)
    yield from _sureness(home, truth, sureness)


def _of_page(truth: TrueDay, lane: object, name: str, span: Spans) -> int:
    """Count the true events; beside a television only if the page does not set those apart."""
    metrics = truth.metrics if "television" in str(lane) else truth.everywhere
    return metrics.home.minutes.between(span).count(name, None).labelled


def _page_sentence(
    text: str, home: HomeDay, truth: TrueDay, span: Spans, *, apart: str = ""
) -> Iterator[Statement]:
    day, modest = truth.everywhere, _IS_BY_SOUND
    if "television" in f"{text} {apart}":
        day = truth.metrics
    if "television" in text:
        _, _, television = text.partition("television")
        edge = re.search(r"(since|until) (\d\d:\d\d)", television)
        first, last = (f"{local_time(int(each[0]), home.zone):%H:%M}" for each in span)
        runs = _RUN.findall(television) if edge is None else [(edge[2], last)]
        runs = [(first, edge[2])] if edge is not None and edge[1] == "until" else runs
        yield from _televisions(PAGE, runs, truth, modest=modest)
    minutes = day.home.minutes.between(span)
    microphone = home.microphones[0]
    shown = dict.fromkeys(microphone.common_names.get(label, label) for label in microphone.names)
    names = [n for n in shown if n not in _NO_SOUNDS and _mentions(text, n)]
    if match := re.search(r"[Nn]o ([^.:;(]*)[.;]", text):
        for name in (n for n in names if _mentions(match[1], n)):
            true = minutes.count(name, None).labelled
            yield judge_count(PAGE, f"{text} [{in_words(name)}]", (0, 0), true, modest=modest)
        return
    if "quiet night" in text:
        sound = intersection(day.home.sound, span).length / MINUTE
        limit = (1 + TOLERANCE) * 0.01 * span.length / MINUTE
        yield judge(PAGE, text, f"{sound:.1f} min of sound", right=sound <= limit, modest=modest)
    for name in names:
        words = re.escape(in_words(name).lower())
        match = re.search(
            rf"{words} ({NUMBER})(?: times)?(?: \(([^)]*)\))?"
            rf"(?:, perhaps ({NUMBER}) more(?: times)?(?: \(([^)]*)\))?)?",
            text,
            re.IGNORECASE,
        )
        if match is None:
            continue
        count, times, more, more_times = match.groups(default="")
        total = read_number(count) + (read_number(more) if more else 0)  # labelled, sure or not
        yield judge_count(
            PAGE,
            f"{text} [{in_words(name)}]",
            (total, total),
            minutes.count(name, None).labelled,
            modest=modest,
        )
        if clocks := _CLOCK.findall(f"{times} {more_times}"):
            yield judge_times(
                PAGE, f"{text} [{in_words(name)}]", name, clocks, truth, modest=modest
            )


def _sureness(home: HomeDay, truth: TrueDay, measured: Sureness) -> Iterator[Statement]:
    """Check how many of the sounds that are said to be sure are right."""
    events = events_between(home.microphones, home.moment.night, home.moment.now + 1)
    shown = ShownBouts(home.moment.now, home.zone, ENGLISH, lambda _: "", True, measured)
    found: defaultdict[str, list[bool]] = defaultdict(list)
    for bout in bouts(events):
        words = re.sub(r" *\(.*", "", shown.describe(bout)["sure"])
        label = bout.first.label
        name = home.microphones[0].common_names.get(label, label)
        spans = truth.everywhere.home.spans.get(name, NONE)
        found[words].append(any(cut(spans, e.start, e.end).length for e in bout.events))
    for words, right in found.items():
        text = f"{len(right)} sounds {words or 'without a word'}"
        share = sum(right) / len(right)
        holds = words != "sure" or share >= _SURE or sum(right) == len(right)
        yield judge(PAGE, text, f"{sum(right)} are of their class", right=holds, modest=False)


def info_statements(sounds: Sequence[TrueSound], day: DayMetrics) -> Iterator[Statement]:
    """Yield the statements of the table of `info` about the 24 hours to 22:00 of a day."""
    truth = true_day(sounds, day)
    true, to_evening = truth.metrics.to_evening, day.to_evening
    minutes = truth.metrics.home.minutes.between(to_evening.span)
    counted = sounds_of_day(day)
    for row in sound_rows(counted):
        if row.name not in _sounds_of(day):
            continue
        length, *_ = row.cells
        total = counted.totals.get(row.name, NO_EVENTS).counted
        text = f"{in_words(row.name)} {total}"
        number = minutes.count(row.name, None).labelled
        yield judge_count(INFO, text, (total, total), number, modest=_IS_AS_LABELLED)
        stated = read_minutes(length or "0 s")
        assert stated is not None
        text = f"{in_words(row.name)} {length or 'for no time'}"
        true_minutes = _counted_minutes(true, row.name)
        yield judge_length(INFO, text, stated, true_minutes, modest=_IS_AS_LABELLED)


def statements(home: Path) -> Iterator[tuple[date, list[Statement]]]:
    """Yield the statements about each day of a composed home with logs, heard for the most part.

    Raise `DataError` if the table of true sounds cannot be read, and as a report does.
    """
    logs = find_home_logs([home / "logs"])
    entries = logs.between()
    sounds = read_sounds(home, entries[0].start)
    before: list[TrueDay] = []
    sureness = read_sureness(logs, 0, entries[-1].start + 24 * HOUR)
    for day in logs.days(UTC):
        data, _ = read_report_data(logs, Period(day, 1, UTC))
        labelled = data.days[0]
        if labelled.share < 0.75:
            continue
        truth = true_day(sounds, labelled)
        past = PastDays(RecorderAddress(home / "logs", entries[0].node, UTC)).read(day, frozenset())
        page = HomeDay([*past.state.microphones.values()], past.moment, UTC, is_past=True)
        yield (
            day,
            [
                *report_statements(data, truth, before[-2:]),
                *page_statements(page, truth, sureness),
                *info_statements(sounds, labelled),
            ],
        )
        before.append(truth)


def main(
    homes: Annotated[list[Path], typer.Argument(help="Folders with logs and events.csv.")],
    *,
    only_false: Annotated[bool, typer.Option("--false", help="Print only what is false.")] = False,
) -> None:
    """Compare what people are told of the days of composed homes with what is true."""
    total: Counter[tuple[str, str]] = Counter()
    ranges: list[bool] = []
    for home in homes:
        for day, found in statements(home):
            print(f"\n{home.name}, {day}")
            for one_ in found:
                if not only_false or one_.verdict == FALSE:
                    print(f"  {one_.surface:7}{one_.verdict:12}{one_.text[:110]:112}{one_.truth}")
            for surface in dict.fromkeys(one_.surface for one_ in found):
                verdicts = Counter(one_.verdict for one_ in found if one_.surface == surface)
                total.update({(surface, verdict): n for verdict, n in verdicts.items()})
                parts = ", ".join(f"{verdicts[v]} {v}" for v in (HOLDS, LABELLED, FALSE))
                print(f"  {surface}: {verdicts.total()} statements: {parts}")
            ranges += [one_.verdict == HOLDS for one_ in found if one_.is_range]
    print()
    for surface in (REPORT, PAGE, INFO):
        of = [total[surface, verdict] for verdict in (HOLDS, LABELLED, FALSE)]
        verdicts = f"{of[0]} hold, {of[1]} wrong as labelled, {of[2]} false"
        print(f"{surface:7} {sum(of):4} statements: {verdicts}")
    if ranges:
        print(f"counts with a range: {sum(ranges)} of {len(ranges)} hold")


if __name__ == "__main__":
    run(main)
