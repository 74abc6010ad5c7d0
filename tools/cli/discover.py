"""`hearthlog discover`: the sounds that recur in a home, and what they are called."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

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
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.table import print_table
from hearthlog.tools.cli.text import end_with_warnings, number, print_json, tell, wrong_use

if TYPE_CHECKING:
    from datetime import tzinfo

    from hearthlog.analyzer.discover.groups import Groups
    from hearthlog.analyzer.discover.naming import Looked
    from hearthlog.analyzer.discover.summary_file import GroupSummary, HomeSummary
    from hearthlog.analyzer.logs.home_logs import HomeLogs

_LABELS = 2  # that are shown of a group


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
    from hearthlog.analyzer.discover.groups_file import locked_groups
    from hearthlog.analyzer.discover.naming import Looked
    from hearthlog.analyzer.discover.sound_spans import CHOICES
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
    from hearthlog.analyzer.discover.groups_file import GROUPS

    if len(logs) > 1 or not logs[0].is_dir():
        wrong_use("--groups: say in which file the groups are kept, where LOGS is no single folder")
    return logs[0] / GROUPS


def _names(given: Sequence[str]) -> dict[int, str]:
    """Read the options --name."""
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
) -> tuple["HomeSummary", list[str]]:
    """Group what is heard, and keep the groups and their summary."""
    from hearthlog.analyzer.discover.discover import discover as find_groups
    from hearthlog.analyzer.discover.discover import unembedded_note
    from hearthlog.analyzer.discover.groups_file import load_groups, save_groups
    from hearthlog.analyzer.discover.read_sounds import read_sounds
    from hearthlog.analyzer.discover.summary import summarise
    from hearthlog.analyzer.discover.summary_file import HomeSummary, save_summary, summary_path

    known = load_groups(file)
    with (
        share_done("reading what was heard") as progress,
        read_sounds(home, *looked, progress, known) as sounds,
    ):
        groups, rows, points = find_groups(sounds, known, least)
        summary = HomeSummary(
            id=groups.id,
            sounds=len(rows),
            timezone=str(zone),
            groups_file=printable(file),
            groups=summarise(sounds, groups, rows, points, zone),
        )
    save_groups(groups, file)
    save_summary(summary, summary_path(file))
    if note := unembedded_note(sounds, groups):
        tell(note)
    if sounds.without:
        tell(f"{number(sounds.without, 'log')} without features and labels")
    return summary, sounds.losses


def _name(
    home: "HomeLogs",
    file: Path,
    undo: Sequence[int],
    names: Mapping[int, str],
    looked: "Looked",
    reviewer: str,
) -> tuple["HomeSummary", list[str]]:
    """Take names of known groups back, and give others; what is heard is not grouped anew."""
    from hearthlog.analyzer.discover.groups_file import load_groups
    from hearthlog.analyzer.discover.naming import name_groups, reason_of, unmark_group
    from hearthlog.analyzer.discover.summary_file import load_summary, summary_path

    groups = _known(load_groups(file), [*undo, *names])
    summary = load_summary(summary_path(file))
    for each in undo:
        count = unmark_group([log.path for log in home.between()], reason_of(groups, each))
        tell(f"group {each}: {number(count, 'mark')} taken back")
        groups, summary = _renamed(groups, summary, {each: ""}, file)
    losses: list[str] = []
    if names:
        with share_done("reading what was heard") as progress:
            marked, losses = name_groups(home, groups, names, looked, reviewer, progress)
        for each, (made, left) in marked.items():
            more = f"; {left} are marked or looked at by somebody already" if left else ""
            tell(f"group {each}: {number(made, 'mark')} of {names[each]}{more}")
        groups, summary = _renamed(groups, summary, names, file)
    return summary, losses


def _known(groups: "Groups | None", numbers: Iterable[int]) -> "Groups":
    """Return the groups, if there are those of some numbers."""
    from hearthlog.analyzer.errors import DataError

    for each in numbers:
        if groups is None or each not in groups.numbers:
            raise DataError(f"there is no group {each}; `hearthlog discover LOGS` lists them")
    assert groups is not None
    return groups


def _renamed(
    groups: "Groups", summary: "HomeSummary", names: Mapping[int, str], file: Path
) -> tuple["Groups", "HomeSummary"]:
    """Give groups other names, and keep them; an empty name takes one away."""
    from hearthlog.analyzer.discover.groups_file import save_groups
    from hearthlog.analyzer.discover.summary_file import save_summary, summary_path

    numbers = groups.numbers.tolist()
    kept = [names.get(each, name) for each, name in zip(numbers, groups.names, strict=True)]
    groups, summary = replace(groups, names=kept), summary.named(names)
    save_groups(groups, file)
    save_summary(summary, summary_path(file))
    return groups, summary


def _print(summary: "HomeSummary", zone: "tzinfo") -> None:
    from hearthlog.analyzer.discover.hours import usual_hours

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


def _tell_next(summary: "HomeSummary", logs: Sequence[Path], file: Path | None) -> None:
    unnamed = [each.number for each in summary.groups if not each.name]
    if unnamed:
        where = " ".join(quote(str(log)) for log in logs)
        where += f" --groups {quote(str(file))}" if file else ""
        tell(f"next: name one: hearthlog discover {where} --name {unnamed[0]}=doorbell")
