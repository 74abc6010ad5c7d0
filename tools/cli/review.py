"""`hearthlog review`: a log, or a folder of logs, on one time axis."""

import shlex
from pathlib import Path
from typing import Annotated

import typer


def review(
    path: Annotated[Path, typer.Argument(help="A log, or a folder of logs.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Rerun recording to make, *.rrd.")],
) -> None:
    """Show labels, probabilities and features on one time axis, in a Rerun recording."""
    from analyzer.timeline import save_timeline
    from schemas.files import find_logs
    from tools.cli.progress import track

    save_timeline(track(find_logs(path), "reading logs"), output)
    print(output)
    # Otherwise the viewer listens to the whole network.
    print(f"open it with: rerun --bind 127.0.0.1 {shlex.quote(str(output))}")
