"""Events of a sound source (frames, gaps, health), and several sources merged by time."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Full, Queue
from threading import Event as Flag
from threading import Thread
from typing import NamedTuple, Protocol

from hearthlog.schemas.arrays import Float32, Int64

OK, WARNING, ERROR = 0, 1, 2  # levels of diagnostic_msgs
LISTENING = "listening"  # health summary of a microphone
READING = "reading"  # health summary of audio files


@dataclass(frozen=True)
class SourceHealth:
    """Health of a sound source."""

    stamp: int  # in nanoseconds of UTC
    level: int  # `OK`, `WARNING` or `ERROR`
    summary: str
    values: Mapping[str, str] = field(default_factory=dict)  # details by name


@dataclass(frozen=True)
class Frames:
    """Successive frames of sound."""

    first: int
    samples: Float32  # [shape=(n, 800)] samples in full scale, -1 to 1
    stamps: Int64  # [shape=(n,)] time of each frame's first sample in nanoseconds of UTC
    # [shape=(n, 800, c)] samples of all microphones of an array, with `samples` as the first; None
    # for a single microphone
    channels: Float32 | None = None
    reports: tuple[SourceHealth, ...] = ()
    filtered: Float32 | None = None  # `samples` after the infrasound filter, if the source has one

    def part(self, start: int, stop: int) -> "Frames":
        """Return the frames in a range of at least one row, with their reports."""
        rows = slice(start, stop)
        stamps = self.stamps[rows]
        channels = None if self.channels is None else self.channels[rows]
        reports = tuple(each for each in self.reports if stamps[0] <= each.stamp <= stamps[-1])
        filtered = None if self.filtered is None else self.filtered[rows]
        return Frames(self.first + start, self.samples[rows], stamps, channels, reports, filtered)


@dataclass(frozen=True)
class Gap:
    """Audio that was not recorded."""

    start: int  # in nanoseconds of UTC
    end: int
    reason: str
    frames_lost: int


Event = Frames | Gap | SourceHealth


class SoundSource(Protocol):
    """A source of sound."""

    @property
    def device(self) -> str:
        """Name of the device in use."""

    def events(self, stop: Flag) -> Iterator[Event]:
        """Yield the events of the source.

        Parameters
        ----------
        stop : threading.Event
            Ends the source when set.

        Yields
        ------
        Event
            Frames, gaps and health, in the order of time.
        """


def event_time(event: Event) -> int:
    """Return the last time of an event, in nanoseconds of UTC."""
    if isinstance(event, Frames):
        return int(event.stamps[-1])
    return event.end if isinstance(event, Gap) else event.stamp


class Notice(NamedTuple):
    """A text about the recorder for its log."""

    level: int  # `OK`, `WARNING` or `ERROR`
    text: str


# Three minutes of a microphone, in addition to its pipe: the longest tolerated wait for the disk.
_EVENTS = 300
_LOOK_SECONDS = 1.0


def merged_events(sources: Mapping[str, SoundSource], stop: Flag) -> Iterator[tuple[str, Event]]:
    """Yield the events of microphones; several microphones are read in a thread each."""
    if len(sources) == 1:
        yield from ((name, event) for name in sources for event in sources[name].events(stop))
        return
    events: Queue[tuple[str, Event | BaseException | None]] = Queue(_EVENTS)
    closed = Flag()
    for name, source in sources.items():
        reader = (name, source, stop, events, closed)
        Thread(target=_read, args=reader, name=f"microphone {name}", daemon=True).start()
    running = set(sources)
    try:
        while running:
            name, event = events.get()
            if isinstance(event, BaseException):
                raise event
            if event is None:
                running.remove(name)
            else:
                yield name, event
    finally:
        closed.set()


def _read(
    name: str,
    source: SoundSource,
    stop: Flag,
    events: "Queue[tuple[str, Event | BaseException | None]]",
    closed: Flag,
) -> None:
    """Put the events of a source into a queue, then None, or the error that ended it."""
    try:
        for event in source.events(stop):
            _put(events, (name, event), closed)
    except BaseException as error:  # noqa: BLE001  the recorder raises it
        _put(events, (name, error), closed)
    else:
        _put(events, (name, None), closed)


def _put(
    events: "Queue[tuple[str, Event | BaseException | None]]",
    item: tuple[str, Event | BaseException | None],
    closed: Flag,
) -> None:
    while not closed.is_set():
        with suppress(Full):
            events.put(item, timeout=_LOOK_SECONDS)
            return
