"""`hearthlog cat`: the messages of logs as text."""

import sys
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hearthlog.schemas.errors import abridged
from hearthlog.tools.cli.options import End, Logs, Start, Topics, parse_span
from hearthlog.tools.cli.text import end_with_warnings, unfinished_lines, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.selection import LogSelection


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
    from hearthlog.analyzer.export.csvfile import CsvFile
    from hearthlog.analyzer.export.exporter import one_table, tables_of
    from hearthlog.analyzer.logs.selection import decode_all

    for topic, channels in selection.channels.items():
        remedy = "choose other logs, or export --format csv, which makes a file for each"
        table = CsvFile(sys.stdout.buffer, one_table(tables_of(topic, channels), remedy), selection)
        for batch in selection.messages():
            if pieces := decode_all(batch):
                table.write(pieces)
