"""A group that gets a name: every sound of it becomes a mark, and is none again when asked."""

import time
from collections.abc import Iterable
from pathlib import Path

from hearthlog.analyzer.discover.groups import Groups
from hearthlog.analyzer.discover.read_sounds import HomeSounds
from hearthlog.analyzer.marks.marks import (
    Mark,
    MarkedSpan,
    ReviewedSpan,
    read_marks,
    read_reviewed,
    write_marks,
)
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.messages.topics import LIVE


def mark_group(  # noqa: PLR0913
    logs: Iterable[Path], sounds: HomeSounds, rows: Int64, *, reason: str, label: str, reviewer: str
) -> tuple[int, int]:
    """Mark the sounds of a group; marks that it has get the label, if it had another name.

    Parameters
    ----------
    logs : iterable of Path
        Of the home.
    sounds : HomeSounds
    rows : np.ndarray [shape=(n,)], int64
        Those of the group.
    reason : str
        `reason_of` the group.
    label : str
        The class that they are.
    reviewer : str
        Who says so.

    Returns
    -------
    made, left : int
        How many marks were made or got another label, and how many sounds were left as they are
        because somebody has marked them, or looked at them.

    Raises
    ------
    LogError
        If a review layer cannot be read or written.
    """
    made = left = 0
    now, wanted = time.time_ns(), _wanted(sounds, rows)
    for log in dict.fromkeys([*logs, *sounds.logs]):
        old, reviewed = read_marks(log), read_reviewed(log)
        own = [mark for mark in old if mark.reason == reason]
        others: list[Mark | ReviewedSpan] = [mark for mark in old if mark.reason != reason]
        others += reviewed
        spans = [span for span in wanted.get(log, ()) if not _any_overlap(span, own)]
        free = [span for span in spans if not _any_overlap(span, others)]
        new = [Mark(*span, label, reviewer, now, LIVE, reason) for span in free]
        new += [
            mark._replace(label=label, reviewer=reviewer, made=now)
            for mark in own
            if mark.label != label
        ]
        if new:
            write_marks(log, new)
        made, left = made + len(new), left + len(spans) - len(free)
    return made, left


def _wanted(sounds: HomeSounds, rows: Int64) -> dict[Path, list[MarkedSpan]]:
    wanted: dict[Path, list[MarkedSpan]] = {}
    starts, ends = sounds.spans.starts.tolist(), sounds.spans.ends.tolist()
    for row in rows.tolist():
        name = sounds.microphones[sounds.microphone[row]]
        span = MarkedSpan(name, starts[row], ends[row])
        wanted.setdefault(sounds.logs[sounds.log[row]], []).append(span)
    return wanted


def unmark_group(logs: Iterable[Path], reason: str) -> int:
    """Take back the marks of a group; return how many there were.

    Parameters
    ----------
    logs : iterable of Path
    reason : str
        `reason_of` the group.

    Raises
    ------
    LogError
        If a review layer cannot be read or written.
    """
    count = 0
    for log in logs:
        own = [mark for mark in read_marks(log) if mark.reason == reason]
        if own:
            write_marks(log, [], [MarkedSpan(*mark[:3]) for mark in own])
        count += len(own)
    return count


def reason_of(groups: Groups, number: int) -> str:
    """Return the reason that the marks of a group have, which those of other files have not."""
    return f"group {number} of {groups.id}"


def _any_overlap(span: MarkedSpan, others: Iterable[Mark | ReviewedSpan]) -> bool:
    return any(
        other.microphone == span.microphone and other.start < span.end and span.start < other.end
        for other in others
    )
