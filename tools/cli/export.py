"""`hearthlog export`: logs in the formats of others."""

from pathlib import Path
from typing import Annotated

import typer

from hearthlog.tools.cli.options import End, Logs, Start, Topics
from hearthlog.tools.cli.text import end_with_warnings, unfinished_lines, wrong_use
from hearthlog.tools.cli.times import parse_span


def export(
    logs: Logs,
    *,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="File to make, *.parquet, *.csv, *.npz, *.wav, *.txt (Audacity labels) or *.bag "
            "(ROS 1); or, with --format, a folder.",
        ),
    ],
    output_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Makes a folder with one file for each topic: parquet, csv, npz, wav or txt; or "
            "rosbag2.",
        ),
    ] = None,
    topics: Topics = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Write logs as Parquet, CSV, NPZ, WAV, Audacity labels, rosbag2 or a ROS 1 bag.

    Exit status 3: a log is unfinished; what is there of it is part of the output.
    """
    from hearthlog.analyzer.export.save import ONE_TOPIC, ExportFormat, fitting
    from hearthlog.analyzer.export.save import export as save
    from hearthlog.analyzer.logs.selection import select
    from hearthlog.tools.cli.progress import share_done

    one_file = output.suffix[1:] in set(ExportFormat) - {ExportFormat.rosbag2}
    name = output_format or output.suffix[1:]
    if name not in set(ExportFormat):
        wrong_use(f"--format {name}: choose one of {', '.join(ExportFormat)}")
    if one_file and output.suffix[1:] != name:
        wrong_use(f"--output {output} is not --format {name}")
    if name == "bag" and not one_file:
        wrong_use(f"--output {output}: a bag is one file, *.bag")
    form = ExportFormat(name)
    selection = fitting(select(logs, topics or [], *parse_span(start, end)), form)
    if one_file and form in ONE_TOPIC and len(selection.channels) > 1:
        names = ", ".join(sorted(selection.channels))
        wrong_use(f"{output} is for one topic: choose one with --topics ({names})")
    with share_done("exporting") as progress:
        save(selection, output, form, progress, folder=not one_file)
    print(output)
    end_with_warnings(unfinished_lines(selection.unfinished))
