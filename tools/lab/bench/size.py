"""Bytes of a log on disk, and what they are spent on."""

import struct
from collections import Counter, defaultdict
from pathlib import Path

import zstandard
from mcap.records import Channel, Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader, breakup_chunk

from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.workload import Workload

_DAY = 86_400
_MEGABYTES = Target(350, at_most=True)
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
_RECORD_HEAD = 9
_INDEX, _REST = "index of messages", "the rest"


def measure(work: Workload) -> Table:
    """Measure a log of the live recorder."""
    log = work.live.finished
    total, bytes_of = log.stat().st_size, _parts(log)
    unfinished = work.live.unfinished.stat().st_size
    megabytes = _DAY / work.seconds / 1e6
    rows = [Row("the whole log", total * megabytes, "MB a day", target=_MEGABYTES)]
    rows += [
        Row(name, size * megabytes, "MB a day", note=f"{size / total:.1%}")
        for name, size in bytes_of.most_common()
    ]
    rows.append(Row("before it was finished", unfinished * megabytes, "MB a day"))
    return Table(f"size: a finished log of {work.seconds:.0f} s", rows)


def _parts(log: Path) -> Counter[str]:
    """Bytes on disk by topic, of the message indexes, and of everything else."""
    topics: dict[int, str] = {}
    parts: Counter[str] = Counter()
    with log.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Chunk):
                parts.update(_shares(record, topics))
            elif isinstance(record, MessageIndex):
                parts[_INDEX] += _RECORD_HEAD + 6 + 16 * len(record.records)
    parts[_REST] = log.stat().st_size - parts.total()
    return parts


def _shares(chunk: Chunk, topics: dict[int, str]) -> Counter[str]:
    """Divide a compressed chunk among its topics as each of them compresses alone."""
    rows: defaultdict[str, bytearray] = defaultdict(bytearray)
    for record in breakup_chunk(chunk):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            head = _MESSAGE.pack(
                5,
                _MESSAGE.size - _RECORD_HEAD + len(record.data),
                record.channel_id,
                record.sequence,
                record.log_time,
                record.publish_time,
            )
            rows[topics[record.channel_id]] += head + record.data
    alone = {topic: len(zstandard.compress(bytes(data))) for topic, data in rows.items()}
    scale = len(chunk.data) / sum(alone.values()) if alone else 0.0
    return Counter({topic: round(size * scale) for topic, size in alone.items()})
