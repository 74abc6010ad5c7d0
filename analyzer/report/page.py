"""HTML page of a report."""

import base64
import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2

from hearthlog.analyzer.activity.daily_metrics import MOST, DayMetrics
from hearthlog.analyzer.activity.values import BASELINE_DAYS, Count, Duration, Value
from hearthlog.analyzer.colours import colour_on_paper
from hearthlog.analyzer.report.report_data import (
    ASSESSED_DAYS,
    ASSESSED_ITEMS,
    Account,
    FigureSection,
    ReportFigure,
    event_figure,
    minutes_figure,
    sections,
)
from hearthlog.analyzer.report.summary_text import (
    gist_of_day,
    gist_of_week,
    longest_quiet,
    not_heard,
    not_well,
    percent,
    plain,
)
from hearthlog.analyzer.report.wording import (
    clock_text,
    date_in_words,
    day_in_words,
    several_in_words,
    short_day,
    times_in_words,
)
from hearthlog.models.classes import COUGHING, FLUSHING_WATER, SHOWER, SILENCE, in_words
from hearthlog.schemas.errors import listed


class Cell(NamedTuple):
    """Table cell: a colour before the text, a change after it; `whole` forbids line breaks."""

    text: str
    change: str = ""
    colour: tuple[int, int, int] | None = None
    whole: bool = False


class TableRow(NamedTuple):
    """Table row with a head cell."""

    cells: Sequence[Cell]
    kind: str = ""


class PageTable(NamedTuple):
    """Table and its CSS class."""

    heads: Sequence[str]
    rows: Sequence[TableRow]
    kind: str = ""


def fill_page(picture: bytes, **parts: Any) -> str:
    """Fill the template; all text is escaped, and the picture is embedded.

    Parameters
    ----------
    **parts
        By the names of the template; all are required.
    """
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    template = files("hearthlog.analyzer.report").joinpath("page.html").read_text("utf-8")
    return environment.from_string(template).render(
        picture=base64.b64encode(picture).decode(), **parts
    )


_NOTHING, _TO = "\u2013", "\u2013"  # dashes
_PARTLY = 0.95


class PageSection(NamedTuple):
    """Section of the page: a table and remarks."""

    section: FigureSection
    table: PageTable
    remarks: Sequence[str] = ()


def day_page(account: Account, picture: bytes) -> str:
    """Return the page of a day."""
    day = account.days[0]
    names = [name for name in account.classes if name != SILENCE]
    return _page(
        account,
        picture,
        title=day_in_words(day.day),
        gist=list(gist_of_day(account, day)),
        overview=[("What was heard", _sounds(account, day))],
        absent=[name for name in names if not _was_heard(account, name)],
        parts=[_part(account, section, day) for section in sections(account.classes)],
    )


def week_page(account: Account, picture: bytes) -> str:
    """Return the page of a week."""
    first, last = account.days[0].day, account.days[-1].day
    spoken = f"{date_in_words(first)} to {date_in_words(last)}"
    names = [name for name in account.classes if name != SILENCE and _was_heard(account, name)]
    return _page(
        account,
        picture,
        title=f"Week {first.isocalendar().week}, {spoken}",
        gist=list(gist_of_week(account)),
        overview=[
            (
                "How long it was heard, as labelled",
                _week(account, list(map(minutes_figure, names))),
            ),
            ("How often it was heard", _week(account, list(map(event_figure, names)))),
        ],
        absent=[name for name in account.classes if name not in (*names, SILENCE)],
        parts=[
            PageSection(section, _week(account, section.figures))
            for section in sections(account.classes)
        ],
    )


def _page(account: Account, picture: bytes, *, absent: Sequence[str], **parts: Any) -> str:
    days = [day for day in (*account.before, *account.days) if day.coverage.length]
    return fill_page(
        picture,
        account=account,
        week=len(account.days) > 1,
        microphones=listed([plain(name) for name in account.microphones], "and"),
        alerts=[*not_heard(account), *not_well(account)],
        absent=listed([in_words(name).lower() for name in absent], "and"),
        television=_television(account),
        scenarios=[(plain(name), _scenario(account, name)) for name in account.scenarios],
        days_before=BASELINE_DAYS,
        interrai=_interrai(account, days),
        interrai_days=ASSESSED_DAYS,
        interrai_heard=_heard(days),
        **parts,
    )


