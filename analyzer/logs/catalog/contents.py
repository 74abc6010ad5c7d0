"""What one log holds, found with as little reading as will do: features are not decoded."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.labelling import MOST_CLASSES
from hearthlog.analyzer.logs.typed_columns import decode_types, is_compatible
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.logs.metadata import read_provenance
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    SCENARIO,
    microphone_of,
    parse_topic,
    scenario_name,
)

_FEATURES: dict[str, Sequence[str]] = {message_types.FEATURES: ("header.stamp", "frame")}
_EVENTS: dict[str, Sequence[str]] = {
    message_types.SEGMENT: ("duration", "label"),
    message_types.GAP: ("duration",),
}
_OTHERS: dict[str, Sequence[str]] = dict.fromkeys(
    (message_types.STREAM_INFO, message_types.STATISTICS, message_types.LABEL), ()
)
_LONGEST = 1000  # characters of what a log says of itself


@dataclass
class Contents:
    """What a log holds."""

    complete: bool  # whether it was finished
    span: tuple[int, int] | None  # first and last log time
    # what its `hearthlog` records say, so far as they agree
    record: dict[str, str] = field(default_factory=dict)
    microphones: list[str] = field(default_factory=list)
    frames: int = 0  # messages of features
    # number and stamp of the first and of the last frame; None where there are no features, or
    # those of several microphones
    first: tuple[int, int] | None = None
    last: tuple[int, int] | None = None
    gaps: int = 0
    gap_seconds: float = 0.0
    # By scenario, which is empty for the sounds of the home, and by label: of its segments
    seconds: dict[str, Counter[str]] = field(default_factory=dict)
    segments: dict[str, Counter[str]] = field(default_factory=dict)  # their number


def read_contents(path: Path, labelling: str) -> Contents:
    """Read what a log holds, without decoding its features.

    Parameters
    ----------
    labelling : str
        `live`, `relabel` or `review`; only segments of this labelling, and of its scenarios, are
        counted.

    Raises
    ------
    LogError
        If the log cannot be read, or a part of it that is needed is damaged.
    """
    span = time_span(path)
    with LogFile(path) as file:
        contents = Contents(file.complete, span, _common_record(file))
        reading = _Reading(file, contents, labelling)
        if file.statistics is None:  # nothing says how many messages there are, or where
            reading.read(file.chunks, _EVENTS | _FEATURES)
        else:
            reading.read(reading.chunks_with(_EVENTS), _EVENTS)
            reading.read(_ends(reading.chunks_with(_FEATURES)), _FEATURES)
            counts = file.statistics.channel_message_counts
            ids = reading.channels_of(_FEATURES)
            contents.frames = min(sum(counts.get(i, 0) for i in ids), file.size)
        ours = [file.channels[i].topic for i in reading.channels_of(_OTHERS | _FEATURES | _EVENTS)]
        contents.microphones = sorted({microphone_of(topic)[:_LONGEST] for topic in ours} - {""})
        if len(reading.channels_of(_FEATURES)) > 1:
            contents.first = contents.last = None
    return contents


def _common_record(file: LogFile) -> dict[str, str]:
    """Read what the file says of itself, so far as its records agree."""
    values_by_name: dict[str, set[str]] = {}
    for record in read_provenance(file):
        for name, value in record.items():
            values_by_name.setdefault(name, set()).add(value[:_LONGEST])
    return {name: values.pop() for name, values in values_by_name.items() if len(values) == 1}


def _ends(chunks: NDArray[np.void]) -> NDArray[np.void]:
    """Return the first and the last of some chunks."""
    return chunks[np.unique([0, chunks["end"].argmax()])] if len(chunks) else chunks


class _Reading:
    """Reads messages of one log, and notes in its contents what they say."""

    def __init__(self, file: LogFile, contents: Contents, labelling: str) -> None:
        self._file = file
        self._contents = contents
        self._labelling = labelling

    def channels_of(self, kinds: Mapping[str, Collection[str]]) -> set[int]:
        """Return the channels of some types, of which some fields are wanted."""
        schemas = self._file.schemas
        return {
            number
            for number, channel in self._file.channels.items()
            if any(
                is_compatible(channel, schemas.get(channel.schema_id), *k) for k in kinds.items()
            )
        }

    def chunks_with(self, kinds: Mapping[str, Collection[str]]) -> NDArray[np.void]:
        """Return the chunks that hold messages of some types."""
        return self._file.with_channels(self._file.chunks, self.channels_of(kinds))

    def read(self, chunks: NDArray[np.void], types: Mapping[str, Collection[str]]) -> None:
        """Read some chunks, a few at a time, and note their messages of some types."""
        topics = None
        if self._file.statistics is not None:
            topics = {self._file.channels[i].topic for i in self.channels_of(types)}
        for batch in read_in_batches(self._file, chunks, topics):
            for columns in decode_types(self._file.path, batch, types):
                self._note(columns)

    def _note(self, columns: Columns) -> None:
        if columns.type == message_types.FEATURES:
            self._note_features(columns)
        elif columns.type == message_types.GAP:
            self._contents.gaps += len(columns)
            self._contents.gap_seconds += float(columns["duration"].sum(dtype=float)) / NANOSECONDS
        elif (scenario := self._scenario(columns.topic)) is not None:
            self._note_segments(columns, scenario)

    def _scenario(self, name: str) -> str | None:
        """Return the scenario of which a topic has segments; None if they do not count."""
        topic = parse_topic(name)
        if topic is None or topic.kind != "segment":
            return None
        root = topic.labelling.partition("/")[0]
        is_own = (LIVE if root == SCENARIO else root) == self._labelling
        return scenario_name(topic.labelling) if is_own else None

    def _note_features(self, columns: Columns) -> None:
        ends = columns.take(np.array([0, len(columns) - 1]))
        pairs = zip(ends["frame"].tolist(), ends["header.stamp"].tolist(), strict=True)
        first, self._contents.last = pairs
        self._contents.first = self._contents.first or first
        self._contents.frames += len(columns)

    def _note_segments(self, columns: Columns, scenario: str) -> None:
        amounts = self._contents.segments, self._contents.seconds
        counts, lengths = (amount.setdefault(scenario, Counter()) for amount in amounts)
        labels, numbers = np.unique(columns["label"], return_inverse=True)
        seconds = np.bincount(numbers, columns["duration"] / NANOSECONDS)
        for label, count, length in zip(
            labels.tolist(), np.bincount(numbers).tolist(), seconds.tolist(), strict=True
        ):
            counts[label[:_LONGEST]] += count
            lengths[label[:_LONGEST]] += length
        if len(amounts[0]) > MOST_CLASSES:
            raise LogError(f"{self._file.path}: has more than {MOST_CLASSES} scenarios")
        if len(counts) > MOST_CLASSES:
            raise LogError(
                f"{self._file.path}: has more than {MOST_CLASSES} different labels; "
                "no classifier has so many"
            )
