"""The frames that could not be saved, where the log still tells how many they were."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from mcap.records import Message

from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE, parse_topic, topic
from hearthlog.schemas.salvage.frame_marks import FEATURES, GAP, INFO, LABEL, Mark, read_marks
from hearthlog.schemas.salvage.salvage import Salvage
from hearthlog.schemas.salvage.whole_records import WholeChunk
from hearthlog.schemas.times import NANOSECONDS

_OF_SOUND = {"features", "statistics", "label", "segment"}  # say that there was sound
_LATEST = NANOSECONDS << 31  # stamps have seconds of 32 bits


class LostFrames(NamedTuple):
    """Successive frames of a microphone that could not be saved."""

    end: int  # nanoseconds of UTC
    start: int
    microphone: str
    frames: int


class FrameSearch:
    """Looks for frames that are missing between the saved pieces of a log.

    Parameters
    ----------
    salvage : Salvage
        Of the log; `before` is told each of its pieces as it comes.
    """

    def __init__(self, salvage: Salvage) -> None:
        self._salvage = salvage
        self._followers: dict[str, _FrameFollower] = {}

    def before(self, piece: WholeChunk | Message) -> list[LostFrames]:
        """Find the frames that are missing before the first frames of a piece."""
        lost: list[LostFrames] = []
        for microphone, marks in read_marks(piece, self._salvage.definitions).items():
            if microphone not in self._followers:
                self._followers[microphone] = _FrameFollower(microphone, self._salvage)
            lost += self._followers[microphone].follow(marks)
        return sorted(lost)

    def at_end(self, ends: Mapping[int, int]) -> list[LostFrames]:
        """Find the frames that are missing behind the last piece.

        Parameters
        ----------
        ends : mapping of int to int
            Last log time that was saved of each channel, in nanoseconds of UTC.

        Returns
        -------
        list of LostFrames
            None of them ends before the last of these times.
        """
        heard: dict[str, int] = {}
        for number, end in ends.items():
            name = parse_topic(self._salvage.definitions.channels[number].topic)
            if name is not None and name.labelling == LIVE and name.kind in _OF_SOUND:
                heard[name.microphone] = max(heard.get(name.microphone, 0), end)
        last = max(ends.values(), default=0)
        followers = self._followers.items()
        return sorted(
            each for name, one in followers for each in one.at_end(heard.get(name, 0), last)
        )


class _Place(NamedTuple):
    """What is known of the place behind a mark."""

    number: int | None  # of the frame that follows
    time: int  # at which it follows, in nanoseconds of UTC
    of_frame: bool  # whether the mark is a frame


class _FrameFollower:
    """Follows the frames of one microphone, by its features or, if there are none, its labels."""

    def __init__(self, microphone: str, salvage: Salvage) -> None:
        self._name = microphone
        self._salvage = salvage
        # Without an index bytes can be missing between two records, and nothing is broken.
        gaps = topic(microphone, GAP)
        has_gaps = any(c.topic == gaps for c in salvage.definitions.channels.values())
        self._has_all_gaps = has_gaps and not salvage.complete
        self._kind = LABEL
        self._place: _Place | None = None  # behind the last mark
        self._damages = 0  # that lie before it

    def follow(self, marks: Sequence[Mark]) -> list[LostFrames]:
        if any(mark.kind == FEATURES for mark in marks):
            self._kind = FEATURES
        lost: list[LostFrames] = []
        has_frames = False
        for mark in marks:
            if mark.kind not in {self._kind, GAP, INFO} or self._is_repeated(mark):
                continue
            count = 0 if has_frames else self._missing(mark)  # a piece is whole in itself
            if count:
                lost += self._lost(self._start(mark, count), mark.start, count)
            has_frames |= mark.kind == self._kind
            self._place = self._behind(mark, count)
            self._damages = self._salvage.damage_count
        return lost

    def at_end(self, heard: int, last: int) -> list[LostFrames]:
        """Find the frames behind the last one; `heard` is when there still was sound."""
        if self._place is None or self._place.number is None or not self._is_damaged():
            return []
        start = self._place.time
        count = self._counted()
        if not count and self._kind == FEATURES:  # labels end before the sound
            count = (heard - start) // FRAME_NANOSECONDS
        return self._lost(start, max(start + count * FRAME_NANOSECONDS, last), count)

    def _is_repeated(self, mark: Mark) -> bool:
        """Tell whether a mark was passed already: a damaged file may hold a piece twice."""
        return self._place is not None and mark.end <= self._place.time

    def _missing(self, mark: Mark) -> int:
        """Count the frames that are missing before a mark."""
        if mark.kind == INFO:  # another recording begins, or the next log of a merged one
            return 0
        if self._place is None:
            return self._counted()
        number, time, of_frame = self._place
        if not self._is_damaged() and not (of_frame and mark.kind != GAP and self._has_all_gaps):
            return 0
        by_time = max(round((mark.start - time) / FRAME_NANOSECONDS), 0)
        if mark.kind == GAP:
            return by_time
        return min(by_time, mark.number) if number is None else max(mark.number - number, 0)

    def _start(self, mark: Mark, count: int) -> int:
        if self._place is None or self._place.number is None:
            return mark.start - count * FRAME_NANOSECONDS
        return self._place.time

    def _behind(self, mark: Mark, missing: int) -> _Place:
        if mark.kind == INFO:
            return _Place(None, mark.start, of_frame=False)
        if mark.kind != GAP:
            return _Place(mark.number + 1, mark.end, of_frame=True)
        number = None if self._place is None else self._place.number
        if number is not None:
            number += missing + mark.number
        return _Place(number, mark.end, of_frame=False)

    def _is_damaged(self) -> bool:
        return self._salvage.damage_count > self._damages

    def _counted(self) -> int:
        """Count the frames in the damages since the last mark; 0 if that is not known."""
        damages = self._salvage.damages()[self._damages :]
        if not all(damage.exact for damage in damages):
            return 0
        return sum(damage.messages.get(topic(self._name, self._kind), 0) for damage in damages)

    def _lost(self, start: int, end: int, count: int) -> list[LostFrames]:
        if count <= 0 or not 0 <= start < end < _LATEST:
            return []
        return [LostFrames(end, start, self._name, count)]
