"""The rows of a catalogue, made from the files."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from hearthlog.analyzer.logs.catalog.catalog import FINISHED, LOG, UNFINISHED, CatalogRow
from hearthlog.analyzer.logs.catalog.contents import Contents, read_contents
from hearthlog.analyzer.logs.catalog.file import table_of
from hearthlog.analyzer.logs.listing import catalogued_name, size_and_time
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.logs.files import log_name, log_of_layer
from hearthlog.schemas.logs.metadata import recorded_scenarios
from hearthlog.schemas.messages.topics import LIVE, RELABEL, REVIEW

_HOME = re.compile(r"(?:(.*?)/)?\d{4}/\d{2}/\d{2}/[^/]*", re.DOTALL)


def read_rows(folder: Path, names: Sequence[str]) -> pa.Table:
    """Make the rows of some files: the task of a worker."""
    paths = [folder.joinpath(*name.split("/")) for name in names]
    rows = [row for read in map_logs(partial(_read_row, folder), paths) for row in read]
    return table_of([vars(row) for row in rows])


def _read_row(folder: Path, path: Path) -> list[CatalogRow]:
    """Make the row of a file; none if the file has gone."""
    name = log_name(path)
    kind = name.layer.partition("-")[0]
    if kind not in {RELABEL, REVIEW}:  # sound is no labelling
        kind = LOG
    home = _HOME.fullmatch(_relative(path, folder))
    try:
        size, mtime = size_and_time(path)
    except LogError:
        return []
    row = CatalogRow(
        path=_relative(path, folder),
        home="" if home is None else home[1] or "",
        node=name.node or None,
        kind=kind,
        log=None if kind == LOG else _relative(log_of_layer(path), folder),
        size=size,
        mtime=mtime,
    )
    try:
        return [_filled(row, read_contents(path, LIVE if kind == LOG else kind))]
    except LogError as error:
        if not path.exists():  # a recorder has completed it, and given it another name
            return []
        return [replace(row, error=str(error).removeprefix(f"{path}: "))]


def _filled(row: CatalogRow, contents: Contents) -> CatalogRow:
    """Add what was found in a file to its row."""
    record = {name: value for name, value in contents.record.items() if value}
    start, end = contents.span or (None, None)
    first, last = contents.first or (None, None), contents.last or (None, None)
    return replace(
        row,
        node=record.get("node", row.node),
        state=FINISHED if contents.complete else UNFINISHED,
        microphones=contents.microphones,
        start=start,
        end=end,
        frames=contents.frames,
        first_frame=first[0],
        first_stamp=first[1],
        last_frame=last[0],
        last_stamp=last[1],
        feature_set=record.get("feature_set"),
        model=record.get("model"),
        model_sha256=record.get("model_sha256"),
        input_sha256=record.get("input_sha256"),
        version=record.get("version"),
        gaps=contents.gaps,
        gap_seconds=contents.gap_seconds,
        labels=list(_labels(contents, "")),
        scenarios=[
            {"scenario": scenario, "model": _model(record, scenario), **labelled}
            for scenario in sorted(contents.segments.keys() - {""})
            for labelled in _labels(contents, scenario)
        ],
    )


def _labels(contents: Contents, scenario: str) -> Iterator[dict[str, Any]]:
    for label, count in sorted(contents.segments.get(scenario, {}).items()):
        minutes = contents.seconds[scenario][label] / 60
        yield {"label": label, "minutes": minutes, "segments": count}


def _model(record: Mapping[str, str], scenario: str) -> str:
    """Name the models that labelled for a scenario, of which microphones may have different ones.

    Empty where a person did.
    """
    models = {one.model for one in recorded_scenarios(record) if one.name == scenario}
    return ", ".join(sorted(models))


def _relative(path: Path, folder: Path) -> str:
    return catalogued_name(path.relative_to(folder).as_posix())
