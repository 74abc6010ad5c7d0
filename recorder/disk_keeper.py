"""Disk keeper: deletion and thinning of old logs every hour, in a process of low priority."""

import json
import os
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from hearthlog.recorder.events import OK, WARNING, Notice, SourceHealth
from hearthlog.recorder.host import disk_of, module_command
from hearthlog.recorder.retention import (
    REVIEWED,
    THINNING_SUFFIX,
    KeepingRules,
    Limits,
    RecordedDays,
    RecordedLog,
    RetentionPlan,
    ThinningDays,
    carry_out,
    is_reviewed,
    kept_because,
    plan_retention,
    recorded_days,
    recorded_logs,
    size_text,
)
from hearthlog.recorder.stream import EncodedMessage, diagnostics, notice_line
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import (
    hand_over,
    locked_folder,
    sync_file,
    sync_folder,
)

_STATISTICS = 1  # thinning step without effect on training
_RIGHTS = 0o666  # no execute bits


class Thinned(NamedTuple):
    """A log to thin, and the step."""

    log: RecordedLog
    step: int


def plan_thinning(
    logs: Sequence[RecordedLog], days: RecordedDays, limits: ThinningDays
) -> Iterator[Thinned]:
    """Select the logs to thin; reviewed logs lose only statistics, as training needs the rest."""
    # Here, as the recorder itself thins no log: the child process does.
    from hearthlog.schemas.salvage.recover import thinned_step  # noqa: PLC0415

    for log in logs[:-1]:
        due = limits.step(days.since(log.start))
        if not due or (kept := kept_because(log)) not in {"", REVIEWED}:
            continue
        step = min(due, _STATISTICS) if kept else due
        try:
            if thinned_step(log.path) < step:
                yield Thinned(log, step)
        except LogError:  # log of a newer version
            continue


def thin(log: Path, step: int) -> bool:
    """Replace a log atomically by a thinned copy.

    Return False if another process uses the log, or it was reviewed in the meantime. Raise
    `LogError` if the log is damaged, `OSError` if the copy cannot be written.
    """
    from hearthlog.schemas.salvage.recover import lock_abandoned, thin_log  # noqa: PLC0415

    copy = log.with_name(log.name + THINNING_SUFFIX)
    with lock_abandoned(log) as is_ours:
        if not is_ours:
            return False
        try:
            thin_log(log, copy, step)
            hand_over(copy, stat.S_IMODE(log.stat().st_mode) & _RIGHTS)
            sync_file(copy)
            with locked_folder(log.parent):  # held by a reviewer that writes a layer
                if step > _STATISTICS and is_reviewed(log):
                    copy.unlink(missing_ok=True)
                    return False
                copy.replace(log)
        except BaseException:
            copy.unlink(missing_ok=True)
            raise
        sync_folder(log.parent)  # outside the try: a copy of this name is now another process's
    return True


_SHOWN = 300  # characters
_AT_ONCE = 100  # logs thinned per run, so that deletion does not wait for an hour


class DiskReport(NamedTuple):
    """Result of a disk check."""

    done: str  # deletions and thinnings; empty for none
    problem: str  # failures; empty for none
    values: Mapping[str, str]
    more: bool = False

    def notices(self) -> list[Notice]:
        """Return at most two notices: actions, and the problem."""
        done = [Notice(OK, self.done)] if self.done else []
        return [*done, *([Notice(WARNING, self.problem)] if self.problem else [])]


def keep_disk(rules: KeepingRules, *, may_thin: bool = True) -> DiskReport:
    """Delete logs by the rules, unless only the newest of several would remain, and thin others.

    Raise `OSError` if the disk cannot be measured.
    """
    root, failures = Path(rules.root), list[OSError]()
    logs = recorded_logs(root, rules.node, failures)
    days = recorded_days(root, rules.node)
    plan = plan_retention(logs, days, rules.limits, disk_of(root))
    problems = list(plan.problems)
    deleted = []
    if plan.wipes:
        problems.insert(0, _wipes(plan, len(logs)))
    else:
        deleted = carry_out(plan, failures)
    left = [log for log in logs if log not in set(deleted)]
    thinned = _thin(left if may_thin else [], days, rules.thinning, problems)
    freed = sum(log.size for log in deleted)
    done = []
    if deleted:
        why = plan.deletions[0].why
        done.append(f"{len(deleted)} logs deleted, {size_text(freed)}: {why}")
    if thinned.logs:
        done.append(f"{thinned.logs} logs thinned, {size_text(thinned.freed)}")
    disk = disk_of(root)
    values = {
        "free_bytes": disk.free,
        "disk_bytes": disk.size,
        "logs": len(left),
        "log_bytes": sum(log.size for log in left) - thinned.freed,
        "deleted_logs": len(deleted),
        "deleted_bytes": freed,
        "kept_logs": len(plan.kept),
        "thinned_logs": thinned.logs,
        "thinned_bytes": thinned.freed,
    }
    problem = "; ".join([*problems, *_failed(failures)])[:_SHOWN]
    texts = {name: str(value) for name, value in values.items()}
    return DiskReport("; ".join(done), problem, texts, more=thinned.more)


