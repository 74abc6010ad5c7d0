"""Segments as a label track of Audacity."""

from collections.abc import Sequence
from typing import BinaryIO

from hearthlog.analyzer.export.exporter import Table, table_exporter
from hearthlog.analyzer.logs.selection import Damages, LogSelection, TypedColumns
from hearthlog.schemas.errors import printable
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, iterate_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import topic as topic_of


class LabelTrack:
    """A label track being written: start, end and label, separated by tabs.

    Times are seconds since the first frame of the microphone in the span or, without frames, since
    the first segment. A segment that began before is cut.
    """

    def __init__(self, stream: BinaryIO, table: Table, selection: LogSelection) -> None:
        self._stream = stream
        self._zero = _first_frame(table.topic, selection)

    def write(self, pieces: Sequence[TypedColumns]) -> None:
        """Append segments.

        Raise `LogError` if one of these fields is missing.
        """
        for piece in pieces:
            self._write(piece.columns)

    def _write(self, columns: Columns) -> None:
        starts = columns["header.stamp"]
        if self._zero is None:
            self._zero = int(starts.min())
        ends = (starts + columns["duration"] - self._zero) / NANOSECONDS
        rows = zip(
            ((starts - self._zero) / NANOSECONDS).tolist(),
            ends.tolist(),
            columns["label"].tolist(),
            strict=True,
        )
        lines = [
            f"{max(start, 0):.6f}\t{max(end, 0):.6f}\t{' '.join(printable(label).split())}\n"
            for start, end, label in rows
            if end > 0  # or it ended before, and was logged in the span
        ]
        self._stream.write("".join(lines).encode())

    def finish(self) -> None:
        """Complete the file, which needs nothing."""


def _first_frame(topic: str, selection: LogSelection) -> int | None:
    features = topic_of(topic.split("/")[1] if topic.startswith("/") else "", "features")
    span = selection.start, selection.end
    stamps = {"header.stamp"}
    batches = iterate_columns(selection.logs, {features}, *span, stamps, on_damage=Damages().add)
    first = next(batches, None)
    return None if first is None else int(first[0]["header.stamp"].min())


EXPORTER = table_exporter(LabelTrack, message_types.SEGMENT, {"header.stamp", "duration", "label"})
