"""`hearthlog merge`: several logs in one."""

from hearthlog.tools.cli.options import Logs, NewLog, check_output
from hearthlog.tools.cli.text import end_with_warnings, number, tell, unfinished_lines


def merge(logs: Logs, *, output: NewLog) -> None:
    """Put logs together, message for message, in the order of their log times.

    What they have twice, with the same topic, times and bytes, is there once.

    Exit status 3: a log is unfinished; what is there of it is part of the output.
    """
    from hearthlog.analyzer.export.merge import merge_logs
    from hearthlog.analyzer.logs.selection import select
    from hearthlog.tools.cli.progress import share_done

    check_output("--output", output, ".mcap", "a log")
    selection = select(logs)
    with share_done("merging") as progress:
        repeated = merge_logs(selection, output, progress)
    print(output)
    if repeated:
        tell(f"{number(repeated, 'message')} left out that the logs have twice")
    end_with_warnings(unfinished_lines(selection.unfinished))
