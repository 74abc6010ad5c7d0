"""`hearthlog events` and `hearthlog report`: what was heard, and a day or a week for a carer."""

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
            }
        )
    else:
        _print_events(found, perhaps_of(data, found), zone)
        _print_sums(found, span, classes, marked)
        _print_pauses(found, span, missing, zone)
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
    from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour, day_span, local_time
    from hearthlog.analyzer.logs.local_time import today as today_at

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
        return ListedSpan(begin, stop, f"from {words[0]} to {words[1]}")
    if night:
        if day is None:
            moment = today_at(ends, zone)
            before = today_at(moment.night - 1, zone)  # the last complete night, if recorded
            if moment.morning > ends and before.morning > _first(logs):
                moment = before
            begin, stop = moment.night, moment.morning
        else:
            own = read_day("--day", day, zone)
            begin = at_hour(own - timedelta(days=1), EVENING, zone)
            stop = at_hour(own, MORNING, zone)
        morning = _date(stop, zone)
        check_day(logs, morning - timedelta(days=1), morning, zone)
        return ListedSpan(begin, stop, f"in the night to {morning:%A, %Y-%m-%d}")
    own = logs.last_complete_day(zone) if day is None else read_day("--day", day, zone)
    check_day(logs, own, own, zone)
    return ListedSpan(*day_span(own, zone), f"on {own:%A, %Y-%m-%d}")


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


_MINUTE = 60  # seconds
_MENTIONED = 600 * 1_000_000_000  # ns: shortest pause in listening that is listed
_MOST_PAUSES = 5


def _form(found: Sequence["HomeEvent"], zone: tzinfo) -> str:
    """Return how times are written: with the day, if there are several."""
    days = {_date(event.start, zone) for event in found}
    return "%a %H:%M:%S" if len(days) > 1 else "%H:%M:%S"


def _part(time: int, zone: tzinfo) -> str:
    """Return the part of a day, or the night, that a time is in."""
    from hearthlog.analyzer.logs.local_time import EVENING, MORNING, local_time

    moment = local_time(time, zone)
    if MORNING <= moment.hour < EVENING:
        return f"{moment:%a} by day"
    return f"Night to {moment + timedelta(days=moment.hour >= EVENING):%a}"


def _print_events(found: Sequence["HomeEvent"], perhaps: Sequence[str], zone: tzinfo) -> None:
    """Print a line for each event, and one for each part of a day, if there are several."""
    from hearthlog.analyzer.logs.local_time import local_time
    from hearthlog.models.classes import in_words

    several = len({name for event in found for name in event.microphones}) > 1
    form = _form(found, zone)
    clock = " or ".join(
        dict.fromkeys(f"{local_time(event.start, zone):%Z}" for event in (found[0], found[-1]))
        if found
        else ()
    )
    lengths = _right("length", [_length(event.seconds) for event in found])
    shares = _right(
        "sure", [f"{100 * event.confidence:.0f} %{'?' * event.is_unsure}" for event in found]
    )
    head = (
        f"when ({clock})" if clock else "when", "sound", next(lengths), next(shares),
        *(["where"] if several else []), "",
    )  # fmt: skip
    rows: list[Sequence[str]] = []
    parts = [_part(event.start, zone) for event in found]
    has_parts = len(set(parts)) > 1
    for place, (event, might_be) in enumerate(zip(found, perhaps, strict=True)):
        if has_parts and (not place or parts[place] != parts[place - 1]):
            empty = [""] * (len(head) - 1)
            rows += [["", *empty]] * bool(place) + [[parts[place], *empty]]
        notes = [f"perhaps {in_words(might_be).lower()}"] if might_be else []
        notes += ["reviewed"] * event.reviewed + ["beside a television"] * event.television
        rows.append(
            (
                f"{local_time(event.start, zone):{form}}",
                in_words(event.label),
                next(lengths),
                next(shares),
                *([", ".join(event.microphones)] if several else []),
                ", ".join(notes),
            )
        )
    print_table(head, rows, words=len(head))


def _print_sums(
    found: Sequence["HomeEvent"],
    span: ListedSpan,
    classes: Sequence[str],
    marked: Collection[str],
) -> None:
    """Print how many events of each class there were."""
    from hearthlog.models.classes import in_words

    for name in classes:
        own = [event for event in found if event.label == name]
        if not own and len(classes) > 1:
            continue
        apart = sum(event.television for event in own)
        unsure = sum(event.is_unsure and not event.television for event in own)
        sure = len(own) - apart - unsure or "none"
        doubt = f", and perhaps {unsure} more" if unsure else ""
        television = f", and {apart} while something like a television sounded" if apart else ""
        by_hand = ", only what people marked: the model does not know it" * (name in marked)
        print(f"{in_words(name)} {span.words}: {sure}{doubt}{television}{by_hand}")


def _print_pauses(
    found: Sequence["HomeEvent"], span: ListedSpan, missing: "Spans", zone: tzinfo
) -> None:
    """Print a notice of when nobody listened."""
    from hearthlog.analyzer.logs.local_time import local_time

    form = _form(found, zone)
    pauses = [
        f"{local_time(start, zone):{form[:-3]}} to {local_time(end, zone):{form[:-3]}}"
        for start, end in missing.pairs()
        if end - start >= _MENTIONED
    ]
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


def _length(seconds: float) -> str:
    from hearthlog.analyzer.activity.values import Duration

    return f"{seconds:.1f} s" if seconds < _MINUTE else Duration.show(seconds / _MINUTE)


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
