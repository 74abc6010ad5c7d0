"""`hearthlog discover` and `hearthlog voices`: recurring sound groups and voices of a home."""

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import printable
from hearthlog.schemas.frames import read_time, time_text
from hearthlog.schemas.new_files import new_file
from hearthlog.tools.cli.options import (
    End,
    Json,
    LocalLogs,
    Start,
    Timezone,
    check_output,
    home_and_zone,
    parse_span,
    reviewer_name,
)
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    number,
    print_json,
    print_notice,
    print_table,
    share_done,
    wrong_use,
)

if TYPE_CHECKING:
    from datetime import tzinfo

    from hearthlog.analyzer.discover import (
        ClusterKind,
        Clusters,
        GroupsSummary,
        GroupSummary,
        NamedSpans,
        VoiceSummary,
    )
    from hearthlog.analyzer.discover.groups import Groups
    from hearthlog.analyzer.discover.sounds import SoundSelection
    from hearthlog.analyzer.discover.speech import HomeSpeech
    from hearthlog.analyzer.discover.voices import HomeVoices
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.home_logs import HomeLogs
    from hearthlog.analyzer.review.timeline import LabelledSpans, MicrophoneTimeline, Timeline
    from hearthlog.schemas.arrays import Int64


_LABELS = 2  # shown per group


def discover(
    logs: LocalLogs,
    *,
    of: Annotated[
        str, typer.Option(help="Which sounds: all, unsure (by their labels), or unknown.")
    ] = "all",
    start: Start = None,
    end: End = None,
    least: Annotated[int, typer.Option(help="Minimum number of sounds in a group.", min=2)] = 8,
    groups: Annotated[
        Path | None,
        typer.Option(
            help="File of the groups, which keeps their numbers.",
            show_default="groups.safetensors in the folder of logs",
        ),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(
            help="Name a group, such as 3=doorbell, and mark its sounds; may be repeated."
        ),
    ] = None,
    undo: Annotated[
        list[int] | None,
        typer.Option(help="Remove the name of a group, and its marks; may be repeated."),
    ] = None,
    reviewer: Annotated[
        str | None,
        typer.Option(help="Name recorded as the reviewer of the marks.", show_default="you"),
    ] = None,
    timezone: Timezone = None,
    as_json: Json = False,
) -> None:
    """Group recurring sounds, whatever their labels, and show each group.

    Groups keep their numbers in later runs. Sounds that a person has marked keep their marks.
    Exit status 3: a log is damaged, unfinished or has other features; the others were used.
    """
    from hearthlog.analyzer.discover import locked_file
    from hearthlog.analyzer.discover.groups import GROUPS
    from hearthlog.analyzer.discover.sounds import CHOICES, SoundSelection
    from hearthlog.analyzer.errors import require
    from hearthlog.models.classes import SILENCE

    if of not in CHOICES:
        wrong_use(f"--of {of}: it is one of {', '.join(CHOICES)}")
    if not (name or undo):
        require("sklearn", "scipy")
    selection = SoundSelection(of, *parse_span(start, end))
    names, who = _names(GROUPS, name or [], "a class", {SILENCE}), reviewer_name(reviewer)
    home, zone = home_and_zone(logs, timezone)
    file = groups or _default_file(GROUPS, logs, "the groups")
    with locked_file(file):
        if names or undo:
            summary, losses = _name(home, file, undo or [], names, selection, who)
        else:
            summary, losses = _group(home, file, selection, least, zone)
    if as_json:
        print_json(summary.model_dump())
    else:
        _print(summary, zone)
        _suggest_next(GROUPS, summary.groups, logs, groups)
    end_with_warnings(losses)


def _default_file(kind: "ClusterKind[Any]", logs: Sequence[Path], what: str) -> Path:
    if len(logs) > 1 or not logs[0].is_dir():
        wrong_use(
            f"--{kind.plural}: say in which file {what} are kept, where LOGS is no single folder"
        )
    return logs[0] / kind.file


def _names(
    kind: "ClusterKind[Any]", given: Sequence[str], what: str, excluded: Container[str] = ()
) -> dict[int, str]:
    """Parse the options --name."""
    from hearthlog.models.classes import CLASS_NAME
    from hearthlog.schemas.messages.topics import spelt

    names: dict[int, str] = {}
    for text in given:
        place, _, label = text.partition("=")
        label = spelt(label)
        is_number = re.fullmatch(r" *[0-9]{1,9} *", place)
        if not is_number or not CLASS_NAME.fullmatch(label) or label in excluded:
            wrong_use(
                f"--name {text[:64]!r}: give the number of a {kind.noun} and {what}, "
                f"such as {kind.example}"
            )
        if int(place) in names:
            wrong_use(f"--name {text[:64]!r}: {kind.noun} {int(place)} has another name already")
        names[int(place)] = label
    return names


