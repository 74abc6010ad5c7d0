"""`hearthlog events` and `hearthlog report`: what was heard, and a day or a week for a carer."""

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from datetime import date, timedelta, tzinfo
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from hearthlog.schemas.errors import LogError, listed
from hearthlog.tools.cli.options import (
    NEAR,
    Day,
    End,
    Json,
    Labels,
    Logs,
    Start,
    Timezone,
    home_and_zone,
    models_folder,
    parse_span,
    read_date,
    read_day,
)
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    print_json,
    print_notice,
    print_table,
    share_done,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.activity.daily_metrics import HomeMetrics
    from hearthlog.analyzer.activity.home_events import HomeEvent
    from hearthlog.analyzer.logs.home_logs import HomeLogs
    from hearthlog.analyzer.logs.spans import Spans


class ListedSpan(NamedTuple):
    """A span of time in nanoseconds of UTC, and its name."""

    start: int
    end: int
    words: str
    day: date | None = None  # if it is a day with the night before it, from 22:00 to midnight


class _Part(NamedTuple):
    """A night, the rest of a day, or a part of these, in nanoseconds of UTC."""

    start: int
    end: int
    title: str


def events(
    logs: Logs,
    *,
    label: Annotated[
        list[str] | None,
        typer.Option(
            help="Class, such as coughing or talking; may be repeated. By default all sounds."
        ),
    ] = None,
    day: Day = None,
    night: Annotated[
        bool,
        typer.Option(
            "--night", help="The night from 22:00 to 07:00 that ends on the day; else the last one."
        ),
    ] = False,
    start: Start = None,
    end: End = None,
    labels: Labels = "live",
    timezone: Timezone = None,
    play: Annotated[
        bool, typer.Option("--play", help="Play the kept sound of each, one after the other.")
    ] = False,
    as_json: Json = False,
) -> None:
    """List sounds: when, how long, how sure, and whether a person has reviewed them.

    Sounds of one class with at most ten seconds between them are one line, as in the report.
    Exit status 3: a log is damaged or unfinished, and its time is missing.
    """
    limits = parse_span(start, end)
    if limits != (None, None) and (day is not None or night):
        wrong_use("--start and --end exclude --day and --night")
    if play and as_json:
        wrong_use("--play and --json exclude each other")
    from hearthlog.analyzer.activity.daily_metrics import metrics_of_home
    from hearthlog.analyzer.activity.home_data import marked_classes, read_home
    from hearthlog.analyzer.activity.home_events import event_totals, home_events, perhaps_of
    from hearthlog.analyzer.logs.local_time import iso_time, midnight

    home_logs, zone = home_and_zone(logs, timezone)
    span = _chosen_span(home_logs, zone, day, limits, night=night)
    before = midnight(_date(span.start, zone) - timedelta(days=1), zone)  # of an event that goes on
    with share_done("reading the labels") as progress:
        data = read_home(home_logs, labels, before, span[:2], progress)
    metrics = metrics_of_home(data)
    marked = marked_classes(data)
    classes = _chosen_classes([*metrics.classes, *marked], label or (), data.hidden)
    found = home_events(data, metrics, classes, *span[:2])
    labelled = [name for name in classes if name not in marked] or metrics.classes
    missing = _not_listened(metrics, labelled, span, every=bool(label))
    if as_json:
        print_json(
            {
                "start": iso_time(span.start, zone),
                "end": iso_time(span.end, zone),
                "labelling": labels,
                "listened": round(1 - missing.length / (span.end - span.start), 4),
                "not_listened": [
                    {"start": iso_time(start, zone), "end": iso_time(end, zone)}
                    for start, end in zip(missing.starts, missing.ends, strict=True)
                ],
                "events": [_fields(event, labels, zone) for event in found],
                "counts": {
                    name: total._asdict()
                    for name, total in event_totals(metrics, *span[:2]).items()
                    if name in classes
                },
                "marked": {
                    name: sum(event.label == name for event in found)
                    for name in classes
                    if name in marked
                },
                "day": _day_json(metrics, classes, span, zone),
            }
        )
    else:
        parts = list(_parts(span, zone))
        _print_events(found, perhaps_of(data, found), parts, missing, zone)
        _print_totals(metrics, found, span, classes, marked, zone)
        _print_pauses(span, missing, zone)
    if play:
        _play(found, home_logs, zone)
    end_with_warnings(data.losses)


