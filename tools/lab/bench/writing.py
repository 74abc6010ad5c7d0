"""Features and labels from arrays to a log: as columns, and message by message."""

from collections.abc import Callable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages.message_types import definition, encode, message, time_message
from hearthlog.schemas.messages.topics import Topic
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import best_of
from hearthlog.tools.lab.bench.workload import Workload

_KINDS = ("/mic/features", "/mic/label")
_AT_ONCE = 7_200  # frames
_FIFTEEN_TIMES = Target(15)


def measure(work: Workload) -> Table:
    """Measure writing what a recorder wrote once more."""
    columns = read_columns([work.live.finished], _KINDS)
    frames = len(columns[_KINDS[0]])
    best = best_of(_ways(work, columns), 3)
    (by_columns, by_messages), unit = best.values(), "frames/s"
    ratio = by_messages.cpu / by_columns.cpu
    rates = [frames / seconds for pair in best.values() for seconds in pair]
    return Table(
        f"writing: {frames:,} frames, two messages each, from arrays to a log, CPU time",
        [
            Row("hearthlog, columns", rates[0], unit, elapsed=rates[1]),
            Row(
                "rosbags + mcap, messages",
                rates[2],
                unit,
                ratio,
                _FIFTEEN_TIMES,
                elapsed=rates[3],
            ),
        ],
    )


def contests(work: Workload) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Return ours and the peers' way to write the same messages."""
    ours, theirs = _ways(work, read_columns([work.live.finished], _KINDS)).values()
    return {"writing: rosbags + mcap": (ours, theirs)}


def _ways(work: Workload, columns: Mapping[str, Columns]) -> dict[str, Callable[[], object]]:
    path = work.folder / "written.mcap"

    def as_columns() -> None:
        path.unlink(missing_ok=True)
        _as_columns(path, columns)

    return {"columns": as_columns, "messages": lambda: _as_messages(path, columns)}


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