def _check_numbers(
    kind: "ClusterKind[Any]", clusters: "Clusters | None", numbers: Iterable[int]
) -> None:
    from hearthlog.analyzer.errors import DataError

    for each in numbers:
        if clusters is None or each not in clusters.numbers:
            raise DataError(
                f"there is no {kind.noun} {each}; `hearthlog {kind.verb} LOGS` lists them"
            )


def _group(
    home: "HomeLogs", file: Path, selection: "SoundSelection", least: int, zone: "tzinfo"
) -> tuple["GroupsSummary", list[str]]:
    """Group the sounds, and save the groups and their summary."""
    from hearthlog.analyzer.discover import (
        GroupsSummary,
        save_summary,
        summarise,
        summary_path,
    )
    from hearthlog.analyzer.discover.groups import load_groups, save_groups
    from hearthlog.analyzer.discover.sounds import discover as find_groups
    from hearthlog.analyzer.discover.sounds import read_sounds, unembedded_note

    earlier = load_groups(file)
    with (
        share_done("reading the labels") as progress,
        read_sounds(home, *selection, progress, earlier) as sounds,
    ):
        groups, rows, points = find_groups(sounds, earlier, least)
        summary = GroupsSummary(
            id=groups.id,
            sounds=len(rows),
            timezone=str(zone),
            groups_file=printable(file),
            groups=summarise(sounds, groups, rows, points, zone),
        )
    save_groups(groups, file)
    save_summary(summary, summary_path(file))
    if note := unembedded_note(sounds, groups):
        print_notice(note)
    if sounds.without:
        print_notice(f"{number(sounds.without, 'log')} without features and labels")
    return summary, sounds.losses


def _name(
    home: "HomeLogs",
    file: Path,
    undo: Sequence[int],
    names: Mapping[int, str],
    selection: "SoundSelection",
    reviewer: str,
) -> tuple["GroupsSummary", list[str]]:
    """Remove and assign names of existing groups, without new grouping."""
    from hearthlog.analyzer.discover import load_summary, summary_path
    from hearthlog.analyzer.discover.groups import GROUPS, load_groups
    from hearthlog.analyzer.discover.sounds import name_groups, reason_of, unmark_group

    groups = load_groups(file)
    _check_numbers(GROUPS, groups, [*undo, *names])
    assert groups is not None
    summary = load_summary(summary_path(file))
    for each in undo:
        count = unmark_group([log.path for log in home.between()], reason_of(groups, each))
        print_notice(f"group {each}: {number(count, 'mark')} taken back")
        groups, summary = _renamed(groups, summary, {each: ""}, file)
    losses: list[str] = []
    if names:
        with share_done("reading the labels") as progress:
            marked, losses = name_groups(home, groups, names, selection, reviewer, progress)
        for each, (made, left) in marked.items():
            more = f"; {left} are marked or looked at by a reviewer already" if left else ""
            print_notice(f"group {each}: {number(made, 'mark')} of {names[each]}{more}")
        groups, summary = _renamed(groups, summary, names, file)
    return summary, losses


def _renamed(
    groups: "Groups", summary: "GroupsSummary", names: Mapping[int, str], file: Path
) -> tuple["Groups", "GroupsSummary"]:
    """Rename groups and save them; an empty name removes a name."""
    from hearthlog.analyzer.discover import save_summary, summary_path
    from hearthlog.analyzer.discover.groups import save_groups

    groups, summary = groups.named(names), summary.named(names)
    save_groups(groups, file)
    save_summary(summary, summary_path(file))
    return groups, summary


