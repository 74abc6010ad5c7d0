"""HTML page of a report."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2
import numpy as np

from hearthlog.analyzer.activity.daily_metrics import HOUR, MOST, DayMetrics
from hearthlog.analyzer.activity.values import BASELINE_DAYS, Clock, Count, Duration, Value
from hearthlog.analyzer.logs.local_time import EVENING
from hearthlog.analyzer.logs.spans import Spans, intersection
from hearthlog.analyzer.report.headline import day_headline, unlogged, week_headline
from hearthlog.analyzer.report.report_data import (
    ASSESSED_DAYS,
    ASSESSED_ITEMS,
    FigureSection,
    ReportData,
    ReportFigure,
    day_parts,
    day_sections,
    event_figure,
    minutes_figure,
    part_figure,
    week_sections,
)
from hearthlog.analyzer.report.summary_text import (
    longest_quiet_text,
    not_recorded,
    percent,
    plain,
    recorder_problems,
    sounds_to_review,
    summarize_day,
    summarize_week,
)
from hearthlog.analyzer.report.timeline import (
    DayTimeline,
    HourBar,
    hour_bars,
    timeline_of,
    week_timelines,
)
from hearthlog.analyzer.report.wording import (
    clock_text,
    clock_with_day,
    dates_in_words,
    day_in_words,
    short_day,
    times_in_words,
    times_of,
)
from hearthlog.models.classes import (
    COUGHING,
    FLUSHING_WATER,
    ON_TELEVISION,
    OTHER,
    SHOWER,
    SILENCE,
    UNKNOWN,
    WORRYING,
    colour_on_dark,
    colour_on_paper,
    in_words,
    ordered,
)
from hearthlog.schemas.errors import listed


class Cell(NamedTuple):
    """Table cell."""

    text: str
    change: str = ""  # how the figure differs from other days
    colour: tuple[int, int, int] | None = None
    unbroken: bool = False  # whether line breaks are forbidden
    note: str = ""  # in small letters below the text
    kind: str = ""  # CSS class


class PageTable(NamedTuple):
    """Table and its CSS class; the first cell of a row is its head."""

    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    kind: str = ""


class PagePicture(NamedTuple):
    """Timelines of a day or a week, and the hours of a day."""

    title: str
    description: str
    days: Sequence[tuple[str, DayTimeline]]  # with their names
    bars: Sequence[HourBar] = ()


def fill_page(**parts: Any) -> str:
    """Fill all names of the template; all text is escaped."""
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["on_dark"] = colour_on_dark
    template = files("hearthlog.analyzer.report").joinpath("page.html").read_text("utf-8")
    return environment.from_string(template).render(**parts)


_NOTHING, _TO = "\u2013", "\u2013"  # dashes
_PARTLY = 0.95
_HOME, _MICROPHONE = "home", "mic"  # names that nobody gave
_FEW = 5  # events of which every time is written
_FEW_WORRYING = 12
_MOST_TIMES = {**dict.fromkeys(WORRYING, _FEW_WORRYING), FLUSHING_WATER: 16, SHOWER: 16}
_BESIDE, _AFTER = "beside a television", f"after {EVENING}:00"
_SPACE = "\N{NO-BREAK SPACE}"
_COMPLETE = 0.995  # share of a day
_LONG = 1.0  # minutes


class PageSection(NamedTuple):
    """Section of the page: a table and remarks."""

    section: FigureSection
    table: PageTable
    remarks: Sequence[str] = ()


def day_page(data: ReportData) -> str:
    """Return the page of a day."""
    day = data.days[0]
    shown = data.from_evening
    with_night = shown.days[0]
    timeline = timeline_of(with_night)
    title, table = day_in_words(day.day), _sounds(shown, with_night)
    bars = hour_bars(with_night, shown.earlier if data.comparable else [])
    return _page(
        data,
        shown,
        PagePicture(f"The sounds of {title}", _description(timeline), [("", timeline)], bars),
        title=title,
        headline=day_headline(day),
        summary=list(summarize_day(data, day)),
        overview=[("What was heard", table, "")],
        evening=[*day_parts(day.day)][-1] in table.heads,
        partly=_partly_covered(with_night),
        parts=[_part(data, section, day) for section in day_sections()],
    )


def week_page(data: ReportData) -> str:
    """Return the page of a week."""
    first, last = data.days[0].day, data.days[-1].day
    shown, spoken = data.from_evening, dates_in_words(first, last)
    names = [name for name in data.classes if name != SILENCE and _occurs(shown, name)]
    days = week_timelines(shown.days)
    described = " ".join(f"{name}: {_description(each)}" for name, each in days)
    return _page(
        data,
        shown,
        PagePicture(f"The sounds of {spoken}", described, days),
        title=f"Week {first.isocalendar().week}, {spoken}",
        headline=week_headline(data.days, shown.days),
        summary=list(summarize_week(data)),
        overview=list(_week_overview(shown, names)),
        evening=False,
        partly=_partly_covered(shown.logged_days[0]) if len(shown.logged_days) == 1 else [],
        parts=[
            PageSection(section, _week(data, section.figures, has_share=_is_partly(data, section)))
            for section in week_sections(data.classes, len(data.logged_days))
        ],
    )


def _description(timeline: DayTimeline) -> str:
    """Return the text alternative of a timeline."""
    parts, day = [], timeline.day.to_evening
    for lane in (each for each in timeline.lanes if not each.empty):
        number = len(day.counted_events(lane.name, day.span))
        uncounted = _uncounted(day.uncounted_events(lane.name))
        late = len(timeline.day.counted_events(lane.name, timeline.day.evening))
        texts = f"{number}", f"and {uncounted}" * bool(uncounted), f"{late} {_AFTER}" * bool(late)
        parts.append(f"{lane.words} {', '.join(filter(None, texts))}")
    zone, spans = timeline.day.zone, timeline.day.missing
    gaps = [
        f"{clock_text(start, zone)} to {clock_text(end, zone)}"
        for start, end in spans.pairs()
        if end - start >= HOUR
    ]
    text = f"{'; '.join(parts) or 'Nothing was heard'}. {unlogged([timeline.day])}".strip()
    return text + (f" Not listening: {', '.join(gaps)}." if gaps else "")


def _page(data: ReportData, shown: ReportData, picture: PagePicture, **parts: Any) -> str:
    """Fill the page; `shown` has the days of the picture and of the first tables."""
    days = [day for day in (*data.before, *data.days) if day.coverage.length]
    names = [name for name in data.classes if name not in {SILENCE, UNKNOWN}]
    absent = [name for name in names if _has_count(shown, name) and not _occurs(shown, name)]
    uncertain = [name for name in names if not _has_count(shown, name)]
    everywhere = [name for name in names if name not in ON_TELEVISION]
    return fill_page(
        data=data,
        picture=picture,
        week=len(data.days) > 1,
        default_home=_HOME,
        default_microphone=_MICROPHONE,
        microphones=listed([plain(name) for name in data.microphones], "and"),
        alerts=[*sounds_to_review(data), *not_recorded(data), *recorder_problems(data)],
        absent=_listed(absent),
        uncertain=_listed(uncertain),
        unknown=_listed(data.unknown),
        confused=_listed(data.confused),
        everywhere=_listed(everywhere),
        dash=_NOTHING,
        unsure=_is_unsure(it for _, it, _ in parts["overview"]),
        has_dash=len(data.days) > 1 and _has_dash(parts),
        is_utc=str(data.zone) in {"Etc/UTC", "UTC"},
        scenarios=[(plain(name), _scenario(data, name)) for name in data.scenarios],
        days_before=BASELINE_DAYS,
        interrai=_interrai(data, [day.to_evening for day in days]),
        interrai_days=ASSESSED_DAYS,
        interrai_covered=_covered_days(days),
        **parts,
    )


def _listed(names: Sequence[str]) -> str:
    return listed([in_words(name).lower() for name in names], "and")


def _covered_days(days: Sequence[DayMetrics]) -> str:
    """Return how many days are covered, and how many of them in part: `2 of them heard`."""
    partly = sum(day.share < MOST for day in days)
    return f"{len(days)} of them heard" + (f", {partly} only in part" if partly else "")


def _scenario(data: ReportData, name: str) -> PageTable:
    """Return the minutes of each class of a scenario, a row per class, a column per day."""
    each = zip(data.scenarios[name], data.days, strict=True)
    days = [found for found, day in each if day.logged.length] or data.scenarios[name]
    classes = ordered(sorted({label for day in days for label in day}))
    rows = [
        [
            Cell(in_words(label), colour=colour_on_paper(label)),
            *(
                Cell(_scenario_text(found.get(label, 0.0), day), unbroken=True)
                for found, day in zip(days, data.logged_days, strict=True)
            ),
        ]
        for label in classes
    ]
    if len(data.logged_days) == 1:
        return PageTable(["Sound", "How long"], rows, "figures")
    return PageTable(["Sound", *_day_heads(data)], rows, "wide")


def _scenario_text(minutes: float, day: DayMetrics) -> str:
    """Return the duration of a scenario's class on a day."""
    return Duration(minutes).text if minutes or day.share >= MOST else _NOTHING