def _heard(days: Sequence[DayMetrics]) -> str:
    """Return how many days are covered, and how many of them in part: `2 of them heard`."""
    partly = sum(day.share < MOST for day in days)
    return f"{len(days)} of them heard" + (f", {partly} only in part" if partly else "")


def _television(account: Account) -> str:
    """Return a remark on labels during television sound, which are not counted."""
    amounts = {
        name: sum(day.beside_television(name) for day in account.days) for name in account.classes
    }
    several = (f"{several_in_words(name).lower()} {n}" for name, n in amounts.items() if n)
    return listed(list(several), "and")


def _scenario(account: Account, name: str) -> PageTable:
    """Return the minutes of each class of a scenario, a row per class, a column per day."""
    days = account.scenarios[name]
    classes = sorted({label for day in days for label in day})
    rows = [
        TableRow(
            [
                Cell(in_words(label), colour=colour_on_paper(label)),
                *(
                    Cell(_scenario_text(found.get(label, 0.0), day), whole=True)
                    for found, day in zip(days, account.days, strict=True)
                ),
            ]
        )
        for label in classes
    ]
    dates = [short_day(day.day) for day in account.days]
    return PageTable(["Sound", *(dates if len(days) > 1 else ["How long, as labelled"])], rows)


def _scenario_text(minutes: float, day: DayMetrics) -> str:
    """Return the duration of a scenario's class on a day."""
    return Duration(minutes).text if minutes or day.share >= MOST else _NOTHING


def _sounds(account: Account, day: DayMetrics) -> PageTable:
    """Return minutes and events of each class with sound."""
    usually = ["Usually"] * account.comparable
    often = "How often" if account.checked else "How often, as labelled"
    how = ["How long, as labelled", *usually, often, *usually]
    heads = ["Sound", *how, *["Right here"] * account.checked]
    names = [name for name in account.classes if name != SILENCE and _was_heard(account, name)]
    rows = []
    for name in [*names, *[SILENCE] * (SILENCE in account.classes)]:
        cells = [Cell(in_words(name), colour=colour_on_paper(name))]
        cells += _cells(account, minutes_figure(name), day)
        if name == SILENCE:
            cells += [Cell("")] * (1 + account.comparable)
        else:
            cells += _cells(account, event_figure(name), day)
        rows.append(TableRow(cells + [Cell(account.rightness(name))] * account.checked))
    return PageTable(heads, rows)


def _was_heard(account: Account, name: str) -> bool:
    """Return whether a class has a value, now or in its usual range."""
    baseline = account.baseline(event_figure(name))
    values = [day.count(name) for day in account.days]
    missing = all(value is None for value in values)
    apart = any(day.beside_television(name) for day in account.days)
    now = any(value and value.labelled for value in values)
    return missing or apart or now or bool(baseline and baseline[0].highest)


def _cells(account: Account, figure: ReportFigure, day: DayMetrics) -> list[Cell]:
    """Return a figure, and its usual range if there is a baseline."""
    cells = [Cell(_text(figure.value(day)), whole=True)]
    if account.comparable:
        cells.append(Cell(account.usually(figure), account.change(figure, day)))
    return cells


def _text(value: Value | None) -> str:
    return "not known" if value is None else value.text


def _part(account: Account, section: FigureSection, day: DayMetrics) -> PageSection:
    heads = ["", "This day", *["Usually"] * account.comparable]
    rows = [TableRow([Cell(f.title), *_cells(account, f, day)]) for f in section.figures]
    return PageSection(section, PageTable(heads, rows), list(_remarks(section, day)))


