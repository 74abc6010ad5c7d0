"""The manifest of labelled clips: a CSV file beside the audio."""

import csv
import io
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from analyzer.errors import DataError
from models.modelfile import TEXT

REQUIRED = ("path", "label", "source_group")
OPTIONAL = ("source", "licence")
_SIZE_LIMIT = 64 << 20  # half a million clips; what is larger is something else


@dataclass(frozen=True)
class Clip:
    """One labelled recording.

    Attributes
    ----------
    path : Path
        The audio file; it existed when the manifest was read.
    label : str
    source_group : str
        The original recording or speaker: clips of one group are never split between folds.
    source, licence : str
        Collection it came from and the licence it gives; empty where the manifest is silent.
    """

    path: Path
    label: str
    source_group: str
    source: str
    licence: str


def read_manifest(path: Path, labels: Collection[str]) -> list[Clip]:
    """Read a manifest with the columns path, label, source_group and, optionally, source, licence.

    Parameters
    ----------
    path : Path
        CSV, UTF-8; the paths in it are relative to its folder. Other columns are ignored.
    labels : collection of str
        Labels that mean something; any other is an error.

    Raises
    ------
    DataError
        With file and line, if a column, a value or an audio file is missing, a label is unknown,
        a clip is listed twice, or the file is no CSV in UTF-8.
    """
    lines = _records(path, _read_text(path))
    first = next(lines, None)
    if first is None:
        raise DataError(f"{path}: is empty; it needs a first line that names the columns")
    number, header = first
    column = {name.strip(): position for position, name in enumerate(header)}
    missing = [name for name in REQUIRED if name not in column]
    if missing:
        raise DataError(f"{path}:{number}: no column {', '.join(missing)} in the first line")
    clips: list[Clip] = []
    seen: dict[Path, int] = {}
    for number, record in lines:
        where = f"{path}:{number}"
        clip = _clip(where, path.parent, column, record, labels)
        if clip.path in seen:
            raise DataError(f"{where}: {clip.path.name!r} is listed in line {seen[clip.path]} too")
        seen[clip.path] = number
        clips.append(clip)
    if not clips:
        raise DataError(f"{path}: lists no clips")
    return clips


def _read_text(path: Path) -> str:
    try:
        if not path.is_file():
            raise DataError(f"{path}: no such manifest")
        if path.stat().st_size > _SIZE_LIMIT:
            raise DataError(f"{path}: larger than {_SIZE_LIMIT >> 20} MB; this is no manifest")
        raw = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise DataError(f"{path}:{line}: is not UTF-8; save the manifest as UTF-8") from error


def _records(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the records that are not blank, each with the line it starts in."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    while True:
        line = reader.line_num + 1
        try:
            record = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise DataError(f"{path}:{line}: is not CSV ({error})") from error
        if any(field.strip() for field in record):
            yield line, record


def _clip(
    where: str, folder: Path, column: dict[str, int], record: list[str], labels: Collection[str]
) -> Clip:
    if len(record) <= max(column[name] for name in REQUIRED):
        raise DataError(f"{where}: has {len(record)} fields, the first line names {len(column)}")
    value = {
        name: record[column[name]].strip() if column.get(name, len(record)) < len(record) else ""
        for name in (*REQUIRED, *OPTIONAL)
    }
    for name in REQUIRED:
        if not value[name]:
            raise DataError(f"{where}: {name} is empty")
    for name in OPTIONAL:
        if not TEXT.fullmatch(value[name]):
            raise DataError(f"{where}: {name} must be one line of at most 300 characters")
    if value["label"] not in labels:
        known = ", ".join(sorted(labels))
        raise DataError(f"{where}: unknown label {value['label'][:64]!r}; known are {known}")
    audio = folder / value["path"]
    if not _is_file(audio):
        raise DataError(f"{where}: no such file: {value['path'][:256]!r}")
    return Clip(audio, value["label"], value["source_group"], value["source"], value["licence"])


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name too long for any file
        return False