def _date(time: int, zone: tzinfo) -> date:
    from hearthlog.analyzer.logs.local_time import local_time

    return local_time(time, zone).date()


def _chosen_span(
    logs: "HomeLogs",
    zone: tzinfo,
    day: str | None,
    limits: tuple[int | None, int | None],
    *,
    night: bool,
) -> ListedSpan:
    """Return the chosen span of time; by default the last complete day, or the last night."""
    from hearthlog.analyzer.logs.home_logs import check_day
    from hearthlog.analyzer.logs.local_time import (
        day_span,
        evening_before,
        local_time,
        night_span,
    )
    from hearthlog.analyzer.logs.local_time import today as today_at
    from hearthlog.tools.cli.tables import day_title

    ends = logs.end()
    if ends is None:
        raise LogError(logs.losses[0] if logs.losses else "there is no message in these logs")
    if limits != (None, None):
        first, last = limits
        begin = _first(logs) if first is None else first
        stop = ends if last is None else last
        words = [f"{local_time(time, zone):%Y-%m-%d %H:%M}" for time in (begin, stop)]
        if begin >= stop:
            wrong_use(f"no log has a message after {words[0]}")
        return ListedSpan(begin, stop, f"From {words[0]} to {words[1]}")
    if night:
        if day is None:
            moment = today_at(ends, zone)
            before = today_at(moment.night - 1, zone)  # the last complete night, if recorded
            if moment.morning > ends and before.morning > _first(logs):
                moment = before
            begin, stop = moment.night, moment.morning
        else:
            begin, stop = night_span(read_day("--day", day, zone), zone)
        morning = _date(stop, zone)
        check_day(logs, morning - timedelta(days=1), morning, zone)
        return ListedSpan(begin, stop, f"The night to {morning:%A, %Y-%m-%d}")
    own = logs.last_complete_day(zone) if day is None else read_day("--day", day, zone)
    check_day(logs, own, own, zone)
    start, end = evening_before(own, zone), day_span(own, zone)[1]
    return ListedSpan(start, end, day_title(own), own)


def _first(logs: "HomeLogs") -> int:
    return min(entry.start for entry in logs.between())


def _chosen_classes(
    classes: Sequence[str], labels: Sequence[str], hidden: Collection[str]
) -> list[str]:
    """Return the classes of labels; all sounds without labels."""
    from hearthlog.analyzer.errors import DataError
    from hearthlog.models.classes import SILENCE, class_name, in_words, meant_by

    sounds = [name for name in classes if name != SILENCE]
    if not labels:
        return sounds
    chosen = []
    for label in labels:
        if class_name(label) in hidden:
            raise DataError(f"{label} is hidden: never_tell, or the page of the home, says so")
        meant = [name for name in sounds if in_words(name).lower() == label.lower()]
        meant = meant or meant_by(label, sounds)
        if len(meant) != 1:
            there = ", ".join(in_words(name).lower() for name in sounds)
            raise DataError(
                f"no class {label[:64]!r} in these logs; there is {there}{_hint(label)}"
            )
        chosen += meant
    return list(dict.fromkeys(chosen))


