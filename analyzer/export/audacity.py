"""Segments as a label track of Audacity."""

from typing import BinaryIO

from hearthlog.analyzer.export.exporter import stream_exporter
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.analyzer.logs.typed_columns import TypedColumns
from hearthlog.schemas.logs.columns import iterate_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import topic as topic_of
from hearthlog.schemas.text import printable
from hearthlog.schemas.times import NANOSECONDS


class LabelTrack:
    """A label track being written: start, end and label, separated by tabs.

    Times are seconds since the first frame of the microphone in the span or, without frames, since
    the first segment. A segment that began before is cut.

    Parameters
    ----------
    stream : binary file
        Is written to.
    topic : str
        Such as `/mic/segment`.
    selection : Selection
        Has the topic.
    """

    def __init__(self, stream: BinaryIO, topic: str, selection: Selection) -> None:
        self._stream = stream
        self._zero = _first_frame(topic, selection)

    def write(self, piece: TypedColumns) -> None:
        """Append segments.

        Parameters
        ----------
        piece : TypedColumns
            Messages with the fields `header.stamp`, `duration` and `label`.

        Raises
        ------
        LogError
            If one of these fields is missing.
        """
        columns = piece.columns
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


def _first_frame(topic: str, selection: Selection) -> int | None:
    features = topic_of(topic.split("/")[1] if topic.startswith("/") else "", "features")
    batches = iterate_columns(
        selection.logs, {features}, selection.start, selection.end, {"header.stamp"}
    )
    first = next(batches, None)
    return None if first is None else int(first[0]["header.stamp"].min())


EXPORTER = stream_exporter(LabelTrack, message_types.SEGMENT, {"header.stamp", "duration", "label"})
