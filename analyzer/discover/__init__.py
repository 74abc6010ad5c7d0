"""Recurring sounds and voices of a home: their clusters, files, occurrences and summaries."""

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Generic, NamedTuple, Self, TypeVar

import numpy as np
import safetensors
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
)

from hearthlog.analyzer.errors import DataError, collect_errors
from hearthlog.analyzer.logs.home_logs import HomeLog
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.logs.spans import Timed
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.arrays import Float64, Int64, read_sealed, write_sealed
from hearthlog.schemas.errors import LogError, Progress, printable, shortened
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.frames import NANOSECONDS, read_time, time_text
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.new_files import open_lock, replaced_file

if TYPE_CHECKING:  # the page of the home reads summaries, and needs nothing that makes them
    from hearthlog.analyzer.discover.groups import Groups
    from hearthlog.analyzer.discover.sounds import HomeSounds
    from hearthlog.analyzer.discover.speech import HomeSpeech
    from hearthlog.analyzer.discover.voices import HomeVoices

NO_CLUSTER = -1
MOST_CLUSTERS = 1_000  # per file
HOURS = 24
_LARGEST_HEADER = 1 << 20  # bytes
_LEAST_NUMBER, MOST_NUMBER = 1, (1 << 31) - 1

ClusterId = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8}$")]
ClusterName = Annotated[str, StringConstraints(pattern=rf"^({CLASS_NAME.pattern})?$")]
ClusterNames = Annotated[list[ClusterName], Field(max_length=MOST_CLUSTERS)]


class StrictModel(BaseModel):
    """A part of a file that may come from elsewhere."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


_Header = TypeVar("_Header", bound=BaseModel)


@dataclass(frozen=True)
class ClusterKind(Generic[_Header]):
    """A kind of cluster: groups of sounds, or voices."""

    noun: str  # for messages, such as `group`
    verb: str  # the command that finds them
    example: str  # a name of one for messages, as `3=doorbell`
    header: type[_Header]  # of their file
    largest: int  # limit of the file in bytes

    @property
    def plural(self) -> str:
        """The noun for several; also the option of their file."""
        return f"{self.noun}s"

    @property
    def file(self) -> str:
        """Name of their file in a folder of logs."""
        return f"{self.plural}.safetensors"

    def write(self, path: Path, arrays: Mapping[str, NDArray[Any]], header: _Header) -> None:
        """Write a file, replacing an existing one of other content.

        Raise `LogError` if it cannot be written.
        """
        contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        text = header.model_dump_json(exclude_none=True)
        data = write_sealed(contiguous, f"hearthlog_{self.plural}", text)
        if not _has_content(path, data):
            with replaced_file(path, readers=log_readers(path.parent)) as temporary:
                temporary.write_bytes(data)

    def read(self, path: Path) -> tuple[dict[str, NDArray[Any]], _Header] | None:
        """Read a file; None if it does not exist.

        Raise `DataError` if it is no such file, is too large, or damaged.
        """
        if not path.exists():
            return None
        data = read_limited(path, f"file of {self.plural}", self.largest, DataError)
        if int.from_bytes(data[:8], "little") > _LARGEST_HEADER:
            raise DataError(f"{path}: is no file of {self.plural} (its header is too large)")
        try:
            arrays, text, damaged = read_sealed(path, data, f"hearthlog_{self.plural}")
            header = self.header.model_validate_json(text)
        except (safetensors.SafetensorError, KeyError, ValidationError) as error:
            raise DataError(
                f"{path}: is no file of {self.plural} of this version of hearthlog; if a later one "
                "wrote it, update hearthlog"
            ) from error
        if damaged:
            raise DataError(damaged)
        return arrays, header


def _has_content(path: Path, data: bytes) -> bool:
    try:
        return path.stat().st_size == len(data) and path.read_bytes() == data
    except OSError:
        return False


@contextmanager
def locked_file(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on a file of clusters.

    Raise `DataError` if its folder cannot be written.
    """
    lock_file = path.with_name(f".{path.name}.lock")
    try:
        lock = os.fdopen(open_lock(lock_file), "rb")
    except OSError as error:
        raise DataError(f"{lock_file}: cannot be written ({error.strerror})") from error
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def are_numbers(numbers: NDArray[Any], names: Sequence[str]) -> bool:
    """Return whether an array from a file can hold the numbers of clusters with these names."""
    return bool(
        numbers.shape == (len(names),)
        and len(np.unique(numbers)) == len(numbers)
        and ((numbers >= _LEAST_NUMBER) & (numbers <= MOST_NUMBER)).all()
    )


