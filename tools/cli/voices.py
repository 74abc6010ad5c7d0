"""`hearthlog voices`: who speaks when in a home, by voices that get a name."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.tools.cli.options import End, Json, LocalLogs, Start, Timezone, parse_span
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.table import print_table
from hearthlog.tools.cli.text import end_with_warnings, number, print_json, tell, wrong_use

if TYPE_CHECKING:
    from datetime import tzinfo

    from hearthlog.analyzer.discover.home_voices import Voices
    from hearthlog.analyzer.discover.read_speech import HomeSpeech
    from hearthlog.analyzer.discover.voice_summary import VoiceSummary
    from hearthlog.schemas.arrays import Int64


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
    from hearthlog.analyzer.discover.groups_file import locked_groups
    from hearthlog.analyzer.discover.home_voices import find_voices
    from hearthlog.analyzer.discover.read_speech import read_speech
    from hearthlog.analyzer.discover.voice_summary import summarise
    from hearthlog.analyzer.discover.voices_file import load_voices, save_voices
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone
    from hearthlog.tools.cli.options import check_output

    if output is not None:
        check_output("--output", output, ".csv", "a table")
    names = _names(name or [])
    if home is not None and not names:
        wrong_use("--home goes with --name")
    span = parse_span(start, end)
    found = find_home_logs(logs)
    zone = home_zone(timezone, found.records())
    path = file or _default_file(logs)
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
        print_json(_as_json(summaries, speech, path, zone))
    else:
        _print(summaries, speech, zone)
        _tell_next(summaries, logs, file)
    end_with_warnings(speech.losses)


def _default_file(logs: Sequence[Path]) -> Path:
    from hearthlog.analyzer.discover.voices_file import VOICES

    if len(logs) > 1 or not logs[0].is_dir():
        wrong_use("--voices: say in which file voices are kept, where LOGS is no single folder")
    return logs[0] / VOICES


def _names(given: Sequence[str]) -> dict[int, str]:
    """Read the options --name."""
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


def _check_numbers(voices: "Voices", numbers: Iterable[int]) -> None:
    from hearthlog.analyzer.errors import DataError

    for each in numbers:
        if each not in voices.numbers:
            raise DataError(f"there is no voice {each}; `hearthlog voices LOGS` lists them")


def _named(voices: "Voices", names: dict[int, str]) -> "Voices":
    pairs = zip(voices.numbers.tolist(), voices.names, strict=True)
    return replace(voices, names=[names.get(number, name) for number, name in pairs])


def _enrol(
    home: Path, speech: "HomeSpeech", voices: "Voices", of: "Int64", names: dict[int, str]
) -> None:
    """Enrol the longest turns of voices."""
    from hearthlog.analyzer.discover.enrol_voice import enrol_voice

    for each, label in names.items():
        row = voices.numbers.tolist().index(each)
        done = enrol_voice(home, label, speech, (of[speech.turns.voice] == row).nonzero()[0])
        seconds = sum(one.seconds for one in done)
        tell(f"voice {each}: {seconds:.0f} s of {label} enrolled in {home}")


def _write_turns(output: Path, speech: "HomeSpeech", voices: "Voices", of: "Int64") -> None:
    """Write who speaks when."""
    import csv

    from hearthlog.analyzer.discover.voice_summary import spoken_spans
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


def _print(summaries: "Sequence[VoiceSummary]", speech: "HomeSpeech", zone: "tzinfo") -> None:
    from hearthlog.analyzer.discover.hours import usual_hours

    head = ("voice", "name", "listen to", "minutes", "turns", "days", "hours")
    rows = [
        (
            str(each.number),
            each.name,
            _place(each, zone),
            f"{each.minutes:.1f}",
            str(each.turns),
            str(each.days),
            usual_hours(each.hours) or "any",
        )
        for each in summaries
    ]
    print_table(head, rows, words=3)
    told = sum(each.minutes for each in summaries)
    voices = number(len(rows), "voice")
    print(f"{speech.seconds / 60:.1f} minutes of speech, of which {told:.1f} by {voices}")
    if speech.without:
        print(f"{number(speech.without, 'log')} without features of voices, or segments")


def _place(summary: "VoiceSummary", zone: "tzinfo") -> str:
    from hearthlog.analyzer.logs.local_time import local_time

    turn = summary.examples[0]
    return f"{local_time(turn.start, zone):%Y-%m-%d %H:%M:%S} {turn.microphone}"


def _tell_next(
    summaries: "Sequence[VoiceSummary]", logs: Sequence[Path], file: Path | None
) -> None:
    unnamed = [each.number for each in summaries if not each.name]
    if unnamed:
        where = " ".join(quote(str(log)) for log in logs)
        where += f" --voices {quote(str(file))}" if file else ""
        tell(f"next: name one: hearthlog voices {where} --name {unnamed[0]}=anna")


def _as_json(
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
