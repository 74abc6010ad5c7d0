"""The homes of a catalogue at a glance: how much was heard in each, and what."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from hearthlog.analyzer.logs.catalog.catalog import DAMAGED, LOG, UNFINISHED, Catalog
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

_HOUR = 3600 * NANOSECONDS // FRAME_NANOSECONDS  # frames
_FUNCTIONS = {"start": "min", "end": "max"}


@dataclass(frozen=True)
class HomeSummary:
    """The files of one home."""

    home: str
    logs: int
    layers: int
    unfinished: int
    damaged: int
    size: int  # bytes
    frames: int  # of the logs
    start: int | None  # first and last log time of the logs
    end: int | None
    gaps: int
    gap_seconds: float

    @property
    def hours(self) -> float:
        """Hours that were heard."""
        return self.frames / _HOUR


@dataclass(frozen=True)
class LabelAmount:
    """How much of a label there is in one home."""

    home: str
    kind: str  # of the files that say so: `log`, `relabel`, `review`
    model: str | None
    label: str
    minutes: float
    segments: int
    scenario: str = ""  # empty for the sounds of the home


def homes(catalog: Catalog) -> list[HomeSummary]:
    """Sum up the files of each home."""
    table = catalog.table
    logs = pc.equal(table["kind"], LOG)
    counted = pa.table(
        {
            "home": table["home"],
            "logs": logs.cast(pa.int64()),
            "layers": pc.invert(logs).cast(pa.int64()),
            "unfinished": pc.equal(table["state"], UNFINISHED).cast(pa.int64()),
            "damaged": pc.equal(table["state"], DAMAGED).cast(pa.int64()),
            "size": table["size"],
            "frames": pc.if_else(logs, table["frames"], 0),
            "gaps": table["gaps"],
            "gap_seconds": table["gap_seconds"],
            "start": pc.if_else(logs, table["start"], None).cast(pa.int64()),
            "end": pc.if_else(logs, table["end"], None).cast(pa.int64()),
        }
    )
    functions = [(name, _FUNCTIONS.get(name, "sum")) for name in counted.column_names[1:]]
    return [HomeSummary(**row) for row in _grouped(counted, ["home"], functions)]


def label_amounts(catalog: Catalog) -> list[LabelAmount]:
    """Sum up the labels of each home, by kind of labelling and by model.

    Returns
    -------
    list of LabelAmount
        In the order of home, kind and model; within these the label with most minutes first.
    """
    return _amounts(catalog.table, "labels", ["home", "kind", "model"], ["label"])


def scenario_amounts(catalog: Catalog) -> list[LabelAmount]:
    """Sum up the labels of the scenarios of each home, by kind of labelling, scenario and model.

    Returns
    -------
    list of LabelAmount
        In the order of home, kind, scenario and model; within these the label with most minutes
        first.
    """
    return _amounts(catalog.table, "scenarios", ["home", "kind"], ["scenario", "model", "label"])


def _amounts(
    table: pa.Table, column: str, keys: Sequence[str], own: Sequence[str]
) -> list[LabelAmount]:
    """Sum up what is in the lists of a column, by columns of the table and some of its own."""
    lists = table[column].combine_chunks()
    labels = pa.Table.from_struct_array(lists.flatten())
    for name in keys:
        labels = labels.append_column(name, table[name].take(pc.list_parent_indices(lists)))
    values = [("minutes", "sum"), ("segments", "sum")]
    amounts = [LabelAmount(**row) for row in _grouped(labels, [*keys, *own], values)]
    return sorted(
        amounts,
        key=lambda one: (one.home, one.kind, one.scenario, one.model or "", -one.minutes),
    )


def _grouped(
    table: pa.Table, keys: Sequence[str], functions: Sequence[tuple[str, str]]
) -> list[dict[str, Any]]:
    """Aggregate the rows that agree in some columns, in the order of these."""
    grouped = table.group_by(keys, use_threads=False).aggregate(functions)
    names = [*keys, *(name for name, _ in functions)]
    sums = grouped.select([*keys, *map("_".join, functions)]).rename_columns(names)
    return sums.sort_by([(key, "ascending") for key in keys]).to_pylist()