def _sounds(data: ReportData, day: DayMetrics) -> PageTable:
    """Return how often each class was heard in each recorded part of the day, when and how long."""
    parts = {
        title: part
        for title, part in day_parts(day.day).items()
        if intersection(day.home.coverage, part(day)).length
    }
    heads = ["Sound", *parts, "When", "How long"]
    rows, before, late = [], day.to_evening, [*day_parts(day.day)][-1]
    for name in data.classes:
        lasting = minutes_figure(name)
        if name == SILENCE or not _occurs(data, name):
            continue
        if day.count(name) is None and not day.uncounted_events(name):
            continue
        length, apart = _cell(data, lasting, day), _apart(lasting, [day])
        cells = [
            *(_count_cell(data, part_figure(name, part), day) for part in parts.values()),
            Cell(_times(day, name, before.span)),
            length._replace(note=", ".join(note for note in (apart, length.note) if note)),
        ]
        if late in parts:
            cells[len(parts) - 1] = _late_cell(cells[len(parts) - 1], day, name)
        right = [Cell(data.accuracy_text(name))] * data.checked
        head = Cell(
            in_words(name),
            colour=colour_on_paper(name),
            note=_uncounted(before.uncounted_events(name)),
        )
        rows.append([head, *cells, *right])
    return PageTable([*heads, *["Right here"] * data.checked], rows, "sounds stack")


