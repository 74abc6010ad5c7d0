"""Thinning: what old logs hold frame by frame is dropped before they are deleted as a whole."""

import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.recorder.disk.limits import ThinningDays
from hearthlog.recorder.disk.recorded import THINNING_SUFFIX, RecordedDays, RecordedLog
from hearthlog.recorder.disk.retention import REVIEWED, is_reviewed, kept_because
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.new_files import (
    hand_over,
    locked_folder,
    sync_file,
    sync_folder,
)
from hearthlog.schemas.salvage.recover import lock_abandoned, thin_log, thinned_step

_STATISTICS = 1  # the step that lessons do not miss
_RIGHTS = 0o666  # of a file that nobody runs


class Thinned(NamedTuple):
    """A log that is to be thinned, and the step."""

    log: RecordedLog
    step: int


def plan_thinning(
    logs: Sequence[RecordedLog], days: RecordedDays, limits: ThinningDays
) -> Iterator[Thinned]:
    """Choose the logs to thin; one that is reviewed only of statistics, for it is learned from."""
    for log in logs[:-1]:
        due = limits.step(days.since(log.start))
        if not due or (kept := kept_because(log)) not in {"", REVIEWED}:
            continue
        step = min(due, _STATISTICS) if kept else due
        try:
            if thinned_step(log.path) < step:
                yield Thinned(log, step)
        except LogError:  # of a newer version
            continue


def thin(log: Path, step: int) -> bool:
    """Put a thinner log in the place of one, in one step that nothing can halve.

    Returns
    -------
    bool
        False if somebody else is at it, or it was reviewed meanwhile.

    Raises
    ------
    LogError
        If it is damaged.
    OSError
        If the copy cannot be written.
    """
    copy = log.with_name(log.name + THINNING_SUFFIX)
    with lock_abandoned(log) as is_ours:
        if not is_ours:
            return False
        try:
            thin_log(log, copy, step)
            hand_over(copy, stat.S_IMODE(log.stat().st_mode) & _RIGHTS)
            sync_file(copy)
            with locked_folder(log.parent):  # a reviewer that writes a layer holds it
                if step > _STATISTICS and is_reviewed(log):
                    copy.unlink(missing_ok=True)
                    return False
                copy.replace(log)
        except BaseException:
            copy.unlink(missing_ok=True)
            raise
        sync_folder(log.parent)  # where it fails, a copy of this name is another process's
    return True
