"""Messages that are not yet known to be on the disk, in memory that goes back whole."""

import mmap
import struct
from collections import deque
from collections.abc import Iterable, Iterator

from hearthlog.recorder.log.description import LogDescription
from hearthlog.recorder.stream.messages import EncodedMessage

_ENTRY = struct.Struct("<qHI")  # log time, bytes of the topic, bytes of the data
_FIRST_BYTES = 1 << 18

Held = EncodedMessage | LogDescription  # a description: here another log begins


class HeldMessages:
    """A queue of messages, and of the descriptions of the logs that begin between them.

    Their bytes lie in one piece of memory: as many small objects they would leave holes that the
    process never gives back to the system.

    Attributes
    ----------
    size : int
        Bytes that are held.
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
        """Whether the first that is held is a description."""
        return not _ENTRY.unpack_from(self._memory, self._begin)[1]

    def extend(self, items: Iterable[Held]) -> None:
        """Append messages and descriptions."""
        for item in items:
            if isinstance(item, LogDescription):
                self._descriptions.append(item)
                self._append(0, b"", b"")
            else:
                self._append(item.log_time, item.topic.encode(), item.data)

    def drop_first(self) -> None:
        """Forget what was held first."""
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
