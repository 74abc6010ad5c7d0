"""`hearthlog export`: logs in other formats."""

from pathlib import Path
from typing import Annotated

import typer

from hearthlog.analyzer.export.formats import FORMATS
from hearthlog.schemas.errors import abridged, listed
from hearthlog.tools.cli.options import End, Logs, Start, Topics, parse_span
from hearthlog.tools.cli.text import end_with_warnings, number, tell, unfinished_lines, wrong_use

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
            help=f"Makes a folder with one file for each topic: {listed(_BY_TOPIC)}; or "
            f"{listed(_FOLDERS)}.",
        ),
    ] = None,
    in_place: Annotated[
        bool,
        typer.Option(
            "--in-place",
            help="With --format rosbag2: make one bag of a folder of logs as they lie, by a "
            "metadata.yaml in it.",
        ),
    ] = False,
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

    if in_place:
        if output_format != "rosbag2" or output or topics or start or end:
            wrong_use("--in-place goes with --format rosbag2, and with nothing else")
        _describe_as_bag(logs)
        return
    if output is None:
        wrong_use("name what to make: --output FILE, or --output FOLDER with --format")
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
    print(output)
    if repeated:
        tell(f"{number(repeated, 'message')} left out that the logs have twice")
    end_with_warnings(unfinished_lines(selection.unfinished))


def _describe_as_bag(logs: list[Path]) -> None:
    from hearthlog.analyzer.export.bag_in_place import describe_as_bag
    from hearthlog.tools.cli.progress import share_done

    if len(logs) != 1:
        wrong_use("--in-place: name one folder of logs")
    with share_done("reading") as progress:
        bag = describe_as_bag(logs[0], progress)
    print(bag.metadata)
    warnings = []
    if bag.unfinished:
        names = ", ".join(map(str, bag.unfinished))
        warnings.append(f"not in the bag, for it is unfinished: {names}")
    if bag.overlapping:
        warnings.append(
            f"{bag.overlapping[0]} begins before another log ends, and rosbag2 plays one after the "
            "other; --output BAG instead of --in-place puts all in the order of time"
        )
    end_with_warnings(warnings)
