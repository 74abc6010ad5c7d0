"""Summaries of the groups and voices of a home, and the file of groups for pages."""

import json
from collections.abc import Mapping
from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from hearthlog.analyzer.discover import (
    HOURS,
    MOST_CLUSTERS,
    MOST_NUMBER,
    ClusterId,
    ClusterName,
    Occurrences,
    StrictModel,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import printable, shortened
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.frames import NANOSECONDS, read_time, time_text
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.new_files import replaced_file

if TYPE_CHECKING:  # the page of the home reads summaries, and needs nothing that makes them
    from hearthlog.analyzer.discover.groups import Groups
    from hearthlog.analyzer.discover.sounds import HomeSounds
    from hearthlog.analyzer.discover.speech import HomeSpeech
    from hearthlog.analyzer.discover.voices import HomeVoices

SUMMARY: Final = "groups.safetensors.json"  # in a folder of logs, next to the groups file
MOST_LABELS, MOST_MICROPHONES = 8, 64  # per group
LONGEST_TEXT = 200  # characters
_FORMAT: Final = 1
_LARGEST = 4 << 20  # bytes
_LATEST = (1 << 32) * NANOSECONDS  # beyond the range of message times


def _is_time(text: str) -> str:
    if abs(read_time(text)) > _LATEST:
        raise ValueError("no time of a log")
    return text


_Count = Annotated[int, Field(ge=0, le=MOST_NUMBER)]
_Text = Annotated[str, Field(max_length=LONGEST_TEXT)]
_Time = Annotated[str, Field(max_length=40), AfterValidator(_is_time)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Example(StrictModel):
    """Example of a group or voice; times in ISO 8601, UTC."""

    log: Annotated[str, Field(max_length=4096)]
    microphone: _Text
    start: _Time
    end: _Time


class GroupSummary(StrictModel):
    """Summary of a group of similar sounds."""

    number: Annotated[int, Field(ge=1, le=MOST_NUMBER)]
    name: ClusterName  # class assigned by a person; empty if unnamed
    times: Annotated[int, Field(ge=1, le=MOST_NUMBER)]
    days: Annotated[int, Field(ge=1, le=MOST_NUMBER)]  # local days with such sounds
    # sounds that began in each local hour of the day
    hours: Annotated[list[_Count], Field(min_length=HOURS, max_length=HOURS)]
    seconds: Annotated[float, Field(ge=0.0, le=1e6)]
    alike: _Share  # similarity: 0, as different as any sounds of the home; 1, identical
    # shares of the most frequent labels, most frequent first
    labels: Annotated[dict[_Text, _Share], Field(max_length=MOST_LABELS)]
    microphones: Annotated[list[_Text], Field(max_length=MOST_MICROPHONES)]
    examples: Annotated[list[Example], Field(min_length=1, max_length=3)]


class VoiceSummary(StrictModel):
    """Summary of a voice."""

    number: int
    name: str  # assigned by a person; empty if unnamed
    minutes: float
    turns: int
    days: int  # local days with this voice
    hours: list[int]  # turns that began in each local hour of the day
    examples: list[Example]


class GroupsSummary(StrictModel):
    """Groups of a home from the last run, largest first."""

    format: Annotated[int, Field(ge=1, le=_FORMAT)] = _FORMAT
    id: ClusterId
    sounds: _Count
    timezone: _Text
    groups_file: Annotated[str, Field(max_length=4096)]
    groups: Annotated[list[GroupSummary], Field(max_length=MOST_CLUSTERS)]

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


_SHOWN = 3


def summarise(
    sounds: "HomeSounds", groups: "Groups", of: Int64, points: Float64, zone: tzinfo
) -> list[GroupSummary]:
    """Summarise the groups of some sounds, largest first."""
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1) if len(points) else [0.0]
    apart = float(np.median(distances))
    found = []
    for row, number in enumerate(groups.numbers.tolist()):
        rows = np.flatnonzero(of == row)
        if not len(rows):
            continue
        days, hours = sounds.days_and_hours(rows, zone)
        labels, counts = np.unique(sounds.labels[rows], return_counts=True)
        order = np.argsort(-counts, kind="stable")[:MOST_LABELS]
        away = np.linalg.norm(points[rows] - np.median(points[rows], axis=0), axis=1)
        seconds = np.median(sounds.ends[rows] - sounds.starts[rows]) / NANOSECONDS
        names = sorted({sounds.microphones[i] for i in sounds.microphone[rows]})
        summary = GroupSummary(
            number=number,
            name=groups.names[row],
            times=len(rows),
            days=days,
            hours=hours,
            seconds=float(seconds),
            alike=max(1.0 - float(np.median(away)) / apart, 0.0) if apart else 1.0,
            labels={
                shortened(str(labels[i]), LONGEST_TEXT): float(counts[i]) / len(rows) for i in order
            },
            microphones=[shortened(each, LONGEST_TEXT) for each in names[:MOST_MICROPHONES]],
            examples=_examples(sounds, rows[np.argsort(away, kind="stable")]),
        )
        found.append(summary)
    return sorted(found, key=lambda each: (-each.times, each.number))


def summarise_voices(
    speech: "HomeSpeech", voices: "HomeVoices", of: Int64, zone: tzinfo
) -> list[VoiceSummary]:
    """Summarise the voices that speak, most speech first; `of` is from `find_voices`."""
    found = []
    for row, number in enumerate(voices.numbers.tolist()):
        rows = np.flatnonzero(of[speech.voice] == row)
        if not len(rows):
            continue
        days, hours = speech.days_and_hours(rows, zone)
        seconds = (speech.ends - speech.starts)[rows] / NANOSECONDS
        summary = VoiceSummary(
            number=number,
            name=voices.names[row],
            minutes=float(seconds.sum()) / 60.0,
            turns=len(rows),
            days=days,
            hours=hours,
            examples=_examples(speech, speech.longest(rows)),
        )
        found.append(summary)
    return sorted(found, key=lambda each: (-each.minutes, each.number))


def _examples(occurrences: Occurrences, rows: Int64) -> list[Example]:
    """Return the first of some occurrences."""
    return [
        Example(
            log=printable(occurrences.logs[occurrences.log[row]]),
            microphone=shortened(
                occurrences.microphones[occurrences.microphone[row]], LONGEST_TEXT
            ),
            start=time_text(int(occurrences.starts[row])),
            end=time_text(int(occurrences.ends[row])),
        )
        for row in rows[:_SHOWN]
    ]


_USUAL = 0.8  # share of the sounds within the busiest hours


def busiest_hours(hours: list[int]) -> str:
    """Return the shortest span of the day with four fifths of the sounds, such as `07 to 09`.

    `hours` count the sounds that began in each hour. Empty if the span exceeds half a day.
    """
    twice = np.cumsum([0, *hours, *hours])
    for length in range(1, HOURS // 2 + 1):
        sums = twice[length : length + HOURS] - twice[:HOURS]
        if sums.max() >= _USUAL * sum(hours):
            first = int(sums.argmax())
            return f"{first:02d} to {(first + length) % HOURS:02d}"
    return ""
