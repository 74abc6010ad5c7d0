"""`hearthlog discover` and `hearthlog voices`: recurring sound groups and voices of a home."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import printable
from hearthlog.tools.cli.options import (
    End,
    Json,
    LocalLogs,
    Start,
    Timezone,
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

    from hearthlog.analyzer.discover.groups import Groups
    from hearthlog.analyzer.discover.home_voices import HomeVoices, VoiceSummary
    from hearthlog.analyzer.discover.naming import Looked
    from hearthlog.analyzer.discover.speech import HomeSpeech
    from hearthlog.analyzer.discover.summary import GroupsSummary, GroupSummary
    from hearthlog.analyzer.logs.home_logs import HomeLogs
    from hearthlog.analyzer.review.timeline import Timeline
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
    least: Annotated[int, typer.Option(help="Sounds of a group, at least.", min=2)] = 8,
    groups: Annotated[
        Path | None,
        typer.Option(
            help="File of the groups, by which they are known again.",
            show_default="groups.safetensors in the folder of logs",
        ),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(help="Name a group, as 3=doorbell, and mark its sounds; may be given again."),
    ] = None,
    undo: Annotated[
        list[int] | None,
        typer.Option(help="Take the name of a group back, and its marks; may be given again."),
    ] = None,
    reviewer: Annotated[str | None, typer.Option(help="Who names.", show_default="you")] = None,
    timezone: Timezone = None,
    as_json: Json = False,
) -> None:
    """Group the sounds that recur, whatever their labels say, and show each group.

    Groups keep their numbers in later runs. Where a person has marked a sound already, it stays so.
    Exit status 3: a log is damaged, unfinished or of other features; the others were used.
    """
    from hearthlog.analyzer.discover.groups import locked_groups
    from hearthlog.analyzer.discover.naming import Looked
    from hearthlog.analyzer.discover.sounds import CHOICES
    from hearthlog.analyzer.extras import require
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone

    if of not in CHOICES:
        wrong_use(f"--of {of}: it is one of {', '.join(CHOICES)}")
    if not (name or undo):
        require("sklearn", "scipy")
    looked = Looked(of, *parse_span(start, end))
    names, who = _names(name or []), reviewer_name(reviewer)
    home = find_home_logs(logs)
    zone = home_zone(timezone, home.records())
    file = groups or _default_file(logs)
    with locked_groups(file):
        if names or undo:
            summary, losses = _name(home, file, undo or [], names, looked, who)
        else:
            summary, losses = _group(home, file, looked, least, zone)
    if as_json:
        print_json(summary.model_dump())
    else:
        _print(summary, zone)
        _tell_next(summary, logs, groups)
    end_with_warnings(losses)


def _default_file(logs: Sequence[Path]) -> Path:
    from hearthlog.analyzer.discover.groups import GROUPS

    if len(logs) > 1 or not logs[0].is_dir():
        wrong_use("--groups: say in which file the groups are kept, where LOGS is no single folder")
    return logs[0] / GROUPS


def _names(given: Sequence[str]) -> dict[int, str]:
    """Parse the options --name."""
    from hearthlog.models.classes import CLASS_NAME, SILENCE
    from hearthlog.schemas.messages.topics import spelt

    names: dict[int, str] = {}
    for text in given:
        group, _, label = text.partition("=")
        label = spelt(label)
        is_number = re.fullmatch(r" *[0-9]{1,9} *", group)
        if not is_number or not CLASS_NAME.fullmatch(label) or label == SILENCE:
            wrong_use(f"--name {text[:64]!r}: say the number of a group and a class, as 3=doorbell")
        if int(group) in names:
            wrong_use(f"--name {text[:64]!r}: group {int(group)} has another name already")
        names[int(group)] = label
    return names


def _group(
    home: "HomeLogs", file: Path, looked: "Looked", least: int, zone: "tzinfo"
) -> tuple["GroupsSummary", list[str]]:
    """Group the sounds, and save the groups and their summary."""
    from hearthlog.analyzer.discover.groups import load_groups, save_groups
    from hearthlog.analyzer.discover.sounds import discover as find_groups
    from hearthlog.analyzer.discover.sounds import read_sounds, unembedded_note
    from hearthlog.analyzer.discover.summary import (
        GroupsSummary,
        save_summary,
        summarise,
        summary_path,
    )

    known = load_groups(file)
    with (
        share_done("reading what was heard") as progress,
        read_sounds(home, *looked, progress, known) as sounds,
    ):
        groups, rows, points = find_groups(sounds, known, least)
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
    looked: "Looked",
    reviewer: str,
) -> tuple["GroupsSummary", list[str]]:
    """Remove and assign names of existing groups, without new grouping."""
    from hearthlog.analyzer.discover.groups import load_groups
    from hearthlog.analyzer.discover.naming import name_groups, reason_of, unmark_group
    from hearthlog.analyzer.discover.summary import load_summary, summary_path

    groups = _known(load_groups(file), [*undo, *names])
    summary = load_summary(summary_path(file))
    for each in undo:
        count = unmark_group([log.path for log in home.between()], reason_of(groups, each))
        print_notice(f"group {each}: {number(count, 'mark')} taken back")
        groups, summary = _renamed(groups, summary, {each: ""}, file)
    losses: list[str] = []
    if names:
        with share_done("reading what was heard") as progress:
            marked, losses = name_groups(home, groups, names, looked, reviewer, progress)
        for each, (made, left) in marked.items():
            more = f"; {left} are marked or looked at by somebody already" if left else ""
            print_notice(f"group {each}: {number(made, 'mark')} of {names[each]}{more}")
        groups, summary = _renamed(groups, summary, names, file)
    return summary, losses


def _known(groups: "Groups | None", numbers: Iterable[int]) -> "Groups":
    """Return the groups; raise if one of the numbers does not exist."""
    from hearthlog.analyzer.errors import DataError

    for each in numbers:
        if groups is None or each not in groups.numbers:
            raise DataError(f"there is no group {each}; `hearthlog discover LOGS` lists them")
    assert groups is not None
    return groups


def _renamed(
    groups: "Groups", summary: "GroupsSummary", names: Mapping[int, str], file: Path
) -> tuple["Groups", "GroupsSummary"]:
    """Rename groups and save them; an empty name removes a name."""
    from hearthlog.analyzer.discover.groups import save_groups
    from hearthlog.analyzer.discover.summary import save_summary, summary_path

    numbers = groups.numbers.tolist()
    kept = [names.get(each, name) for each, name in zip(numbers, groups.names, strict=True)]
    groups, summary = replace(groups, names=kept), summary.named(names)
    save_groups(groups, file)
    save_summary(summary, summary_path(file))
    return groups, summary


def _print(summary: "GroupsSummary", zone: "tzinfo") -> None:
    from hearthlog.analyzer.discover.summary import busiest_hours

    head = ("group", "name", "heard as", "listen to", "times", "days", "hours", "seconds", "alike")
    rows = [
        (
            str(each.number),
            each.name,
            ", ".join(f"{name} {100 * s:.0f} %" for name, s in [*each.labels.items()][:_LABELS]),
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


def _place(group: "GroupSummary", zone: "tzinfo") -> str:
    from hearthlog.analyzer.logs.local_time import local_time
    from hearthlog.schemas.frames import read_time

    example = group.examples[0]
    start = local_time(read_time(example.start), zone)
    return f"{start:%Y-%m-%d %H:%M:%S} {example.microphone}"


def _tell_next(summary: "GroupsSummary", logs: Sequence[Path], file: Path | None) -> None:
    unnamed = [each.number for each in summary.groups if not each.name]
    if unnamed:
        where = " ".join(quote(str(log)) for log in logs)
        where += f" --groups {quote(str(file))}" if file else ""
        print_notice(f"next: name one: hearthlog discover {where} --name {unnamed[0]}=doorbell")


def voices(
    logs: LocalLogs,
    *,
    start: Start = None,
    end: End = None,
    file: Annotated[
        Path | None,
        typer.Option(
            "--voices",
            help="File of the voices, by which they are known again.",
            show_default="voices.safetensors in the folder of logs",
        ),
    ] = None,
    name: Annotated[
        list[str] | None, typer.Option(help="Name a voice, as 2=anna; may be given again.")
    ] = None,
    undo: Annotated[
        list[int] | None, typer.Option(help="Take the name of a voice back; may be given again.")
    ] = None,
    home: Annotated[
        Path | None,
        typer.Option(
            help="Training set of voices, to enrol a minute in of each that is named now."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Table of who speaks when, *.csv.")
    ] = None,
    timezone: Timezone = None,
    as_json: Json = False,
) -> None:
    """Tell voices apart where the labels say speech: how many there are, and who speaks when.

    Voices keep their numbers in later runs. Exit status 3: a log is damaged, or has no features by
    which voices can be told apart; the others were used.
    """
    from hearthlog.analyzer.discover.groups import locked_groups
    from hearthlog.analyzer.discover.home_voices import (
        find_voices,
        load_voices,
        save_voices,
        summarise,
    )
    from hearthlog.analyzer.discover.speech import read_speech
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone
    from hearthlog.tools.cli.options import check_output

    if output is not None:
        check_output("--output", output, ".csv", "a table")
    names = _voice_names(name or [])
    if home is not None and not names:
        wrong_use("--home goes with --name")
    span = parse_span(start, end)
    found = find_home_logs(logs)
    zone = home_zone(timezone, found.records())
    path = file or _voices_file(logs)
    with locked_groups(path):
        known = load_voices(path)
        with share_done("reading what was said") as progress:
            speech = read_speech(found, *span, progress)
        heard, of = find_voices(speech, known)
        _check_numbers(heard, [*(undo or []), *names])
        heard = _named(heard, dict.fromkeys(undo or [], "") | names)
        if home is not None:
            _enrol(home, speech, heard, of, names)
        save_voices(heard, path)
    if output is not None:
        _write_turns(output, speech, heard, of)
    summaries = summarise(speech, heard, of, zone)
    if as_json:
        print_json(_voices_as_json(summaries, speech, path, zone))
    else:
        _print_voices(summaries, speech, zone)
        _suggest_next_of_voices(summaries, logs, file)
    end_with_warnings(speech.losses)


def _voices_file(logs: Sequence[Path]) -> Path:
    from hearthlog.analyzer.discover.home_voices import VOICES

    if len(logs) > 1 or not logs[0].is_dir():
        wrong_use("--voices: say in which file voices are kept, where LOGS is no single folder")
    return logs[0] / VOICES


def _voice_names(given: Sequence[str]) -> dict[int, str]:
    """Parse the options --name."""
    from hearthlog.models.classes import CLASS_NAME, find_class
    from hearthlog.schemas.messages.topics import spelt

    names: dict[int, str] = {}
    for text in given:
        voice, _, label = text.partition("=")
        label = spelt(label)
        is_number = re.fullmatch(r" *[0-9]{1,9} *", voice)
        if not is_number or not CLASS_NAME.fullmatch(label):
            wrong_use(f"--name {text[:64]!r}: say the number of a voice and a name, as 2=anna")
        if find_class(label) is not None:
            wrong_use(f"--name {text[:64]!r}: {label} is a class of sound; give a person's name")
        if int(voice) in names:
            wrong_use(f"--name {text[:64]!r}: voice {int(voice)} has another name already")
        names[int(voice)] = label
    return names


def _check_numbers(voices: "HomeVoices", numbers: Iterable[int]) -> None:
    from hearthlog.analyzer.errors import DataError

    for each in numbers:
        if each not in voices.numbers:
            raise DataError(f"there is no voice {each}; `hearthlog voices LOGS` lists them")


def _named(voices: "HomeVoices", names: dict[int, str]) -> "HomeVoices":
    pairs = zip(voices.numbers.tolist(), voices.names, strict=True)
    return replace(voices, names=[names.get(number, name) for number, name in pairs])


def _enrol(
    home: Path, speech: "HomeSpeech", voices: "HomeVoices", of: "Int64", names: dict[int, str]
) -> None:
    """Enrol the longest turns of voices."""
    from hearthlog.analyzer.discover.home_voices import enrol_voice

    for each, label in names.items():
        row = voices.numbers.tolist().index(each)
        done = enrol_voice(home, label, speech, (of[speech.turns.voice] == row).nonzero()[0])
        seconds = sum(one.seconds for one in done)
        print_notice(f"voice {each}: {seconds:.0f} s of {label} enrolled in {home}")


def _write_turns(output: Path, speech: "HomeSpeech", voices: "HomeVoices", of: "Int64") -> None:
    """Write the table of voice turns."""
    import csv

    from hearthlog.analyzer.discover.home_voices import spoken_spans
    from hearthlog.analyzer.logs.text_files import disarmed
    from hearthlog.schemas.frames import time_text
    from hearthlog.schemas.new_files import new_file

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
    from hearthlog.analyzer.discover.summary import busiest_hours

    head = ("voice", "name", "listen to", "minutes", "turns", "days", "hours")
    rows = [
        (
            str(each.number),
            each.name,
            _voice_place(each, zone),
            f"{each.minutes:.1f}",
            str(each.turns),
            str(each.days),
            busiest_hours(each.hours) or "any",
        )
        for each in summaries
    ]
    print_table(head, rows, words=3)
    told = sum(each.minutes for each in summaries)
    voices = number(len(rows), "voice")
    print(f"{speech.seconds / 60:.1f} minutes of speech, of which {told:.1f} by {voices}")
    if speech.without:
        print(f"{number(speech.without, 'log')} without features of voices, or segments")


def _voice_place(summary: "VoiceSummary", zone: "tzinfo") -> str:
    from hearthlog.analyzer.logs.local_time import local_time

    turn = summary.examples[0]
    return f"{local_time(turn.start, zone):%Y-%m-%d %H:%M:%S} {turn.microphone}"


def _suggest_next_of_voices(
    summaries: "Sequence[VoiceSummary]", logs: Sequence[Path], file: Path | None
) -> None:
    unnamed = [each.number for each in summaries if not each.name]
    if unnamed:
        where = " ".join(quote(str(log)) for log in logs)
        where += f" --voices {quote(str(file))}" if file else ""
        print_notice(f"next: name one: hearthlog voices {where} --name {unnamed[0]}=anna")


def _voices_as_json(
    summaries: "Sequence[VoiceSummary]", speech: "HomeSpeech", file: Path, zone: "tzinfo"
) -> dict[str, Any]:
    from hearthlog.schemas.frames import time_text

    def turn(each: Any) -> dict[str, Any]:
        times = {key: time_text(getattr(each, key)) for key in ("start", "end")}
        return {"log": str(each.log), "microphone": each.microphone, **times}

    return {
        "seconds": speech.seconds,
        "timezone": str(zone),
        "voices_file": str(file),
        "voices": [
            {**asdict(each), "examples": [turn(one) for one in each.examples]} for each in summaries
        ],
    }


def add_groups(timeline: "Timeline", logs: list[Path], file: Path) -> None:
    """Add the sounds of a groups file to a timeline.

    Raise `DataError` if the file does not exist.
    """
    from hearthlog.analyzer.discover.groups import load_groups
    from hearthlog.analyzer.discover.sounds import group_spans
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.review.timeline import LabelledSpans

    groups = load_groups(file)
    if groups is None:
        raise DataError(f"{file}: no such file of groups; `hearthlog discover` makes one")
    span = timeline.grid.start, timeline.grid.end
    with share_done("finding what recurs") as progress:
        spans_by_name, losses = group_spans(find_home_logs(logs), groups, *span, progress)
    for name, spans in spans_by_name.items():
        if name in timeline.microphones:
            timeline.microphones[name].recurring = LabelledSpans(*spans)
    timeline.losses += [text for text in losses if text not in timeline.losses]


def add_voices(timeline: "Timeline", logs: list[Path], file: Path) -> None:
    """Add the turns of a voices file to a timeline.

    Raise `DataError` if the file does not exist.
    """
    from hearthlog.analyzer.discover.home_voices import find_voices, load_voices, spoken_spans
    from hearthlog.analyzer.discover.speech import read_speech
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.review.timeline import LabelledSpans

    known = load_voices(file)
    if known is None:
        raise DataError(f"{file}: no such file of voices; `hearthlog voices` makes one")
    with share_done("telling voices apart") as progress:
        span = timeline.grid.start, timeline.grid.end
        speech = read_speech(find_home_logs(logs), *span, progress)
    voices, of = find_voices(speech, known)
    for name, spans in spoken_spans(speech, voices, of).items():
        if name in timeline.microphones:
            timeline.microphones[name].spoken = LabelledSpans(*spans)
    timeline.losses += [text for text in speech.losses if text not in timeline.losses]
