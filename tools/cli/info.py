"""`hearthlog info` and `hearthlog catalog`: contents of logs, and of a folder of homes."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, tzinfo
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import HearthlogError, LogError, Progress, printable
from hearthlog.schemas.new_files import check_new
from hearthlog.tools.cli.options import IN_LOGS, Json, Log, Scheduler, log_location
from hearthlog.tools.cli.terminal import (
    first_of,
    long_bar,
    moment,
    number,
    print_lines,
    print_notice,
    print_table,
    share_done,
    wrong_use,
)

if TYPE_CHECKING:
    from collections import Counter

    from hearthlog.analyzer.activity.home_events import DaySounds
    from hearthlog.analyzer.logs.catalog import Catalog, HomeTotals, LabelAmount
    from hearthlog.analyzer.logs.home_logs import HomeLogs
    from hearthlog.analyzer.logs.summary import LogSummary
    from hearthlog.schemas.logs.contents import LoggedGap, Status
    from hearthlog.schemas.logs.metadata import RecordedScenario
    from hearthlog.tools.cli.info_summary import Accuracy, Overview


_LEVELS = ("ok", "warning", "error", "stale")  # levels of diagnostic_msgs/DiagnosticStatus


def info(
    path: Log,
    *,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Also show the files, their topics, rates and metadata."),
    ] = False,
    catalog: Annotated[bool, typer.Option("--catalog", hidden=True)] = False,
    as_json: Json = False,
) -> None:
    """Show what was heard, for how long, and whether all is well.

    Exit status 3: a file is unfinished or damaged, or sound is missing.
    """
    if catalog:
        wrong_use("use `hearthlog catalog FOLDER`")
    from hearthlog.analyzer.logs.summary import summarise
    from hearthlog.models.registry import is_starter
    from hearthlog.schemas.logs.files import find_logs
    from hearthlog.tools.cli.info_summary import Overview, next_step

    with share_done("reading logs") as progress:
        summary = summarise(_each(find_logs(path), progress))
    print_notice(*summary.damaged.values())
    if not summary.files:
        raise typer.Exit(1)
    for stream in summary.streams:
        stream["starter"] = is_starter(stream["model"], stream["model_sha256"])
    logs = _home_logs(path)
    following, accuracy = next_step(summary, path), _accuracy(summary, logs)
    scenarios = _scenarios(summary, logs)
    zone, hidden = _zone_and_hidden(logs)
    sounds = _last_day(summary, logs, zone)
    if as_json:
        more = {
            "scenarios": [one._asdict() for one in scenarios],
            "checked": None if accuracy is None else accuracy.as_json(),
            "next": following,
            "day": None if sounds is None else sounds.as_json(),
        }
        print(json.dumps(_as_json(summary) | more, indent=2))
    else:
        start = min((entry.start for entry in logs.between()), default=None)
        overview = Overview(summary, zone, hidden, start)
        print_lines(overview.lines())
        _print_sounds(overview, sounds, verbose=verbose)
        print_lines(_stream_lines(summary))
        print_lines(_model_lines(summary, path, logs, scenarios))
        print_lines(_checked_lines(accuracy, following))
        print_lines(first_of("gap", [_gap_text(gap, overview) for gap in summary.gaps]))
        print_lines([] if following is None else [f"Next: {following}"])
        if verbose or not summary.streams:
            _print_files(summary)
        else:
            print("More, also of all the time and of the files: --verbose")
    if summary.unfinished or summary.damaged or summary.gaps:
        raise typer.Exit(3)


def _model_lines(
    summary: "LogSummary",
    path: Path,
    logs: "HomeLogs",
    scenarios: "Sequence[RecordedScenario]",
) -> Iterator[str]:
    """Yield the names of the models that label in addition to the recorder's."""
    from hearthlog.schemas.messages.topics import CANDIDATE

    has_candidate = any(name.endswith(f"/{CANDIDATE}/label") for name in summary.topics)
    later: set[str] = set()  # recorders without a candidate since
    for record in logs.records() if has_candidate else ():
        node = record.get("node", "")
        if name := record.get("candidate"):
            sha256, was = record.get("candidate_sha256", "")[:12], "was " * (node in later)
            compare = f"hearthlog models compare --live --logs {quote(str(path))}"
            yield f"candidate: {name} ({sha256}), {was}on trial: `{compare}`"
            break
        later.add(node)
    for one in scenarios:
        yield f"scenario {one.name}, {one.microphone}: model {one.model} ({one.sha256[:12]})"


