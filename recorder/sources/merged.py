"""The events of several microphones, in the order in which they come."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from queue import Full, Queue
from threading import Event as Flag
from threading import Thread

from hearthlog.recorder.events import Event, SoundSource

# Three minutes of a microphone, beyond what its pipe holds: so long the disk may be waited for.
_EVENTS = 300
_LOOK_SECONDS = 1.0


def merged_events(sources: Mapping[str, SoundSource], stop: Flag) -> Iterator[tuple[str, Event]]:
    """Yield the events of microphones, each of several read by a thread of its own."""
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
    """Put the events of a source into a queue, then None, or why it cannot go on."""
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
