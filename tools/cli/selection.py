"""What verbs that read a part of some logs have in common: their options, what they report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from hearthlog.tools.cli.text import tell

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.selection import Selection


def log_location(text: str) -> Path:
    """Read the name of a log or a folder, which may be the URL of a store."""
    if "://" not in text:
        return Path(text)
    from hearthlog.analyzer.logs.locations import location

    return location(text)


Logs = Annotated[
    list[Path],
    typer.Argument(
        help="Logs, or folders of logs, or URLs such as s3://bucket/home.",
        parser=log_location,
    ),
]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topics", help="Topic, or pattern such as '/mic/*'; may be given again."),
]
Start = Annotated[
    str | None,
    typer.Option(help="From this log time on, as 2026-03-01T07:00 (UTC unless it says otherwise)."),
]
End = Annotated[str | None, typer.Option(help="Up to this log time, which is not part of it.")]


def wrong_use(message: str) -> NoReturn:
    """End with one line, and the exit status of wrong use."""
    tell(message)
    raise typer.Exit(2)


def report_unfinished(selection: "Selection") -> None:
    """End with exit status 3 if a log was not completed, and say which."""
    if selection.unfinished:
        names = ", ".join(map(str, selection.unfinished))
        tell(f"unfinished, read up to the last whole chunk: {names}")
        raise typer.Exit(3)


def check_log_name(path: Path) -> None:
    """End with the exit status of wrong use unless logs may have this name."""
    if path.suffix != ".mcap":
        wrong_use(f"--output {path}: a log is named *.mcap")