def _scenarios(summary: "LogSummary", logs: "HomeLogs") -> "list[RecordedScenario]":
    """Return the scenarios with labels, each with its last model."""
    from hearthlog.schemas.logs.metadata import recorded_scenarios
    from hearthlog.schemas.messages.topics import SCENARIO

    if not any(f"/{SCENARIO}/" in name for name in summary.topics):
        return []
    last: dict[tuple[str, str, str], RecordedScenario] = {}
    for record in logs.records():
        for one in recorded_scenarios(record):
            last.setdefault((record.get("node", ""), one.microphone, one.name), one)
    return [last[key] for key in sorted(last)]


def _last_day(summary: "LogSummary", logs: "HomeLogs", zone: tzinfo) -> "DaySounds | None":
    """Return the sounds of the last complete day; None without any."""
    from hearthlog.analyzer.activity.home_events import read_day_sounds
    from hearthlog.analyzer.errors import DataError

    if not summary.segments:
        return None
    try:
        sounds = read_day_sounds(logs, logs.last_complete_day(zone), zone)
    except (DataError, LogError):  # of no home, or without labels
        return None
    return sounds if sounds.totals else None


def _accuracy(summary: "LogSummary", logs: "HomeLogs") -> "Accuracy | None":
    """Read the accuracy of a recorder's labels; None without labels."""
    from hearthlog.tools.cli.info_summary import Accuracy

    if not (logs.entries and any(stream["model"] for stream in summary.streams)):
        return None
    try:
        accuracy = Accuracy(logs)
    except LogError as error:
        print_notice(str(error))
        return None
    print_notice(*accuracy.losses)
    return accuracy


def _each(paths: Sequence[Path], progress: Progress) -> Iterator[Path]:
    for count, path in enumerate(paths, 1):
        yield path
        progress(count / len(paths))


def _as_json(summary: "LogSummary") -> dict[str, Any]:
    first, last = summary.span or (None, None)
    return {
        "files": list(map(str, summary.files)),
        "unfinished": list(map(str, summary.unfinished)),
        "layers": list(map(str, summary.layers)),
        "damaged": {str(path): error for path, error in summary.damaged.items()},
        "size_bytes": summary.size,
        "chunks": summary.chunks,
        "compression_ratio": summary.compression_ratio,
        "profiles": sorted(summary.profiles),
        "libraries": sorted(summary.libraries),
        "start": moment(first),
        "end": moment(last),
        "seconds": summary.seconds,
        "streams": summary.streams,
        "topics": {
            name: {
                "type": topic.type,
                "encoding": topic.encoding,
                "messages": topic.messages,
                "rate_hz": topic.rate,
                "bytes": topic.bytes,
            }
            for name, topic in summary.topics.items()
        },
        "labels": {
            microphone: _in_minutes(labels) for microphone, labels in summary.label_seconds.items()
        },
        "segments": {
            microphone: dict(labels.most_common())
            for microphone, labels in summary.segments.items()
        },
        "segment_minutes": {
            microphone: _in_minutes(labels)
            for microphone, labels in summary.segment_seconds.items()
        },
        "unsure": {
            microphone: {"minutes": amounts["seconds"] / 60, "segments": int(amounts["segments"])}
            for microphone, amounts in summary.unsure.items()
        },
        "gaps": [gap._asdict() | {"start": moment(gap.start)} for gap in summary.gaps],
        "gap_seconds": summary.gap_seconds,
        "health": _health(summary.health),
        "latest_health": _health(summary.latest_health),
        "attachments": sorted(summary.attachments),
        "metadata": sorted(summary.metadata),
        "schema_versions": sorted(summary.schema_versions),
    }


def _in_minutes(seconds: "Counter[str]") -> dict[str, float]:
    return {label: value / 60 for label, value in seconds.most_common()}


def _health(health: "Status | None") -> dict[str, str] | None:
    if health is None:
        return None
    return {
        "level": _LEVELS[min(health.level, len(_LEVELS) - 1)],
        "name": health.name,
        "message": health.message,
        "time": str(moment(health.time)),
    }


