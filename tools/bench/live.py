"""One microphone recorded live: how much of a core, and how much memory."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from hearthlog.models.classifiers.svm_rbf import SVM_RBF
from hearthlog.recorder.sources import capture
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.bench.labmic import DEVICE, make_microphone
from hearthlog.tools.bench.table import Row, Table, Target
from hearthlog.tools.bench.timing import HEARTHLOG, BenchError
from hearthlog.tools.bench.workload import Workload

_SECONDS = 60.0
_SETTLE_SECONDS = 5.0
_START_SECONDS = 30.0
_HEARD_SECONDS = 10.0  # again and again; the device keeps them in memory
_CPU = Target(1.0, at_most=True)
_MEMORY = Target(120.0, at_most=True)
_HEAVY = ("sklearn", "hmmlearn", "rerun", "dask", "matplotlib", "scipy")
_NO_HEAVY = Target(0, at_most=True)
_GAPS = 3  # exit status

# Opens the microphone as the recorder does, and throws the sound away.
_BARE = """
import sys, sounddevice
device, rate, block, latency = sys.argv[1:]
sounddevice.RawInputStream(
    samplerate=int(rate), blocksize=int(block), latency=float(latency),
    device=device, channels=1, dtype="int16", callback=lambda *_: None,
).start()
sys.stdin.read()
"""
# `hearthlog`, which at its end writes the names of the modules it imported.
_TELLING_MODULES = """
import atexit, sys
atexit.register(lambda: print(*sys.modules, file=sys.stderr))
from hearthlog.tools.cli.main import main
main()
"""


@dataclass(frozen=True)
class _Usage:
    """Seconds of CPU time and bytes of memory, of one process."""

    cpu: float
    memory: int


def measure(work: Workload) -> Table:
    """Record for a minute, and beside it hear the same device without doing anything."""
    size = SVM_RBF.summary(work.model)
    title = f"live: one microphone for {_SECONDS:.0f} s, {size}"
    try:
        rows = _live(work)
    except (BenchError, ImportError) as error:
        rows = [
            Row("hearthlog, all processes", None, "% of a core", target=_CPU, note=str(error)),
            Row("their memory (PSS)", None, "MB", target=_MEMORY, note=str(error)),
        ]
    return Table(title, [*rows, _imports(work)])


def _live(work: Workload) -> list[Row]:
    middle = len(work.samples) // 2
    samples = work.samples[middle : middle + round(_HEARD_SECONDS * SAMPLE_RATE)]
    env = make_microphone(work.folder, samples)
    logs = work.folder / "logs-live"
    recorder = ["record", "--device", DEVICE, "--model", work.model_file, "--output", logs]
    block = round(capture.BLOCK_SECONDS * SAMPLE_RATE)
    latency = capture.LATENCY_SECONDS
    bare = [sys.executable, "-c", _BARE, DEVICE, SAMPLE_RATE, block, latency]
    with ExitStack() as stack:
        ours = stack.enter_context(_running([*HEARTHLOG, *recorder], env))
        other = stack.enter_context(_running(bare, env))
        _wait_for_log(logs, ours)
        time.sleep(_SETTLE_SECONDS)
        before, began = _usage(ours) | _usage(other), time.monotonic()
        time.sleep(_SECONDS)
        after, seconds = _usage(ours) | _usage(other), time.monotonic() - began
        ours.terminate()
        gaps = ours.wait(timeout=_START_SECONDS) == _GAPS
    if before.keys() != after.keys() or len(after) != 3:
        raise BenchError("the recorder lost the microphone while it was measured")
    *percent, bare_percent = [100 * (after[pid].cpu - before[pid].cpu) / seconds for pid in after]
    *megabytes, bare_megabytes = [usage.memory / 1e6 for usage in after.values()]
    unit = "% of a core"
    note = "sound was lost: the machine was busy" if gaps else ""
    rows = [Row("hearthlog, all processes", sum(percent), unit, target=_CPU, note=note)]
    names = ("recorder", "capture")
    rows += [Row(f"  {n}", p, unit) for n, p in zip(names, percent, strict=True)]
    rows += [
        Row("the bare microphone", bare_percent, unit, note="opened alike, sound thrown away"),
        Row("memory (PSS), all processes", sum(megabytes), "MB", target=_MEMORY),
    ]
    rows += [Row(f"  {n}", m, "MB") for n, m in zip(names, megabytes, strict=True)]
    return [*rows, Row("the bare microphone, memory", bare_megabytes, "MB")]


@contextmanager
def _running(command: list[object], env: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process that ends with the block, or with this process if that is killed."""
    process = subprocess.Popen(  # noqa: S603  our own
        ["setpriv", "--pdeathsig", "KILL", *map(str, command)],  # noqa: S607  where it is, differs
        env=env,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _wait_for_log(logs: Path, recorder: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + _START_SECONDS
    while not any(logs.rglob("*.active")):
        if time.monotonic() > deadline or recorder.poll() is not None:
            raise BenchError("the recorder did not start with the microphone of the tests")
        time.sleep(0.1)


def _usage(process: subprocess.Popen[bytes]) -> dict[int, _Usage]:
    """Read what a process, and then those it started, have used so far, by process id."""
    import psutil  # noqa: PLC0415  an extra, like the peers

    try:
        root = psutil.Process(process.pid)
        return {
            one.pid: _Usage(_seconds_on_cpu(one.pid), one.memory_full_info().pss)
            for one in (root, *root.children(recursive=True))
        }
    except (psutil.Error, OSError) as error:
        raise BenchError(f"a process ended while it was measured ({error})") from error


def _seconds_on_cpu(pid: int) -> float:
    """Add up what the scheduler counted for each thread; other figures are sampled at ticks."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9


def _imports(work: Workload) -> Row:
    """Ask a recorder what it imported."""
    second = work.write_wav("imports.wav", 2.0)
    logs = work.folder / "logs-imports"
    arguments = ["record", second, "--model", work.model_file, "--output", logs]
    command = [sys.executable, "-c", _TELLING_MODULES, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  ours
    if done.returncode != 0:
        raise BenchError(f"hearthlog record failed: {done.stderr.strip()[-300:]}")
    modules = done.stderr.split()
    heavy = sorted({name.split(".")[0] for name in modules} & set(_HEAVY))
    note = f"{len(modules)} modules; " + (f"MUST NOT: {', '.join(heavy)}" if heavy else "none of ")
    note += "" if heavy else ", ".join(_HEAVY)
    return Row("heavy imports of the recorder", len(heavy), "packages", None, _NO_HEAVY, note)