def _late_cell(cell: Cell, day: DayMetrics, name: str) -> Cell:
    """Add to the count of a class after 22:00 its times, and what is beside a television."""
    minutes = day.home.minutes.between(day.evening)
    uncounted = _uncounted(minutes.uncounted_events(name))
    notes = _times(day, name, day.evening), uncounted, cell.note
    kind = "count" if uncounted else cell.kind
    return cell._replace(note="; ".join(filter(None, notes)), kind=kind)


def _uncounted(number: int) -> str:
    """Return how many events are beside a television, and so not counted; empty for none."""
    return f"{number} {_BESIDE}" if number else ""


def _partly_covered(day: DayMetrics) -> list[str]:
    """Return sentences on the classes that could be heard for less of a day than others."""
    names: dict[str, list[str]] = {}
    for name in day.home.classes:
        if name not in {SILENCE, UNKNOWN, OTHER} and day.share_of(name) < _PARTLY * day.share:
            names.setdefault(percent(day.share_of(name)), []).append(name)
    return [
        f"{_listed(own).capitalize()} could be heard for {share} of the time only."
        for share, own in names.items()
    ]


def _apart(figure: ReportFigure, days: Sequence[DayMetrics]) -> str:
    """Return how much of a figure is beside a television, and so not in it: `11 beside a …`."""
    shown = [day.to_evening for day in days]
    number = sum(day.uncounted_events(figure.name) for day in shown) if figure.counts else 0
    minutes = sum(day.uncounted_minutes(figure.name) for day in shown) if figure.lasts else 0.0
    amount = f"{number}" if number else Duration(minutes).text.replace(" ", _SPACE)
    return f"{amount} {_BESIDE}" if number or minutes >= 1 else ""


def _times(day: DayMetrics, name: str, span: Spans) -> str:
    """Return the times of a few events of a class in a span, else the first and the last."""
    starts = day.counted_events(name, span)
    if len(starts) <= _MOST_TIMES.get(name, _FEW):
        return times_in_words(starts, day.zone, first=day.day, unsure=day.unsure_events(name))
    first, last = (
        clock_with_day(int(edge), day.zone, day.day) for edge in (starts.min(), starts.max())
    )
    return f"first {first}, last {last}"


def _occurs(data: ReportData, name: str) -> bool:
    """Return whether a class has a value, now or in its usual range."""
    baseline = data.baseline(event_figure(name))
    values = [day.count(name) for day in data.days]
    uncounted = any(day.uncounted_events(name) for day in data.days)
    now = any(value and value.labelled for value in values)
    return uncounted or now or bool(baseline and baseline[0].highest)


def _is_unsure(tables: Iterable[PageTable]) -> bool:
    """Whether tables show what is not sure: those with a range do not."""
    return any(re.search(r"\d\?", cell.text) for it in tables for row in it.rows for cell in row)


def _has_dash(parts: Mapping[str, Any]) -> bool:
    """Whether tables have a dash in place of a figure."""
    tables = [it for _, it, _ in parts["overview"]] + [part.table for part in parts["parts"]]
    return any(cell.text == _NOTHING for it in tables for row in it.rows for cell in row)