def _home_logs(path: Path) -> "HomeLogs":
    """Find the logs of a home; none if the file belongs to no home."""
    from hearthlog.analyzer.logs.home_logs import HomeLogs, find_home_logs

    try:
        return find_home_logs([path])
    except LogError:
        return HomeLogs([], [])


def _zone_and_hidden(logs: "HomeLogs") -> "tuple[tzinfo, frozenset[str]]":
    """Return the time zone of the home, and the classes that no output shows."""
    from hearthlog.analyzer.logs.local_time import home_zone

    if not logs.entries:
        return UTC, frozenset()
    try:
        hidden = logs.hidden_classes()
    except LogError as error:
        print_notice(str(error))
        return UTC, frozenset()
    try:
        return home_zone(None, logs.records()), hidden
    except HearthlogError as error:
        print_notice(str(error))
        return UTC, hidden


_BAR_WIDTH = 24


def _checked_lines(accuracy: "Accuracy | None", following: str | None) -> Iterator[str]:
    """Yield how many labels are right; nothing if nobody knows, and the next step is to see."""
    from hearthlog.tools.cli.info_summary import TO_REVIEW

    if accuracy is not None and (accuracy.is_known or TO_REVIEW not in (following or "")):
        yield from accuracy.lines()


def _print_sounds(overview: "Overview", sounds: "DaySounds | None", *, verbose: bool) -> None:
    """Print the table of a day, and bars of all time: of scenarios, and of what is in no table."""
    from hearthlog.tools.cli.tables import AS_LABELLED, day_title, print_sounds, sound_rows

    if sounds is not None:
        print(f"\n{day_title(sounds.day)}, {AS_LABELLED}")
        print_sounds(sound_rows(sounds), bars=True)
    bars = list(overview.bars(microphones=verbose or sounds is None))
    for microphone, amounts in bars:
        width = max((len(one.time) for one in amounts), default=0)
        name = max((len(one.words) for one in amounts), default=0)
        what = "time labelled as each sound, sure or not, also by a television"
        print()
        print(printable(f"Microphone {microphone}: {what}"))
        for one in amounts:
            bar = long_bar(one.share, _BAR_WIDTH)
            print(printable(f"  {one.words:{name}}  {bar:{_BAR_WIDTH}}  {one.time:>{width}}"))
    print_lines(overview.doubts() if verbose else ())
    if bars or sounds is not None:
        print()


def _print_files(summary: "LogSummary") -> None:
    print()
    print_lines(_lines(summary))
    topics = [
        (
            name,
            topic.type if topic.encoding == "cdr" else f"{topic.type} ({topic.encoding})",
            str(topic.messages),
            f"{topic.rate:.3g}",
            "-" if topic.bytes is None else f"{topic.bytes / 1e6:.2f}",
        )
        for name, topic in sorted(summary.topics.items())
    ]
    print_table(("topic", "type", "messages", "per second", "MB raw"), topics, words=2)
    print_table(("labelling", "label", "segments"), _layer_rows(summary), words=2)


def _lines(summary: "LogSummary") -> Iterator[str]:
    """Describe the files by contents and metadata."""
    chunks = f", {number(summary.chunks, 'chunk')}" if summary.chunks else ""
    ratio = summary.compression_ratio
    packed = f", compressed {ratio:.2f} to 1" if ratio else ""
    yield f"{number(len(summary.files), 'file')}, {summary.size / 1e6:.1f} MB{chunks}{packed}"
    if summary.span is None:
        yield "no messages"
    else:
        start, end = map(moment, summary.span)
        yield f"{start} to {end} in UTC ({_duration(summary.seconds)})"
    origins = {
        "written by": summary.libraries,
        "profile": summary.profiles,
        "metadata": summary.metadata,
        "schema version": summary.schema_versions,
        "attachments": summary.attachments,
    }
    yield "; ".join(
        f"{what} {', '.join(sorted(names))}" for what, names in origins.items() if names
    )
    yield from first_of("unfinished", [str(path) for path in summary.unfinished])
    yield from first_of("layer", [str(path) for path in summary.layers])
    latest, worst = _health(summary.latest_health), _health(summary.health)
    for what, one in (("health", latest), ("health, worst status", worst)):
        if one is not None and not (one is worst and worst == latest):
            yield f"{what}: {one['level']}, {one['time']} {one['name']}: {one['message']}"


