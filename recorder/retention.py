"""Retention of logs: limits in bytes and days, recorded logs, and the selection for deletion."""

import os
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BeforeValidator

from hearthlog.recorder.host import Disk
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, is_layer, log_name, review_path
from hearthlog.schemas.logs.metadata import provenance_records
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.new_files import locked_folder, sync_folder

KEEP_SUFFIX = ".keep"  # of a file next to a log; protects the log from deletion
THINNING_SUFFIX = ".thinning"  # of an unfinished thinned copy of a log
_TIME = "%Y%m%dT%H%M%SZ"
_DAY = 86_400 * NANOSECONDS
# An unset clock shows 1970, or the build date of its system.
_NO_EARLIER = int(datetime(2024, 1, 1, tzinfo=UTC).timestamp()) * NANOSECONDS


class RecordedLog(NamedTuple):
    """A finished log of a node, with its layers."""

    path: Path
    start: int  # from its name, in nanoseconds of UTC
    layers: tuple[Path, ...]
    size: int  # disk usage of log and layers in bytes
    locked: bool

    @property
    def by_age(self) -> tuple[bool, int, str]:
        """Sort key from old to new; logs recorded with an unset clock count as new."""
        return self.start < _NO_EARLIER, self.start, self.path.name


class RecordedDays:
    """Days with recordings, from starts of logs in nanoseconds of UTC: the clock of retention.

    A wrong clock adds days with few recordings, and never makes a recording older than the number
    of days on which the recorder ran.
    """

    def __init__(self, starts: Iterable[int]) -> None:
        self._days = sorted({start // _DAY for start in starts if start >= _NO_EARLIER})

    def since(self, start: int) -> int:
        """Count the recorded days after a time; 0 for the last day, and times of an unset clock."""
        if start < _NO_EARLIER:
            return 0
        return len(self._days) - bisect_right(self._days, start // _DAY)


def walk(root: Path, failures: list[OSError]) -> Iterator[tuple[Path, list[str]]]:
    """Iterate over the day folders of a recorder."""
    for folder, folders, files in os.walk(root, onerror=failures.append):
        folders[:] = [each for each in folders if each.isdigit()]
        yield Path(folder), files


def start_of(name: str, node: str) -> int | None:
    """Return the start in the name of a node's log or layer, in nanoseconds of UTC, or None."""
    parts = log_name(Path(name))
    match = re.fullmatch(r"(\d{8}T\d{6}Z)(?:_\d+)?", parts.time)
    if parts.node != node or match is None:
        return None
    try:
        moment = datetime.strptime(match[1], _TIME).replace(tzinfo=UTC)
    except ValueError:  # digits, but not a time
        return None
    return int(moment.timestamp()) * NANOSECONDS


def recorded_days(root: Path, node: str) -> RecordedDays:
    """Return the days on which a node has recorded."""
    names = (name for _, files in walk(root, []) for name in files)
    ours = (start_of(name, node) for name in names if name.endswith((SUFFIX, ACTIVE_SUFFIX)))
    return RecordedDays(start for start in ours if start is not None)


def recorded_logs(root: Path, node: str, failures: list[OSError]) -> list[RecordedLog]:
    """Return the finished logs of a node, sorted by age."""
    logs = []
    for folder, files in walk(root, failures):
        names = set(files)
        layers: dict[str, list[Path]] = {}
        for name in sorted(files):
            if name.endswith(SUFFIX) and is_layer(path := folder / name):
                layers.setdefault(log_name(path).log, []).append(path)
        for name in files:
            start = start_of(name, node)
            path = folder / name
            if start is None or not name.endswith(SUFFIX) or is_layer(path) or path.is_symlink():
                continue
            own = tuple(layers.get(name.removesuffix(SUFFIX), ()))
            size = sum(map(_size, (path, *own)))
            logs.append(RecordedLog(path, start, own, size, name + KEEP_SUFFIX in names))
    return sorted(logs, key=lambda log: log.by_age)


def _size(path: Path) -> int:
    with suppress(OSError):
        return path.lstat().st_blocks * 512
    return 0


class Limits(NamedTuple):
    """Limits of retention; 0 for no limit."""

    days: int = 0  # days with recordings
    files: int = 0
    size: int = 0  # bytes of finished logs and their layers
    free: int = 0  # minimum free bytes on the disk


class ThinningDays(NamedTuple):
    """Age in recorded days at which each part of a log is dropped; 0 for never."""

    statistics: int = 0
    features: int = 0
    rest: int = 0

    def step(self, age: int) -> int:
        """Return the thinning step after `age` recorded days.

        It is an index of `hearthlog.schemas.salvage.recover.STEPS`.
        """
        due = [step for step, days in enumerate(self, 1) if days and age >= days]
        return max(due, default=0)


class KeepingRules(NamedTuple):
    """Retention and thinning rules of a recorder."""

    root: str
    node: str
    limits: Limits
    thinning: ThinningDays = ThinningDays()


_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_LARGEST = 10**18


def parse_size(value: object) -> int:
    """Parse bytes, as a number or a text such as "500M" or "1.5 GB"; else raise `ValueError`."""
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,15})?) ?([kmgt]?)b?", str(value).lower())
    if match is None:
        raise ValueError(f"{str(value)[:40]!r} is not a size; write bytes, such as 500M or 20G")
    size = int(float(match[1]) * _UNITS[match[2]])
    if size > _LARGEST:
        raise ValueError("larger than any disk; write bytes, such as 500M or 20G")
    return size


