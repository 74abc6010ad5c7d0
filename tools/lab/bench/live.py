"""One microphone recorded live: how much of a core, and how much memory."""

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.classifiers.rbf_machines import RBF_LANDMARKS
from hearthlog.models.embedding.networks import YAMNET, find_network
from hearthlog.models.modelfile import SUFFIX
from hearthlog.models.registry import CANDIDATE
from hearthlog.models.starter import GENERAL, starter_file, with_network
from hearthlog.recorder.labelling.embedder_probe import NO_NETWORK
from hearthlog.recorder.sources import capture
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.lab.bench.labmic import DEVICES, make_microphone
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import HEARTHLOG, BenchError
from hearthlog.tools.lab.bench.workload import Workload

_SECONDS = 60.0
_SETTLE_SECONDS = 5.0
_START_SECONDS = 30.0
_LOOP_SECONDS = 10  # again and again; the device keeps them in memory
_CPU = Target(0.5, at_most=True)
_WITH_NETWORK = Target(1.0, at_most=True)
_PROCESSES = ("recorder", "capture")
_MANY = (2, 4)  # microphones
_NETWORK = "with the network"
_UNIT = "% of a core"
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
    """Record sound for a minute, also with a candidate, more microphones and a network."""
    size = RBF_LANDMARKS.summary(work.model)
    title = f"live: one microphone for {_SECONDS:.0f} s, {size}"
    try:
        rows = _live(work)
    except (BenchError, ImportError) as error:
        rows = [
            Row("hearthlog, all processes", None, _UNIT, target=_CPU, note=str(error)),
            Row("memory (PSS), all processes", None, "MB", target=_MEMORY, note=str(error)),
        ]
    return Table(title, [*rows, _imports(work)])


def _live(work: Workload) -> list[Row]:
    env = make_microphone(work.folder, most_sounding(work.samples))
    recorders = [
        _Recorder("hearthlog", work.model_file),
        _Recorder("with a candidate", _with_candidate(work)),
        *(_Recorder(f"with {count} microphones", work.model_file, count) for count in _MANY),
    ]
    if find_network(YAMNET.name) is not None:
        network = starter_file(with_network(GENERAL))
        recorders.append(_Recorder(_NETWORK, network, network=YAMNET.name))
    block = round(capture.BLOCK_SECONDS * SAMPLE_RATE)
    latency = capture.LATENCY_SECONDS
    bare = [sys.executable, "-c", _BARE, DEVICES[0], SAMPLE_RATE, block, latency]
    with ExitStack() as stack:
        running_recorders = []
        for number, recorder in enumerate(recorders):
            logs = work.folder / f"logs-{number}"
            # Without a word, all would listen with the network where it is installed.
            own = env | {"HEARTHLOG_EMBEDDING": recorder.network}
            process = stack.enter_context(running(recorder.command(logs), own))
            running_recorders.append(process)
            wait_for_log(logs, process)
        processes = [*running_recorders, stack.enter_context(running(bare, env))]
        time.sleep(_SETTLE_SECONDS)
        before, began = [usage(process) for process in processes], time.monotonic()
        time.sleep(_SECONDS)
        after, seconds = [usage(process) for process in processes], time.monotonic() - began
        for process in running_recorders:
            process.terminate()
        ends = [process.wait(timeout=_START_SECONDS) for process in running_recorders]
    if [one.keys() for one in before] != [one.keys() for one in after]:
        raise BenchError("the recorder lost the microphone while it was measured")
    percents = [
        [100 * (last[pid].cpu - first[pid].cpu) / seconds for pid in first]
        for first, last in zip(before, after, strict=True)
    ]
    megabytes = [[usage.memory / 1e6 for usage in last.values()] for last in after]
    notes = ["sound was lost: the machine was busy" if end == _GAPS else "" for end in ends]
    return _rows(recorders, percents, megabytes, notes)


@dataclass(frozen=True)
class _Recorder:
    """A recorder to measure."""

    name: str
    model: Path
    microphones: int = 1
    network: str = NO_NETWORK

    def command(self, logs: Path) -> list[object]:
        """Return the command that runs it; write its configuration next to its logs."""
        config = logs.with_suffix(".toml")
        config.write_text(
            "".join(
                f'[[microphone]]\nname = "{device}"\ndevice = "{device}"\n'
                for device in DEVICES[: self.microphones]
            )
        )
        files = ["--config", config, "--model", self.model, "--output", logs]
        return [*HEARTHLOG, "record", *files]


def _with_candidate(work: Workload) -> Path:
    """Copy the model to a folder with a candidate; the same model would not label twice."""
    folder = work.folder / "on-trial"
    folder.mkdir()
    shutil.copy(starter_file(GENERAL), folder / (CANDIDATE + SUFFIX))
    return Path(shutil.copy(work.model_file, folder))


def most_sounding(samples: NDArray[np.int16]) -> NDArray[np.int16]:
    """Return the ten seconds in which most seconds are loud: in quiet a model is hardly asked."""
    seconds = samples[: len(samples) // SAMPLE_RATE * SAMPLE_RATE].reshape(-1, SAMPLE_RATE)
    levels = np.log10(np.einsum("ij,ij->i", seconds, seconds, dtype=np.float64) + 1.0)
    sums = np.convolve(levels, np.ones(min(_LOOP_SECONDS, len(levels))), "valid")
    return seconds[sums.argmax() :][:_LOOP_SECONDS].ravel()


def _rows(
    recorders: list[_Recorder],
    percents: list[list[float]],
    megabytes: list[list[float]],
    notes: list[str],
) -> list[Row]:
    """Make rows of the use of recorders and, at the end, of the bare microphone."""
    *used, (bare,) = percents
    rows = []
    for recorder, own, note in zip(recorders, used, notes, strict=True):
        target = {recorders[0].name: _CPU, _NETWORK: _WITH_NETWORK}.get(recorder.name)
        rows.append(Row(f"{recorder.name}, all processes", sum(own), _UNIT, None, target, note))
        if recorder is recorders[0]:
            rows += [Row(f"  {n}", p, _UNIT) for n, p in zip(_PROCESSES, own, strict=True)]
    rows.append(Row("the bare microphone", bare, _UNIT, note="opened alike, sound thrown away"))
    (first, *others), (bare,) = megabytes[:-1], megabytes[-1]
    rows.append(Row("memory (PSS), all processes", sum(first), "MB", target=_MEMORY))
    rows += [Row(f"  {n}", m, "MB") for n, m in zip(_PROCESSES, first, strict=True)]
    for recorder, own in zip(recorders[1:], others, strict=True):
        rows.append(Row(f"memory {recorder.name}", sum(own), "MB"))
    return [*rows, Row("the bare microphone, memory", bare, "MB")]


@contextmanager
def running(command: list[object], env: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
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


def wait_for_log(logs: Path, recorder: subprocess.Popen[bytes]) -> None:
    """Wait until a recorder writes."""
    deadline = time.monotonic() + _START_SECONDS
    while not any(logs.rglob("*.active")):
        if time.monotonic() > deadline or recorder.poll() is not None:
            raise BenchError("the recorder did not start with the microphone of the tests")
        time.sleep(0.1)


def usage(process: subprocess.Popen[bytes]) -> dict[int, _Usage]:
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