def _remarks(section: FigureSection, day: DayMetrics) -> Iterator[str]:
    share = _share(section.figures, day)
    if share < _PARTLY * day.share:
        yield f"These sounds could be heard for {percent(share)} of the day only."
    if section.title == "Bathroom":
        for name in (FLUSHING_WATER, SHOWER):
            starts = day.events(name)
            if len(starts):
                yield f"{several_in_words(name)} at {times_in_words(starts, day.zone)}."
    elif section.title == "Night":
        yield _coughing(day)
    else:
        yield longest_quiet(day)


def _coughing(day: DayMetrics) -> str:
    """Return the hours of the night with labelled coughing."""
    starts = day.night_events(COUGHING)
    if not len(starts) or not day.night_hours:
        return ""
    hours = [clock_text(time, day.zone)[:2] for time in starts.tolist()]
    each = [f"{hours.count(hour)} from {hour}:00" for hour in dict.fromkeys(hours)]
    rate = len(starts) / day.night_hours
    return f"Coughing as labelled: {', '.join(each)}. {rate:.1f} an hour."


def _week(account: Account, figures: Sequence[ReportFigure]) -> PageTable:
    """Return the figures of seven days, their total, and the usual daily value."""
    rows = []
    for day in account.days:
        share = _share(figures, day)
        share_text = percent(share) if share else "not heard"
        values = [figure.value(day) if day.coverage.length else None for figure in figures]
        rows.append(_row(short_day(day.day), share_text, *map(_short, values)))
    totals = (_total(account.days, figure) for figure in figures)
    rows.append(_row("All days", "", *totals, kind="sum"))
    if account.comparable:
        usually = (_dense(account.usually(figure)) for figure in figures)
        rows.append(_row("Usual day", "", *usually, kind="usual"))
    return PageTable(["Day", "Heard", *(figure.short for figure in figures)], rows, "wide")


def _row(*texts: str, kind: str = "") -> TableRow:
    return TableRow([Cell(text) for text in texts], kind)


def _share(figures: Sequence[ReportFigure], day: DayMetrics) -> float:
    """Return the share of a day covered for all classes of these figures."""
    return min([day.share, *(day.share_of(f.name) for f in figures if f.name)])


def _short(value: Value | None) -> str:
    """Return a figure in short form, with a dash for `to`."""
    return _NOTHING if value is None else _dense(value.text)


def _dense(text: str) -> str:
    text = re.sub(r"(\d h \d\d) min", r"\1", text.replace("under 1 min", "< 1 min"))
    return text.replace(" to ", _TO)


def _total(days: Sequence[DayMetrics], figure: ReportFigure) -> str:
    values = [figure.value(day) for day in days if day.coverage.length]
    return _short(_sum(values)) if figure.sums else ""


def _sum(values: Sequence[Value | None]) -> Count | Duration | None:
    """Add daily figures, some unknown; None if a total of 0 is uncertain."""
    counts = [value for value in values if isinstance(value, Count)]
    minutes = [value for value in values if isinstance(value, Duration)]
    known = counts or minutes
    if not known:
        return None
    total = sum(counts, Count()) if counts else sum(minutes, Duration())
    return total if total.middle or len(known) >= MOST * len(values) else None


def _interrai(account: Account, days: Sequence[DayMetrics]) -> PageTable:
    """Return the interRAI items that sound can inform."""
    rows = []
    for item in ASSESSED_ITEMS:
        audible = not item.needs or item.needs in account.classes
        number = _sum([item.value(day) for day in days])
        text = _text(number) if audible else "this model does not know the sound"
        if account.checked and number is not None and not _is_checked(number):
            text += ", as labelled"
        rows.append(_row(item.topic, item.heard, text, item.limits))
    count = "Count" if account.checked else "Count, as labelled"
    return PageTable(["The form asks about", "Heard here", count, "What sound cannot tell"], rows)


def _is_checked(value: Count | Duration) -> bool:
    """Return whether checked minutes give a range for the correct number."""
    return isinstance(value, Count) and value.rates is not None
