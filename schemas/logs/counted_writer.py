"""Write an MCAP file that says, when it is finished, what is in its messages."""

from collections.abc import Iterable
from itertools import chain, zip_longest
from typing import BinaryIO

import numpy as np
from mcap.records import Channel, Schema

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.contents import Contents, has_contents
from hearthlog.schemas.logs.contents_record import METADATA, as_metadata
from hearthlog.schemas.mcap.chunk_writer import ChunkWriter
from hearthlog.schemas.mcap.chunks import BATCH_SIZE
from hearthlog.schemas.mcap.definitions import Definitions
from hearthlog.schemas.mcap.formats import INDEX_ENTRIES, MESSAGE_HEAD
from hearthlog.schemas.mcap.raw_messages import RawMessages, gather_heads
from hearthlog.schemas.mcap.stored_chunk import LATEST, StoredChunk


class CountedWriter(ChunkWriter):
    """A `ChunkWriter` whose last metadata record is `hearthlog_contents`.

    The record is left out where there would be nothing to say, where it or a chunk would be large,
    and where a message cannot be read.
    """

    def __init__(
        self,
        stream: BinaryIO,
        definitions: Definitions | None = None,
        chunk_span: int = LATEST,
    ) -> None:
        super().__init__(stream, chunk_span=chunk_span)
        self._copied = definitions
        self._contents: Contents | None = Contents()
        self._waiting: list[StoredChunk] = []  # one batch of a reader, so that it counts alike
        self._size = 0

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a metadata record; that of another file's contents is left out."""
        if name != METADATA:
            super().add_metadata(name, data)

    def finish(self) -> None:
        """Write the chunk in progress, the record, the index and the footer."""
        self.flush()
        self._count_waiting()
        channels, schemas = self._definitions()
        ours = any(has_contents(c, schemas.get(c.schema_id)) for c in channels.values())
        record = as_metadata(self._contents) if ours and self._contents is not None else None
        if record is not None:
            super().add_metadata(METADATA, record)
        super().finish()

    def copy_large_chunk(self, chunk: StoredChunk, length: int, data: Iterable[bytes]) -> None:
        """Write a chunk of another file; what it says is not counted."""
        self._give_up()
        super().copy_large_chunk(chunk, length, data)

    def _put(self, chunk: StoredChunk) -> int:
        length = super()._put(chunk)
        batch = self._size // BATCH_SIZE
        self._size += chunk.size + length
        if self._size // BATCH_SIZE != batch:
            self._count_waiting()
        if chunk.size > BATCH_SIZE:
            self._give_up()  # no recorder's, and too large to be kept
        if self._contents is not None:
            self._waiting.append(chunk)
        return length

    def _count_waiting(self) -> None:
        if self._contents is None or not self._waiting:
            return
        try:
            self._contents.add(_messages(self._waiting, *self._definitions()))
        except LogError:
            self._give_up()
        else:
            self._waiting = []
            if as_metadata(self._contents) is None:
                self._give_up()

    def _give_up(self) -> None:
        self._contents = None
        self._waiting = []

    def _definitions(self) -> tuple[dict[int, Channel], dict[int, Schema]]:
        if self._copied is not None:
            return self._copied.channels, self._copied.schemas
        return {c.id: c for c in self._channels}, {s.id: s for s in self._schemas}


def _messages(
    chunks: list[StoredChunk], channels: dict[int, Channel], schemas: dict[int, Schema]
) -> list[RawMessages]:
    """Find the messages of some chunks, in the order in which a reader does."""
    contents = [chunk.content() if chunk.raw is None else chunk.raw for chunk in chunks]
    buffer = np.frombuffer(b"".join(contents), np.uint8)
    bases = np.cumsum([0, *map(len, contents)]).tolist()
    messages = []
    numbers = chain.from_iterable(zip_longest(*(chunk.entries for chunk in chunks)))
    for number in dict.fromkeys(n for n in numbers if n is not None):
        starts = np.concatenate(
            [
                np.frombuffer(chunk.entries[number], INDEX_ENTRIES)["offset"] + base
                for chunk, base in zip(chunks, bases, strict=False)
                if number in chunk.entries
            ]
        )
        heads = gather_heads(buffer, starts)
        order = np.argsort(heads["log_time"], kind="stable")
        channel = channels[number]
        schema = schemas.get(channel.schema_id)
        offsets = starts[order] + MESSAGE_HEAD.itemsize
        messages.append(RawMessages(channel, schema, buffer, offsets, heads[order]))
    return messages
