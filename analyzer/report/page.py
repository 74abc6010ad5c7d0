"""The page of a report."""

import re
from collections.abc import Iterator, Sequence
from html import escape

from hearthlog.analyzer.colours import colour
from hearthlog.analyzer.report import class_words, interrai
from hearthlog.analyzer.report.baseline import DAYS
from hearthlog.analyzer.report.class_words import (
    clock_text,
    in_words,
    listed,
    several_in_words,
    times_in_words,
)
from hearthlog.analyzer.report.daily_metrics import Day
from hearthlog.analyzer.report.html import box, figure, heading, page, paragraph, swatch, table
from hearthlog.analyzer.report.report_data import Account
from hearthlog.analyzer.report.sections import Figure, Section, events_of, minutes_of, sections
from hearthlog.analyzer.report.summary_text import (
    gist_of_day,
    gist_of_week,
    longest_quiet,
    not_heard,
    not_well,
    percent,
    plain,
)
from hearthlog.analyzer.report.values import Count, Minutes, Value
from hearthlog.models.classes import COUGHING, FLUSHING_WATER, SHOWER, SILENCE
from hearthlog.schemas.messages.topics import LIVE

_NOTHING, _TO = "\u2013", "\u2013"  # dashes
_PARTLY = 0.95
_DAY_CAPTION = (
    "Each line is a kind of sound, from midnight to midnight: the taller the mark, the more of it "
    "in those three minutes. Shaded: night. Hatched: not heard. The bars show minutes with sound "
    "in each hour; the short dark lines show what is usual."
)
_WEEK_CAPTION = (
    "Each block is a kind of sound, with a line for each day, from midnight to midnight: the "
    "taller the mark, the more of it in those ten minutes. Shaded: night. Hatched: not heard."
)
_HOW_TO_READ = (
    "A computer listens for kinds of sound; this report needs no recording. It can be wrong. "
    "“About 5 (4 to 6)”: it is not equally sure of every sound it marked. 5 is the likeliest "
    "number by its own sureness, and nine times in ten the right one should be from 4 to 6. Sounds "
    "that it missed are in no number. Sounds of one kind with at most ten seconds between them "
    "count once. What a person has listened to and corrected counts as certain."
)
_RIGHT_IN_TESTS = (
    "“Right in tests”: how many of ten sounds of this name were right when the model was tested on "
    "recordings that it had not learned from. At home it may be better or worse."
)


def day_page(account: Account, picture: bytes) -> str:
    """Write the page of a day."""
    day = account.days[0]
    title = class_words.day_in_words(day.day)
    body = [
        *_top(account, title, list(gist_of_day(account, day))),
        figure(picture, f"Timeline of {title}", _DAY_CAPTION),
        heading("What was heard"),
        *_sounds(account, day),
        paragraph(_about_usual(account), "note"),
    ]
    for section in sections(account.classes):
        body += [heading(section.title), *_section(account, section, day)]
    body += [*_interrai(account), *_foot(account)]
    return page(f"{account.home}, {title}", body)


def week_page(account: Account, picture: bytes) -> str:
    """Write the page of a week."""
    first, last = account.days[0].day, account.days[-1].day
    spoken = f"{class_words.date_in_words(first)} to {class_words.date_in_words(last)}"
    title = f"Week {first.isocalendar().week}, {spoken}"
    names = [name for name in account.classes if name != SILENCE and _was_heard(account, name)]
    absent = [in_words(name).lower() for name in account.classes if name not in (*names, SILENCE)]
    body = [
        *_top(account, title, list(gist_of_week(account))),
        figure(picture, f"Timeline of {title}", _WEEK_CAPTION),
        heading("How long it was heard"),
        _week(account, [minutes_of(name) for name in names]),
        heading("How often it was heard"),
        _week(account, [events_of(name) for name in names]),
        paragraph(f"Not heard: {listed(absent)}." if absent else ""),
        paragraph(_about_usual(account), "note"),
    ]
    for section in sections(account.classes):
        body.append(heading(section.title))
        if section.missing:
            body.append(paragraph(section.missing))
        else:
            body += [_week(account, section.figures), paragraph(section.note, "note")]
    body += [*_interrai(account), *_foot(account)]
    return page(f"{account.home}, {title}", body)


