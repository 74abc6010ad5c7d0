"""The manifest of labelled clips: a CSV file beside the audio."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import csv_records, read_text
from hearthlog.models.classes import meant_by
from hearthlog.models.classifiers.description import TEXT

REQUIRED = ("path", "label", "source_group")
OPTIONAL = ("source", "licence", "start", "end")
SIZE_LIMIT = 64 << 20  # half a million clips; what is larger is something else


@dataclass(frozen=True)
class LabelledClip:
    """One labelled recording.

    Attributes
    ----------
    path : Path
        The audio file.
    label : str
    source_group : str
        The original recording or speaker; folds never split a group.
    source, licence : str
        Its collection and licence; empty where the manifest does not say.
    start, end : float
        The part of the file that the label is about, in seconds; `end` is infinite for the rest.
    """

    path: Path
    label: str
    source_group: str
    source: str
    licence: str
    start: float = 0.0
    end: float = math.inf


def read_manifest(path: Path, labels: Collection[str]) -> list[LabelledClip]:
    """Read a manifest with the columns path, label, source_group.

    Parameters
    ----------
    path : Path
        CSV, UTF-8; the paths in it are relative to its folder. It may have the columns source,
        licence, start and end, too; others are ignored.
    labels : collection of str
        Allowed labels; other names of the same sounds (`hearthlog.models.classes`) are allowed too.

    Returns
    -------
    list of LabelledClip
        In the order of the file; at least one.

    Raises
    ------
    DataError
        With file and line, if a column, a value or an audio file is missing, a label is unknown,
        a start and an end are no part of a file, or the same clip, or part of it, is listed twice;
        if the file lists no clip, or is no CSV in UTF-8; if it cannot be read, or is larger than
        64 MiB.
    """
    lines = csv_records(path, read_text(path, "manifest", SIZE_LIMIT))
    first = next(lines, None)
    if first is None:
        raise DataError(f"{path}: is empty; it needs a first line that names the columns")
    number, header = first
    column = {name.strip(): position for position, name in enumerate(header)}
    missing = [name for name in REQUIRED if name not in column]
    if missing:
        raise DataError(f"{path}:{number}: no column {', '.join(missing)} in the first line")
    clips: list[LabelledClip] = []
    seen: dict[tuple[Path, float, float], int] = {}
    for number, record in lines:
        where = f"{path}:{number}"
        clip = _clip(where, path.parent, column, record, labels)
        span = clip.path, clip.start, clip.end
        if span in seen:
            raise DataError(f"{where}: {clip.path.name!r} is listed in line {seen[span]} too")
        seen[span] = number
        clips.append(clip)
    if not clips:
        raise DataError(f"{path}: lists no clips")
    return clips


def _clip(
    where: str, folder: Path, column: dict[str, int], record: list[str], labels: Collection[str]
) -> LabelledClip:
    if len(record) <= max(column[name] for name in REQUIRED):
        raise DataError(f"{where}: has {len(record)} fields, the first line names {len(column)}")
    value = {
        name: record[column[name]].strip() if column.get(name, len(record)) < len(record) else ""
        for name in (*REQUIRED, *OPTIONAL)
    }
    for name in REQUIRED:
        if not value[name]:
            raise DataError(f"{where}: {name} is empty")
    for name in ("source", "licence"):
        if not TEXT.fullmatch(value[name]):
            raise DataError(f"{where}: {name} must be one line of at most 300 characters")
    if not meant_by(value["label"], labels):
        names = ", ".join(sorted(labels))
        raise DataError(f"{where}: unknown label {value['label'][:64]!r}; known are {names}")
    audio = folder / value["path"]
    if not _is_file(audio):
        raise DataError(f"{where}: no such file: {value['path'][:256]!r}")
    return LabelledClip(
        audio,
        value["label"],
        value["source_group"],
        value["source"],
        value["licence"],
        *_span(where, value["start"], value["end"]),
    )


def _span(where: str, start: str, end: str) -> tuple[float, float]:
    try:
        span = float(start or 0), float(end or math.inf)
    except ValueError:
        span = math.nan, math.nan
    if not 0 <= span[0] < span[1]:
        raise DataError(
            f"{where}: start {start[:32]!r} and end {end[:32]!r} are no part of a file; give "
            "seconds, the start before the end"
        )
    return span


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name too long for any file
        return False
