"""From a WAV file to a labelled log: the whole command, its start included."""

from pathlib import Path

from hearthlog.models.classifiers.rbf_machines import RBF_LANDMARKS
from hearthlog.tools.lab.bench.hours import DENSE, KINDS
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import Seconds, best_of_processes
from hearthlog.tools.lab.bench.workload import Workload

_REPEATS = 3
_FAST = Target(1_800)


def measure(work: Workload) -> Table:
    """Measure `hearthlog record FILE` on one core: the sound of all, and sound of each kind."""
    note = "the simulated home" if work.audio is None else DENSE
    rows = [_speed(work, work.wav, "hearthlog record", _FAST, note)]
    for kind in KINDS:
        if (wav := work.wav_of(kind)) != work.wav:
            target = _FAST if kind == DENSE else None
            rows.append(_speed(work, wav, f"hearthlog record, {kind}", target))
    start = _best(work, work.write_wav("second.wav", 1.0))
    what, note = "from start to end, a second of sound", "part of the above"
    rows.append(Row(what, start.cpu, "s", note=note, elapsed=start.elapsed))
    size = RBF_LANDMARKS.summary(work.model)
    title = f"recording: {work.seconds:.0f} s of WAV to a labelled log on one core, {size}"
    return Table(title, rows)


def _speed(work: Workload, wav: Path, what: str, target: Target | None, note: str = "") -> Row:
    best = _best(work, wav)
    cpu, elapsed = work.seconds / best.cpu, work.seconds / best.elapsed
    return Row(what, cpu, "x real time", target=target, note=note, elapsed=elapsed)


def _best(work: Workload, wav: Path) -> Seconds:
    return best_of_processes([_record(work, wav, number) for number in range(_REPEATS)])


def _record(work: Workload, wav: Path, number: int) -> list[str | Path]:
    logs = work.folder / f"logs-{wav.stem}-{number}"  # no log is written over
    return ["record", wav, "--model", work.model_file, "--output", logs]
