"""Features and labels from arrays to a log: as columns, and message by message."""

import time
from collections.abc import Iterator, Mapping
from itertools import count
from operator import itemgetter
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.log_stream import TopicBatch
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages.message_types import definition, encode, message, time_message
from hearthlog.schemas.messages.topics import Topic
from hearthlog.tools.bench.table import Row, Table, Target
from hearthlog.tools.bench.timing import best_of, hearthlog
from hearthlog.tools.bench.workload import Workload

_KINDS = ("/mic/features", "/mic/label")
_AT_ONCE = 7_200  # frames
_TEN_TIMES = Target(10)


def measure(work: Workload) -> Table:
    """Measure writing what `hearthlog record` wrote once more."""
    folder = work.folder / "logs-writing"
    hearthlog(["record", work.wav, "--model", work.model_file, "-o", folder])
    columns = read_columns(find_logs(folder), _KINDS)
    frames = len(columns[_KINDS[0]])
    numbers = count()
    best = best_of(
        {
            "columns": lambda: _as_columns(folder / f"{next(numbers)}.mcap", columns),
            "messages": lambda: _as_messages(folder / f"{next(numbers)}.mcap", columns),
        },
        2,
        time.perf_counter,
    )
    columns_rate, messages_rate = (frames / seconds for seconds in best.values())
    ratio = columns_rate / messages_rate
    return Table(
        f"writing: {frames:,} frames, two messages each, from arrays to a log, elapsed",
        [
            Row("hearthlog, columns", columns_rate, "frames/s"),
            Row("rosbags + mcap, messages", messages_rate, "frames/s", ratio, _TEN_TIMES),
        ],
    )


def _as_columns(path: Path, columns: Mapping[str, Columns]) -> None:
    writer = LogWriter(path, [Topic(name, part.type) for name, part in columns.items()], {})
    for start in range(0, len(columns[_KINDS[0]]), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        writer.write_columns(
            [
                TopicBatch(name, part.log_times[rows], {k: v[rows] for k, v in part.fields.items()})
                for name, part in columns.items()
            ]
        )
    writer.finish()


def _as_messages(path: Path, columns: Mapping[str, Columns]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        channels = {
            name: writer.register_channel(
                name,
                "cdr",
                writer.register_schema(part.type, "ros2msg", definition(part.type).encode()),
            )
            for name, part in columns.items()
        }
        encoded = [row for part in columns.values() for row in _encoded(part)]
        for log_time, topic, data in sorted(encoded, key=itemgetter(0)):
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()


def _encoded(columns: Columns) -> Iterator[tuple[int, str, bytes]]:
    names = [name for name in columns.fields if not name.startswith("header.")]
    stamps, frame_ids = columns["header.stamp"].tolist(), columns["header.frame_id"]
    values = zip(*(columns[name] for name in names), strict=True)
    for log_time, stamp, frame_id, row in zip(
        columns.log_times.tolist(), stamps, frame_ids, values, strict=True
    ):
        header = message("std_msgs/msg/Header", stamp=time_message(stamp), frame_id=frame_id)
        fields: dict[str, Any] = dict(zip(names, row, strict=True))
        yield log_time, columns.topic, encode(message(columns.type, header=header, **fields))