def _stream_lines(summary: "LogSummary") -> Iterator[str]:
    """Yield device, feature set and model of each microphone."""
    for stream in summary.streams:
        model = f"{stream['model']} ({stream['model_sha256'][:12]})" if stream["model"] else "none"
        device = stream["device"] or "no microphone"
        yield (
            f"Microphone {stream['microphone']}: {device}, features {stream['feature_set']}, model "
            f"{model}{', a starter model, not trained on this home' * stream['starter']}"
        )


def _gap_text(gap: "LoggedGap", overview: "Overview") -> str:
    lost = f"{gap.seconds:.3f} s, {number(gap.frames_lost, 'frame')}"
    return f"{gap.microphone} {overview.local(gap.start)} {lost}: {gap.reason}"


def _layer_rows(summary: "LogSummary") -> Iterator[tuple[str, ...]]:
    """Yield the segments of layers, scenarios and reviews."""
    from hearthlog.models.classes import in_words, ordered

    for labelling, segments in summary.segments.items():
        if "/" in labelling:
            for label in ordered(segments):
                yield labelling, in_words(label), str(segments[label])


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"


_HOMES_SHOWN = 40  # one page
_MINUTE, _MINUTE_AND_OFFSET = "%Y-%m-%d %H:%M", "%Y-%m-%d %H:%M%z"
_ZONES = 2  # in the head of a table
_COUNTS = "logs", "layers", "unfinished", "damaged"
_FIGURES = "MB", "hours", "gaps", "gap minutes"
_IF_ANY = frozenset({"layers", "unfinished", "damaged", "gaps", "gap minutes"})


