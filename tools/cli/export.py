"""`hearthlog export`: logs in other formats."""

from pathlib import Path
from typing import Annotated

import typer

from hearthlog.analyzer.export.formats import FORMATS
from hearthlog.schemas.text import listed
from hearthlog.tools.cli.options import End, Logs, Start, Topics, parse_span
from hearthlog.tools.cli.text import end_with_warnings, unfinished_lines, wrong_use

_FILES = [each.pattern for each in FORMATS.values() if not each.is_folder]
_BY_TOPIC = [each.name for each in FORMATS.values() if each.by_topic]
_FOLDERS = [each.name for each in FORMATS.values() if each.is_folder]


def export(
    logs: Logs,
    *,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help=f"File to make, {listed(_FILES)}; or, with --format, a folder.",
        ),
    ],
    output_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help=f"Makes a folder with one file for each topic: {listed(_BY_TOPIC)}; or "
            f"{listed(_FOLDERS)}.",
        ),
    ] = None,
    topics: Topics = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Write logs in another format: one file, or a folder with a file for each topic.

    Exit status 3: a log is unfinished; what is there of it is part of the output.
    """
    from hearthlog.analyzer.export.save import export as save
    from hearthlog.analyzer.export.save import exportable
    from hearthlog.analyzer.logs.selection import select
    from hearthlog.tools.cli.progress import share_done

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
        names = ", ".join(sorted(selection.channels))
        wrong_use(f"{output} is for one topic: choose one with --topics ({names})")
    with share_done("exporting") as progress:
        save(selection, output, format_, progress, folder=not one_file)
    print(output)
    end_with_warnings(unfinished_lines(selection.unfinished))
