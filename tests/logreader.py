"""Read logs message by message, finished ones, those being written and those cut short."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.mcap.chunks import read_chunks
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages.cdr_codec import decode_rows
from hearthlog.schemas.messages.fields import DURATION, TIME
from hearthlog.schemas.messages.message_types import (
    decode,
    duration_message,
    number_type,
    store_of,
    time_message,
)
from hearthlog.schemas.messages.type_definitions import message_type


@dataclass(frozen=True)
class LogMessage:
    """One message as it stands in a log."""

    topic: str
    type: str
    log_time: int
    data: bytes
    schema: Schema | None = None

    def decode(self) -> Any:
        """Decode the message, if its type is one of ROS 2's or ours.

        It has the fields that this version knows: defaults for those that were appended since it
        was written, and none that a later version appended.

        Raises
        ------
        LogError
            If it is of another type, or its bytes are not of its type.
        """
        try:
            if self.schema is not None:
                schema = self.schema
                kind = message_type(schema.name, schema.encoding, schema.data)
                if kind.growth:
                    data = np.frombuffer(self.data, np.uint8)
                    columns = decode_rows(kind, data, np.array([0]), np.array([len(data)]))
                    return _message(self.type, {path: row[0] for path, row in columns.items()})
            return decode(self.data, self.type)
        except (SerdeError, KeyError) as error:
            raise LogError(f"{self.topic}: no message of type {self.type} ({error})") from error


def _message(typename: str, values: Mapping[str, Any], prefix: str = "") -> Any:
    """Make a message of the values of its columns."""
    fields = store_of(typename).fielddefs[typename][1]
    return store_of(typename).types[typename](
        *(_field(described, values, f"{prefix}{name}") for name, described in fields)
    )


def _field(description: tuple[Nodetype, Any], values: Mapping[str, Any], path: str) -> Any:
    node, kind = description
    if node is Nodetype.NAME and kind not in {TIME, DURATION}:
        return _message(kind, values, f"{path}.")
    value = values[path]
    if node is Nodetype.NAME:
        return (time_message if kind == TIME else duration_message)(int(value))
    if node is Nodetype.BASE:
        return value.item() if isinstance(value, np.generic) else value
    (element, base), _ = kind
    if element is Nodetype.NAME:
        return [_message(base, each) for each in value]
    return list(value) if base[0] == "string" else np.asarray(value, number_type(base[0]))


class LogReader:
    """One pass over a log, in the order in which it was written; every checksum is compared.

    Attributes
    ----------
    metadata : dict of str to dict of str to str
        The metadata records, by name.
    attachments : dict of str to bytes
        The attachments, by name.
    channels : dict of str to Channel
        The channels met so far, by topic.
    complete : bool
        Whether the log is finished.

    Raises
    ------
    LogError
        If this is not an MCAP file, or if it is damaged before its end.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.channels: dict[str, Channel] = {}
        with LogFile(path) as file:
            self.complete = file.complete
            for place in file.record_locations:
                record = file.record(place)
                if isinstance(record, Metadata):
                    self.metadata[record.name] = record.metadata
                elif isinstance(record, Attachment):
                    self.attachments[record.name] = record.data

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """Read the messages of some topics, or of all."""
        with LogFile(self.path) as file:
            for chunk in np.sort(file.chunks, order="offset"):
                found = read_chunks(file, np.array([chunk]), topics)
                self.channels.update({c.topic: c for c in file.channels.values()})
                yield from _as_written(found)


def _as_written(found: list[RawMessages]) -> Iterator[LogMessage]:
    """Put the messages of a chunk in the order of their places."""
    places = [
        (offset, size, time, raw)
        for raw in found
        for offset, size, time in zip(
            raw.offsets.tolist(), raw.sizes.tolist(), raw.log_times.tolist(), strict=True
        )
    ]
    for offset, size, time, raw in sorted(places, key=lambda place: place[0]):
        name = "" if raw.schema is None else raw.schema.name
        data = raw.buffer[offset : offset + size].tobytes()
        yield LogMessage(raw.channel.topic, name, time, data, raw.schema)
