"""Messages held in memory during disk errors."""

import mmap
import struct
from collections import deque
from collections.abc import Iterable, Iterator

from hearthlog.recorder.log.description import LogDescription
from hearthlog.recorder.stream.messages import EncodedMessage

_ENTRY = struct.Struct("<qHI")  # log time, bytes of the topic, bytes of the data
_FIRST_BYTES = 1 << 18
_WRITTEN_AT_ONCE = 256  # held messages per batch

Held = EncodedMessage | LogDescription  # a description begins another log


class HeldMessages:
    """Queue of messages, and of the descriptions of logs that begin between them; `size` in bytes.

    The bytes are in one block of memory: many small objects would leave holes in the heap that the
    process never returns to the system.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, _FIRST_BYTES)
        self._begin = self._end = 0
        self._descriptions: deque[LogDescription] = deque()  # each has an entry without a topic

    def __bool__(self) -> bool:
        return self._begin < self._end

    def __iter__(self) -> Iterator[Held]:
        descriptions = iter(self._descriptions)
        begin = self._begin
        while begin < self._end:
            log_time, topic_size, size = _ENTRY.unpack_from(self._memory, begin)
            data = begin + _ENTRY.size + topic_size
            if topic_size:
                topic = self._memory[data - topic_size : data].decode()
                yield EncodedMessage(log_time, topic, self._memory[data : data + size])
            else:
                yield next(descriptions)
            begin = data + size

    @property
    def size(self) -> int:  # noqa: D102
        return self._end - self._begin

    @property
    def begins_log(self) -> bool:
        """Whether the first item is a description."""
        return not _ENTRY.unpack_from(self._memory, self._begin)[1]

    def extend(self, items: Iterable[Held]) -> None:
        """Append messages and descriptions."""
        for item in items:
            if isinstance(item, LogDescription):
                self._descriptions.append(item)
                self._append(0, b"", b"")
            else:
                self._append(item.log_time, item.topic.encode(), item.data)

    def batches(self) -> Iterator[list[Held]]:
        """Split the items at a change of the log time: files may begin there."""
        batch: list[Held] = []
        last = -1
        for item in self:
            now = item.log_time if isinstance(item, EncodedMessage) else -1
            if len(batch) >= _WRITTEN_AT_ONCE and now != last:
                yield batch
                batch = []
            batch.append(item)
            last = now
        yield batch

    def drop_first(self) -> None:
        """Drop the first item."""
        _, topic_size, size = _ENTRY.unpack_from(self._memory, self._begin)
        if not topic_size:
            self._descriptions.popleft()
        self._begin += _ENTRY.size + topic_size + size
        if self._begin == self._end:
            self._begin = self._end = 0
            if len(self._memory) > _FIRST_BYTES:
                self._memory.close()
                self._memory = mmap.mmap(-1, _FIRST_BYTES)

    def _append(self, log_time: int, topic: bytes, data: bytes) -> None:
        entry = _ENTRY.pack(log_time, len(topic), len(data)) + topic + data
        if self._end + len(entry) > len(self._memory):
            wider = mmap.mmap(-1, 2 * len(self._memory) + len(entry))
            wider[: self._end] = self._memory[: self._end]
            self._memory.close()
            self._memory = wider
        self._memory[self._end : self._end + len(entry)] = entry
        self._end += len(entry)
