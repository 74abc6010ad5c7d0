"""Summaries of the groups of a home, and their file for pages."""

import json
from collections.abc import Mapping
from datetime import date, tzinfo
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from hearthlog.analyzer.discover.groups import Groups
from hearthlog.analyzer.discover.sounds import HomeSounds
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import printable, shortened
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.frames import NANOSECONDS, read_time, time_text
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.new_files import replaced_file

SUMMARY: Final = "groups.safetensors.json"  # in a folder of logs, next to the groups file
MOST_GROUPS = 1_000  # per file
MOST_LABELS, MOST_MICROPHONES = 8, 64  # per group
LONGEST_TEXT = 200  # characters
_FORMAT: Final = 1
_LARGEST = 4 << 20  # bytes
_MOST_COUNT = (1 << 31) - 1
_LATEST = (1 << 32) * NANOSECONDS  # beyond the range of message times


def _is_time(text: str) -> str:
    if abs(read_time(text)) > _LATEST:
        raise ValueError("no time of a log")
    return text


_Count = Annotated[int, Field(ge=0, le=_MOST_COUNT)]
_Text = Annotated[str, Field(max_length=LONGEST_TEXT)]
_Time = Annotated[str, Field(max_length=40), AfterValidator(_is_time)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Example(_Part):
    """Example sound of a group; times in ISO 8601, UTC."""

    log: Annotated[str, Field(max_length=4096)]
    microphone: _Text
    start: _Time
    end: _Time


class GroupSummary(_Part):
    """Summary of a group of similar sounds.

    Attributes
    ----------
    name : str
        Class assigned by a person; empty if unnamed.
    days : int
        Number of local days with such sounds.
    hours : list of int
        Number of sounds that began in each local hour of the day.
    alike : float
        Similarity: 0, as different as any sounds of the home; 1, identical.
    labels : dict of str to float
        Share of each of the most frequent labels, most frequent first.
    """

    number: Annotated[int, Field(ge=1, le=_MOST_COUNT)]
    name: Annotated[str, Field(pattern=rf"^({CLASS_NAME.pattern})?$")]
    times: Annotated[int, Field(ge=1, le=_MOST_COUNT)]
    days: Annotated[int, Field(ge=1, le=_MOST_COUNT)]
    hours: Annotated[list[_Count], Field(min_length=24, max_length=24)]
    seconds: Annotated[float, Field(ge=0.0, le=1e6)]
    alike: _Share
    labels: Annotated[dict[_Text, _Share], Field(max_length=MOST_LABELS)]
    microphones: Annotated[list[_Text], Field(max_length=MOST_MICROPHONES)]
    examples: Annotated[list[Example], Field(min_length=1, max_length=3)]


class GroupsSummary(_Part):
    """Groups of a home from the last run, largest first."""

    format: Annotated[int, Field(ge=1, le=_FORMAT)] = _FORMAT
    id: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")]
    sounds: _Count
    timezone: _Text
    groups_file: Annotated[str, Field(max_length=4096)]
    groups: Annotated[list[GroupSummary], Field(max_length=MOST_GROUPS)]

    def named(self, names: Mapping[int, str]) -> "GroupsSummary":
        """Return a copy with other group names, by number."""
        groups = [
            each.model_copy(update={"name": names.get(each.number, each.name)})
            for each in self.groups
        ]
        return self.model_copy(update={"groups": groups})


def summary_path(groups_file: Path) -> Path:
    """Return the path of a groups file's summary; `SUMMARY` for `groups.safetensors`."""
    return groups_file.with_name(f"{groups_file.name}.json")


def save_summary(summary: GroupsSummary, path: Path) -> None:
    """Write a summary, replacing an existing one.

    Raise `LogError` if it cannot be written.
    """
    with replaced_file(path, readers=log_readers(path.parent)) as temporary:
        temporary.write_text(f"{json.dumps(summary.model_dump(), allow_nan=False)}\n", "utf-8")


def load_summary(path: Path) -> GroupsSummary:
    """Read a summary.

    Raise `DataError` if it is missing, not a summary, or damaged.
    """
    if not path.exists():
        raise DataError(f"{path}: no such summary of groups; `hearthlog discover` writes it")
    data = read_limited(path, "summary of groups", _LARGEST, DataError)
    try:
        return GroupsSummary.model_validate_json(data)
    except ValidationError as error:
        raise DataError(
            f"{path}: is no summary of groups; `hearthlog discover` writes it anew"
        ) from error


_HOURS = 24
_SHOWN = 3


def summarise(
    sounds: HomeSounds, groups: Groups, of: Int64, points: Float64, zone: tzinfo
) -> list[GroupSummary]:
    """Summarise the groups of some sounds, largest first."""
    apart = _typical_distance(points)
    found = []
    for row, number in enumerate(groups.numbers.tolist()):
        rows = np.flatnonzero(of == row)
        if len(rows):
            found.append(_summary(sounds, groups.names[row], number, rows, points, apart, zone))
    return sorted(found, key=lambda each: (-each.times, each.number))


def _summary(  # noqa: PLR0913, PLR0917
    sounds: HomeSounds,
    name: str,
    number: int,
    rows: Int64,
    points: Float64,
    apart: float,
    zone: tzinfo,
) -> GroupSummary:
    spans = sounds.spans
    moments = [local_time(start, zone) for start in spans.starts[rows].tolist()]
    days: set[date] = {moment.date() for moment in moments}
    hours = np.bincount([moment.hour for moment in moments], minlength=_HOURS)
    labels, counts = np.unique(spans.labels[rows], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    away = np.linalg.norm(points[rows] - np.median(points[rows], axis=0), axis=1)
    seconds = np.median(spans.ends[rows] - spans.starts[rows]) / NANOSECONDS
    middle = rows[np.argsort(away, kind="stable")[:_SHOWN]]
    names = {sounds.microphones[i] for i in sounds.microphone[rows]}
    return GroupSummary(
        number=number,
        name=name,
        times=len(rows),
        days=len(days),
        hours=hours.tolist(),
        seconds=float(seconds),
        alike=max(1.0 - float(np.median(away)) / apart, 0.0) if apart else 1.0,
        labels={
            shortened(str(labels[i]), LONGEST_TEXT): float(counts[i]) / len(rows)
            for i in order[:MOST_LABELS]
        },
        microphones=[shortened(each, LONGEST_TEXT) for each in sorted(names)[:MOST_MICROPHONES]],
        examples=[_example(sounds, row) for row in middle.tolist()],
    )


def _example(sounds: HomeSounds, row: int) -> Example:
    spans = sounds.spans
    return Example(
        log=printable(sounds.logs[sounds.log[row]]),
        microphone=shortened(sounds.microphones[sounds.microphone[row]], LONGEST_TEXT),
        start=time_text(int(spans.starts[row])),
        end=time_text(int(spans.ends[row])),
    )


def _typical_distance(points: Float64) -> float:
    if not len(points):
        return 0.0
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


_USUAL = 0.8  # share of the sounds within the busiest hours


def busiest_hours(hours: list[int]) -> str:
    """Return the shortest span of the day with four fifths of the sounds, such as `07 to 09`.

    Parameters
    ----------
    hours : list of int
        Number of sounds that began in each hour of the day.

    Returns
    -------
    str
        Empty if the span exceeds half a day.
    """
    twice = np.cumsum([0, *hours, *hours])
    for length in range(1, _HOURS // 2 + 1):
        sums = twice[length : length + _HOURS] - twice[:_HOURS]
        if sums.max() >= _USUAL * sum(hours):
            first = int(sums.argmax())
            return f"{first:02d} to {(first + length) % _HOURS:02d}"
    return ""
