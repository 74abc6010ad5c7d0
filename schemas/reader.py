"""Read logs message by message, finished ones, those being written and those cut short."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Metadata
from rosbags.serde import SerdeError

from hearthlog.schemas.chunks import RawMessages, read_chunks
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logfile import LogFile
from hearthlog.schemas.messages import decode


@dataclass(frozen=True)
class LogMessage:
    """One message as it stands in a log."""

    topic: str
    type: str
    log_time: int
    data: bytes

    def decode(self) -> Any:
        """Decode the message, if its type is one of ROS 2's or ours.

        Raises
        ------
        LogError
            If it is of another type, or its bytes are not of its type.
        """
        try:
            return decode(self.data, self.type)
        except (SerdeError, KeyError) as error:
            raise LogError(f"{self.topic}: no message of type {self.type} ({error})") from error


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
        If this is no MCAP file, or if it is damaged before its end.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.channels: dict[str, Channel] = {}
        with LogFile(path) as file:
            self.complete = file.complete
            for place in file.places:
                record = file.record(place)
                if isinstance(record, Metadata):
                    self.metadata[record.name] = record.metadata
                elif isinstance(record, Attachment):
                    self.attachments[record.name] = record.data

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """Read the messages of some topics, or of all."""
        with LogFile(self.path) as file:
            for chunk in np.sort(file.chunks, order="offset"):
                found = read_chunks(file, np.array([chunk]), topics, check=True)
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
        yield LogMessage(raw.channel.topic, name, time, data)