def _hint(label: str) -> str:
    """Return how a class that the logs lack can be labelled."""
    from hearthlog.analyzer.logs.hidden_classes import common_names
    from hearthlog.models.classes import meant_by
    from hearthlog.models.registry import list_models

    models = [entry.model for entry in list_models(models_folder()) if entry.model is not None]
    for model in sorted(models, key=lambda one: one.description.embedding is not None):
        about = model.description
        apart = set(about.classes) - common_names(about.model_dump()).keys()
        if not meant_by(label, sorted(apart)):
            continue
        if about.embedding is None:
            return f". `hearthlog relabel LOGS --model {model.name}` labels it"
        network = about.embedding.network
        return (
            f". {model.name} labels it in what is recorded with the network {network}: "
            f"`hearthlog models fetch {network}`"
        )
    return (
        ". No model here has it: mark some of these sounds (`hearthlog review`), then "
        "`hearthlog train --home LOGS`"
    )


def _not_listened(
    metrics: "HomeMetrics", classes: Sequence[str], span: ListedSpan, *, every: bool
) -> "Spans":
    """Return the parts of a span in which no class could be labelled, or not every one of them."""
    from hearthlog.analyzer.logs.spans import NONE, difference, intersection, single_span, union

    own = single_span(span.start, span.end)
    listened = [metrics.listened[name] for name in classes]
    return difference(own, reduce(intersection if every else union, listened) if listened else NONE)


def _fields(event: "HomeEvent", labelling: str, zone: tzinfo) -> dict[str, object]:
    from hearthlog.analyzer.logs.local_time import iso_time

    times = {"start": iso_time(event.start, zone), "end": iso_time(event.end, zone)}
    values = {"seconds": round(event.seconds, 2), "confidence": round(event.confidence, 3)}
    return event._asdict() | times | values | {"labelling": labelling}


_MENTIONED = 600 * 1_000_000_000  # ns: shortest pause in listening that is listed
_MOST_PAUSES = 5


def _parts(span: ListedSpan, zone: tzinfo) -> Iterator[_Part]:
    """Yield the nights and the rest of the days of a span, and what a day has after 22:00."""
    from hearthlog.analyzer.logs.local_time import EVENING, awake_span, night_span

    own = _date(span.start, zone)
    last = _date(span.end, zone) + timedelta(days=1) if span.day is None else span.day
    while own <= last:
        for place, (start, end) in enumerate((night_span(own, zone), awake_span(own, zone))):
            begin, stop = max(start, span.start), min(end, span.end)
            if begin < stop:
                night = "" if place else "Night to "
                hours = " to ".join(_clock(time, zone) for time in (begin, stop))
                yield _Part(begin, stop, f"{night}{own:%a} {own.day} {own:%B}, {hours}")
        own += timedelta(days=1)
    if span.day is not None:
        yield _Part(awake_span(span.day, zone)[1], span.end, f"After {EVENING}:00")


def _clock(time: int, zone: tzinfo) -> str:
    from hearthlog.analyzer.logs.local_time import local_time

    return f"{local_time(time, zone):%H:%M}"


def _title(part: _Part, missing: "Spans") -> str:
    """Return the title of a part, with how much of it was listened to, if not all."""
    from hearthlog.analyzer.activity.event_counts import MINUTE
    from hearthlog.analyzer.logs.spans import cut
    from hearthlog.tools.cli.tables import length_text

    lacks, all_of_it = cut(missing, part.start, part.end).length, part.end - part.start
    if lacks < _MENTIONED:
        return part.title
    listened, length = (length_text(n / MINUTE) for n in (all_of_it - lacks, all_of_it))
    return f"{part.title}, listened to {listened} of {length}"