def _print(summary: "GroupsSummary", zone: "tzinfo") -> None:
    from hearthlog.analyzer.discover import busiest_hours
    from hearthlog.models.classes import in_words

    head = ("group", "name", "heard as", "listen to", "times", "days", "hours", "seconds", "alike")
    rows = [
        (
            str(each.number),
            each.name,
            ", ".join(
                f"{in_words(name)} {100 * s:.0f} %" for name, s in [*each.labels.items()][:_LABELS]
            ),
            _place(each, zone),
            str(each.times),
            str(each.days),
            busiest_hours(each.hours) or "any",
            f"{each.seconds:.1f}",
            f"{each.alike:.2f}",
        )
        for each in summary.groups
    ]
    print_table(head, rows, words=4)
    grouped = sum(each.times for each in summary.groups)
    total = number(summary.sounds, "sound")
    print(f"{total}, of which {grouped} recur in {number(len(rows), 'group')}")


def _place(summary: "GroupSummary | VoiceSummary", zone: "tzinfo") -> str:
    from hearthlog.analyzer.logs.local_time import local_time

    example = summary.examples[0]
    start = local_time(read_time(example.start), zone)
    return f"{start:%Y-%m-%d %H:%M:%S} {example.microphone}"


def _suggest_next(
    kind: "ClusterKind[Any]",
    summaries: "Sequence[GroupSummary] | Sequence[VoiceSummary]",
    logs: Sequence[Path],
    file: Path | None,
) -> None:
    unnamed = [each.number for each in summaries if not each.name]
    if unnamed:
        where = " ".join(quote(str(log)) for log in logs)
        where += f" --{kind.plural} {quote(str(file))}" if file else ""
        name = f"{unnamed[0]}={kind.example.partition('=')[2]}"
        print_notice(f"next: name one: hearthlog {kind.verb} {where} --name {name}")


