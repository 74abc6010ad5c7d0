"""`hearthlog discover`: the sounds that recur in a home, and what they are called."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.tools.cli.options import End, Json, Start, Timezone, parse_span, reviewer_name
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.table import print_table
from hearthlog.tools.cli.text import end_with_warnings, number, print_json, tell, wrong_use

if TYPE_CHECKING:
    from datetime import tzinfo

    from hearthlog.analyzer.discover.groups import Groups
    from hearthlog.analyzer.discover.read_sounds import HomeSounds
    from hearthlog.analyzer.discover.summary import GroupSummary
    from hearthlog.schemas.arrays import Int64

_LABELS = 2  # that are shown of a group


def discover(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders of logs.")],
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
    from hearthlog.analyzer.discover.discover import discover as find_groups
    from hearthlog.analyzer.discover.groups_file import load_groups, locked_groups, save_groups
    from hearthlog.analyzer.discover.read_sounds import read_sounds
    from hearthlog.analyzer.discover.sound_spans import CHOICES
    from hearthlog.analyzer.discover.summary import summarise
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone

    if of not in CHOICES:
        wrong_use(f"--of {of}: it is one of {', '.join(CHOICES)}")
    first, last = parse_span(start, end)
    names, who = _names(name or []), reviewer_name(reviewer)
    home = find_home_logs(logs)
    every = [entry.path for entry in home.between(0, 1 << 62)]
    zone = home_zone(timezone, home.records())
    file = groups or _default_file(logs)
    with locked_groups(file):
        known = _undo(load_groups(file), file, every, undo or [])
        with (
            share_done("reading what was heard") as progress,
            read_sounds(home, of, first, last, progress) as sounds,
        ):
            found, rows, points = find_groups(sounds, known, least)
            _check_numbers(found, names)
            save_groups(found, file)  # before there are marks of it
            found = _name(found, every, sounds, rows, names, who)
            save_groups(found, file)
            summaries = summarise(sounds, found, rows, points, zone)
    if as_json:
        print_json(_as_json(summaries, len(rows), file, zone))
    else:
        _print(summaries, len(rows), sounds.without, zone)
        _tell_next(summaries, logs)
    end_with_warnings(sounds.losses)


def _default_file(logs: Sequence[Path]) -> Path:
    from hearthlog.analyzer.discover.groups_file import GROUPS

    if len(logs) > 1 or not logs[0].is_dir():
        wrong_use("--groups: say in which file the groups are kept, where LOGS is no single folder")
    return logs[0] / GROUPS


def _names(given: Sequence[str]) -> dict[int, str]:
    """Read the options --name."""
    from hearthlog.models.classes import CLASS_NAME, SILENCE
    from hearthlog.schemas.messages.labels import spelt

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


def _check_numbers(groups: "Groups | None", numbers: Iterable[int]) -> None:
    from hearthlog.analyzer.errors import DataError

    for each in numbers:
        if groups is None or each not in groups.numbers:
            raise DataError(f"there is no group {each}; `hearthlog discover LOGS` lists them")


def _undo(
    groups: "Groups | None", file: Path, logs: Sequence[Path], numbers: Sequence[int]
) -> "Groups | None":
    from hearthlog.analyzer.discover.groups_file import save_groups
    from hearthlog.analyzer.discover.naming import reason_of, unmark_group

    _check_numbers(groups, numbers)
    if groups is None:
        return None
    for each in numbers:
        count = unmark_group(logs, reason_of(groups, each))
        tell(f"group {each}: {number(count, 'mark')} taken back")
        groups = _named(groups, each, "")
        save_groups(groups, file)
    return groups


def _name(
    groups: "Groups",
    logs: Sequence[Path],
    sounds: "HomeSounds",
    of: "Int64",
    names: dict[int, str],
    reviewer: str,
) -> "Groups":
    from hearthlog.analyzer.discover.naming import mark_group, reason_of

    for each, label in names.items():
        rows = (of == groups.numbers.tolist().index(each)).nonzero()[0]
        made, left = mark_group(
            logs, sounds, rows, reason=reason_of(groups, each), label=label, reviewer=reviewer
        )
        more = f"; {left} are marked or looked at by somebody already" if left else ""
        tell(f"group {each}: {number(made, 'mark')} of {label}{more}")
        groups = _named(groups, each, label)
    return groups


def _named(groups: "Groups", group: int, label: str) -> "Groups":
    row = groups.numbers.tolist().index(group)
    return replace(groups, names=[*groups.names[:row], label, *groups.names[row + 1 :]])


def _print(summaries: "Sequence[GroupSummary]", total: int, without: int, zone: "tzinfo") -> None:
    from hearthlog.analyzer.discover.summary import usual_hours

    head = ("group", "name", "heard as", "listen to", "times", "days", "hours", "seconds", "alike")
    rows = [
        (
            str(each.number),
            each.name,
            ", ".join(f"{name} {100 * s:.0f} %" for name, s in [*each.labels.items()][:_LABELS]),
            _place(each, zone),
            str(each.times),
            str(each.days),
            usual_hours(each.hours) or "any",
            f"{each.seconds:.1f}",
            f"{each.alike:.2f}",
        )
        for each in summaries
    ]
    print_table(head, rows, words=4)
    grouped = sum(each.times for each in summaries)
    print(f"{number(total, 'sound')}, of which {grouped} recur in {number(len(rows), 'group')}")
    if without:
        print(f"{number(without, 'log')} without features and labels")


def _place(summary: "GroupSummary", zone: "tzinfo") -> str:
    from hearthlog.analyzer.logs.local_time import local_time

    example = summary.examples[0]
    return f"{local_time(example.start, zone):%Y-%m-%d %H:%M:%S} {example.microphone}"


def _tell_next(summaries: "Sequence[GroupSummary]", logs: Sequence[Path]) -> None:
    unnamed = [each.number for each in summaries if not each.name]
    if unnamed:
        where = " ".join(quote(str(log)) for log in logs)
        tell(f"next: name one: hearthlog discover {where} --name {unnamed[0]}=doorbell")


def _as_json(
    summaries: "Sequence[GroupSummary]", total: int, file: Path, zone: "tzinfo"
) -> dict[str, Any]:
    from hearthlog.schemas.times import time_text

    def example(each: Any) -> dict[str, Any]:
        times = {key: time_text(getattr(each, key)) for key in ("start", "end")}
        return {"log": str(each.log), "microphone": each.microphone, **times}

    return {
        "sounds": total,
        "timezone": str(zone),
        "groups_file": str(file),
        "groups": [
            {**asdict(each), "examples": [example(one) for one in each.examples]}
            for each in summaries
        ],
    }
