"""`hearthlog catalog`: the catalogue of a folder, and its homes at a glance."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.options import Json, Scheduler, log_location, logs_folder
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.table import print_table
from hearthlog.tools.cli.text import first_of, moment, number, print_lines, tell, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.catalog import Catalog, HomeTotals, LabelAmount

_HOMES_SHOWN = 40  # that is a page
_TO_THE_MINUTE = len("2026-03-01T08:00")
_COUNTS = "logs", "layers", "unfinished", "damaged"
_FIGURES = "MB", "hours", "gaps", "gap minutes", "from", "to"


def catalog(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder that holds the logs or homes, or a URL such as s3://bucket/homes.",
            parser=log_location,
            default_factory=logs_folder,
            show_default="logs",
        ),
    ],
    *,
    workers: Annotated[
        int,
        typer.Option(min=1, max=256, help="Processes; worth it where thousands of files are new."),
    ] = 1,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Write FOLDER/catalog.parquet, a row for each file, and show the homes in the folder.

    Files that have not changed since the last catalogue are not read again. Exit status 3: a file
    is unfinished or damaged.
    """
    from hearthlog.analyzer.extras import require
    from hearthlog.schemas.logs.files import check_allowed

    require("pyarrow")
    from hearthlog.analyzer.logs.catalog import (
        DAMAGED,
        UNFINISHED,
        homes,
        label_amounts,
        scenario_amounts,
    )

    check_allowed(folder)
    if folder.is_file():
        wrong_use(f"{folder} is a file; give the folder that holds the logs or homes")
    files = _write(folder, workers, scheduler)
    damaged = files.of_state(DAMAGED)
    for row in damaged:
        tell(f"{folder / row.path}: {row.error}")
    unfinished = [row.path for row in files.of_state(UNFINISHED)]
    if as_json:
        result = {
            "files": len(files),
            "unfinished": unfinished,
            "damaged": {row.path: row.error for row in damaged},
            "homes": [_home(home) for home in homes(files)],
            "labels": [asdict(label) for label in label_amounts(files)],
            "scenarios": [asdict(label) for label in scenario_amounts(files)],
        }
        print(json.dumps(result, indent=2))
    else:
        _print(homes(files), [*label_amounts(files), *scenario_amounts(files)], unfinished)
    if damaged or unfinished:
        raise typer.Exit(3)


def _write(folder: Path, workers: int, scheduler: str | None) -> "Catalog":
    from hearthlog.analyzer.logs.catalog import read_catalog
    from hearthlog.analyzer.logs.catalog_writer import write_catalog
    from hearthlog.analyzer.workers import open_workers

    previous = read_catalog(folder)
    for line in () if previous is None else previous.unusable:
        tell(f"{line}; it is made anew")
    try:
        with open_workers(workers, scheduler) as pool, share_done("reading logs") as progress:
            return write_catalog(folder, previous, progress, pool)
    except KeyboardInterrupt:
        tell(
            "interrupted; what was read is in the catalogue, and the same command goes on from "
            "there"
        )
        raise


def _home(home: "HomeTotals") -> dict[str, object]:
    times = {"start": moment(home.start), "end": moment(home.end)}
    return asdict(home) | times | {"hours": home.hours}


def _print(
    homes: Sequence["HomeTotals"], labels: Sequence["LabelAmount"], unfinished: Sequence[str]
) -> None:
    print_table(("home", *_COUNTS, *_FIGURES), _home_rows(homes))
    if len(homes) > _HOMES_SHOWN:
        print(f"and {len(homes) - _HOMES_SHOWN} more homes (--json lists all)")
    print_table(("labels", "model", "label", "minutes", "segments"), _label_rows(labels), words=3)
    print_lines(first_of("unfinished", unfinished))


def _home_rows(homes: Sequence["HomeTotals"]) -> Iterator[Sequence[str]]:
    for home in homes[:_HOMES_SHOWN]:
        yield _home_row(home.home or "-", [home])
    if len(homes) > 1:
        yield _home_row(number(len(homes), "home"), homes)


def _home_row(name: str, homes: Sequence["HomeTotals"]) -> Sequence[str]:
    starts = [home.start for home in homes if home.start is not None]
    ends = [home.end for home in homes if home.end is not None]
    return [
        name,
        *(str(sum(getattr(home, what) for home in homes)) for what in _COUNTS),
        f"{sum(home.size for home in homes) / 1e6:.1f}",
        f"{sum(home.hours for home in homes):.2f}",
        str(sum(home.gaps for home in homes)),
        f"{sum(home.gap_seconds for home in homes) / 60:.2f}",
        (moment(min(starts, default=None)) or "")[:_TO_THE_MINUTE],
        (moment(max(ends, default=None)) or "")[:_TO_THE_MINUTE],
    ]


def _label_rows(labels: Sequence["LabelAmount"]) -> Iterator[Sequence[str]]:
    """Add up the labels of all homes, those of one kind and model together."""
    sums: dict[tuple[str, str, str], tuple[float, int]] = {}
    for one in labels:
        kind = f"{one.kind}, scenario {one.scenario}" if one.scenario else one.kind
        key = kind, one.model or "", one.label
        minutes, segments = sums.get(key, (0.0, 0))
        sums[key] = minutes + one.minutes, segments + one.segments
    for key, (minutes, segments) in sorted(
        sums.items(), key=lambda item: (item[0][:2], -item[1][0])
    ):
        yield [*key, f"{minutes:.1f}", str(segments)]
