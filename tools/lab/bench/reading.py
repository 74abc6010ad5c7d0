"""Features from logs to arrays: ours, its peers, and the least that any reader does."""

import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import HEAD, chunk_head
from hearthlog.schemas.messages.message_types import nanoseconds
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import BenchError, Seconds, best_of
from hearthlog.tools.lab.bench.workload import Workload

_TOPIC = "/mic/features"
_SHARE = Target(1.3, at_most=True)
_MINUTE_MILLISECONDS = Target(50, at_most=True)
_MINUTE = 60_000_000_000
_BLOCK = 32 << 10  # bytes, out of which rows are copied at once
_PEAK_MEGABYTES = Target(100, at_most=True)
_PEAK = """
from pathlib import Path
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.logs.columns import iterate_columns
def peak():  # of this process; what getrusage says begins with that of the one before it
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])
before = peak()
for batch in iterate_columns([Path(log) for log in {logs!r}]):
    del batch
print((peak() - before) / 1024)
"""

Read = tuple[NDArray[np.int64], NDArray[np.uint64], NDArray[np.float32]]


def measure(work: Workload) -> Table:
    """Measure reading what the live recorder leaves: an hour beside the peers, and a day alone.

    The peers read the whole hour, of the same file; none of them reads an unfinished one.
    """
    live = work.live
    hours = {"finished": live.finished, "chunks of 0.5 s": live.completed}
    rows = [row for name, log in hours.items() for row in _against_peers(name, log)]
    rows += _alone("unfinished", [live.unfinished])
    days = {"a day finished": work.day, "a day, chunks of 0.5 s": work.completed_day}
    for name, folder in days.items():
        logs = find_logs(folder)
        rows += _alone(name, logs)
        rows.append(_minute(name, logs))
    peak = _peak(find_logs(work.day))
    rows.append(Row("a day finished: peak memory", peak, "MB", target=_PEAK_MEGABYTES))
    frames = len(_columns([live.finished]))
    return Table(f"reading: features of {frames:,} frames a log, CPU time", rows)


def _alone(name: str, logs: Sequence[Path]) -> list[Row]:
    return _rows_of_ours(name, _ours_and_least(logs))


def _ours_and_least(logs: Sequence[Path]) -> dict[str, Seconds]:
    """Measure ours, decompression, and what any reader does besides."""
    count = len(_columns(logs))
    runs: dict[str, Callable[[], object]] = {
        "read": lambda: _columns(logs),
        "bare": lambda: _decompress(logs),
        "floor": lambda: _copy(logs, count),
    }
    return best_of(runs, 3)


def _rows_of_ours(name: str, best: Mapping[str, Seconds]) -> list[Row]:
    read, bare, floor = best["read"], best["bare"], best["floor"]
    checked = f"{name}: decompressed, checked, values copied"
    return [
        Row(f"{name}: to arrays", read.cpu, "s", elapsed=read.elapsed),
        Row(f"{name}: decompressed, nothing else", bare.cpu, "s", elapsed=bare.elapsed),
        Row(f"{name}: to arrays / decompressed", read.cpu / bare.cpu, ""),
        Row(checked, floor.cpu, "s", elapsed=floor.elapsed, note="what any reader must do"),
        Row(f"{name}: to arrays / all that", read.cpu / floor.cpu, "", target=_SHARE),
        Row(f"{name}: the same by the clock", read.elapsed / floor.elapsed, "", note="two threads"),
    ]


def _against_peers(name: str, log: Path) -> list[Row]:
    ours = _ours(log)
    count = len(ours[0])
    best = _ours_and_least([log])
    rows = _rows_of_ours(name, best)
    for peer, read_all in _PEERS.items():
        theirs = best_of({peer: partial(read_all, log, count)}, 1)[peer]
        ratio, possible = theirs.cpu / best["read"].cpu, theirs.cpu / best["floor"].cpu
        note = f"{possible:.1f} x would be possible"
        rows.append(
            Row(f"{name}: {peer}", theirs.cpu, "s", ratio, elapsed=theirs.elapsed, note=note)
        )
    for read_some in (_rosbags, _mcap_ros2):
        _check(ours, read_some(log, min(count, 1000)))
    return rows


def _minute(name: str, logs: Sequence[Path]) -> Row:
    """Measure reading a minute in the middle of some logs."""
    with LogFile(logs[len(logs) // 2]) as file:
        start = int(file.chunks["start"][0])

    def read() -> int:
        return len(read_columns(logs, [_TOPIC], start=start, end=start + _MINUTE)[_TOPIC])

    best = best_of({"minute": read}, 3)["minute"] / 1e-3
    what = f"{name}: a minute of it"
    return Row(what, best.cpu, "ms", target=_MINUTE_MILLISECONDS, elapsed=best.elapsed)


def _columns(logs: Sequence[Path]) -> Columns:
    return read_columns(logs, [_TOPIC])[_TOPIC]


def _ours(log: Path) -> Read:
    columns = _columns([log])
    return columns["header.stamp"], columns["frame"], columns["values"]


def _decompress(logs: Sequence[Path]) -> None:
    for log in logs:
        with LogFile(log) as file:
            for _ in _contents(file):
                pass


def _copy(logs: Sequence[Path], count: int) -> None:
    """Check all chunks, and copy so many rows of values out of them: as if parsing took no time.

    Rows are taken at even distances, which takes as long as from where they are.
    """
    width = DEFAULT.width * np.dtype(np.float32).itemsize
    rows, done = np.empty((count, width), np.uint8), 0
    for number, log in enumerate(logs, start=1):
        with LogFile(log) as file:
            missing, left = count * number // len(logs) - done, int(file.chunks["size"].sum())
            for block in _checked_blocks(_contents(file)):
                here = min(missing * len(block) // left, len(block) // width)
                step = (len(block) - width) // max(here - 1, 1)
                rows[done : done + here] = np.ndarray(
                    (here, width), np.uint8, block, strides=(step, 1)
                )
                done, missing, left = done + here, missing - here, left - len(block)


def _contents(file: LogFile) -> Iterator[bytes]:
    """Decompress each chunk of a log."""
    decompressor = zstandard.ZstdDecompressor()
    for offset, length, *_ in file.chunks.tolist():
        record = memoryview(file.read(offset, length))[HEAD.size :]
        head = chunk_head(record)
        yield decompressor.decompress(record[head.data], max_output_size=head.size)


def _checked_blocks(contents: Iterator[bytes]) -> Iterator[bytes]:
    """Compute checksums, and put small chunks together, for which numpy is slow."""
    block: list[bytes] = []
    for content in contents:
        zlib.crc32(content)
        block.append(content)
        if sum(map(len, block)) >= _BLOCK:
            yield b"".join(block)
            block.clear()
    if block:
        yield b"".join(block)


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


def _peak(logs: Sequence[Path]) -> float:
    code = _PEAK.format(logs=[str(log) for log in logs])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603  ours
    return float(done.stdout)


_PEERS: Mapping[str, Callable[[Path, int], Any]] = {
    "rosbags AnyReader": _rosbags,
    "mcap-ros2-support": _mcap_ros2,
    "Rerun McapReader, to Arrow": _rerun,
}


def contests(work: Workload) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Return ours and a peer's way to read the same logs."""
    hours = {"finished": work.live.finished, "chunks of 0.5 s": work.live.completed}
    return {
        f"reading, {name}: rosbags": (
            partial(_columns, [log]),
            partial(_rosbags, log, len(_columns([log]))),
        )
        for name, log in hours.items()
    }
