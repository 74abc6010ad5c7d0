"""A source of sound that loses some of it."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from threading import Event as Flag

from hearthlog.recorder.events import Event, Frames, Gap, SoundSource
from hearthlog.schemas.frames import FRAME_NANOSECONDS


class LossySource:
    """Another source, with frames lost before some of its blocks.

    Parameters
    ----------
    source : SoundSource
    lost : dict of int to int
        Frames lost before a block, by the number of the block.
    at_end : callable
        Called when the source has ended, before the recorder learns of it.
    """

    def __init__(
        self, source: SoundSource, lost: dict[int, int], at_end: Callable[[], object] = lambda: None
    ) -> None:
        self.device = source.device
        self._source = source
        self._lost = lost
        self._at_end = at_end

    def events(self, stop: Flag) -> Iterator[Event]:
        number = late = 0
        for event in self._source.events(stop):
            if not isinstance(event, Frames):
                yield replace(event, stamp=event.stamp + late * FRAME_NANOSECONDS)
                continue
            if lost := self._lost.get(number):
                start = int(event.stamps[0]) + late * FRAME_NANOSECONDS
                late += lost
                yield Gap(start, start + lost * FRAME_NANOSECONDS, "overrun", lost)
            number += 1
            stamps = event.stamps + late * FRAME_NANOSECONDS
            yield replace(event, first=event.first + late, stamps=stamps)
        self._at_end()