def size_text(size: int) -> str:
    """Format bytes in a suitable unit."""
    for unit, text in (("g", "GB"), ("m", "MB"), ("k", "kB")):
        if size >= _UNITS[unit]:
            return f"{size / _UNITS[unit]:.1f} {text}"
    return f"{size} B"


Size = Annotated[int, BeforeValidator(parse_size, json_schema_input_type=int | str)]


REVIEWED = "reviewed"
_FEW = 2  # with so few logs, all but the newest may be deleted without confirmation


class Deletion(NamedTuple):
    """A log to delete, and the reason."""

    log: RecordedLog
    why: str


@dataclass
class RetentionPlan:
    """Planned deletions."""

    deletions: list[Deletion] = field(default_factory=list)
    # logs beyond a limit that are kept, and the reason
    kept: dict[Path, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    wipes: bool = False


def plan_retention(
    logs: Sequence[RecordedLog], days: RecordedDays, limits: Limits, disk: Disk
) -> RetentionPlan:
    """Select the logs to delete."""
    plan = RetentionPlan()
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


def _sensible_floor(
    logs: Sequence[RecordedLog], limits: Limits, disk: Disk, plan: RetentionPlan
) -> int:
    """Return the minimum free space, or 0 if no deletion can reach it."""
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
    """Format the limits that are exceeded because of protected logs."""
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
    """Return why a log is never deleted; empty if it may be."""
    if log.locked:
        return "locked by its .keep file"
    if is_reviewed(log.path):
        return REVIEWED
    try:
        with LogFile(log.path) as file:
            is_complete, records = file.complete, provenance_records(file)
    except LogError as error:
        return f"cannot be read ({error})"
    return "" if is_complete and records else "no log that a recorder has finished"


def is_reviewed(log: Path) -> bool:
    """Return whether a log has or may have marks or reviewed time."""
    layer = review_path(log)
    if not os.path.lexists(layer):
        return False
    try:
        with LogFile(layer) as file:
            return file.statistics is None or file.statistics.message_count > 0
    except LogError:
        return True


def carry_out(plan: RetentionPlan, failures: list[OSError]) -> list[RecordedLog]:
    """Execute a plan: delete each log after its layers."""
    deleted = []
    for log, _ in plan.deletions:
        try:
            with locked_folder(log.path.parent):  # held by a reviewer that writes a layer
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