def catalog(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder that holds the logs or homes, or a URL such as s3://bucket/homes.",
            parser=log_location,
            **IN_LOGS,
        ),
    ],
    *,
    workers: Annotated[
        int,
        typer.Option(
            min=1, max=256, help="Number of processes; useful with thousands of new files."
        ),
    ] = 1,
    scheduler: Scheduler = None,
    export: Annotated[
        Path | None,
        typer.Option(dir_okay=False, metavar="FILE", help="Also write the rows to a Parquet file."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write FOLDER/catalog.sqlite, with a row for each file, and summarise the homes in the folder.

    Files that have not changed since the last catalogue are not read again. Exit status 3: a
    file is unfinished or damaged.
    """
    from hearthlog.analyzer.errors import require
    from hearthlog.analyzer.logs.catalog import (
        DAMAGED,
        UNFINISHED,
        export_parquet,
        homes,
        label_amounts,
    )
    from hearthlog.schemas.logs.files import check_allowed

    check_allowed(folder)
    if folder.is_file():
        wrong_use(f"{folder} is a file; give the folder that holds the logs or homes")
    if export is not None:
        require("pyarrow")
        check_new(export)
    files = _write(folder, workers, scheduler)
    if export is not None:
        export_parquet(files, export)
    amounts = label_amounts(files)
    damaged = files.of_state(DAMAGED)
    print_notice(*(f"{folder / row.path}: {row.error}" for row in damaged))
    unfinished = [row.path for row in files.of_state(UNFINISHED)]
    if as_json:
        result = {
            "files": len(files),
            "unfinished": unfinished,
            "damaged": {row.path: row.error for row in damaged},
            "homes": [
                asdict(home)
                | {"start": moment(home.start), "end": moment(home.end), "hours": home.hours}
                for home in homes(files)
            ],
            "labels": [asdict(label) for label in amounts if not label.scenario],
            "scenarios": [asdict(label) for label in amounts if label.scenario],
        }
        print(json.dumps(result, indent=2))
    else:
        _print_homes(folder, homes(files), amounts, unfinished)
    if damaged or unfinished:
        raise typer.Exit(3)


def _write(folder: Path, workers: int, scheduler: str | None) -> "Catalog":
    from hearthlog.analyzer.logs.catalog import read_catalog
    from hearthlog.analyzer.logs.catalog_writer import write_catalog
    from hearthlog.analyzer.workers import open_workers

    previous = read_catalog(folder)
    unusable = () if previous is None else previous.unusable
    print_notice(*(f"{line}; it is rebuilt" for line in unusable))
    try:
        with open_workers(workers, scheduler) as pool, share_done("reading logs") as progress:
            return write_catalog(folder, previous, progress, pool)
    except KeyboardInterrupt:
        print_notice(
            "interrupted; the catalogue has what was read so far, and the same command continues"
        )
        raise


def _print_homes(
    folder: Path,
    homes: Sequence["HomeTotals"],
    labels: Sequence["LabelAmount"],
    unfinished: Sequence[str],
) -> None:
    from hearthlog.tools.cli.info_summary import zone_name

    zones = {home.home: _zone_of(folder / home.home) for home in homes[:_HOMES_SHOWN]}
    names = sorted(map(zone_name, {*zones.values()}))
    shown = ", ".join(names[:_ZONES]) + " …" * (len(names) > _ZONES)
    rows = list(_home_rows(homes, zones))
    heads = "home", *_COUNTS, *_FIGURES, f"from ({shown})", "to"
    columns = [
        column
        for column in zip(heads, *rows, strict=True)
        if column[0] not in _IF_ANY or any(map(float, column[1:]))
    ]
    head, *cells = zip(*columns, strict=True)
    print_table(head, cells)
    if len(homes) > _HOMES_SHOWN:
        print(f"and {len(homes) - _HOMES_SHOWN} more homes (--json lists all)")
    if homes and not {"unfinished", "damaged", "gaps"} & {*head}:
        print("no file is unfinished or damaged, and no log has a gap")
    print()
    print_table(("labels", "model", "sound", "minutes", "events"), _label_sums(labels), words=3)
    print_lines(first_of("unfinished", unfinished))


def _zone_of(folder: Path) -> tzinfo:
    """Return the time zone that the latest log of a home has; UTC if that cannot be read."""
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone

    try:
        return home_zone(None, islice(find_home_logs([folder]).records(), 1))
    except HearthlogError:
        return UTC


def _home_rows(
    homes: Sequence["HomeTotals"], zones: Mapping[str, tzinfo]
) -> Iterator[Sequence[str]]:
    is_one = len({*map(str, zones.values())}) == 1
    for home in homes[:_HOMES_SHOWN]:
        form = _MINUTE if is_one else _MINUTE_AND_OFFSET
        yield _home_row(home.home or "this folder", [home], zones[home.home], form)
    if len(homes) > 1:
        zone, form = (next(iter(zones.values())), _MINUTE) if is_one else (UTC, _MINUTE_AND_OFFSET)
        yield _home_row(number(len(homes), "home"), homes, zone, form)


def _home_row(name: str, homes: Sequence["HomeTotals"], zone: tzinfo, form: str) -> Sequence[str]:
    from hearthlog.analyzer.logs.local_time import local_time

    starts = [home.start for home in homes if home.start is not None]
    ends = [home.end for home in homes if home.end is not None]
    return [
        name,
        *(str(sum(getattr(home, what) for home in homes)) for what in _COUNTS),
        f"{sum(home.size for home in homes) / 1e6:.1f}",
        f"{sum(home.hours for home in homes):.2f}",
        str(sum(home.gaps for home in homes)),
        f"{sum(home.gap_seconds for home in homes) / 60:.2f}",
        f"{local_time(min(starts), zone):{form}}" if starts else "",
        f"{local_time(max(ends), zone):{form}}" if ends else "",
    ]


def _label_sums(labels: Sequence["LabelAmount"]) -> Iterator[Sequence[str]]:
    """Add up the labels of all homes by kind and model."""
    from hearthlog.models.classes import in_words

    sums: dict[tuple[str, str, str], tuple[float, int]] = {}
    for one in labels:
        kind = f"{one.kind}, scenario {one.scenario}" if one.scenario else one.kind
        key = kind, one.model or "", one.label
        minutes, events = sums.get(key, (0.0, 0))
        sums[key] = minutes + one.minutes, events + one.events
    for key, (minutes, events) in sorted(sums.items(), key=lambda item: (item[0][:2], -item[1][0])):
        yield [*key[:2], in_words(key[2]), f"{minutes:.1f}", str(events)]
