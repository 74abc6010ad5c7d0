"""The watcher of a fast month: runs the recorder, injects faults, and reads the logs."""

import os
import random
import signal
import subprocess
import time
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from hearthlog.recorder.host import module_command
from hearthlog.recorder.log.recovery import recover_active
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, is_layer, stem
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX
from hearthlog.tools.lab.bench.timing import HEARTHLOG
from hearthlog.tools.lab.month.faults import Fault
from hearthlog.tools.lab.month.folders import NODE, MonthFolder
from hearthlog.tools.lab.month.log_coverage import LogCoverage, read_log_coverage
from hearthlog.tools.lab.month.shared_state import SharedState, shared_state

_RECORDER = module_command("hearthlog.tools.lab.month.recorder")
_STOPPED = {0, 3}  # 3: something was not heard
_LOOK_SECONDS = 0.004
_LIST_SECONDS = 0.3
_SAMPLE = 1800 * NANOSECONDS
_BOOT = 20 * NANOSECONDS
_MOMENT_SECONDS = 0.03  # within which a process is killed, to hit any line of it


@dataclass
class Sample:
    """What a process needed.

    Attributes
    ----------
    now : int
        Nanoseconds since the month began.
    memory : int
        Its own, in bytes.
    descriptors, children : int
    """

    now: int
    memory: int
    descriptors: int
    children: int


@dataclass
class Run:
    """One life of the recorder.

    Attributes
    ----------
    process : int
        Its number.
    end : str
        What ended it.
    sound : int
        From the first to the last sample that it was given, in nanoseconds.
    samples : list of Sample
    """

    process: int
    end: str = "the month was over"
    sound: int = 0
    samples: list[Sample] = field(default_factory=list)


@dataclass
class MonthRecord:
    """What was seen of a month.

    Attributes
    ----------
    runs : list of Run
    coverages : list of LogCoverage
        In the order of recording.
    problems : list of str
        What should not have happened.
    """

    runs: list[Run]
    coverages: list[LogCoverage]
    problems: list[str]


