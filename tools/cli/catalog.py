"""`hearthlog info --catalog`: the catalogue of a folder, and its homes at a glance."""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hearthlog.schemas.text import printable
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.selection import wrong_use
from hearthlog.tools.cli.text import PLAIN_WIDTH, first_of, moment, number, tell

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.catalog import Catalog
    from hearthlog.analyzer.logs.catalog.fleet import Heard, Home

_HOMES_SHOWN = 40  # that is a page
_TO_THE_MINUTE = len("2026-03-01T08:00")
_COUNTS = "logs", "layers", "unfinished", "damaged"


def make_catalog(folder: Path, *, as_json: bool) -> None:
    """Make the catalogue of a folder, and show what is in it."""
    from hearthlog.analyzer.logs.catalog import DAMAGED, UNFINISHED
    from hearthlog.analyzer.logs.catalog.fleet import heard, homes

    if folder.is_file():
        wrong_use(f"--catalog: {folder} is a file; give the folder that holds the logs or homes")
    catalog = _written(folder)
    damaged = catalog.of_state(DAMAGED)
    for row in damaged:
        tell(f"{folder / row.path}: {row.error}")
    unfinished = [row.path for row in catalog.of_state(UNFINISHED)]
    found, labels = homes(catalog), heard(catalog)
    if as_json:
        about = {
            "files": len(catalog),
            "unfinished": unfinished,
            "damaged": {row.path: row.error for row in damaged},
            "homes": [_home(home) for home in found],
            "labels": [asdict(label) for label in labels],
        }
        print(json.dumps(about, indent=2))
    else:
        _print(found, labels, unfinished)
    if damaged or unfinished:
        raise typer.Exit(3)


def _written(folder: Path) -> "Catalog":
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.catalog import load_catalog, write_catalog

    known = None
    try:
        known = load_catalog(folder)
    except DataError as error:
        print(f"hearthlog: {error}; it is made anew", file=sys.stderr)
    try:
        with share_done("reading logs") as report:
            return write_catalog(folder, known, report)
    except KeyboardInterrupt:
        print(
            "hearthlog: interrupted; what was read is in the catalogue, and the same command goes "
            "on from there",
            file=sys.stderr,
        )
        raise


def _home(home: "Home") -> dict[str, object]:
    times = {"start": moment(home.start), "end": moment(home.end)}
    return asdict(home) | times | {"hours": home.hours}


def _print(homes: Sequence["Home"], labels: Sequence["Heard"], unfinished: Sequence[str]) -> None:
    from rich.console import Console
    from rich.table import Table

    width = None if sys.stdout.isatty() else PLAIN_WIDTH
    console = Console(highlight=False, markup=False, emoji=False, soft_wrap=True, width=width)
    figures = "MB", "hours", "gaps", "gap minutes", "from", "to"
    table = Table("home", *_COUNTS, *figures, box=None)
    for row in _home_rows(homes):
        table.add_row(*map(printable, row))
    console.print(table, soft_wrap=False)
    if len(homes) > _HOMES_SHOWN:
        console.print(f"and {len(homes) - _HOMES_SHOWN} more homes (--json lists all)")
    table = Table("labels", "model", "label", "minutes", "segments", box=None)
    for row in _label_rows(labels):
        table.add_row(*map(printable, row))
    if table.rows:
        console.print(table, soft_wrap=False)
    for line in first_of("unfinished", unfinished):
        console.print(printable(line))


def _home_rows(homes: Sequence["Home"]) -> Iterator[Sequence[str]]:
    for home in homes[:_HOMES_SHOWN]:
        yield _home_row(home.home or "-", [home])
    if len(homes) > 1:
        yield _home_row(number(len(homes), "home"), homes)


def _home_row(name: str, homes: Sequence["Home"]) -> Sequence[str]:
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


def _label_rows(labels: Sequence["Heard"]) -> Iterator[Sequence[str]]:
    """Add up the labels of all homes, those of one kind and model together."""
    sums: dict[tuple[str, str, str], tuple[float, int]] = {}
    for one in labels:
        key = one.kind, one.model or "", one.label
        minutes, segments = sums.get(key, (0.0, 0))
        sums[key] = minutes + one.minutes, segments + one.segments
    for key, (minutes, segments) in sorted(
        sums.items(), key=lambda item: (item[0][:2], -item[1][0])
    ):
        yield [*key, f"{minutes:.1f}", str(segments)]
