"""A group that gets a name: every sound of it becomes a mark, and is none again when asked."""

import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hearthlog.analyzer.discover.read_sounds import HomeSounds
from hearthlog.analyzer.marks.marks import Mark, MarkedSpan, read_marks, write_marks
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.messages.topics import LIVE


def mark_group(
    sounds: HomeSounds, rows: Int64, number: int, label: str, reviewer: str
) -> tuple[int, int]:
    """Mark the sounds of a group; what somebody has marked already stays as it is.

    Parameters
    ----------
    sounds : HomeSounds
    rows : np.ndarray [shape=(n,)], int64
        Those of the group.
    number : int
        Of the group, which is the reason of each mark.
    label : str
        The class that they are.
    reviewer : str
        Who says so.

    Returns
    -------
    made, left : int
        How many were marked, and how many were left because there is a mark of another reason.

    Raises
    ------
    LogError
        If a review layer cannot be read or written.
    """
    made = left = 0
    now, spans = time.time_ns(), sounds.spans
    for place in np.unique(sounds.log[rows]).tolist():
        own = rows[sounds.log[rows] == place]
        names = [sounds.microphones[i] for i in sounds.microphone[own].tolist()]
        wanted = [
            Mark(name, start, end, label, reviewer, now, LIVE, reason_of(number))
            for name, start, end in zip(
                names, spans.starts[own].tolist(), spans.ends[own].tolist(), strict=True
            )
        ]
        log = sounds.logs[place]
        old = [mark for mark in read_marks(log) if mark.reason != reason_of(number)]
        new = [mark for mark in wanted if not any(_overlap(mark, each) for each in old)]
        write_marks(log, new)
        made, left = made + len(new), left + len(wanted) - len(new)
    return made, left


def unmark_group(logs: Iterable[Path], number: int) -> int:
    """Take back the marks of a group; return how many there were.

    Parameters
    ----------
    logs : iterable of Path
    number : int

    Raises
    ------
    LogError
        If a review layer cannot be read or written.
    """
    count = 0
    for log in logs:
        own = [mark for mark in read_marks(log) if mark.reason == reason_of(number)]
        if own:
            write_marks(log, [], [MarkedSpan(*mark[:3]) for mark in own])
        count += len(own)
    return count


def reason_of(number: int) -> str:
    """Return the reason that the marks of a group have."""
    return f"group {number}"


def _overlap(one: Mark, other: Mark) -> bool:
    return one.microphone == other.microphone and one.start < other.end and other.start < one.end
