"""Clips of sound as frames and the gaps between them."""

from collections.abc import Iterator

import numpy as np
import soxr
from numpy.typing import NDArray

from hearthlog.recorder.events import Frames, Gap
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.schemas.times import NANOSECONDS

_JOINED = 10_000_000  # nanoseconds between clips that still follow each other
_REASON = "no clip holds it"


class ClipFramer:
    """Cuts clips into frames: those that follow each other as one sound.

    After a hole the next frame begins with the first sample of a clip. What fills no frame before
    a hole is not heard.
    """

    def __init__(self) -> None:
        self._next_frame = 0
        self._end: int | None = None  # of the last frame, in UTC
        self._rate = 0  # of the clips that follow each other; 0: none was heard yet
        self._heard = 0  # samples of theirs
        self._held = np.empty(0, np.float32)
        self._cut = 0  # frames that were cut from them
        self._resampler: soxr.ResampleStream | None = None
        # Where clips begin, in nanoseconds of their sound, and how much later that is in UTC.
        self._starts: list[int] = []
        self._offsets: list[int] = []

    def add(self, start: int, rate: int, samples: Float32) -> Iterator[Frames | Gap]:
        """Take a clip, and hand on the frames that it completes and the gap before them.

        Parameters
        ----------
        start : int
            Time of its first sample, in nanoseconds of UTC.
        rate : int
            Samples per second.
        samples : np.ndarray [shape=(n,)], float32
        """
        if rate != self._rate or abs(start - self._expected()) > _JOINED:
            yield from self.finish()
            self._rate, self._heard, self._cut = rate, 0, 0
            self._starts, self._offsets = [], []
            if rate != SAMPLE_RATE:
                self._resampler = soxr.ResampleStream(rate, SAMPLE_RATE, 1, dtype="float32")
        position = self._position()
        self._starts.append(position)
        self._offsets.append(start - position)
        self._heard += len(samples)
        if self._resampler is not None:
            samples = self._resampler.resample_chunk(samples)
        yield from self._frames(samples)

    def finish(self) -> Iterator[Frames | Gap]:
        """Hand on what is left of the clips that follow each other."""
        if self._resampler is not None:
            rest = self._resampler.resample_chunk(np.empty(0, np.float32), last=True)
            yield from self._frames(rest)
        self._resampler = None
        self._held = np.empty(0, np.float32)

    def _position(self) -> int:
        """Return how long the clips that follow each other last so far, in nanoseconds."""
        return self._heard * NANOSECONDS // self._rate

    def _expected(self) -> int:
        return self._position() + self._offsets[-1]

    def _frames(self, samples: Float32) -> Iterator[Frames | Gap]:
        self._held = np.concatenate([self._held, samples])
        count = len(self._held) // FRAME_SAMPLES
        if not count:
            return
        frames, self._held = np.split(self._held, [count * FRAME_SAMPLES])
        stamps = self._stamps(count)
        if self._cut == 0 and self._end is not None:
            start, end = self._end, int(stamps[0])
            lost = max(round((end - start) / FRAME_NANOSECONDS), 1)
            self._next_frame += lost
            yield Gap(start, end, _REASON, lost)
        yield Frames(self._next_frame, frames.reshape(count, FRAME_SAMPLES), stamps)
        self._next_frame += count
        self._cut += count
        self._end = int(stamps[-1]) + FRAME_NANOSECONDS

    def _stamps(self, count: int) -> NDArray[np.int64]:
        """Return when the next frames start: each by the clip that it starts in."""
        positions = (self._cut + np.arange(count)) * FRAME_NANOSECONDS
        clips = np.searchsorted(self._starts, positions, side="right") - 1
        stamps = positions + np.array(self._offsets)[clips]
        self._starts, self._offsets = self._starts[clips[-1] :], self._offsets[clips[-1] :]
        return stamps
