"""The time span and the message counts of a log, without its index where it is finished."""

import struct
import zlib
from collections import Counter
from contextlib import closing, suppress
from pathlib import Path

from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.mcap.chunk_records import iterate_records
from hearthlog.schemas.mcap.chunk_table import LAST_TIME
from hearthlog.schemas.mcap.formats import FOOTER, FOOTER_SIZE, HEAD, SUMMARY_OFFSET
from hearthlog.schemas.mcap.logfile import LogFile, open_log
from hearthlog.schemas.mcap.records import LIMIT, parse, read_footer
from hearthlog.schemas.storage.byte_ranges import LocalFile, StoredFile

_SIZE_LIMIT = 1 << 20  # bytes of the records of one kind that are read


def time_span(path: Path, *, partial: bool = False) -> tuple[int, int] | None:
    """Find the first and the last log time of a log.

    Returns
    -------
    tuple of int, or None
        The two log times in nanoseconds of UTC; None if the log has no messages.

    Raises
    ------
    LogError
        If it cannot be read, is not an MCAP file, or is damaged.
    """
    stated = stated_span(path)
    if stated is not None:
        return stated[0]
    with LogFile(path, partial=partial) as log:
        return log.span


def stated_span(path: Path) -> tuple[tuple[int, int] | None] | None:
    """Read the first and the last log time of a log from its statistics alone.

    Returns
    -------
    tuple or None
        Holds the two log times in nanoseconds of UTC, or None if the log has no messages. None if
        the log is unfinished or its index is damaged: then only walking through it tells.

    Raises
    ------
    LogError
        If it cannot be read.
    """
    try:
        _, opened = open_log(path)
        with closing(opened) as file:
            statistics = _statistics(file) if _is_summary_sound(file) else None
    except (McapError, UnicodeDecodeError, struct.error):
        return None
    if statistics is None:
        return None
    times = statistics.message_start_time, statistics.message_end_time
    if max(times) > LAST_TIME:
        return None
    return (times if statistics.message_count else None,)


def topic_counts(path: Path) -> Counter[str]:
    """Count the messages of each topic by the statistics of a finished log.

    Returns
    -------
    Counter of str
        Messages by topic, as the log claims, but no more of a channel than the log has bytes.
        Nothing is counted if the log has no statistics, they are damaged, or it cannot be read.
    """
    topics: Counter[str] = Counter()
    with suppress(LogError, McapError, UnicodeDecodeError, struct.error):
        _, opened = open_log(path)
        with closing(opened) as file:
            statistics = _statistics(file)
            counts = {} if statistics is None else statistics.channel_message_counts
            for channel in _summary_group(file, Opcode.CHANNEL):
                if isinstance(channel, records.Channel):
                    most = file.size  # a message takes more than a byte
                    topics[channel.topic] += min(counts.get(channel.id, 0), most)
    return topics


def _is_summary_sound(file: LocalFile | StoredFile) -> bool:
    """Compare the summary of a finished log with its checksum, if it has one."""
    end = file.size - FOOTER_SIZE
    footer = read_footer(file.read(max(end, 0), FOOTER_SIZE))
    if footer is None or not footer.summary_crc:
        return True
    start = footer.summary_start
    if not 0 < start <= end or end - start > LIMIT:
        return False
    summary = file.read(start, end - start + HEAD.size + FOOTER.size)
    return zlib.crc32(summary) == footer.summary_crc


def _statistics(file: LocalFile | StoredFile) -> records.Statistics | None:
    """Read the statistics of a finished log, without the rest of its index."""
    for record in _summary_group(file, Opcode.STATISTICS):
        if isinstance(record, records.Statistics):
            return record
    return None


def _summary_group(file: LocalFile | StoredFile, opcode: int) -> list[McapRecord | None]:
    """Read the records of one kind in the summary of a finished log."""
    end = max(file.size - FOOTER_SIZE, 0)
    footer = read_footer(file.read(end, FOOTER_SIZE))
    if footer is None:
        return []
    size = end - footer.summary_offset_start
    if not footer.summary_offset_start or not 0 <= size <= _SIZE_LIMIT:
        return []
    offsets = file.read(footer.summary_offset_start, size)
    for group, start, length in SUMMARY_OFFSET.iter_unpack(offsets):
        if group == opcode and length <= _SIZE_LIMIT and start < end:
            raw = file.read(start, length)
            return [parse(kind, raw[a + HEAD.size : b]) for kind, a, b in iterate_records(raw)]
    return []