@dataclass(frozen=True)
class Clusters:
    """Groups or voices of a home."""

    numbers: Int64  # [shape=(g,)]; never reused
    # assigned by a person; empty if unnamed
    names: list[str] = field(default_factory=list, kw_only=True)
    id: str = field(default="", kw_only=True)  # unique; identifies the file that a mark refers to

    def named(self, names: Mapping[int, str]) -> Self:
        """Return a copy with other names, by number."""
        pairs = zip(self.numbers.tolist(), self.names, strict=True)
        return replace(self, names=[names.get(number, name) for number, name in pairs])

    def with_new(self, count: int, **changes: Any) -> Self:
        """Return a copy with new unnamed clusters."""
        first = self.numbers.max(initial=0) + 1
        numbers = np.append(self.numbers, np.arange(first, first + count))
        return replace(self, numbers=numbers, names=[*self.names, *[""] * count], **changes)

    def identified(self, arrays: Iterable[NDArray[Any]]) -> Self:
        """Return a copy with the id of arrays; equal ids mean equal clusters."""
        digest = hashlib.sha256(b"".join(each.tobytes() for each in arrays)).hexdigest()
        return replace(self, id=digest[:8])

    def texts(self, kind: ClusterKind[Any]) -> list[str]:
        """Return the name of each cluster, or `group 3`."""
        pairs = zip(self.names, self.numbers.tolist(), strict=True)
        return [name or f"{kind.noun} {number}" for name, number in pairs]


class NamedSpans(NamedTuple):
    """Spans of time with the names of clusters, in time order."""

    starts: Int64  # [shape=(n,)], in nanoseconds of UTC
    ends: Int64  # likewise
    texts: NDArray[np.object_]  # [shape=(n,)] of str


@dataclass(frozen=True)
class Occurrences:
    """Sounds or turns of speech of a home, in the order of logs, and by time within a log."""

    logs: list[Path]  # one for each microphone in it
    microphones: list[str]
    log: Int64  # [shape=(n,)]; index into `logs`
    microphone: Int64  # [shape=(n,)]; index into `microphones`
    starts: Int64  # [shape=(n,)], in nanoseconds of UTC
    ends: Int64  # likewise
    losses: list[str]
    without: int  # number of logs without what is to be found

    def spans(self, of: Int64, texts: Sequence[str]) -> dict[str, NamedSpans]:
        """Return the spans of each microphone; `of` is the row of `texts`, or `NO_CLUSTER`."""
        order, names = np.argsort(self.starts, kind="stable"), np.array(texts, object)
        found = {}
        for place, microphone in enumerate(self.microphones):
            rows = order[(self.microphone[order] == place) & (of[order] != NO_CLUSTER)]
            found[microphone] = NamedSpans(self.starts[rows], self.ends[rows], names[of[rows]])
        return found

    def days_and_hours(self, rows: Int64, zone: tzinfo) -> tuple[int, list[int]]:
        """Return the number of local days of some occurrences, and how many began in each hour."""
        moments = [local_time(start, zone) for start in self.starts[rows].tolist()]
        hours = np.bincount([moment.hour for moment in moments], minlength=HOURS)
        return len({moment.date() for moment in moments}), hours.tolist()


def places(parts: Sequence[tuple[Path, str, Timed]]) -> tuple[list[Path], list[str], Int64, Int64]:
    """Return `logs`, `microphones`, `log` and `microphone` of `Occurrences`.

    Each part is of one log and microphone.
    """
    microphones = list(dict.fromkeys(name for _, name, _ in parts))
    counts = np.array([len(spans.starts) for _, _, spans in parts], np.int64)
    of_microphone = np.array([microphones.index(name) for _, name, _ in parts], np.int64)
    log = np.repeat(np.arange(len(parts)), counts)
    return [log for log, _, _ in parts], microphones, log, of_microphone[log]


def read_each(
    entries: Sequence[HomeLog],
    read: Callable[[HomeLog], None],
    losses: list[str],
    progress: Progress,
) -> None:
    """Read logs one by one, and add the errors of those that cannot be read to the losses."""
    for number, entry in enumerate(entries, 1):
        with collect_errors(losses, LogError):
            read(entry)
        progress(number / len(entries))


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