def _top(account: Account, title: str, gist: Sequence[str]) -> Iterator[str]:
    microphones = listed([plain(name) for name in account.microphones])
    many = "s" if len(account.microphones) > 1 else ""
    who = f"Home: {account.home}, microphone{many}: {microphones}."
    line = f"{who} Times are those of {account.zone}."
    yield f"<header>\n<h1>{escape(title)}</h1>\n{paragraph(line)}\n</header>"
    yield box("gist", [paragraph(line) for line in gist])
    alerts = [*not_heard(account), *not_well(account)]
    yield box("alert", [paragraph(line, "" if not i else "more") for i, line in enumerate(alerts)])


def _about_usual(account: Account) -> str:
    if not account.comparable:
        return account.too_few
    return (
        f"Usually: the middle of {len(account.earlier)} of the {DAYS} days before, with their "
        "lowest and highest. Only days that were heard for the most part are used. A word such as "
        "“longer” is there where this is outside of all of them, whatever the uncertainty. One or "
        "two such words on a page are nothing to worry about."
    )


def _sounds(account: Account, day: Day) -> Iterator[str]:
    """Tell minutes and events of each class; what was not heard at all is only named."""
    tested = any(name in account.precisions for name in account.classes)
    usually = ["Usually"] * account.comparable
    heads = ["Sound", "How long", *usually, "How often", *usually, *["Right in tests"] * tested]
    names = [name for name in account.classes if name != SILENCE]
    absent = [name for name in names if not _was_heard(account, name)]
    rows = []
    for name in [*names, *[SILENCE] * (SILENCE in account.classes)]:
        if name in absent:
            continue
        often = events_of(name)
        row = [swatch(*colour(name)) + escape(in_words(name))]
        row += _cells(account, minutes_of(name), day)
        row += [""] * (1 + account.comparable) if name == SILENCE else _cells(account, often, day)
        rows.append(row + [_tenths(account.precisions.get(name))] * tested)
    yield table(heads, rows)
    if absent:
        yield paragraph(f"Not heard: {listed([in_words(name).lower() for name in absent])}.")


def _was_heard(account: Account, name: str) -> bool:
    """Tell whether there is something to say of a class: now, or that it is usual."""
    baseline = account.baseline(events_of(name))
    values = [day.count(name) for day in account.days]
    missing = all(value is None for value in values)
    return missing or any(v and v.marked for v in values) or bool(baseline and baseline[0].highest)


def _cells(account: Account, figure: Figure, day: Day) -> list[str]:
    """Return a figure, and what is usual if anything is compared."""
    cells = [f'<span class="unit">{escape(_text(figure.value(day)))}</span>']
    if account.comparable:
        change = account.change(figure, day)
        mark = f' <span class="differs">{change}</span>' if change else ""
        cells.append(escape(account.usually(figure)) + mark)
    return cells


def _text(value: Value | None) -> str:
    return "not known" if value is None else value.text


def _section(account: Account, section: Section, day: Day) -> Iterator[str]:
    if section.missing:
        yield paragraph(section.missing)
        return
    heads = ["", "This day", *["Usually"] * account.comparable]
    yield table(heads, [[escape(f.title), *_cells(account, f, day)] for f in section.figures])
    share = _share(section.figures, day)
    if share < _PARTLY * day.share:
        yield paragraph(f"These sounds could be heard for {percent(share)} of the day only.")
    if section.title == "Bathroom":
        for name in (FLUSHING_WATER, SHOWER):
            starts = day.events(name).starts
            times = f"{several_in_words(name)} at {times_in_words(starts, day.zone)}."
            yield paragraph(times if len(starts) else "")
    elif section.title == "Night":
        yield paragraph(_coughing(day))
    else:
        yield paragraph(longest_quiet(day))
    yield paragraph(section.note, "note")


