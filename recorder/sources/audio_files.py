"""Audio files in place of a microphone."""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Event as Flag

import numpy as np

from hearthlog.recorder.errors import SourceError
from hearthlog.recorder.events import OK, Event, SourceHealth
from hearthlog.recorder.sources.decoding import audio_seconds, check_channels, read_audio
from hearthlog.recorder.sources.framing import frames_of
from hearthlog.recorder.sources.wall_clock import check_times
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.times import NANOSECONDS

_REALTIME_FRAMES = 10
_HEALTH_FRAMES = 200  # every 10 s


class FileSource:
    """Several audio files in a row, as one stream of frames.

    The last samples are dropped where they do not fill a frame.

    Parameters
    ----------
    paths : sequence of Path
    start : int
        Time of the first sample in nanoseconds of UTC.
    realtime : bool
        Whether to yield each frame only once as much time has passed since the first one.
    channels : int or None
        Of an array, which the files must have; None: their channels are averaged.
    progress : callable
        Told the share of the sound that was read, 0 to 1.

    Attributes
    ----------
    realtime : bool

    Raises
    ------
    SourceError
        If one of the files is missing, is not audio, holds none, has a sample rate that cannot be
        recorded, or other channels than the array; if a log cannot have their times.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        start: int,
        *,
        realtime: bool = False,
        channels: int | None = None,
        progress: Progress = ignore_progress,
    ) -> None:
        for path in paths:
            check_channels(path, channels)
        self._seconds = sum(audio_seconds(path) for path in paths)
        check_times(start, start + int(self._seconds * NANOSECONDS))
        self.device = _name(paths)
        self._paths = paths
        self._start = start
        self.realtime = realtime
        self._channels = channels
        self._progress = progress

    def events(self, stop: Flag) -> Iterator[Event]:
        """Yield the frames, and the health of the source every ten seconds of sound.

        Parameters
        ----------
        stop : threading.Event
            Ends the source when it is set.

        Yields
        ------
        Event
            `Frames` and `SourceHealth`, in the order of time.

        Raises
        ------
        SourceError
            If a file turns out to be damaged, or if all together are shorter than a frame.
        """
        began = time.monotonic()
        first = 0
        for samples in self._frames():
            frames = frames_of(first, samples, self._stamps(first, len(samples)))
            if self.realtime:
                due = began + (first + len(samples)) * FRAME_NANOSECONDS / NANOSECONDS
                stop.wait(max(due - time.monotonic(), 0.0))
            if stop.is_set():
                return
            if first % _HEALTH_FRAMES == 0:
                yield SourceHealth(int(frames.stamps[0]), OK, "reading", {"device": self.device})
            yield frames
            first += len(samples)
            self._progress(first * FRAME_NANOSECONDS / NANOSECONDS / self._seconds)
        if first == 0:
            files = ", ".join(str(path) for path in self._paths)
            raise SourceError(f"{files}: shorter than one frame of 50 ms")

    def _stamps(self, first: int, count: int) -> Int64:
        return self._start + np.arange(first, first + count) * FRAME_NANOSECONDS

    def _frames(self) -> Iterator[Float32]:
        """Yield blocks of frames whose number divides the interval of the health reports."""
        size = (_REALTIME_FRAMES if self.realtime else _HEALTH_FRAMES) * FRAME_SAMPLES
        shape = () if self._channels is None else (self._channels,)
        held = np.empty((0, *shape), np.float32)
        for path in self._paths:
            for block in read_audio(path, channels=self._channels):
                held = np.concatenate([held, block])
                whole = len(held) - len(held) % size
                for start in range(0, whole, size):
                    yield held[start : start + size].reshape(-1, FRAME_SAMPLES, *shape)
                held = held[whole:]
        rest = len(held) - len(held) % FRAME_SAMPLES
        if rest:
            yield held[:rest].reshape(-1, FRAME_SAMPLES, *shape)


def _name(paths: Sequence[Path]) -> str:
    """Name the files in a few words, since every diagnostic message repeats them."""
    if len(paths) == 1:
        return paths[0].name
    return f"{paths[0].name} … {paths[-1].name} ({len(paths)} files)"