def _print_events(
    found: Sequence["HomeEvent"],
    perhaps: Sequence[str],
    parts: Sequence[_Part],
    missing: "Spans",
    zone: tzinfo,
) -> None:
    """Print a line for each event, below the title of its part of a day."""
    from hearthlog.analyzer.logs.local_time import local_time
    from hearthlog.models.classes import in_words
    from hearthlog.tools.cli.tables import length_text

    several = len({name for event in found for name in event.microphones}) > 1
    clock = " or ".join(
        dict.fromkeys(f"{local_time(event.start, zone):%Z}" for event in (found[0], found[-1]))
        if found
        else ()
    )
    lengths = _right("length", [length_text(event.seconds / 60) for event in found])
    shares = _right(
        "score",
        [f"{100 * event.confidence:.0f} %{'?' if event.is_unsure else ' '}" for event in found],
    )
    head = (
        f"when ({clock})" if clock else "when", "sound", next(lengths), next(shares),
        *(["where"] if several else []), "",
    )  # fmt: skip
    rows: list[Sequence[str]] = []
    left = deque(parts)
    title = ""
    for event, might_be in zip(found, perhaps, strict=True):
        while left and left[0].start <= event.start:
            title = _title(left.popleft(), missing)
        if title:
            rows += [[""]] * bool(rows) + [[title]]
            title = ""
        notes = [f"perhaps {in_words(might_be).lower()}"] if might_be else []
        notes += ["reviewed"] * event.reviewed + ["beside a television"] * event.television
        rows.append(
            (
                f"{local_time(event.start, zone):%H:%M:%S}",
                in_words(event.label),
                next(lengths),
                next(shares),
                *([", ".join(event.microphones)] if several else []),
                ", ".join(notes),
            )
        )
    print_table(head, rows, words=len(head))


def _day_json(
    metrics: "HomeMetrics", classes: Collection[str], span: ListedSpan, zone: tzinfo
) -> dict[str, object] | None:
    """Return the totals of a day to 22:00, as `info` has them; None for another span."""
    from hearthlog.analyzer.activity.daily_metrics import day_of
    from hearthlog.analyzer.activity.home_events import sounds_of_day

    if span.day is None:
        return None
    return sounds_of_day(day_of(metrics, span.day, zone)).of_classes(classes).as_json()


def _print_totals(
    metrics: "HomeMetrics",
    found: Sequence["HomeEvent"],
    span: ListedSpan,
    classes: Sequence[str],
    marked: Collection[str],
    zone: tzinfo,
) -> None:
    """Print the table of the totals, of a day to 22:00, and what was after that."""
    from hearthlog.analyzer.activity.checked_minutes import UNSURE_BELOW
    from hearthlog.analyzer.activity.home_events import sounds_between
    from hearthlog.analyzer.logs.local_time import EVENING, awake_span
    from hearthlog.models.classes import in_words
    from hearthlog.tools.cli.tables import AS_LABELLED, counts_text, print_sounds, sound_rows

    day = _date(span.start, zone) if span.day is None else span.day
    stop = span.end if span.day is None else awake_span(day, zone)[1]
    sounds = sounds_between(metrics, day, zone, span.start, stop).of_classes(classes)
    sounds = sounds.with_marked([e for e in found if e.label in marked and e.start < stop])
    later = sounds_between(metrics, day, zone, stop, span.end).of_classes(classes)
    print(f"{chr(10) * bool(found)}{span.words}, {AS_LABELLED}")
    print_sounds(sound_rows(sounds, classes if len(classes) == 1 else ()))
    if text := counts_text(later):
        print(f"After {EVENING}:00: {text}")
    for name in classes:
        if name in marked and any(event.label == name for event in found):
            print(f"{in_words(name)}: only what people marked: the model does not know it")
    if any(event.is_unsure for event in found):
        print(f"? less than {100 * UNSURE_BELOW:.0f} %: perhaps")


def _print_pauses(span: ListedSpan, missing: "Spans", zone: tzinfo) -> None:
    """Print a notice of when nobody listened."""
    from hearthlog.analyzer.logs.local_time import local_time

    long = [pair for pair in missing.pairs() if pair[1] - pair[0] >= _MENTIONED]
    days = {_date(time, zone) for start, end in long for time in (start, end - 1)}
    form = "%a %H:%M" if len(days) > 1 else "%H:%M"
    pauses = [" to ".join(f"{local_time(time, zone):{form}}" for time in pair) for pair in long]
    if pauses:
        share = 1 - missing.length / (span.end - span.start)
        more = [f"{len(pauses) - _MOST_PAUSES} more pauses"] * (len(pauses) > _MOST_PAUSES)
        print_notice(
            f"{100 * share:.0f} % of that time was listened to, not: "
            f"{listed([*pauses[:_MOST_PAUSES], *more], 'and')}"
        )