class Watcher:
    """Watches the recorder of a month.

    Parameters
    ----------
    folder : MonthFolder
    arguments : sequence of str
        Of the recorder.
    faults : sequence of Fault
    seed : int
    """

    def __init__(
        self, folder: MonthFolder, arguments: Sequence[str], faults: Sequence[Fault], seed: int
    ) -> None:
        self._folder = folder
        self._arguments = arguments
        self._faults = faults
        self._state: SharedState = shared_state(folder.state)
        self._random = random.Random(seed)
        self._pool = ProcessPoolExecutor(1)
        self._coverages: dict[str, Future[LogCoverage]] = {}
        self._problems: list[str] = []
        self._listed = 0.0

    def watch(self, end: int) -> MonthRecord:
        """Let the month pass.

        Parameters
        ----------
        end : int
            In nanoseconds since it began.
        """
        runs = []
        while self._state.now < end:
            runs.append(self._run())
            if runs[-1].end.startswith("by itself"):
                self._problems.append(f"the recorder ended {runs[-1].end}")
                recover_active(self._folder.logs, NODE)
                break
        self._list_logs()
        with self._pool:
            coverages = [future.result() for future in self._coverages.values()]
        order = {log: number for number, (_, log) in enumerate(self._folder.begun())}
        known = [coverage for coverage in coverages if stem(coverage.path) in order]
        strange = [coverage.path.name for coverage in coverages if coverage not in known]
        self._problems += [f"{name}: no recorder of this month has begun it" for name in strange]
        known.sort(key=lambda coverage: order[stem(coverage.path)])
        return MonthRecord(runs, known, self._problems)

    def _run(self) -> Run:
        """Live once: from a start of the recorder to its end."""
        state = self._state
        state.first_sound = state.last_sound = state.request = 0
        with self._folder.errors.open("ab") as errors:
            process = subprocess.Popen(  # noqa: S603  ours
                [*_RECORDER, *self._arguments], stdout=subprocess.DEVNULL, stderr=errors
            )
        run = Run(process.pid)
        fault = self._watch_over(process, run)
        if fault is not None:
            run.end = fault.kind
            self._end(process, fault)
        elif process.returncode not in _STOPPED:
            run.end = f"by itself, with status {process.returncode}"
        run.sound = state.last_sound - state.first_sound
        if run.end == "power cut":
            self._lose_what_is_not_synced()
        if fault is not None:
            state.now += fault.length
            state.boot = state.now - _BOOT if fault.kind == "power cut" else state.boot
        self._note_begun(process.pid)
        self._list_logs()
        return run

    def _watch_over(self, process: subprocess.Popen[bytes], run: Run) -> Fault | None:
        """Look after the recorder until it ends, or until a fault is to end it: return that."""
        while process.poll() is None:
            if self._state.request:
                fault = self._faults[self._state.request - 1]
                if fault.kind != "second recorder":
                    return fault
                self._start_second()
                self._state.request = 0
            self._look(process, run)
            time.sleep(_LOOK_SECONDS)
        return None

    def _end(self, process: subprocess.Popen[bytes], fault: Fault) -> None:
        if fault.kind == "restarted":
            process.terminate()
            if process.wait() not in _STOPPED:
                self._problems.append(f"stopped, it ended with status {process.returncode}")
            return
        time.sleep(self._random.random() * _MOMENT_SECONDS)
        children = _children(process.pid)
        process.kill()
        process.wait()
        for child in children:
            _kill(child)

    def _start_second(self) -> None:
        """Start another recorder in the same folder, which must be refused."""
        sound, logs = str(self._folder.composed), str(self._folder.logs)
        command = [*HEARTHLOG, "record", sound, "-o", logs, "--node", NODE, "--model", "none"]
        second = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if "is in use by the recorder" not in second.stderr:
            self._problems.append(f"a second recorder was not refused: {second.stderr.strip()}")

    def _lose_what_is_not_synced(self) -> None:
        """Cut what is being written where it may end after a power cut, or leave zeros there."""
        synced = self._folder.synced()
        for path in self._folder.logs.rglob(f"*{ACTIVE_SUFFIX}"):
            size = path.stat().st_size
            kept = self._random.randint(min(synced.get(path.name, 0), size), size)
            os.truncate(path, kept)
            if self._random.random() < 0.5:
                os.truncate(path, size)

    def _note_begun(self, process: int) -> None:
        """Note the logs that were not synced once before the recorder ended."""
        begun = {log for _, log in self._folder.begun()}
        active = self._folder.logs.rglob(f"*{ACTIVE_SUFFIX}")
        for log in sorted({stem(path) for path in active} - begun):
            self._folder.note_begun(process, log)

    def _look(self, process: subprocess.Popen[bytes], run: Run) -> None:
        if time.monotonic() - self._listed > _LIST_SECONDS:
            self._listed = time.monotonic()
            self._list_logs()
        last = run.samples[-1].now if run.samples else 0
        if self._state.now - last >= _SAMPLE:
            sample = _sample(process.pid, self._state.now)
            run.samples += [] if sample is None else [sample]

    def _list_logs(self) -> None:
        """Read the coverage of the finished logs, before they are thinned or deleted."""
        for path in self._folder.logs.rglob(f"*{SUFFIX}"):
            if path.name not in self._coverages and not is_layer(path):
                self._coverages[path.name] = self._pool.submit(read_log_coverage, path)


def _sample(process: int, now: int) -> Sample | None:
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
        fields = dict(line.split(":", 1) for line in lines[1:])
        memory = int(fields["Anonymous"].split()[0])  # the composed sound is a mapped file
        descriptors = sum(1 for _ in Path(f"/proc/{process}/fd").iterdir())
    except (OSError, ValueError, KeyError):  # it has just ended
        return None
    return Sample(now, memory * 1024, descriptors, len(_children(process)))


def _children(process: int) -> list[int]:
    children = []
    for path in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            children += [int(child) for child in path.read_text().split()]
        except OSError:
            continue
    return children


def _kill(process: int) -> None:
    try:
        os.kill(process, signal.SIGKILL)
    except ProcessLookupError:
        return
    while Path(f"/proc/{process}").exists():
        time.sleep(_LOOK_SECONDS)
