"""What diagnostics say, status by status."""

from collections.abc import Iterator
from typing import NamedTuple

from hearthlog.schemas.logs.columns import Columns


class Status(NamedTuple):
    """What a part of the box said of itself, at a log time (ns of UTC).

    `level` is that of `diagnostic_msgs/DiagnosticStatus`: 0 is well, higher is worse.
    """

    name: str
    time: int
    level: int
    message: str


def statuses_of(columns: Columns) -> Iterator[Status]:
    """Yield each status of diagnostic messages.

    Raise `LogError` if the field is missing.
    """
    for time, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
        for status in statuses:
            yield Status(status["name"], time, int(status["level"]), status["message"])