def _has_count(data: ReportData, name: str) -> bool:
    """Whether enough was recorded on some of the days to tell how often a class was heard."""
    return any(day.count(name) is not None or day.uncounted_events(name) for day in data.days)


def _cell(data: ReportData, figure: ReportFigure, day: DayMetrics) -> Cell:
    """Return a figure, how it differs, and its usual range if there is a baseline."""
    text = _text(figure.value(day), is_often=figure.is_often)
    apart = _apart_sound(figure, [day])
    if not data.comparable:
        return Cell(text, unbroken=True, note=apart)
    usual = data.usually(figure)
    note = ", ".join(filter(None, (apart, f"usually {usual}" * bool(usual))))
    return Cell(text, data.change(figure, day), unbroken=True, note=note)


def _count_cell(data: ReportData, figure: ReportFigure, day: DayMetrics) -> Cell:
    cell = _cell(data, figure, day)
    return cell._replace(kind="count zero" if cell.text == "0" else "count")


def _text(value: Value | None, *, is_often: bool = False) -> str:
    if value is None:
        return _NOTHING
    return times_of(round(value.middle)) if is_often else value.text


def _apart_sound(figure: ReportFigure, days: Sequence[DayMetrics]) -> str:
    """Return how much of the time with any sound is beside a television."""
    minutes = sum(figure.apart(day) for day in days if day.coverage.length)
    return f"{Duration(minutes).text} of it {_BESIDE}" if minutes >= 1 else ""


def _part(data: ReportData, section: FigureSection, day: DayMetrics) -> PageSection:
    heads = ["", f"24 hours to {EVENING}:00", _AFTER.capitalize()]
    shown = [figure for figure in section.figures if figure.value(day) is not None]
    has_late = bool(intersection(day.home.coverage, day.evening).length)
    rows = []
    for figure in shown:
        cells = [_cell(data, figure, day), Cell(_text(figure.late(day)).strip(_NOTHING))]
        value = figure.value(day)
        if isinstance(value, Clock) and value.minutes >= EVENING * 60:
            cells.reverse()
        rows.append([Cell(figure.title, note=figure.note), *cells[: 1 + has_late]])
    remarks = [_coughing(day), longest_quiet_text(day)]
    if len(shown) < len(section.figures):
        more = "more" if shown else "anything"
        remarks.append(f"The box listened too little to tell {more}.")
    return PageSection(
        section,
        PageTable(heads[: 2 + has_late], rows, "amounts" if has_late else "figures"),
        remarks,
    )


def _coughing(day: DayMetrics) -> str:
    """Return when coughing was labelled in the night, unless the table of sounds has each time."""
    listed_day, starts = day.to_evening, day.night_events(COUGHING)
    if len(listed_day.counted_events(COUGHING, listed_day.span)) <= _FEW_WORRYING or not len(
        starts
    ):
        return ""
    if len(starts) <= _FEW:
        unsure = day.unsure_events(COUGHING)
        times = times_in_words(starts, day.zone, first=day.day, unsure=unsure)
        return f"Coughing in the night at {times}."
    hours = [clock_text(time, day.zone)[:2] for time in np.sort(starts).tolist()]
    each = [f"{hours.count(hour)} after {hour}:00" for hour in dict.fromkeys(hours)]
    return f"Coughing in the night, hour by hour: {', '.join(each)}."


def _week_overview(data: ReportData, names: Sequence[str]) -> Iterator[tuple[str, PageTable, str]]:
    """Yield how often and how long each class was heard: titles, tables, and remarks on them.

    Of a week with a single logged day it is one table.
    """
    often, long = [*map(event_figure, names)], [*map(minutes_figure, names)]
    if len(data.logged_days) == 1:
        yield "What was heard", _amounts(data, often, long), ""
        return
    yield "How often it was heard", _week(data, often, has_share=True), ""
    lasting = [figure for figure in long if _is_long(data, figure)]
    short = _listed([figure.name for figure in long if figure not in lasting])
    remark = f"Under a minute a day: {short}." if short else ""
    yield "How long it was heard", _week(data, lasting, has_share=False), remark


def _is_long(data: ReportData, figure: ReportFigure) -> bool:
    """Whether a class was heard for a minute on a day, or is usually on some days."""
    baseline = data.baseline(figure) if data.comparable else None
    minutes = [] if baseline is None else [baseline[0].highest]
    for day in data.logged_days:
        value = figure.value(day)
        minutes += [0.0 if value is None else value.middle, day.uncounted_minutes(figure.name)]
    return max(minutes) >= _LONG


