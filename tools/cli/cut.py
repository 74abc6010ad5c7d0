"""`hearthlog cut`: a part of some logs as a log of its own."""

from hearthlog.tools.cli.options import End, Logs, NewLog, Start, Topics, check_output, parse_span
from hearthlog.tools.cli.text import end_with_warnings, number, tell, unfinished_lines


def cut(
    logs: Logs,
    *,
    output: NewLog,
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

    check_output("--output", output, ".mcap", "a log")
    selection = select(logs, topics or [], *parse_span(start, end))
    with share_done("cutting") as progress:
        repeated = merge_logs(selection, output, progress, latched=True)
    print(output)
    if repeated:
        tell(f"{number(repeated, 'message')} left out that the logs have twice")
    end_with_warnings(unfinished_lines(selection.unfinished))
