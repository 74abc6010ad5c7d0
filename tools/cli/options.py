"""Options and arguments that several verbs have."""

from pathlib import Path
from typing import Annotated

import typer

from hearthlog.tools.cli.text import wrong_use

METHODS = "How to learn: bands, or paper (42 statistics)."


def log_location(text: str) -> Path:
    """Read the name of a log or a folder, which may be the URL of a store."""
    if "://" not in text:
        return Path(text)
    from hearthlog.analyzer.logs.locations import location

    return location(text)


Log = Annotated[
    Path,
    typer.Argument(
        help="A log, or a folder of logs, or a URL such as s3://bucket/home.", parser=log_location
    ),
]
Logs = Annotated[
    list[Path],
    typer.Argument(
        help="Logs, or folders of logs, or URLs such as s3://bucket/home.", parser=log_location
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
NewLog = Annotated[Path, typer.Option("--output", "-o", help="Log to make, *.mcap.")]
Microphone = Annotated[
    str | None, typer.Option(help="Name of the microphone, where there are several.")
]
Timezone = Annotated[
    str | None,
    typer.Option(
        help="Time zone of the home, as Europe/Vienna.", show_default="what the logs say, or UTC"
    ),
]
Clips = Annotated[
    Path, typer.Option(help="Manifest of labelled clips (CSV), or the folder of a manifest.csv.")
]
Scheduler = Annotated[
    str | None, typer.Option(help="Work on this Dask cluster, as tcp://host:port.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def manifest_path(path: Path) -> Path:
    """Return the manifest that a path is, or that the folder holds."""
    return path / "manifest.csv" if path.is_dir() else path


def check_log_name(path: Path) -> None:
    """End with the exit status of wrong use unless logs may have this name."""
    if path.suffix != ".mcap":
        wrong_use(f"--output {path}: a log is named *.mcap")
