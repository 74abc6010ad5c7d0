"""Read logs message by message, finished ones, those being written and those cut short."""

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.serde import SerdeError

from schemas.errors import LogError
from schemas.messages import decode

_RECORD_LIMIT = 256 << 20  # bytes; ours are below 2 MiB
_TAIL_LIMIT = 64 << 10  # a longer one was not left by a writer that was killed between two flushes


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


def read_records(path: Path) -> Iterator[McapRecord]:
    """Read the records of a log, those inside chunks too, up to the point where it is cut.

    The last record is a `Footer` if the log is complete.

    Raises
    ------
    LogError
        If this is no MCAP file, or if it is damaged before its end.
    """
    with path.open("rb") as stream:
        reader = StreamReader(stream, emit_chunks=True, record_size_limit=_RECORD_LIMIT)
        offset = 0
        try:
            for record in reader.records:
                yield from _opened(record)
                offset = stream.tell()
        except (EndOfFile, struct.error) as error:
            # The reader says the latter of a length of which the last bytes are missing.
            if offset == 0:
                raise LogError(f"{path}: is no MCAP file (it ends at once)") from error
            rest = path.stat().st_size - offset
            if stream.read(1) or rest > _TAIL_LIMIT:
                raise LogError(f"{path}: damaged at byte {offset} ({error})") from error
        except Exception as error:  # the decompressors raise what they like
            what = str(error) or type(error).__name__
            place = "is no MCAP file" if offset == 0 else f"damaged at byte {offset}"
            raise LogError(f"{path}: {place} ({what})") from error


def _opened(record: McapRecord) -> list[McapRecord]:
    if not isinstance(record, Chunk):
        return [record]
    if record.uncompressed_size > _RECORD_LIMIT:
        raise McapError("a chunk claims to be too large")
    return breakup_chunk(record, validate_crc=True)


class LogReader:
    """One pass over a log, in the order in which it was written.

    Attributes
    ----------
    metadata : dict of str to dict of str to str
        The metadata records met so far, by name.
    attachments : dict of str to bytes
        The attachments met so far, by name.
    channels : dict of str to Channel
        The channels met so far, by topic.
    complete : bool
        Whether the end of a finished log was reached.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.channels: dict[str, Channel] = {}
        self.complete = False

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """Read the messages of some topics, or of all."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in read_records(self.path):
            if isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None or channel.schema_id not in schemas:
                    raise LogError(f"{self.path}: damaged: a message of an unknown channel")
                if topics is None or channel.topic in topics:
                    name = schemas[channel.schema_id].name
                    yield LogMessage(channel.topic, name, record.log_time, record.data)
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = self.channels[record.topic] = record
            elif isinstance(record, Metadata):
                self.metadata[record.name] = record.metadata
            elif isinstance(record, Attachment):
                self.attachments[record.name] = record.data
            elif isinstance(record, Footer):
                self.complete = True
