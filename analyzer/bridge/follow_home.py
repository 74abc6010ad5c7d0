"""Follow the log of one recorder from some time on, and then live, without a seam."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event as Flag

import numpy as np

from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.home_state import FIELDS, HomeState
from hearthlog.analyzer.bridge.listeners import listener_of
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.files import is_layer, log_name
from hearthlog.schemas.logs.follow import follow_messages
from hearthlog.schemas.logs.metadata import provenance_records, unknown_version
from hearthlog.schemas.mcap.chunks import read_definitions
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import DIAGNOSTICS, LIVE, is_scenario, parse_topic

_LATEST = 60 * NANOSECONDS  # of labels and diagnostics: of the older ones nothing is left
_WAIT_SECONDS = 1.0
_TICK_SECONDS = 0.5


def is_of_bridge(topic: str) -> bool:
    """Tell whether what a home is told of needs a topic."""
    if topic == DIAGNOSTICS:
        return True
    name = parse_topic(topic)
    if name is None:
        return False
    kinds = {"label", "segment", "gap"} if name.labelling == LIVE else {"label", "segment"}
    return (name.labelling == LIVE or is_scenario(name.labelling)) and name.kind in kinds


def follow_home(
    home: Home, start: int, stop: Flag, damaged: Callable[[LogError], None]
) -> Iterator[tuple[HomeState, list[Event]]]:
    """Follow the logs of a recorder, and keep the state of its home.

    Parameters
    ----------
    start : int
        Log time from which on the events are to be known, in nanoseconds of UTC.
    damaged : callable
        Told the error of a log of which no more can be read, and that there is no folder yet.

    Yields
    ------
    state : HomeState
        The same one each time: after whatever was written, and twice a second while nothing is.
    """
    state, folder = HomeState(), home.folder
    while not folder.is_dir():
        damaged(LogError(f"{folder}: no such folder yet; waiting for a recorder"))
        state.caught_up = True
        yield state, []
        if stop.wait(_WAIT_SECONDS):
            return
    state.caught_up = False
    messages = follow_messages(folder, is_of_bridge, start, stop, damaged, ticks=True)
    yielded, current, described = -math.inf, folder, folder
    for path, batch in messages:
        if path == folder:  # all that was written has been read
            if current != described and (names := _listeners(current)) is not None:
                state.listeners, described = names, current
            if not state.caught_up or time.monotonic() - yielded >= _TICK_SECONDS:
                state.caught_up = True
                yielded = time.monotonic()
                yield state, []
        elif log_name(path).node == home.node:
            if path != current and not is_layer(path):
                current = path
                state.begin_log()
                _check_version(path, damaged)
            yielded = time.monotonic()
            yield state, _push(state, path, batch, damaged)
        if stop.is_set():
            return


def _push(
    state: HomeState, log: Path, batch: list[RawMessages], damaged: Callable[[LogError], None]
) -> list[Event]:
    """Add what was read of a log; return the events that begin with it."""
    try:
        return state.push(_decode(batch))
    except LogError as error:
        damaged(LogError(f"{log}: {error}"))
        return []


def _check_version(log: Path, damaged: Callable[[LogError], None]) -> None:
    """Tell of a log of a later version, of which only what is known here is read."""
    with suppress(LogError), LogFile(log) as file:  # it gets another name at this moment
        for record in provenance_records(file):
            if text := unknown_version(record):
                damaged(LogError(f"{log}: {text}"))


def _listeners(log: Path) -> set[str] | None:
    """Name those who label, or hear, in a log; None if it cannot be read at this moment."""
    with suppress(LogError), LogFile(log) as file:
        read_definitions(file)
        topics = [channel.topic for channel in file.channels.values()]
        parsed = [parse_topic(topic) for topic in topics if topic != DIAGNOSTICS]
        names = (listener_of(name) for name in parsed if name is not None)
        return {name for name in names if name is not None}
    return None


def _decode(batch: list[RawMessages]) -> list[Columns]:
    columns: list[Columns] = []
    for raw in batch:
        if raw.schema is not None and raw.schema.name in FIELDS and len(raw):
            kind = raw.schema.name
            if kind not in {message_types.SEGMENT, message_types.GAP}:
                raw = raw.between(int(np.max(raw.log_times)) - _LATEST, None)  # noqa: PLW2901
            columns += decode([raw], FIELDS[kind])
    return columns
