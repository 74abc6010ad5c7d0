"""Topics of logs as columns, ordered by time and read in bounded memory."""

import warnings
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.frames import millisecond_text
from hearthlog.schemas.logs.files import topic_counts
from hearthlog.schemas.logs.merged_reading import iterate_pieces
from hearthlog.schemas.mcap.chunks import OnDamage, TopicChoice
from hearthlog.schemas.mcap.raw_messages import RawMessages, bounds
from hearthlog.schemas.mcap.records import LAST_TIME
from hearthlog.schemas.messages.cdr_codec import (
    Fields,
    UndecodableText,
    decode_rows,
    ragged,
    unreadable_rows,
)
from hearthlog.schemas.messages.fields import fields_of
from hearthlog.schemas.messages.type_definitions import message_type

_DEFINITIONS_KEPT = 256
_HEADS = ("log_times", "publish_times", "sequences")


@dataclass(frozen=True)
class Columns:
    """Messages of one topic as arrays with one row per message.

    `columns["values"]` is the column of a field, by its path ("header.stamp" for a field of a
    nested message): numbers unchanged; stamps and durations as int64 nanoseconds; strings as
    `str` objects; arrays as one row each, or as objects if their lengths differ; arrays of
    messages as lists of dicts. Hearthlog types have the fields of this version: fields missing
    in an older log have their defaults, and fields appended by a newer version are omitted.

    Attributes
    ----------
    topic, type : str
    metadata : mapping of str to str
        Of the channel.
    log_times, publish_times : np.ndarray [shape=(n,)], int64
        Nanoseconds; log times ascend.
    sequences : np.ndarray [shape=(n,)], uint32
    fields : dict of str to np.ndarray [shape=(n, ...)]
    """

    topic: str
    type: str
    metadata: Mapping[str, str]
    log_times: Int64
    publish_times: Int64
    sequences: NDArray[np.uint32]
    fields: Fields

    def __len__(self) -> int:
        return len(self.log_times)

    def __getitem__(self, path: str) -> NDArray[Any]:
        """Return the column of a field.

        Parameters
        ----------
        path : str
            Path of the field, such as "header.stamp".

        Raises
        ------
        LogError
            If the messages have no such field, or it was not read.
        """
        try:
            return self.fields[path]
        except KeyError:
            raise LogError(f"{self.topic}: {self.type} has no field {path!r}") from None

    def between(self, start: int | None, end: int | None) -> "Columns":
        """Return the messages with start <= log time < end.

        Parameters
        ----------
        start, end : int or None
            Log times, in nanoseconds of UTC; None for no limit on that side.
        """
        rows = slice(*bounds(self.log_times, start, end))
        if rows == slice(0, len(self)):
            return self
        return self.take(rows)

    def take(self, rows: slice | NDArray[np.intp]) -> "Columns":
        """Return the messages with the given indices.

        Parameters
        ----------
        rows : slice or np.ndarray [shape=(m,)], intp
            Indices of messages; log times must remain ascending.
        """
        return replace(
            self,
            log_times=self.log_times[rows],
            publish_times=self.publish_times[rows],
            sequences=self.sequences[rows],
            fields={path: values[rows] for path, values in self.fields.items()},
        )


def read_columns(  # noqa: PLR0913
    logs: Iterable[Path],
    topics: TopicChoice | None = None,
    start: int | None = None,
    end: int | None = None,
    fields: Collection[str] | None = None,
    *,
    on_damage: OnDamage | None = None,
) -> dict[str, Columns]:
    """Read topics of logs as one series per topic; topics without messages are left out.

    By default, all topics and fields are read; `topics` has names or is a predicate, `fields` has
    paths. Log times are from `start` on, before `end`, in nanoseconds of UTC. If the files of a
    topic differ in metadata or fields, only the common entries are kept. Undecodable messages are
    skipped with a `HearthlogWarning`, as in `decode_readable`. `on_damage` receives a log and the
    error of a damaged chunk, which is skipped; by default it is raised.

    Raise `LogError` if a log cannot be read or is damaged, or two logs have different types on one
    topic.
    """
    logs = list(logs)
    unlimited = start is None and end is None
    expected = sum(map_logs(topic_counts, logs), Counter()) if unlimited else Counter()
    builders: dict[str, _ColumnBuilder] = {}
    for batch in iterate_columns(logs, topics, start, end, fields, on_damage=on_damage):
        for columns in batch:
            builder = _ColumnBuilder(expected[columns.topic])
            builders.setdefault(columns.topic, builder).add(columns)
    return {topic: builders.pop(topic).columns() for topic in list(builders)}


