"""The parts of a catalogue on the disk or in a store: a Parquet file for each home."""

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import pyarrow as pa
import pyarrow.compute as pc

from hearthlog.analyzer.logs.catalog.file import read_table, write_table
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local, map_logs, store_errors
from hearthlog.schemas.logs.files import CATALOG, log_readers
from hearthlog.schemas.new_files import private_folder, replaced_file

_SUFFIX = ".parquet"
_LONGEST = 150  # bytes of a home's name in that of its part


class Parts(NamedTuple):
    """What there is of a catalogue."""

    tables: dict[str, pa.Table]  # by the name of the part
    unusable: list[str]  # what is wrong with other parts


def part_of(home: str) -> str:
    """Name the part of a home."""
    name = quote(home, safe="")  # which is never hidden from pyarrow by how it begins
    if len(name) > _LONGEST:
        name = f"{name[:_LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return f"home-{name}{_SUFFIX}"


def read_parts(folder: Path) -> Parts | None:
    """Read the catalogue of a folder; None if there is none.

    An older catalogue, which is one file, is one part.

    Raise `LogError` if the folder cannot be looked into.
    """
    catalog = folder / CATALOG
    with store_errors(catalog):
        older = catalog.is_file()
        paths = [catalog] if older else [catalog / name for name in _names(catalog)]
    if not paths:
        return None
    parts = Parts({}, [])
    for path, read in zip(paths, map_logs(_read, paths), strict=True):
        if isinstance(read, str):
            parts.unusable.append(f"{path}: cannot be used as a catalogue ({read})")
        else:
            parts.tables[path.name] = read
    return parts


def _read(path: Path) -> pa.Table | str:
    try:
        with path.open("rb") as stream:
            return read_table(stream)
    except (pa.ArrowException, OSError, ValueError) as error:
        return str(error).partition("\n")[0]


def write_parts(
    folder: Path, parts: Mapping[str, pa.Table], before: Mapping[str, pa.Table]
) -> None:
    """Write the parts of the catalogue of a folder that are not there yet, each in one step.

    Raise `LogError` if the catalogue cannot be written, or is a link.
    """
    catalog = folder / CATALOG
    if is_local(catalog) and catalog.is_symlink():
        raise LogError(f"{catalog}: is a link, and what it leads to is not hearthlog's: delete it")
    with store_errors(catalog):
        if catalog.is_file():  # an older one
            catalog.unlink()
        if is_local(catalog):
            private_folder(catalog, readers=log_readers(folder))
        there = set(_names(catalog))
        for gone in there - parts.keys():
            (catalog / gone).unlink(missing_ok=True)
    for name, table in parts.items():
        if name not in there or table != before.get(name):
            put = replaced_file(catalog / name, readers=log_readers(folder))
            with put as temporary, temporary.open("wb") as stream:
                write_table(table, stream)


def _names(catalog: Path) -> list[str]:
    if not catalog.is_dir():  # a store has no empty folders
        return []
    return sorted(part.name for part in catalog.iterdir() if part.name.endswith(_SUFFIX))


def divided(table: pa.Table) -> Iterator[tuple[str, pa.Table]]:
    """Divide rows by their homes."""
    ordered = table.sort_by([("home", "ascending"), ("path", "ascending")])
    first = 0
    runs = pc.run_end_encode(ordered["home"].combine_chunks())
    for home, end in zip(runs.values.to_pylist(), runs.run_ends.to_pylist(), strict=True):
        yield part_of(home), ordered.slice(first, end - first)
        first = end
