"""Export of audio clips as WAV files, and of segments as an Audacity label track."""

import wave
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np

from hearthlog.analyzer.export.exporter import (
    Exporter,
    OutputFiles,
    Table,
    table_exporter,
    write_tables,
)
from hearthlog.analyzer.logs.clips import CLIP_FIELDS, SAMPLE_BYTES, LoggedClip, clips_of
from hearthlog.analyzer.logs.selection import Damages, LogSelection, TypedColumns
from hearthlog.schemas.errors import LogError, Progress, printable
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import iterate_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import RAW_AUDIO
from hearthlog.schemas.messages.topics import topic as topic_of

_HOLE = 5_000_000  # ns: stamps are accurate to 1 ms, and a loss is at least one frame
_FILE_LIMIT = 2 << 30  # bytes; the WAV limit is 4 GiB


class WavFiles:
    """Writer of one topic's clips; consecutive clips without a gap share a file.

    `name` returns the path of the file that begins at a given time (nanoseconds of UTC).
    """

    def __init__(self, name: Callable[[int], Path]) -> None:
        self._name = name
        self._file: wave.Wave_write | None = None
        self._last: LoggedClip | None = None
        self._size = 0

    def write(self, pieces: Sequence[TypedColumns]) -> None:
        """Append clips; start a new file after a gap or a format change.

        Raise `LogError` if the messages hold no audio that fits WAV; the callable `name` may raise
        it too.
        """
        try:
            for piece in pieces:
                for clip in clips_of(piece.columns):
                    self._append(clip)
        except (LogError, OSError):
            with suppress(OSError):
                self.finish()
            raise

    def _append(self, clip: LoggedClip) -> None:
        if self._file is None or not self._follows(clip):
            self.finish()
            self._file = wave.open(str(self._name(clip.start)), "wb")  # noqa: SIM115
            self._file.setparams((clip.channels, SAMPLE_BYTES, clip.rate, 0, "NONE", ""))
        self._file.writeframesraw(clip.data)
        self._last = clip
        self._size += len(clip.data)

    def finish(self) -> None:
        """Complete the open file."""
        file, self._file, self._size = self._file, None, 0
        if file is not None:
            file.close()

    def _follows(self, clip: LoggedClip) -> bool:
        last = self._last
        assert last is not None
        return (
            (clip.rate, clip.channels) == (last.rate, last.channels)
            and abs(clip.start - last.end) <= _HOLE
            and self._size + len(clip.data) <= _FILE_LIMIT
        )


def _save_wav(selection: LogSelection, files: OutputFiles, progress: Progress) -> None:
    def opened(table: Table) -> WavFiles:
        return WavFiles(lambda start: files.new(f"{table.stem}_{_moment(start)}"))

    write_tables(selection, files, progress, opened, RAW_AUDIO)


def _moment(time: int) -> str:
    seconds, rest = divmod(time, NANOSECONDS)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y%m%dT%H%M%S}.{rest // 1000:06}Z"


WAV = Exporter(_save_wav, RAW_AUDIO, CLIP_FIELDS)


class LabelTrack:
    """Writer of a label track: start, end and label, separated by tabs.

    Times are seconds since the microphone's first frame in the span or, without frames, since
    the first segment. Segments that began earlier are clipped.
    """

    def __init__(self, stream: BinaryIO, table: Table, selection: LogSelection) -> None:
        self._stream = stream
        self._zero = _first_frame(table.topic, selection)

    def write(self, pieces: Sequence[TypedColumns]) -> None:
        """Append segments.

        Raise `LogError` if a required field is missing.
        """
        for piece in pieces:
            starts, lengths = (piece.columns[name] for name in ("header.stamp", "duration"))
            if self._zero is None:
                self._zero = int(starts.min())
            times = np.stack([starts, starts + lengths], axis=1) - self._zero
            labels = piece.columns["label"].tolist()
            lines = [
                f"{max(start, 0):.6f}\t{max(end, 0):.6f}\t{' '.join(printable(label).split())}\n"
                for (start, end), label in zip((times / NANOSECONDS).tolist(), labels, strict=True)
                if end > 0  # otherwise the segment ended before the span and was logged in it
            ]
            self._stream.write("".join(lines).encode())

    def finish(self) -> None:
        """Do nothing: the file is complete after each write."""


def _first_frame(topic: str, selection: LogSelection) -> int | None:
    features = topic_of(topic.split("/")[1] if topic.startswith("/") else "", "features")
    span = selection.start, selection.end
    stamps = {"header.stamp"}
    batches = iterate_columns(selection.logs, {features}, *span, stamps, on_damage=Damages().add)
    first = next(batches, None)
    return None if first is None else int(first[0]["header.stamp"].min())


LABEL_TRACK = table_exporter(
    LabelTrack, message_types.SEGMENT, {"header.stamp", "duration", "label"}
)