def iterate_columns(  # noqa: PLR0913
    logs: Iterable[Path],
    topics: TopicChoice | None = None,
    start: int | None = None,
    end: int | None = None,
    fields: Collection[str] | None = None,
    *,
    on_damage: OnDamage | None = None,
) -> Iterator[list[Columns]]:
    """Read topics of logs by spans of time, with the arguments of `read_columns`.

    A span has one item for each topic with messages in it, or more if its channels differ in type,
    fields or metadata. No message is older than those yielded before. Undecodable messages are
    skipped with a `HearthlogWarning`, as in `decode_readable`. Raise `LogError` if a log cannot be
    read or is damaged.
    """
    function = partial(decode_readable, fields=fields)
    pieces = iterate_pieces(logs, topics, start, end, function, on_damage=on_damage)
    return map(_joined, pieces)


def decode(messages: Iterable[RawMessages], fields: Collection[str] | None = None) -> list[Columns]:
    """Decode messages into one `Columns` for each topic, type, set of fields and metadata.

    They are in the order of their first messages; `fields` has paths, by default all. Raise
    `LogError` if messages are not of the type of their channel, or not encoded as CDR, or the
    definition of the type cannot be parsed.
    """
    return _joined([_decode(raw, fields) for raw in messages])


def decode_readable(
    messages: Iterable[RawMessages], fields: Collection[str] | None = None
) -> list[Columns]:
    """Decode messages as `decode` does, but skip undecodable ones, and channels without others.

    A `HearthlogWarning` names each topic that loses messages. In strings that are not UTF-8, U+FFFD
    replaces invalid bytes.
    """
    decoded = (_decode_readable(raw, fields) for raw in messages)
    return _joined([_with_valid_times(columns) for columns in decoded if columns is not None])


def unreadable(channel: Channel, schema: Schema | None) -> str:
    """Return why no message of a channel can be decoded; empty if its definition is valid."""
    if schema is None or channel.message_encoding != "cdr":
        return f"holds no ROS 2 messages ({channel.message_encoding!r})"
    return definition_fault(schema.name, schema.encoding, schema.data)


@lru_cache(_DEFINITIONS_KEPT)
def definition_fault(name: str, encoding: str, text: bytes) -> str:
    """Return why messages with this definition cannot be decoded; empty if they can."""
    try:
        kind = message_type(name, encoding, text)
        fields_of(kind)
        kind.layout_for(defaultdict(int))
    except LogError as error:
        return str(error)
    return ""


def leave_out(topic: str, why: str) -> None:
    """Warn that a topic is skipped."""
    text = f"{why}: left out; --topics chooses others"
    warnings.warn(HearthlogWarning(text, topic, each=True), stacklevel=2)


def _decode_readable(raw: RawMessages, fields: Collection[str] | None) -> Columns | None:
    topic = raw.channel.topic
    if why := unreadable(raw.channel, raw.schema):
        leave_out(topic, why)
        return None
    try:
        return _decode(raw, fields)
    except LogError:
        raw = without_unreadable(raw)
    if not len(raw):
        return None
    try:
        return _decode(raw, fields)
    except LogError as error:
        text = f"U+FFFD stands for what cannot be read in texts of {topic}"
        warnings.warn(HearthlogWarning(text, str(error)), stacklevel=2)
    return _decode(raw, fields, "replace")


def faults(raw: RawMessages) -> dict[int, LogError]:
    """Return the error of each message that does not match its type, by ascending index."""
    assert raw.schema is not None
    kind = message_type(raw.schema.name, raw.schema.encoding, raw.schema.data)
    return dict(sorted(unreadable_rows(kind, raw.buffer, raw.offsets, raw.sizes).items()))


def without_unreadable(raw: RawMessages) -> RawMessages:
    """Skip messages that do not match their type; warn of the first of them."""
    errors = faults(raw)
    if not errors:
        return raw
    topic, first = raw.channel.topic, next(iter(errors))
    where = f"{topic} at {millisecond_text(int(raw.log_times[first]))}: {errors[first]}"
    text = f"such messages of {topic} are left out; `hearthlog doctor` says more"
    warnings.warn(HearthlogWarning(text, where), stacklevel=2)
    return raw.take(np.delete(np.arange(len(raw)), list(errors)))


def _joined(pieces: Iterable[Columns]) -> list[Columns]:
    """Join pieces with equal topic, type, fields and metadata, in order of time."""
    parts: dict[Any, list[Columns]] = {}
    for columns in pieces:
        metadata = tuple(sorted(columns.metadata.items()))
        key = columns.topic, columns.type, tuple(columns.fields), metadata
        parts.setdefault(key, []).append(columns)
    return [_in_order(join(same)) if len(same) > 1 else same[0] for same in parts.values()]