def _right(head: str, cells: Sequence[str]) -> Iterator[str]:
    """Yield the head and the cells of a column of figures, which ends in one line."""
    width = max(map(len, (head, *cells)))
    return (cell.rjust(width) for cell in (head, *cells))


def _play(found: Sequence["HomeEvent"], logs: "HomeLogs", zone: tzinfo) -> None:
    """Play the kept sound of events, one after the other."""
    from hearthlog.analyzer.logs.clips import kept_sound, play_sound
    from hearthlog.analyzer.logs.local_time import local_time
    from hearthlog.models.classes import in_words
    from hearthlog.schemas.logs.files import audio_path
    from hearthlog.schemas.messages.topics import LIVE, labelling_topic

    unkept = 0
    for event in found:
        layers = [audio_path(entry.path) for entry in logs.between(event.start, event.end)]
        layers = [path for path in layers if Path(path).exists()]
        sounds = (
            kept_sound(layers, labelling_topic(name, LIVE, "audio"), event.start, event.end)
            for name in event.microphones
        )
        rate, samples = next((each for each in sounds if len(each[1])), (0, None))
        if samples is None:
            unkept += 1
            continue
        try:
            print_notice(
                f"playing {local_time(event.start, zone):%H:%M:%S} {in_words(event.label)}"
            )
            play_sound(samples, rate, wait=True)
        except LogError as error:
            print_notice(str(error))
            return
    if unkept:
        print_notice(
            f"no sound was kept of {unkept} of these: keep_audio in the configuration keeps some"
        )


def report(
    logs: Logs,
    *,
    day: Day = None,
    week: Annotated[
        str | None, typer.Option(help="Such as 2026-W09, or a day in it: Monday to Sunday.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Page to write, *.html (by default NODE_DAY.html); its "
            "picture is written next to it.",
        ),
    ] = None,
    no_picture: Annotated[
        bool,
        typer.Option("--no-picture", help="Write no PNG; the page contains the picture anyway."),
    ] = False,
    labels: Labels = "live",
    timezone: Timezone = None,
) -> None:
    """Write a page about a day or a week, for a carer, and its picture.

    Exit status 3: a log is damaged or unfinished; the page shows its time as not recorded.
    """
    if day is not None and week is not None:
        wrong_use("--day and --week exclude each other")
    if output is not None and output.suffix != ".html":
        wrong_use(f"--output {output}: a page is named *.html")
    from hearthlog.analyzer.errors import require

    require("jinja2", *[] if no_picture else ["matplotlib"])
    first = None
    if week is not None:
        monday = read_date("--week", week)
        first = monday - timedelta(days=monday.weekday())
    elif day is not None and day not in NEAR:
        first = read_date("--day", day)
    from hearthlog.analyzer.report.report import WEEK, Period, make_report

    draw = None
    if not no_picture:
        from hearthlog.analyzer.report.timeline_plot import save_timelines

        draw = save_timelines
    home_logs, zone = home_and_zone(logs, timezone)
    if first is None:
        first = home_logs.last_complete_day(zone) if day is None else read_day("--day", day, zone)
    count = 1 if week is None else WEEK
    page = output or Path(_name(home_logs, first, count))
    with share_done("reading the labels") as progress:
        period = Period(first, count, zone)
        result = make_report(home_logs, period, page, labels, progress, draw=draw)
    print(result.page)
    if result.picture is not None:
        print(result.picture)
    end_with_warnings(result.losses)


def _name(home_logs: "HomeLogs", first: date, count: int) -> str:
    """Return a page name from the home and the day."""
    node = next((entry.node for entry in home_logs.entries if entry.node), "home")
    when = f"{first}" if count == 1 else f"{first:%G-W%V}"
    return f"{node}_{when}.html"
