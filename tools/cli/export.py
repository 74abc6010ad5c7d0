"""`hearthlog export`, `cat`, `cut` and `merge`: messages of logs in other files."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hearthlog.analyzer.export import FORMATS
from hearthlog.schemas.errors import abridged, listed
from hearthlog.tools.cli.options import End, Logs, NewLog, Start, Topics, check_output, parse_span
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    number,
    print_notice,
    share_done,
    unfinished_lines,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.selection import LogSelection


_FILES = [each.pattern for each in FORMATS.values() if not each.is_folder]
_BY_TOPIC = [each.name for each in FORMATS.values() if each.by_topic]
_FOLDERS = [each.name for each in FORMATS.values() if each.is_folder]


def export(
    logs: Logs,
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help=f"File to make, {listed(_FILES)}; or, with --format, a folder.",
        ),
    ] = None,
    output_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help=f"Write a folder with one file for each topic: {listed(_BY_TOPIC)}; or "
            f"{listed(_FOLDERS)}.",
        ),
    ] = None,
    in_place: Annotated[
        bool,
        typer.Option(
            "--in-place",
            help="With --format rosbag2: make a folder of logs a bag, by writing a "
            "metadata.yaml into it.",
        ),
    ] = False,
    topics: Topics = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Write logs in another format: one file, or a folder with a file for each topic.

    Exit status 3: a log is unfinished; its complete part is in the output.
    """
    from hearthlog.analyzer.export.exporter import export as save
    from hearthlog.analyzer.export.exporter import exportable
    from hearthlog.analyzer.logs.selection import select

    if in_place:
        if output_format != "rosbag2" or output or topics or start or end:
            wrong_use("--in-place goes with --format rosbag2 only")
        _describe_as_bag(logs)
        return
    if output is None:
        wrong_use("give --output FILE, or --output FOLDER with --format")
    suffix = output.suffix[1:]
    format_ = FORMATS.get(output_format or suffix)
    if format_ is None:
        wrong_use(f"--format {output_format or suffix}: choose one of {', '.join(FORMATS)}")
    one_file = suffix in FORMATS and not FORMATS[suffix].is_folder
    if one_file and suffix != format_.name:
        wrong_use(f"--output {output} is not --format {format_.name}")
    if not (one_file or format_.by_topic or format_.is_folder):
        wrong_use(f"--output {output}: a {format_.name} is one file, *.{format_.name}")
    selection = exportable(select(logs, topics or [], *parse_span(start, end)), format_)
    if one_file and format_.by_topic and len(selection.channels) > 1:
        names = abridged(sorted(selection.channels))
        wrong_use(f"{output} is for one topic: choose one with --topics ({names})")
    with share_done("exporting") as progress:
        repeated = save(selection, output, format_, progress, folder=not one_file)
    _end(output, repeated, selection)


def _end(output: Path, repeated: int, selection: "LogSelection") -> None:
    """Print what was written; end with exit status 3 if a log is unfinished."""
    print(output)
    if repeated:
        print_notice(f"{number(repeated, 'message')} left out, which the logs contain twice")
    end_with_warnings(unfinished_lines(selection.unfinished))


def _describe_as_bag(logs: list[Path]) -> None:
    from hearthlog.analyzer.export.bags import describe_as_bag

    if len(logs) != 1:
        wrong_use("--in-place: name one folder of logs")
    with share_done("reading") as progress:
        bag = describe_as_bag(logs[0], progress)
    print(bag.metadata)
    names = ", ".join(map(str, bag.unfinished))
    warnings = [f"not in the bag, because it is unfinished: {names}"] if names else []
    if bag.overlapping:
        warnings.append(
            f"{bag.overlapping[0]} begins before another log ends, and rosbag2 plays one log "
            "after the other; use --output BAG instead of --in-place to sort all messages by "
            "time"
        )
    end_with_warnings(warnings)


def cat(
    logs: Logs,
    *,
    output_format: Annotated[
        Literal["text", "ndjson", "csv"], typer.Option("--format", help="csv is for one topic.")
    ] = "text",
    topics: Topics = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Print the messages of logs in the order of their log times.

    Exit status 3: a log is unfinished.
    """
    from hearthlog.analyzer.export.text import in_order, json_lines, text_lines
    from hearthlog.analyzer.logs.selection import decode_all, select

    selection = select(logs, topics or [], *parse_span(start, end)).decodable()
    if output_format == "csv" and len(selection.channels) > 1:
        names = abridged(sorted(selection.channels))
        wrong_use(f"csv is for one topic: choose one with --topics ({names})")
    if output_format == "csv":
        _print_table(selection)
    else:
        lines = json_lines if output_format == "ndjson" else text_lines
        for batch in selection.messages():
            sys.stdout.write("\n".join([*in_order(decode_all(batch), lines), ""]))
    end_with_warnings(unfinished_lines(selection.unfinished))


def _print_table(selection: "LogSelection") -> None:
    from hearthlog.analyzer.export.arrow import CsvFile
    from hearthlog.analyzer.export.exporter import one_table, tables_of
    from hearthlog.analyzer.logs.selection import decode_all

    for topic, channels in selection.channels.items():
        remedy = "choose other logs, or export --format csv, which makes a file for each"
        table = CsvFile(sys.stdout.buffer, one_table(tables_of(topic, channels), remedy), selection)
        for batch in selection.messages():
            if pieces := decode_all(batch):
                table.write(pieces)


def cut(
    logs: Logs,
    *,
    output: NewLog,
    topics: Topics = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Copy the messages of a time span of logs into a new log.

    It begins with the descriptions of the streams (`/mic/info`) that hold at the start of the
    span. Exit status 3: a log is unfinished; its complete part is in the output.
    """
    from hearthlog.analyzer.export.merge import merge_logs
    from hearthlog.analyzer.logs.selection import select

    check_output("--output", output, ".mcap", "a log")
    selection = select(logs, topics or [], *parse_span(start, end))
    with share_done("cutting") as progress:
        repeated = merge_logs(selection, output, progress, latched=True)
    _end(output, repeated, selection)


def merge(logs: Logs, *, output: NewLog) -> None:
    """Merge logs into one, in the order of log times.

    Duplicates, messages with the same topic, times and bytes, are written once. Exit status
    3: a log is unfinished; its complete part is in the output.
    """
    from hearthlog.analyzer.export.merge import merge_logs
    from hearthlog.analyzer.logs.selection import select

    check_output("--output", output, ".mcap", "a log")
    selection = select(logs)
    with share_done("merging") as progress:
        repeated = merge_logs(selection, output, progress)
    _end(output, repeated, selection)