def _decode(
    raw: RawMessages,
    fields: Collection[str] | None,
    undecodable: UndecodableText = "strict",
) -> Columns:
    topic, schema = raw.channel.topic, raw.schema
    if schema is None or raw.channel.message_encoding != "cdr":
        raise LogError(f"{topic}: holds no ROS 2 messages ({raw.channel.message_encoding!r})")
    try:
        kind = message_type(schema.name, schema.encoding, schema.data)
        values = decode_rows(
            kind, raw.buffer, raw.offsets, raw.sizes, fields, undecodable=undecodable
        )
    except LogError as error:
        raise LogError(f"{topic}: {error}") from error
    return Columns(
        topic,
        schema.name,
        raw.channel.metadata,
        np.ascontiguousarray(raw.heads["log_time"]),
        np.ascontiguousarray(raw.heads["publish_time"]),
        np.ascontiguousarray(raw.heads["sequence"]),
        values,
    )


def _with_valid_times(columns: Columns) -> Columns:
    """Replace publish times beyond the int64 range by its maximum, with a warning."""
    late = columns.publish_times < 0  # 2**63 or more in the file
    if not late.any():
        return columns
    text = "publish times after the year 2262 are not known here: 2262-04-11 stands for them"
    warnings.warn(HearthlogWarning(text, columns.topic), stacklevel=2)
    return replace(columns, publish_times=np.where(late, LAST_TIME, columns.publish_times))


def join(parts: Sequence[Columns]) -> Columns:
    """Concatenate pieces of one topic, with the fields that all pieces have.

    At least one piece, in order of time. Raise `LogError` if the pieces have different types.
    """
    builder = _ColumnBuilder()
    for part in parts:
        builder.add(part)
    return builder.columns()


class _ColumnBuilder:
    """Accumulator of pieces of one topic."""

    def __init__(self, expected: int = 0) -> None:
        self._expected = expected
        self._first: Columns | None = None
        self._metadata: dict[str, str] = {}
        self._heads = {name: _Growing(expected) for name in _HEADS}
        self._fields: dict[str, _Growing] = {}

    def add(self, part: Columns) -> None:
        """Append a piece of the same type."""
        if self._first is None:
            self._first, self._metadata = part, dict(part.metadata)
            self._fields = {path: _Growing(self._expected) for path in part.fields}
        if part.type != self._first.type:
            raise LogError(f"{part.topic}: is of type {self._first.type} and of type {part.type}")
        self._metadata = dict(self._metadata.items() & part.metadata.items())
        for name, growing in self._heads.items():
            growing.append(getattr(part, name))
        for path in self._fields.keys() - part.fields.keys():
            del self._fields[path]
        for path, growing in self._fields.items():
            growing.append(part.fields[path])

    def columns(self) -> Columns:
        """Return all pieces as one, and clear the builder."""
        assert self._first is not None
        heads: Any = {name: growing.joined() for name, growing in self._heads.items()}
        fields = {path: growing.joined() for path, growing in self._fields.items()}
        return replace(self._first, metadata=self._metadata, fields=fields, **heads)


class _Growing:
    """Growing array.

    Fresh memory dominates the time, and numpy requests large pages for large arrays: one
    allocation of the right size is written twice as fast as a concatenation.
    """

    def __init__(self, expected: int) -> None:
        self._expected = expected
        self._values: NDArray[Any] | None = None
        self._count = 0

    def append(self, values: NDArray[Any]) -> None:
        """Append rows; if dtype or shape differ, rows become objects."""
        kept = self._values
        if kept is not None and (kept.dtype, kept.shape[1:]) != (values.dtype, values.shape[1:]):
            kept, values = ragged(kept[: self._count]), ragged(values)
        end = self._count + len(values)
        if kept is None or end > len(kept):
            rows = end if kept is None and end >= self._expected else max(2 * end, self._expected)
            try:
                grown = np.empty((rows, *values.shape[1:]), values.dtype)
            except MemoryError:  # a file may state any size
                grown = np.empty((end, *values.shape[1:]), values.dtype)
            if kept is not None:
                grown[: self._count] = kept[: self._count]
            kept = grown
        kept[self._count : end] = values
        self._values, self._count = kept, end

    def joined(self) -> NDArray[Any]:
        """Return all rows."""
        assert self._values is not None
        return self._values[: self._count]


def _in_order(columns: Columns) -> Columns:
    return columns.take(np.argsort(columns.log_times, kind="stable"))
