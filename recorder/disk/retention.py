"""Retention: which logs are deleted, and why; the oldest first."""

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from hearthlog.recorder.disk.limits import Limits
from hearthlog.recorder.disk.recorded import THINNING_SUFFIX, RecordedDays, RecordedLog
from hearthlog.recorder.disk.sizes import size_text
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import review_path
from hearthlog.schemas.logs.metadata import provenance_records
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.new_files import locked_folder, sync_folder

REVIEWED = "reviewed"
_FEW = 2  # logs, all of which but the newest may go without a question


class Disk(NamedTuple):
    """How large a disk is, and how much of it is free, in bytes."""

    size: int
    free: int


class Deletion(NamedTuple):
    """A log that is to go, and why."""

    log: RecordedLog
    why: str


@dataclass
class Plan:
    """What retention would do.

    Attributes
    ----------
    kept : dict of Path to str
        Logs that a limit asks for, and why they are kept all the same.
    """

    deletions: list[Deletion] = field(default_factory=list)
    kept: dict[Path, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    wipes: bool = False


def disk_of(folder: Path) -> Disk:
    """Measure the disk of a folder, or of the one that it will be made in.

    Raise `OSError` if it cannot be.
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    usage = shutil.disk_usage(there)
    return Disk(usage.total, usage.free)


def plan_retention(
    logs: Sequence[RecordedLog], days: RecordedDays, limits: Limits, disk: Disk
) -> Plan:
    """Choose the logs that are to be deleted."""
    plan = Plan()
    limits = limits._replace(free=_sensible_floor(logs, limits, disk, plan))
    count, size, free = len(logs), sum(log.size for log in logs), disk.free
    for log in logs[:-1]:
        why = ""
        if limits.days and days.since(log.start) >= limits.days:
            why = f"{limits.days} days were recorded since"
        elif limits.files and count > limits.files:
            why = f"more than {limits.files} logs"
        elif limits.size and size > limits.size:
            why = f"more than {size_text(limits.size)} of logs"
        elif free < limits.free:
            why = f"less than {size_text(limits.free)} free"
        if not why:
            continue
        if reason := kept_because(log):
            plan.kept[log.path] = reason
            continue
        plan.deletions.append(Deletion(log, why))
        count, size, free = count - 1, size - log.size, free + log.size
    plan.wipes = len(logs) > _FEW and len(plan.deletions) == len(logs) - 1
    plan.problems += _unmet(limits, count, size, free)
    return plan


def _sensible_floor(logs: Sequence[RecordedLog], limits: Limits, disk: Disk, plan: Plan) -> int:
    """Return the floor, or 0 if no deletion can reach it, so that nothing is deleted in vain."""
    floor, most = limits.free, sum(log.size for log in logs[:-1])
    if floor >= disk.size:
        plan.problems.append(
            f"min_free_space: the disk has only {size_text(disk.size)}, so {size_text(floor)} "
            "cannot be free; no log is deleted for it"
        )
        return 0
    if disk.free + most < floor:
        plan.problems.append(
            f"min_free_space: {size_text(disk.free)} are free, and without all older logs less "
            f"than {size_text(floor)} would be; no log is deleted for it"
        )
        return 0
    return floor


def _unmet(limits: Limits, count: int, size: int, free: int) -> list[str]:
    """Say which limits are not met because of the logs that are kept."""
    rest = "the rest is reviewed or locked, or the newest log"
    problems = []
    if limits.files and count > limits.files:
        problems.append(f"max_bag_files: {count} logs of {limits.files} are left; {rest}")
    if limits.size and size > limits.size:
        problems.append(
            f"max_record_size: {size_text(size)} of {size_text(limits.size)} are left; {rest}"
        )
    if free < limits.free:
        problems.append(
            f"min_free_space: {size_text(free)} of {size_text(limits.free)} are free; {rest}"
        )
    return problems


def kept_because(log: RecordedLog) -> str:
    """Say why a log is never deleted; empty if it may be."""
    if log.locked:
        return "locked by its .keep file"
    if is_reviewed(log.path):
        return REVIEWED
    try:
        with LogFile(log.path) as file:
            whole, records = file.complete, provenance_records(file)
    except LogError as error:
        return f"cannot be read ({error})"
    return "" if whole and records else "no log that a recorder has finished"


def is_reviewed(log: Path) -> bool:
    """Tell whether a log has marks or reviewed time, or may have."""
    layer = review_path(log)
    if not os.path.lexists(layer):
        return False
    try:
        with LogFile(layer) as file:
            return file.statistics is None or file.statistics.message_count > 0
    except LogError:
        return True


def carry_out(plan: Plan, failures: list[OSError]) -> list[RecordedLog]:
    """Delete what a plan says, each log after its layers."""
    deleted = []
    for log, _ in plan.deletions:
        try:
            with locked_folder(log.path.parent):  # a reviewer that writes a layer holds it
                if is_reviewed(log.path):
                    continue
                left = log.path.with_name(log.path.name + THINNING_SUFFIX)
                for path in (*log.layers, left, log.path):
                    path.unlink(missing_ok=True)
                sync_folder(log.path.parent)
        except OSError as error:
            failures.append(error)
        else:
            deleted.append(log)
    for folder in {log.path.parent for log in deleted}:
        with suppress(OSError):
            folder.rmdir()
    return deleted
