"""Clips of sound as frames and the gaps between them."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.sources.framing import FrameCutter
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

_JOINED = 10_000_000  # nanoseconds at most between clips that follow each other
_REASON = "no clip holds it"


class ClipFramer:
    """Cuts clips into frames; clips that follow each other are one sound.

    After a hole the next frame begins with the first sample of a clip. Samples before a hole that
    do not fill a frame are dropped.
    """

    def __init__(self) -> None:
        self._next_frame = 0
        self._end: int | None = None  # end of the last frame, in nanoseconds of UTC
        self._rate = 0  # of the clips that follow each other; 0 before the first one
        self._samples = 0  # number of their samples
        self._frames = 0  # number of frames cut from them
        self._cutter = FrameCutter()
        # Where clips begin, in nanoseconds of their sound, and how much later that is in UTC.
        self._starts: list[int] = []
        self._offsets: list[int] = []

    def add(self, start: int, rate: int, samples: Float32) -> Iterator[Frames | Gap]:
        """Add a clip, and yield the frames that it completes and the gap before them.

        Parameters
        ----------
        start : int
            Time of its first sample, in nanoseconds of UTC.
        rate : int
            Samples per second.
        samples : np.ndarray [shape=(n,)], float32

        Yields
        ------
        Frames or Gap
            In the order of time: the last frames before a hole, the gap, the frames of this clip.
        """
        if rate != self._rate or abs(start - self._expected()) > _JOINED:
            yield from self.finish()
            self._rate, self._samples, self._frames = rate, 0, 0
            self._starts, self._offsets = [], []
            self._cutter = FrameCutter(rate)
        position = self._position()
        self._starts.append(position)
        self._offsets.append(start - position)
        self._samples += len(samples)
        yield from self._events(self._cutter.push(samples))

    def finish(self) -> Iterator[Frames | Gap]:
        """Yield the last frames of the clips that follow each other, and a gap before them."""
        yield from self._events(self._cutter.push(np.empty(0, np.float32), last=True))
        self._cutter = FrameCutter()

    def _position(self) -> int:
        """Return the length of the clips so far that follow each other, in nanoseconds."""
        return self._samples * NANOSECONDS // self._rate

    def _expected(self) -> int:
        return self._position() + self._offsets[-1]

    def _events(self, frames: Float32) -> Iterator[Frames | Gap]:
        count = len(frames)
        if not count:
            return
        stamps = self._stamps(count)
        if self._frames == 0 and self._end is not None:
            start, end = self._end, int(stamps[0])
            lost = max(round((end - start) / FRAME_NANOSECONDS), 1)
            self._next_frame += lost
            yield Gap(start, end, _REASON, lost)
        yield Frames(self._next_frame, frames, stamps)
        self._next_frame += count
        self._frames += count
        self._end = int(stamps[-1]) + FRAME_NANOSECONDS

    def _stamps(self, count: int) -> NDArray[np.int64]:
        """Return when the next frames start, each by the clip that it starts in."""
        positions = (self._frames + np.arange(count)) * FRAME_NANOSECONDS
        clips = np.searchsorted(self._starts, positions, side="right") - 1
        stamps = positions + np.array(self._offsets)[clips]
        self._starts, self._offsets = self._starts[clips[-1] :], self._offsets[clips[-1] :]
        return stamps
