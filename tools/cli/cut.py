"""`hearthlog cut`: a part of some logs as a log of its own."""

from pathlib import Path
from typing import Annotated

import typer

from hearthlog.tools.cli.selection import (
    End,
    Logs,
    Start,
    Topics,
    check_log_name,
    report_unfinished,
)
from hearthlog.tools.cli.times import parse_span


def cut(
    logs: Logs,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Log to make, *.mcap.")],
    topics: Topics = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Cut a span of time out of logs, message for message.

    It begins with what describes the streams (`/mic/info`) as it was at the start of the span.
    Exit status 3: a log is unfinished; what is there of it is part of the output.
    """
    from hearthlog.analyzer.export.merge import merge_logs
    from hearthlog.analyzer.logs.selection import select
    from hearthlog.tools.cli.progress import share_done

    check_log_name(output)
    selection = select(logs, topics or [], *parse_span(start, end))
    with share_done("cutting") as progress:
        merge_logs(selection, output, progress, latched=True)
    print(output)
    report_unfinished(selection)
