"""What was not well: gaps, and what diagnostics say."""

from collections.abc import Iterator
from typing import NamedTuple

from hearthlog.schemas.logs.columns import Columns


class Trouble(NamedTuple):
    """What was not well, from when to when (ns of UTC): a gap, or what diagnostics say."""

    source: str
    text: str
    start: int
    end: int


def gaps_of(node: str, columns: Columns) -> Iterator[Trouble]:
    """Go through messages of gaps."""
    starts, lasting = columns["header.stamp"], columns["duration"]
    rows = zip(starts.tolist(), lasting.tolist(), columns["reason"].tolist(), strict=True)
    for start, nanoseconds, reason in rows:
        if nanoseconds > 0:
            yield Trouble(f"{node}/{columns.topic}", reason, start, start + nanoseconds)


class Status(NamedTuple):
    """What a part of the box said of itself; level 0 is well."""

    name: str
    time: int
    level: int
    message: str


def statuses_of(columns: Columns) -> Iterator[Status]:
    """Go through diagnostic messages."""
    for time, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
        for status in statuses:
            yield Status(status["name"], time, int(status["level"]), status["message"])


def troubles_of(said: list[Status], end: int) -> Iterator[Trouble]:
    """Yield what was not well: from when it was said to when something else was."""
    ordered = sorted(said)
    latest = {status.name: status.time for status in ordered}
    last: dict[str, Trouble] = {}
    for status in ordered:
        before = last.pop(status.name, None)
        if before is not None and status.level and before.text == status.message:
            last[status.name] = before
            continue
        if before is not None:
            yield before._replace(end=status.time)
        if status.level:
            last[status.name] = Trouble(status.name, status.message, status.time, status.time)
    for name, trouble in last.items():
        yield trouble._replace(end=min(latest[name], end))
