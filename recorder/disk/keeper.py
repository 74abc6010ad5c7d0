"""The keeper of the disk: looks after it in a process of its own, hourly and when it fills."""

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from hearthlog.recorder.disk.keeping import DiskReport, keep_disk
from hearthlog.recorder.disk.limits import KeepingRules, Limits, ThinningDays
from hearthlog.recorder.disk.retention import disk_of
from hearthlog.recorder.events import OK, WARNING, SourceHealth
from hearthlog.recorder.modules import module_command
from hearthlog.recorder.stream import rosout
from hearthlog.recorder.stream.diagnostics import diagnostics
from hearthlog.recorder.stream.messages import EncodedMessage
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import ROSOUT

_COMMAND = module_command("hearthlog.recorder.disk.keeper")
_EVERY = 3600 * NANOSECONDS
_THIN = 24 * _EVERY  # for that all old logs are opened
_LOOK = 60 * NANOSECONDS  # at how much is free
_NICENESS = 19


class DiskKeeper:
    """Keeps the disk as configured while a recorder goes on, which never waits for it."""

    def __init__(self, rules: KeepingRules) -> None:
        self._rules = rules
        self._process: subprocess.Popen[bytes] | None = None
        self._began: int | None = None
        self._looked = 0
        self._thinned: int | None = None
        self._said: set[str] = set()
        self._helpless = False

    def tick(self, now: int) -> tuple[list[EncodedMessage], list[str]]:
        """Look after the disk if it is time, and tell what came of the last time."""
        if self._process is not None:
            if self._process.poll() is None:
                return [], []
            report = self._read(self._process)
            self._process = None
            self._helpless = bool(report.problem)
            if report.more:
                self._thinned = None
            news = {report.problem} - self._said - {""}
            self._said |= news
            return report_messages(self._rules.node, now, report), sorted(news)
        if self._is_due(now):
            self._began = now
            may_thin = self._thinned is None or abs(now - self._thinned) >= _THIN
            self._thinned = now if may_thin else self._thinned
            with suppress(OSError):  # no memory for a process: in an hour again
                self._process = subprocess.Popen(  # noqa: S603  our own module
                    [*_COMMAND, json.dumps([self._rules, may_thin])],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                )
        return [], []

    def close(self) -> None:
        """End what is going on, at any moment of it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._read(self._process)
            self._process = None

    def _is_due(self, now: int) -> bool:
        if self._began is None or abs(now - self._began) >= _EVERY:
            return True
        if self._helpless or min(abs(now - self._looked), abs(now - self._began)) < _LOOK:
            return False
        self._looked = now
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
            return DiskReport(
                "", f"the disk was not looked after (status {process.returncode})", {}
            )


def report_messages(node: str, stamp: int, report: DiskReport) -> list[EncodedMessage]:
    """Tell what came of a look at the disk."""
    level = WARNING if report.problem else OK
    text = report.problem or report.done or "nothing to delete"
    health = SourceHealth(stamp, level, text, report.values)
    lines = [rosout.notice_line("disk", stamp, notice) for notice in report.notices()]
    return [
        diagnostics(f"{node} disk", health),
        *(EncodedMessage(stamp, ROSOUT, line) for line in lines),
    ]


def main() -> None:
    """Look after the disk once by the rules in the argument, and print the report."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the recorder decides when this ends
    os.nice(_NICENESS)
    (root, node, limits, thinning), may_thin = json.loads(sys.argv[1])
    rules = KeepingRules(root, node, Limits(*limits), ThinningDays(*thinning))
    try:
        report = keep_disk(rules, may_thin=may_thin)
    except OSError as error:
        report = DiskReport("", f"{root}: cannot be looked after ({error.strerror or error})", {})
    with suppress(BrokenPipeError):  # the recorder was killed
        os.write(sys.stdout.fileno(), json.dumps(report).encode())


if __name__ == "__main__":
    main()