def _wipes(plan: RetentionPlan, logs: int) -> str:
    return (
        f"the limits would delete all but the newest of {logs} logs ({plan.deletions[-1].why}): "
        "nothing is deleted; `hearthlog retain` deletes them, if intended"
    )


class _Thinnings(NamedTuple):
    logs: int = 0
    freed: int = 0
    more: bool = False


def _thin(
    logs: Sequence[RecordedLog], days: RecordedDays, limits: ThinningDays, problems: list[str]
) -> _Thinnings:
    """Thin some logs, and append the first failure to the problems."""
    count = freed = 0
    failed: list[str] = []
    for log, step in plan_thinning(logs, days, limits):
        if count == _AT_ONCE:
            return _Thinnings(count, freed, more=True)
        try:
            before = log.path.stat().st_size
            if thin(log.path, step):
                count, freed = count + 1, freed + before - log.path.stat().st_size
        except LogError as error:
            failed.append(str(error))
        except OSError as error:  # no space for a copy, nor for the others
            failed.append(f"{log.path}: cannot be thinned ({error.strerror or error})")
            break
    problems += failed[:1]
    return _Thinnings(count, freed)


def _failed(failures: list[OSError]) -> list[str]:
    if not failures:
        return []
    more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
    first = failures[0]
    return [f"{first.filename}: cannot be listed or deleted ({first.strerror}){more}"]


_COMMAND = module_command("hearthlog.recorder.disk_keeper")
_EVERY = 3600 * NANOSECONDS
_THIN = 24 * _EVERY  # thinning opens all old logs
_LOOK = 60 * NANOSECONDS  # between checks of the free space
_NICENESS = 19


class DiskKeeper:
    """Applies the rules in a child process during recording; the recorder never waits for it."""

    def __init__(self, rules: KeepingRules) -> None:
        self._rules = rules
        self._process: subprocess.Popen[bytes] | None = None
        self._began: int | None = None
        self._checked = 0
        self._thinned: int | None = None
        self._reported: set[str] = set()
        self._helpless = False

    def tick(self, now: int) -> tuple[list[EncodedMessage], list[str]]:
        """Start a check if it is due, and report the result of the previous one."""
        if self._process is not None:
            if self._process.poll() is None:
                return [], []
            report = self._read(self._process)
            self._process = None
            self._helpless = bool(report.problem)
            if report.more:
                self._thinned = None
            news = {report.problem} - self._reported - {""}
            self._reported |= news
            return report_messages(self._rules.node, now, report), sorted(news)
        if self._is_due(now):
            self._began = now
            may_thin = self._thinned is None or abs(now - self._thinned) >= _THIN
            self._thinned = now if may_thin else self._thinned
            with suppress(OSError):  # no memory for a process: retry in an hour
                self._process = subprocess.Popen(  # noqa: S603  our own module
                    [*_COMMAND, json.dumps([self._rules, may_thin])],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                )
        return [], []

    def close(self) -> None:
        """Kill a running check; this is safe at any time."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._read(self._process)
            self._process = None

    def _is_due(self, now: int) -> bool:
        if self._began is None or abs(now - self._began) >= _EVERY:
            return True
        if self._helpless or min(abs(now - self._checked), abs(now - self._began)) < _LOOK:
            return False
        self._checked = now
        with suppress(OSError):
            return disk_of(Path(self._rules.root)).free < self._rules.limits.free
        return False

    def _read(self, process: subprocess.Popen[bytes]) -> DiskReport:
        assert process.stdout is not None
        with process.stdout:
            text = process.stdout.read()
        try:
            return DiskReport(*json.loads(text))
        except (ValueError, TypeError):
            return DiskReport("", f"the limits were not applied (status {process.returncode})", {})


def report_messages(node: str, stamp: int, report: DiskReport) -> list[EncodedMessage]:
    """Encode the report of a disk check."""
    level = WARNING if report.problem else OK
    text = report.problem or report.done or "nothing to delete"
    health = SourceHealth(stamp, level, text, report.values)
    lines = [notice_line("disk", stamp, notice) for notice in report.notices()]
    return [diagnostics(f"{node} disk", health), *lines]


def main() -> None:
    """Run one check with the rules in the argument, and print the report."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the recorder decides when this ends
    os.nice(_NICENESS)
    (root, node, limits, thinning), may_thin = json.loads(sys.argv[1])
    rules = KeepingRules(root, node, Limits(*limits), ThinningDays(*thinning))
    try:
        report = keep_disk(rules, may_thin=may_thin)
    except OSError as error:
        report = DiskReport(
            "", f"{root}: the limits cannot be applied ({error.strerror or error})", {}
        )
    with suppress(BrokenPipeError):  # the recorder was killed
        os.write(sys.stdout.fileno(), json.dumps(report).encode())


if __name__ == "__main__":
    main()
