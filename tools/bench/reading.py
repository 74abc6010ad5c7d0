"""A day's features to arrays: ours, its peers, and the decompressor alone."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader

from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.logs.columns import Columns, iterate_columns, read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.mcap.formats import HEAD
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import chunk_head
from hearthlog.schemas.messages.message_types import nanoseconds
from hearthlog.tools.bench.table import Row, Table, Target
from hearthlog.tools.bench.timing import BenchError, best_of, hearthlog
from hearthlog.tools.bench.workload import Workload

_DAY = 86_400
_MIDNIGHT = "2026-03-01T00:00"  # so that it becomes one file
_TOPIC = "/mic/features"
_TWICE = Target(2, at_most=True)
_PEAK_MEGABYTES = Target(100, at_most=True)
_PEAK = """
from pathlib import Path
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.logs.columns import iterate_columns
def peak():  # of this process; what getrusage says begins with that of the one before it
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])
before = peak()
for batch in iterate_columns([Path({log!r})]):
    del batch
print((peak() - before) / 1024)
"""

Read = tuple[NDArray[np.int64], NDArray[np.uint64], NDArray[np.float32]]


def measure(work: Workload) -> Table:
    """Measure reading the log of a day that `hearthlog record` writes."""
    log = _day(work)
    stamps, frames, values = _ours(log)
    best = best_of(
        {
            "read": lambda: _columns(log),
            "decompress": lambda: _decompress(log),
            "iterate": lambda: _iterate(log),
        },
        3,
        time.perf_counter,
    )
    rows = [
        Row("hearthlog, to arrays", best["read"], "s"),
        Row("hearthlog, batch by batch", best["iterate"], "s"),
        Row("its chunks decompressed, nothing else", best["decompress"], "s"),
        Row("to arrays / decompressed", best["read"] / best["decompress"], "", target=_TWICE),
    ]
    for name, read, target in _PEERS:
        seconds = best_of({name: partial(read, log, len(frames))}, 1, time.perf_counter)[name]
        rows.append(Row(name, seconds, "s", seconds / best["read"], target))
    for peer in (_rosbags, _mcap_ros2):
        _check((stamps, frames, values), peer(log, 1000))
    rows.append(Row("peak memory, batch by batch", _peak(log), "MB", target=_PEAK_MEGABYTES))
    size = log.stat().st_size / 1e6
    return Table(f"reading: features of {len(frames):,} frames from {size:.0f} MB, elapsed", rows)


def _day(work: Workload) -> Path:
    folder = work.folder / "logs-day"
    sound = [work.wav] * max(round(_DAY / work.seconds), 1)
    hearthlog(
        [
            "record",
            *sound,
            "--model",
            work.model_file,
            "-o",
            folder,
            "-d",
            str(_DAY),
            "--start",
            _MIDNIGHT,
        ]
    )
    return find_logs(folder)[0]


def _columns(log: Path) -> Columns:
    return read_columns([log], [_TOPIC])[_TOPIC]


def _ours(log: Path) -> Read:
    columns = _columns(log)
    return columns["header.stamp"], columns["frame"], columns["values"]


def _iterate(log: Path) -> int:
    return sum(len(c) for batch in iterate_columns([log], [_TOPIC]) for c in batch)


def _decompress(log: Path) -> None:
    decompressor = zstandard.ZstdDecompressor()
    with LogFile(log) as file:
        for offset, length, *_ in file.chunks.tolist():
            record = memoryview(file.read(offset, length))[HEAD.size :]
            head = chunk_head(record)
            decompressor.decompress(record[head.data], max_output_size=head.size)


def _rosbags(log: Path, count: int) -> Read:
    with AnyReader([log]) as reader:
        chosen = [c for c in reader.connections if c.topic == _TOPIC]
        decoded = (reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(chosen))
        return _filled(decoded, count)


def _mcap_ros2(log: Path, count: int) -> Read:
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = (message for *_, message in reader.iter_decoded_messages([_TOPIC]))
        return _filled(decoded, count)


def _filled(decoded: Iterable[Any], count: int) -> Read:
    """Put the first messages into arrays."""
    stamps, frames = np.empty(count, np.int64), np.empty(count, np.uint64)
    values = np.empty((count, DEFAULT.width), np.float32)
    for row, message in zip(range(count), decoded, strict=False):
        stamps[row] = nanoseconds(message.header.stamp)
        frames[row] = message.frame
        values[row] = message.values
    return stamps, frames, values


def _rerun(log: Path, _count: int) -> int:
    chunks = McapReader(log, include_topic_regex=[_TOPIC]).stream()
    return sum(c.to_record_batch().num_rows for c in chunks if not c.is_static)


def _check(ours: Read, theirs: Read) -> None:
    count = len(theirs[0])
    if any((ours[i][:count] != theirs[i]).any() for i in range(3)):
        raise BenchError("two readers read different values")


def _peak(log: Path) -> float:
    code = _PEAK.format(log=str(log))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603  ours
    return float(done.stdout)


_PEERS: tuple[tuple[str, Callable[[Path, int], Any], Target | None], ...] = (
    ("rosbags AnyReader", _rosbags, Target(20)),
    ("mcap-ros2-support", _mcap_ros2, Target(100)),
    ("Rerun McapReader, to Arrow", _rerun, None),
)
