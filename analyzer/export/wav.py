"""Clips of sound as WAV files."""

import wave
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.logs.typed_columns import TypedColumns
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.times import NANOSECONDS

FORMAT = "pcm-s16"
FIELDS = {"timestamp", "data", "format", "sample_rate", "number_of_channels"}
_SAMPLE_BYTES = 2
_HOLE = 5_000_000  # ns: stamps are as good as 1 ms, and what is lost is a frame at least
_RATE_LIMIT = 1_000_000  # Hz
_CHANNELS_LIMIT = 64
_FILE_LIMIT = 2 << 30  # bytes; WAV has no more than 4 GiB


class _Clip(NamedTuple):
    """One message of type RawAudio."""

    start: int
    data: bytes
    rate: int
    channels: int

    @property
    def end(self) -> int:
        samples = len(self.data) // (_SAMPLE_BYTES * self.channels)
        return self.start + samples * NANOSECONDS // self.rate


class WavFiles:
    """The clips of one topic, those that follow each other without a hole in one file.

    Parameters
    ----------
    name : callable
        Gives the path of the file that begins at a time, in nanoseconds of UTC.
    """

    def __init__(self, name: Callable[[int], Path]) -> None:
        self._name = name
        self._file: wave.Wave_write | None = None
        self._last: _Clip | None = None
        self._size = 0

    def write(self, piece: TypedColumns) -> None:
        """Append messages.

        Raises
        ------
        LogError
            If they are no sound that WAV can hold.
        """
        for clip in _clips(piece):
            if self._file is None or not self._follows(clip):
                self.finish()
                self._file = wave.open(str(self._name(clip.start)), "wb")  # noqa: SIM115
                self._file.setparams((clip.channels, _SAMPLE_BYTES, clip.rate, 0, "NONE", ""))
            self._file.writeframesraw(clip.data)
            self._last = clip
            self._size += len(clip.data)

    def finish(self) -> None:
        """Complete the file that is open."""
        if self._file is not None:
            self._file.close()
        self._file, self._size = None, 0

    def _follows(self, clip: _Clip) -> bool:
        last = self._last
        assert last is not None
        return (
            (clip.rate, clip.channels) == (last.rate, last.channels)
            and abs(clip.start - last.end) <= _HOLE
            and self._size + len(clip.data) <= _FILE_LIMIT
        )


def _clips(piece: TypedColumns) -> Iterator[_Clip]:
    columns = piece.columns
    fields = (columns[path].tolist() for path in ("format", "sample_rate", "number_of_channels"))
    for start, data, form, rate, channels in zip(
        columns["timestamp"].tolist(), columns["data"], *fields, strict=True
    ):
        what = ""
        if form != FORMAT:
            what = f"its format is {form!r}, not {FORMAT!r}"
        elif not 0 < rate <= _RATE_LIMIT:
            what = f"{rate} samples a second"
        elif not 0 < channels <= _CHANNELS_LIMIT:
            what = f"{channels} channels"
        elif len(data) % (channels * _SAMPLE_BYTES):
            what = f"{len(data)} bytes are no whole samples of {channels} channels"
        if what:
            raise LogError(f"{columns.topic}: no sound that can be saved as WAV ({what})")
        yield _Clip(start, bytes(data), rate, channels)
