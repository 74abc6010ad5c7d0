"""Files of a collection: tables, JSON, and audio found by its name."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import csv_records, read_text
from hearthlog.recorder.sources.audio_files import files_below
from hearthlog.recorder.sources.open_audio import is_audio
from hearthlog.schemas.files import read_whole

_TABLE_LIMIT = 128 << 20  # the largest, of AudioSet, has 50 MB
_JSON_LIMIT = 256 << 20


def read_table(
    path: Path, columns: Sequence[str], delimiter: str = ","
) -> Iterator[tuple[str, list[str]]]:
    """Yield some columns of a table whose first line names them.

    Parameters
    ----------
    delimiter : str
        Between fields.

    Raises
    ------
    DataError
        If the file cannot be read, is larger than 128 MB, is no such table, lacks one of the
        columns, or has a line that ends before them.
    """
    lines = csv_records(path, read_text(path, "table", _TABLE_LIMIT), delimiter)
    number, header = next(lines, (1, []))
    names = [name.strip() for name in header]
    missing = [name for name in columns if name not in names]
    if missing:
        raise DataError(
            f"{path}:{number}: no column {', '.join(missing)} in the first line; is this another "
            "version of the collection?"
        )
    places = [names.index(name) for name in columns]
    for number, record in lines:
        where = f"{path}:{number}"
        if len(record) <= max(places):
            raise DataError(f"{where}: has {len(record)} fields, the first line names {len(names)}")
        yield where, [record[place].strip() for place in places]


def read_json(path: Path) -> dict[str, object]:
    """Read an object of JSON.

    Raise `DataError` if the file cannot be read, is larger than 256 MB, or is no object of
    JSON.
    """
    try:
        content = json.loads(read_whole(path, "file of the collection", _JSON_LIMIT, DataError))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is not JSON ({str(error)[:100]})") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds no object of JSON")
    return content


def inside(where: str, folder: Path, name: str) -> Path:
    """Return the path of a file that a table names.

    Raise `DataError` if the name leads out of the folder, or none can be called so.
    """
    pure = PurePosixPath(name)
    if not name or pure.is_absolute() or ".." in pure.parts or "\0" in name:
        raise DataError(f"{where}: {name[:64]!r} is no name of a file of the collection")
    return folder / pure


def audio_by_name(folder: Path) -> dict[str, Path]:
    """Find audio files by their names, wherever they are in a folder."""
    found: dict[str, Path] = {}
    for path in files_below(folder):
        if is_audio(path.name):
            found.setdefault(path.name, path)
    return found


def seconds(where: str, *texts: str) -> list[float]:
    """Read times in seconds.

    Raise `DataError` if one is no number from 0 to 1e9.
    """
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = []
    if len(values) < len(texts) or not all(0 <= value <= 1e9 for value in values):
        shown = ", ".join(repr(text[:32]) for text in texts)
        raise DataError(f"{where}: {shown}: a time is not in seconds")
    return values
