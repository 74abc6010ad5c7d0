"""Read logs message by message, finished ones, those being written and those cut short."""

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from rosbags.serde import SerdeError

from schemas.errors import LogError
from schemas.files import ACTIVE_SUFFIX
from schemas.messages import decode

_RECORD_LIMIT = 256 << 20  # bytes; ours are below 2 MiB
_HEAD = struct.Struct("<BQ")  # opcode and length
_READ = {  # the others index these
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.FOOTER,
}
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
        magic = stream.read(len(MCAP0_MAGIC))
        if path.name.endswith(ACTIVE_SUFFIX) and MCAP0_MAGIC.startswith(magic):
            pass  # at first a writer has written less than that
        elif magic != MCAP0_MAGIC:
            raise LogError(f"{path}: is no MCAP file")
        while True:
            offset = stream.tell()
            try:
                content = _next_record(stream, path.stat().st_size - offset)
                records = [] if content is None else _parsed(content)
            except Exception as error:  # the decompressors raise what they like
                what = str(error) or type(error).__name__
                raise LogError(f"{path}: damaged at byte {offset} ({what})") from error
            yield from records
            if content is None or content[0] == Opcode.FOOTER:
                return


def _next_record(stream: BinaryIO, rest: int) -> bytes | None:
    """Read one record as it is; None at the end of what was written."""
    head = stream.read(_HEAD.size)
    length = _HEAD.unpack(head)[1] if len(head) == _HEAD.size else _RECORD_LIMIT
    if len(head) + length > rest:
        if rest > _TAIL_LIMIT:
            raise McapError("a record claims to be longer than the file")
        return None
    if length > _RECORD_LIMIT:
        raise McapError("a record claims to be too large")
    return head + stream.read(length)


def _parsed(content: bytes) -> list[McapRecord]:
    if content[0] not in _READ:
        return []
    record = next(StreamReader(BytesIO(content), skip_magic=True, emit_chunks=True).records)
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
