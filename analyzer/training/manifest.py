"""The manifest of labelled clips: a CSV file beside the audio."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import csv_records, read_text, without_disarming
from hearthlog.models.classes import meant_by
from hearthlog.models.classifiers.model import TEXT

REQUIRED = ("path", "label", "source_group")
OPTIONAL = ("source", "licence", "start", "end")
_NAMED = 3  # of those that are left out
SIZE_LIMIT = 64 << 20  # half a million clips; what is larger is something else


@dataclass(frozen=True)
class LabelledClip:
    """One labelled recording.

    Attributes
    ----------
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


class LeftOut(NamedTuple):
    """A clip that nothing is learned from.

    Attributes
    ----------
    reason : str
        Why; the same for clips of one kind.
    clip : str
        Which one, and more about it.
    """

    reason: str
    clip: str


def left_out_lines(left_out: Sequence[LeftOut]) -> list[str]:
    """Say how many clips were left out, and which first, in a line for each reason.

    Parameters
    ----------
    left_out : sequence of LeftOut
    """
    by_reason: dict[str, list[str]] = {}
    for reason, clip in left_out:
        by_reason.setdefault(reason, []).append(clip)
    lines = []
    for reason, clips in by_reason.items():
        first = "; ".join(clips[:_NAMED])
        more = f"; and {len(clips) - _NAMED:,} more" if len(clips) > _NAMED else ""
        lines.append(f"left out: {len(clips):,}, {reason}: {first}{more}")
    return lines


def example_of(left_out: Sequence[LeftOut]) -> str:
    """Name the first clip that was left out, behind the reasons; empty if there is none."""
    return f", such as {left_out[0].clip}" if left_out else ""


class _RowError(DataError):
    """One line of a manifest is of no use."""

    def __init__(self, where: str, reason: str, detail: str, shown: str = "") -> None:
        super().__init__(f"{where}: {detail}")
        self.left_out = LeftOut(reason, f"{where}: {shown or detail}")


def read_manifest(
    path: Path, labels: Collection[str], left_out: list[LeftOut] | None = None
) -> list[LabelledClip]:
    """Read a manifest with the columns path, label, source_group.

    Parameters
    ----------
    path : Path
        CSV, UTF-8; the paths in it are relative to its folder. It may have the columns source,
        licence, start and end, too; others are ignored.
    labels : collection of str
        Allowed labels; other names of the same sounds (`hearthlog.models.classes`) are allowed too.
    left_out : list of LeftOut, optional
        Takes lines that are of no use, which raise an error without it.

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
        try:
            clip = _clip(where, path.parent, column, record, labels)
            _check_new(where, clip, seen, number)
        except _RowError as error:
            if left_out is None:
                raise
            left_out.append(error.left_out)
            continue
        clips.append(clip)
    if not clips and left_out:
        raise DataError(f"{path}: lists no clip that can be used; of its first, {left_out[0].clip}")
    if not clips:
        raise DataError(f"{path}: lists no clips")
    return clips


def _check_new(
    where: str, clip: LabelledClip, seen: dict[tuple[Path, float, float], int], number: int
) -> None:
    """Refuse a part of a file that another line lists."""
    first = seen.setdefault((clip.path, clip.start, clip.end), number)
    if first != number:
        raise _RowError(where, "listed twice", f"{clip.path.name!r} is listed in line {first} too")


def _clip(
    where: str, folder: Path, column: dict[str, int], record: list[str], labels: Collection[str]
) -> LabelledClip:
    if len(record) <= max(column[name] for name in REQUIRED):
        detail = f"has {len(record)} fields, the first line names {len(column)}"
        raise _RowError(where, "a line that is not complete", detail)
    value = {
        name: without_disarming(record[column[name]].strip())
        if column.get(name, len(record)) < len(record)
        else ""
        for name in (*REQUIRED, *OPTIONAL)
    }
    for name in REQUIRED:
        if not value[name]:
            raise _RowError(where, f"no {name}", f"{name} is empty")
    for name in ("source", "licence"):
        if not TEXT.fullmatch(value[name]):
            detail = f"{name} must be one line of at most 300 characters"
            raise _RowError(where, f"no {name} that can be kept", detail)
    if not meant_by(value["label"], labels):
        names = ", ".join(sorted(labels))
        shown = repr(value["label"][:64])
        detail = f"unknown label {shown}; known are {names}"
        raise _RowError(where, "a label that the scenario does not know", detail, shown)
    audio = folder / value["path"]
    if not _is_file(audio):
        shown = repr(value["path"][:256])
        raise _RowError(where, "no such file", f"no such file: {shown}", shown)
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
        detail = (
            f"start {start[:32]!r} and end {end[:32]!r} are no part of a file; give seconds, the "
            "start before the end"
        )
        raise _RowError(where, "no part of a file", detail)
    return span


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name too long for any file
        return False