def _coughing(day: Day) -> str:
    """Say in which hours of the night there was coughing, as marked."""
    events = day.night_events(COUGHING)
    if not len(events.starts) or not day.night_hours:
        return ""
    hours = [clock_text(time, day.zone)[:2] for time in events.starts.tolist()]
    each = [f"{hours.count(hour)} from {hour}:00" for hour in dict.fromkeys(hours)]
    rate = events.number.middle / day.night_hours
    return f"Coughing as marked: {', '.join(each)}. About {rate:.1f} an hour."


def _week(account: Account, figures: Sequence[Figure]) -> str:
    """Tell figures of seven days, their total, and what is usual on a day."""
    rows = []
    for day in account.days:
        share = _share(figures, day)
        heard = percent(share) if share else "not heard"
        values = [figure.value(day) if day.coverage.length else None for figure in figures]
        cells = [escape(_short(value)) for value in values]
        rows.append([escape(class_words.short_day(day.day)), heard, *cells])
    rows.append(["All days", "", *(escape(_total(account.days, figure)) for figure in figures)])
    kinds = ["sum"]
    if account.comparable:
        usually = (_dense(account.usually(figure)) for figure in figures)
        rows.append(["Usual day", "", *map(escape, usually)])
        kinds.append("usual")
    return table(["Day", "Heard", *(figure.short for figure in figures)], rows, kinds, "wide")


def _share(figures: Sequence[Figure], day: Day) -> float:
    """Return for how much of a day all that these figures are about would have been heard."""
    return min([day.share, *(day.share_of(f.name) for f in figures if f.name)])


def _short(value: Value | None) -> str:
    """Write a figure in little room, with a dash for `to`."""
    return _NOTHING if value is None else _dense(value.text.removeprefix("about "))


def _dense(text: str) -> str:
    text = re.sub(r"(\d h \d\d) min", r"\1", text.replace("under 1 min", "< 1 min"))
    return text.replace(" to ", _TO)


def _total(days: Sequence[Day], figure: Figure) -> str:
    values = [figure.value(day) for day in days if day.coverage.length]
    return _short(_sum([v for v in values if v is not None])) if figure.sums else ""


def _sum(values: Sequence[Value]) -> Count | Minutes | None:
    counts = [value for value in values if isinstance(value, Count)]
    minutes = [value for value in values if isinstance(value, Minutes)]
    if not values:
        return None
    return sum(counts, Count()) if counts else sum(minutes, Minutes())


def _interrai(account: Account) -> Iterator[str]:
    """Tell what sound can say to an assessment."""
    days = [day for day in (*account.before, *account.days) if day.coverage.length]
    over = "this week" if len(account.days) > 1 else f"{interrai.DAYS} days, up to this one"
    heard = "" if len(account.days) > 1 else f" ({len(days)} of them heard)"
    yield heading("For the interRAI Home Care assessment")
    yield paragraph(
        f"Counts over {over}{heard}, to help with questions that are mostly about the last "
        f"{interrai.DAYS} days. They are no scores and no diagnosis, and do not replace asking and "
        "seeing the person.",
        "note",
    )
    rows = []
    for item in interrai.ITEMS:
        audible = not item.needs or item.needs in account.classes
        values = [value for day in days if (value := item.value(day)) is not None]
        text = _text(_sum(values)) if audible else "this model does not know the sound"
        rows.append([escape(cell) for cell in (item.topic, item.heard, text, item.limits)])
    yield table(["The form asks about", "Heard here", "Count", "What sound cannot tell"], rows)


def _foot(account: Account) -> Iterator[str]:
    live = account.labelling == LIVE
    source = "what the recorder heard at the time" if live else f"the labels of {account.labelling}"
    yield "<footer>"
    yield heading("How to read this")
    yield paragraph(_HOW_TO_READ, "note")
    yield paragraph(_RIGHT_IN_TESTS if account.precisions else "", "note")
    yield paragraph(f"Made from {source}, and from corrections, if there are any.", "note")
    yield "</footer>"


def _tenths(share: float | None) -> str:
    return _NOTHING if share is None else f"{share * 10:.0f} of 10"