def _amounts(
    data: ReportData, often: Sequence[ReportFigure], long: Sequence[ReportFigure]
) -> PageTable:
    """Return how often and how long each class was heard in a week with a single logged day."""
    (day,) = data.logged_days
    rows = []
    for count, lasting in zip(often, long, strict=True):
        cells = [
            Cell(_text(figure.value(day)), note=_notes(data, figure)) for figure in (count, lasting)
        ]
        rows.append([Cell(count.short, colour=colour_on_paper(count.name)), *cells])
    return PageTable(["Sound", "How often", "How long"], rows, "amounts")


def _notes(data: ReportData, figure: ReportFigure) -> str:
    """Return what is in small letters at a figure of a week."""
    usual = _dense(data.usually(figure)) if data.comparable else ""
    days = data.logged_days
    apart = _apart(figure, days), _apart_sound(figure, days)
    notes = figure.note, *apart, f"usually {usual} a day" * bool(usual)
    return ", ".join(filter(None, notes))


def _week(data: ReportData, figures: Sequence[ReportFigure], *, has_share: bool) -> PageTable:
    """Return the figures of the days of a week that have logs, a column for each, and their total.

    With `has_share`, the first row is the share of each day that was recorded.
    """
    days = data.logged_days
    rows: list[list[Cell]] = []
    if has_share:
        rows.append([Cell("Listened"), *(Cell(_recorded(figures, day)) for day in days), Cell("")])
    for figure in figures:
        values = [figure.value(day) if day.coverage.length else None for day in days]
        colour = colour_on_paper(figure.name) if figure.name else None
        title = figure.title if len(days) == 1 else figure.short
        rows.append(
            [
                Cell(title, colour=colour, note=_notes(data, figure)),
                *(
                    Cell(_short(value, is_often=figure.is_often and len(days) == 1))
                    for value in values
                ),
                Cell(_total(days, figure)),
            ]
        )
    heads = ["", *_day_heads(data), "All"]
    if len(days) == 1:
        return PageTable(heads[:-1], [row[:-1] for row in rows], "figures")
    return PageTable(heads, rows, "wide")


def _is_partly(data: ReportData, section: FigureSection) -> bool:
    """Whether a day of a week was not all recorded for the classes of a section."""
    return any(_share(section.figures, day) < _COMPLETE for day in data.logged_days)


def _recorded(figures: Sequence[ReportFigure], day: DayMetrics) -> str:
    """Return the share of a day that was recorded for all classes of some figures."""
    share = _share(figures, day)
    text = percent(share).replace("more than", ">").replace("less than", "<")
    return text if share else _NOTHING


def _day_heads(data: ReportData) -> list[str]:
    return [short_day(day.day).rpartition(" ")[0] for day in data.logged_days]


def _share(figures: Sequence[ReportFigure], day: DayMetrics) -> float:
    """Return the share of a day covered for all classes of these figures."""
    return min([day.share, *(day.share_of(f.name) for f in figures if f.name)])


def _short(value: Value | None, *, is_often: bool = False) -> str:
    """Return a figure in short form, with a dash for `to`, and without what was labelled."""
    return _dense(re.sub(r" \(\d+ labelled\)", "", _text(value, is_often=is_often)))


def _dense(text: str) -> str:
    return text.replace("under 1 min", "< 1 min").replace(" to ", _TO)


def _total(days: Sequence[DayMetrics], figure: ReportFigure) -> str:
    values = [figure.value(day) for day in days if day.coverage.length]
    total = _sum(values) if figure.sums else None
    return _dense(total.text) if total is not None else _NOTHING * figure.sums


def _sum(values: Sequence[Value | None]) -> Count | Duration | None:
    """Add daily figures, some unknown; None if a total of 0 is uncertain."""
    counts = [value for value in values if isinstance(value, Count)]
    minutes = [value for value in values if isinstance(value, Duration)]
    of_kind = counts or minutes
    if not of_kind:
        return None
    total = sum(counts, Count()) if counts else sum(minutes, Duration())
    return total if total.middle or len(of_kind) >= MOST * len(values) else None


def _interrai(data: ReportData, days: Sequence[DayMetrics]) -> PageTable:
    """Return the interRAI items that sound can inform, as far as they are known."""
    rows = []
    for item in ASSESSED_ITEMS:
        number = _sum([item.value(day) for day in days])
        if number is None or item.needs not in ("", *data.classes):
            continue
        lasts = isinstance(number, Duration) and item.needs
        note = _apart(minutes_figure(item.needs), days) if lasts else ""
        count = Cell(_text(number), note=note)
        rows.append([Cell(item.topic), Cell(item.sounds), count, Cell(item.limits)])
    heads = ["The form asks about", "Heard here", "Count", "What sound cannot tell"]
    return PageTable(heads, rows, "stack")