def voices(
    logs: LocalLogs,
    *,
    start: Start = None,
    end: End = None,
    file: Annotated[
        Path | None,
        typer.Option(
            "--voices",
            help="File of the voices, which keeps their numbers.",
            show_default="voices.safetensors in the folder of logs",
        ),
    ] = None,
    name: Annotated[
        list[str] | None, typer.Option(help="Name a voice, such as 2=anna; may be repeated.")
    ] = None,
    undo: Annotated[
        list[int] | None, typer.Option(help="Remove the name of a voice; may be repeated.")
    ] = None,
    home: Annotated[
        Path | None,
        typer.Option(
            help="Training set of voices, in which to enrol a minute of each voice that is "
            "named now."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Table of who speaks when, *.csv.")
    ] = None,
    timezone: Timezone = None,
    as_json: Json = False,
) -> None:
    """Separate the voices in labelled speech: how many there are, and who speaks when.

    Voices keep their numbers in later runs. Exit status 3: a log is damaged, or its features
    cannot separate voices; the others were used.
    """
    from hearthlog.analyzer.discover import locked_file, summarise_voices
    from hearthlog.analyzer.discover.speech import find_voices, read_speech
    from hearthlog.analyzer.discover.voices import VOICES, load_voices, save_voices

    check_output("--output", output, ".csv", "a table")
    names = _voice_names(name or [])
    if home is not None and not names:
        wrong_use("--home goes with --name")
    span = parse_span(start, end)
    found, zone = home_and_zone(logs, timezone)
    path = file or _default_file(VOICES, logs, "voices")
    with locked_file(path):
        earlier = load_voices(path)
        with share_done("reading the speech") as progress:
            speech = read_speech(found, *span, progress)
        separated, of = find_voices(speech, earlier)
        _check_numbers(VOICES, separated, [*(undo or []), *names])
        separated = separated.named(dict.fromkeys(undo or [], "") | names)
        if home is not None:
            _enrol(home, speech, separated, of, names)
        save_voices(separated, path)
    if output is not None:
        _write_turns(output, speech, separated, of)
    summaries = summarise_voices(speech, separated, of, zone)
    if as_json:
        result = {"seconds": speech.seconds, "timezone": str(zone), "voices_file": str(path)}
        print_json({**result, "voices": [each.model_dump() for each in summaries]})
    else:
        _print_voices(summaries, speech, zone)
        _suggest_next(VOICES, summaries, logs, file)
    end_with_warnings(speech.losses)


def _voice_names(given: Sequence[str]) -> dict[int, str]:
    from hearthlog.analyzer.discover.voices import VOICES
    from hearthlog.models.classes import find_class

    names = _names(VOICES, given, "a name")
    for text, label in zip(given, names.values(), strict=True):
        if find_class(label) is not None:
            wrong_use(f"--name {text[:64]!r}: {label} is a class of sound; give a person's name")
    return names


def _enrol(
    home: Path, speech: "HomeSpeech", voices: "HomeVoices", of: "Int64", names: dict[int, str]
) -> None:
    """Enrol the longest turns of voices."""
    from hearthlog.analyzer.discover.speech import enrol_voice

    for each, label in names.items():
        row = voices.numbers.tolist().index(each)
        done = enrol_voice(home, label, speech, (of[speech.voice] == row).nonzero()[0])
        seconds = sum(one.seconds for one in done)
        print_notice(f"voice {each}: {seconds:.0f} s of {label} enrolled in {home}")


def _write_turns(output: Path, speech: "HomeSpeech", voices: "HomeVoices", of: "Int64") -> None:
    """Write the table of voice turns."""
    import csv

    from hearthlog.analyzer.discover.speech import spoken_spans
    from hearthlog.analyzer.logs.text_files import disarmed

    with (
        new_file(output) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as stream,
    ):
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(("start", "end", "microphone", "voice"))
        for microphone, spans in spoken_spans(speech, voices, of).items():
            columns = spans.starts.tolist(), spans.ends.tolist(), spans.texts.tolist()
            for start, end, text in zip(*columns, strict=True):
                table.writerow((time_text(start), time_text(end), microphone, disarmed(text)))


def _print_voices(
    summaries: "Sequence[VoiceSummary]", speech: "HomeSpeech", zone: "tzinfo"
) -> None:
    from hearthlog.analyzer.discover import busiest_hours

    head = ("voice", "name", "listen to", "minutes", "turns", "days", "hours")
    rows = [
        (
            str(each.number),
            each.name,
            _place(each, zone),
            f"{each.minutes:.1f}",
            str(each.turns),
            str(each.days),
            busiest_hours(each.hours) or "any",
        )
        for each in summaries
    ]
    print_table(head, rows, words=3)
    minutes = sum(each.minutes for each in summaries)
    voices = number(len(rows), "voice")
    print(f"{speech.seconds / 60:.1f} minutes of speech, of which {minutes:.1f} by {voices}")
    if speech.without:
        print(f"{number(speech.without, 'log')} without features of voices, or segments")


def add_groups(timeline: "Timeline", logs: list[Path], file: Path) -> None:
    """Add the sounds of a groups file to a timeline.

    Raise `DataError` if the file does not exist.
    """
    from hearthlog.analyzer.discover.groups import GROUPS, load_groups
    from hearthlog.analyzer.discover.sounds import group_spans
    from hearthlog.analyzer.logs.home_logs import find_home_logs

    groups = load_groups(file)
    if groups is None:
        raise _missing(GROUPS, file)
    span = timeline.grid.start, timeline.grid.end
    with share_done("finding what recurs") as progress:
        spans, losses = group_spans(find_home_logs(logs), groups, *span, progress)
    for microphone, labelled in _lanes(timeline, spans, losses):
        microphone.recurring = labelled


def add_voices(timeline: "Timeline", logs: list[Path], file: Path) -> None:
    """Add the turns of a voices file to a timeline.

    Raise `DataError` if the file does not exist.
    """
    from hearthlog.analyzer.discover.speech import find_voices, read_speech, spoken_spans
    from hearthlog.analyzer.discover.voices import VOICES, load_voices
    from hearthlog.analyzer.logs.home_logs import find_home_logs

    earlier = load_voices(file)
    if earlier is None:
        raise _missing(VOICES, file)
    with share_done("telling voices apart") as progress:
        span = timeline.grid.start, timeline.grid.end
        speech = read_speech(find_home_logs(logs), *span, progress)
    spans = spoken_spans(speech, *find_voices(speech, earlier))
    for microphone, labelled in _lanes(timeline, spans, speech.losses):
        microphone.spoken = labelled


def _missing(kind: "ClusterKind[Any]", file: Path) -> "DataError":
    from hearthlog.analyzer.errors import DataError

    return DataError(f"{file}: no such file of {kind.plural}; `hearthlog {kind.verb}` makes one")


def _lanes(
    timeline: "Timeline", spans: "Mapping[str, NamedSpans]", losses: Iterable[str]
) -> "list[tuple[MicrophoneTimeline, LabelledSpans]]":
    """Return the spans of each microphone of a timeline, which gets the losses."""
    from hearthlog.analyzer.review.timeline import LabelledSpans

    timeline.losses += [text for text in losses if text not in timeline.losses]
    lanes = timeline.microphones
    return [(lanes[name], LabelledSpans(*each)) for name, each in spans.items() if name in lanes]
