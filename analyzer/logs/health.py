"""What was not well, from gaps and diagnostics."""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from typing import Any, NamedTuple

from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.contents import Status
from hearthlog.schemas.messages.topics import LIVE, parse_topic

_LONGEST = 200  # characters


class Trouble(NamedTuple):
    """What was not well, from when to when (ns of UTC): a gap, or what diagnostics say."""

    source: str
    text: str
    start: int
    end: int


class MicrophoneState(NamedTuple):
    """How a microphone was at a time (ns of UTC): the worst level, and all that was not well.

    `floor_dbfs` is the level of the floor of the room, NaN where it is not known.
    """

    microphone: str
    time: int
    level: int
    text: str
    floor_dbfs: float


def gaps_of(node: str, columns: Columns) -> Iterator[Trouble]:
    """Yield the gaps of messages, without those of no length.

    Raise `LogError` if one of these fields is missing.
    """
    starts, durations = columns["header.stamp"], columns["duration"]
    rows = zip(starts.tolist(), durations.tolist(), columns["reason"].tolist(), strict=True)
    for start, nanoseconds, reason in rows:
        if nanoseconds > 0:
            yield Trouble(f"{node}/{columns.topic}", reason, start, start + nanoseconds)


def microphone_states(columns: Columns) -> Iterator[MicrophoneState]:
    """Yield the state of a microphone for each diagnostic message that is about one.

    Raise `LogError` if one of these fields is missing.
    """
    times, names = columns["header.stamp"].tolist(), columns["header.frame_id"].tolist()
    for time, name, statuses in zip(times, names, columns["status"], strict=True):
        topic = parse_topic(f"/{name}/info")
        if topic is not None and topic.labelling == LIVE:
            level = max((status["level"] for status in statuses), default=0)
            bad = [status["message"] for status in statuses if status["level"]]
            yield MicrophoneState(name, time, level, "; ".join(bad)[:_LONGEST], _floor(statuses))


def _floor(statuses: Sequence[Any]) -> float:
    for status in statuses:
        for pair in status["values"]:
            if pair["key"] == "floor_dbfs":
                with suppress(ValueError):
                    value = float(pair["value"])
                    return value if math.isfinite(value) else math.nan
    return math.nan


def troubles_of(statuses: Iterable[Status], end: int) -> Iterator[Trouble]:
    """Yield what was not well, from when it was said until something else was said.

    Parameters
    ----------
    end : int
        Nanoseconds of UTC. The last trouble of a name ends with the last status of that name, or
        here if that is earlier.
    """
    for name, same in groupby(sorted(statuses), lambda status: status.name):
        own = list(same)
        texts = [(status.time, status.message if status.level else None) for status in own]
        for start, stop, text in lasting(texts, min(own[-1].time, end)):
            yield Trouble(name, text, start, stop)


def lasting(texts: Sequence[tuple[int, str | None]], end: int) -> Iterator[tuple[int, int, str]]:
    """Let each text last until the next one that differs, and the last one until `end`.

    Parameters
    ----------
    texts : sequence of (int, str or None)
        When something was said (nanoseconds of UTC), in the order of time; None where there is
        nothing to say.
    """
    changes = [(next(same)[0], text) for text, same in groupby(texts, lambda pair: pair[1])]
    ends = [*(time for time, _ in changes[1:]), end]
    for (start, text), stop in zip(changes, ends, strict=False):
        if text is not None:
            yield start, stop, text
