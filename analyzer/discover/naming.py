"""Naming of groups: marks on every sound of a group, and their removal."""

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.discover.groups import Groups
from hearthlog.analyzer.discover.sounds import lost_text, read_log_sounds
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.marks.marks import (
    Mark,
    MarkedSpan,
    ReviewedSpan,
    read_marks,
    read_reviewed,
    write_marks,
)
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.messages.topics import LIVE


class Looked(NamedTuple):
    """Selection of sounds to search for named groups."""

    choice: str
    start: int | None = None
    end: int | None = None


class Marked(NamedTuple):
    """Changes made by naming a group."""

    made: int = 0
    left: int = 0


def name_groups(  # noqa: PLR0913, PLR0917
    home: HomeLogs,
    groups: Groups,
    names: Mapping[int, str],
    looked: Looked,
    reviewer: str,
    progress: Progress = ignore_progress,
) -> tuple[dict[int, Marked], list[str]]:
    """Mark the sounds of groups; existing marks of a group get its new name.

    Logs are read one at a time, so a box with little memory can name groups found by another.

    Parameters
    ----------
    progress : callable, optional
        Receives the share of the logs read, 0 to 1.

    Raises
    ------
    LogError
        If a review layer cannot be read or written.
    """
    marked, losses = dict.fromkeys(names, Marked()), list(home.losses)
    logs = home.between()
    inside = {entry.path for entry in home.between(looked.start, looked.end)}
    for count, (log, *_) in enumerate(logs, 1):
        spans: dict[int, list[MarkedSpan]] = {}
        if log in inside:
            try:
                spans = _spans(log, groups, looked, losses)
            except LogError as error:
                losses.append(str(error))
        for number, label in names.items():
            made, left = _mark(
                log, spans.get(number, []), reason_of(groups, number), label, reviewer
            )
            before = marked[number]
            marked[number] = Marked(before.made + made, before.left + left)
        progress(count / len(logs))
    return marked, losses


def _spans(
    log: Path, groups: Groups, looked: Looked, losses: list[str]
) -> dict[int, list[MarkedSpan]]:
    """Return the sounds of groups in a log, by group number."""
    found: dict[int, list[MarkedSpan]] = {}
    for sounds in read_log_sounds(log, *looked):
        if sounds.features != groups.features:
            raise LogError(f"{log}: has other features than the groups; left out")
        if sounds.lost:
            losses.append(lost_text(log, sounds.lost))
        of = groups.of_sounds(sounds.descriptors, sounds.embeddings, sounds.embedding)
        starts, ends = sounds.spans.starts.tolist(), sounds.spans.ends.tolist()
        for row, start, end in zip(of.tolist(), starts, ends, strict=True):
            if row >= 0:
                span = MarkedSpan(sounds.microphone, start, end)
                found.setdefault(int(groups.numbers[row]), []).append(span)
    return found


def _mark(
    log: Path, wanted: Sequence[MarkedSpan], reason: str, label: str, reviewer: str
) -> Marked:
    """Mark sounds of a log; marks with this reason get the label."""
    now, old, reviewed = time.time_ns(), read_marks(log), read_reviewed(log)
    own = [mark for mark in old if mark.reason == reason]
    others: list[Mark | ReviewedSpan] = [mark for mark in old if mark.reason != reason]
    others += reviewed
    spans = [span for span in wanted if not _any_overlap(span, own)]
    free = [span for span in spans if not _any_overlap(span, others)]
    new = [Mark(*span, label, reviewer, now, LIVE, reason) for span in free]
    new += [
        mark._replace(label=label, reviewer=reviewer, made=now)
        for mark in own
        if mark.label != label
    ]
    if new:
        write_marks(log, new)
    return Marked(len(new), len(spans) - len(free))


def unmark_group(logs: Iterable[Path], reason: str) -> int:
    """Remove the marks of a group; return their number.

    Raise `LogError` if a review layer cannot be read or written.
    """
    count = 0
    for log in logs:
        own = [mark for mark in read_marks(log) if mark.reason == reason]
        if own:
            write_marks(log, [], [MarkedSpan(*mark[:3]) for mark in own])
        count += len(own)
    return count


def reason_of(groups: Groups, number: int) -> str:
    """Return the reason stored in a group's marks, unique to this groups file."""
    return f"group {number} of {groups.id}"


def _any_overlap(span: MarkedSpan, others: Iterable[Mark | ReviewedSpan]) -> bool:
    return any(
        other.microphone == span.microphone and other.start < span.end and span.start < other.end
        for other in others
    )
