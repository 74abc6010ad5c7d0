"""What logs hold of a span of time, to be played from any moment on."""

from collections.abc import Callable, Collection, Generator, Sequence
from pathlib import Path

from mcap import records

from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.logs.merged_reading import iterate_messages, time_spans
from hearthlog.schemas.mcap.chunks import read_definitions
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages.message_types import STREAM_INFO

_WINDOW = 3600 * NANOSECONDS  # whose logs are looked into at once
_RECENT = NANOSECONDS  # what was said so long before a moment is still seen then

Damaged = Callable[[LogError], None]
ChannelType = tuple[records.Channel, records.Schema | None]


def channels_of(log: Path) -> list[ChannelType]:
    """List the channels of a log with their schemas.

    Raise `LogError` if it cannot be read, is not an MCAP file, or is damaged.
    """
    with LogFile(log) as file:
        read_definitions(file)
        return [(each, file.schemas.get(each.schema_id)) for each in file.channels.values()]


class Recording:
    """The messages of some logs between two times.

    Parameters
    ----------
    start, end : int or None
        Nanoseconds of UTC: from `start` on, before `end`; None for all there is.

    Raises
    ------
    DataError
        If there is no message between the two times.
    """

    def __init__(
        self, logs: Sequence[Path], start: int | None, end: int | None, damaged: Damaged
    ) -> None:
        self._damaged = damaged
        spans = [
            (first, last, path)
            for first, last, path in time_spans(logs, self._span)
            if (start is None or last >= start) and (end is None or first < end)
        ]
        if not spans:
            raise DataError("nothing was recorded in this time; `hearthlog info` tells what was")
        self.start = max(start or 0, spans[0][0])
        last_end = max(last for _, last, _ in spans) + 1
        self.end = last_end if end is None else min(end, last_end)
        self._spans = spans
        self._passed_over: set[Path] = set()
        self.channels: dict[str, ChannelType] = {}
        for _, _, path in spans:
            self._add_channels(path)

    def _span(self, log: Path) -> tuple[int, int] | None:
        try:
            return time_span(log)
        except LogError as error:
            self._damaged(error)
            return None

    def _add_channels(self, log: Path) -> None:
        try:
            for channel, schema in channels_of(log):
                self.channels.setdefault(channel.topic, (channel, schema))
        except LogError as error:
            self._damaged(error)

    def messages(self, start: int) -> Generator[list[RawMessages], None, None]:
        """Read the messages from a moment on.

        Yields
        ------
        list of RawMessages
            Those of the next span of time; none is older than any that was yielded before.
        """
        while start < self.end:
            end = min(start + _WINDOW, self.end)
            yield from self._between(start, end)
            # Years may lie between two logs: a box without a clock begins in 1970.
            later = (max(first, end) for first, last, _ in self._spans if last >= end)
            start = min(later, default=self.end)

    def before(self, moment: int) -> list[tuple[RawMessages, int]]:
        """Read what is known at a moment.

        Returns
        -------
        list of (RawMessages, int)
            The last description of each stream in the logs that have the moment, and the last
            message of each topic in the second before, with their places.
        """
        known: dict[str, tuple[RawMessages, int]] = {}
        topics = {
            topic
            for topic, (_, schema) in self.channels.items()
            if schema is not None and schema.name == STREAM_INFO
        }
        first = min((a for a, b, _ in self._spans if a < moment <= b), default=moment)
        descriptions = self._between(first, moment, topics)
        for batches in (descriptions, self._between(max(moment - _RECENT, 0), moment)):
            for batch in batches:
                known |= {part.channel.topic: (part, len(part) - 1) for part in batch}
        return list(known.values())

    def _between(
        self, start: int, end: int, topics: Collection[str] | None = None
    ) -> Generator[list[RawMessages], None, None]:
        """Read all logs together; without those that turn out to be damaged."""
        spans = [path for a, b, path in self._spans if a < end and b >= start]
        logs = [path for path in spans if path not in self._passed_over]
        try:
            for batch in iterate_messages(logs, topics, start, end):
                start = 1 + max(int(part.log_times[-1]) for part in batch)
                yield batch
        except LogError as error:
            self._damaged(error)
            damaged = {path for path in logs if not _is_sound(path, start, end)}
            self._passed_over |= damaged
            if damaged:
                yield from self._between(start, end, topics)


def _is_sound(log: Path, start: int, end: int) -> bool:
    try:
        for _ in iterate_messages([log], None, start, end):
            pass
    except LogError:
        return False
    return True
