"""`hearthlog pause` and `hearthlog resume`: nobody is listened to for a while."""

import re
from datetime import timedelta
from pathlib import Path
from typing import Annotated

import typer

from hearthlog.tools.cli.options import LogsFolder
from hearthlog.tools.cli.text import wrong_use

_UNITS = {"m": "minutes", "h": "hours", "d": "days"}
_LONGEST = timedelta(days=366)


def pause(
    logs: LogsFolder,
    duration: Annotated[
        str | None,
        typer.Option("--for", help="How long, such as 30m, 2h or 1d.", show_default="until resume"),
    ] = None,
) -> None:
    """Have the recorders of a folder close their microphones; the log says when, and why."""
    from hearthlog.recorder import pause_schedule

    _check_folder(logs)
    pause_schedule.pause(logs, None if duration is None else _read_duration(duration))
    until = "until `hearthlog resume`" if duration is None else f"for {duration}, or until resume"
    print(f"{logs}: paused {until}; its recorders close their microphones within a second")


def resume(logs: LogsFolder) -> None:
    """End a pause."""
    from hearthlog.recorder import pause_schedule

    _check_folder(logs)
    was_paused = pause_schedule.resume(logs)
    print(f"{logs}: {'is recorded again' if was_paused else 'was not paused'}")


def _check_folder(logs: Path) -> None:
    from hearthlog.schemas.logs.files import check_allowed

    check_allowed(logs)
    if not logs.is_dir():
        wrong_use(f"{logs}: no such folder; name the folder that the recorder writes to")


def _read_duration(text: str) -> timedelta:
    match = re.fullmatch(r"(\d{1,6})([mhd])", text)
    if match is None:
        wrong_use(f"--for {text}: not a duration such as 30m, 2h or 1d")
    duration = timedelta(**{_UNITS[match[2]]: int(match[1])})
    if not timedelta() < duration <= _LONGEST:
        wrong_use(f"--for {text}: more than nothing, and a year at most")
    return duration
