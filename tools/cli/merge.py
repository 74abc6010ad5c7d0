"""`hearthlog merge`: several logs in one."""

from pathlib import Path
from typing import Annotated

import typer

from hearthlog.tools.cli.selection import Logs, check_log_name, report_unfinished


def merge(
    logs: Logs,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Log to make, *.mcap.")],
) -> None:
    """Put logs together, message for message, in the order of their log times.

    Exit status 3: a log is unfinished; what is there of it is part of the output.
    """
    from hearthlog.analyzer.export.merge import merge_logs
    from hearthlog.analyzer.logs.selection import select
    from hearthlog.tools.cli.progress import share_done

    check_log_name(output)
    selection = select(logs)
    with share_done("merging") as progress:
        merge_logs(selection, output, progress)
    print(output)
    report_unfinished(selection)
