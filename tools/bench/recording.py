"""From a WAV file to a labelled log: the whole command, its start included."""

from pathlib import Path

from tools.bench.table import Row, Table, Target
from tools.bench.timing import best_of_processes
from tools.bench.workload import Workload

_REPEATS = 3
_FAST = Target(1_000)


def measure(work: Workload) -> Table:
    """Measure `hearthlog record FILE` on one core."""
    second = work.write_wav("second.wav", 1.0)
    elapsed, cpu = best_of_processes(_record(work, work.wav), _REPEATS)
    started, _ = best_of_processes(_record(work, second), _REPEATS)
    return Table(
        f"recording: {work.seconds:.0f} s of WAV to a labelled log, one core, "
        f"{len(work.model.support_vectors)} support vectors",
        [
            Row("hearthlog record", work.seconds / elapsed, "x real time", target=_FAST),
            Row("the same by CPU time", work.seconds / cpu, "x real time"),
            Row("start to end, a second of sound", started, "s", note="part of the above"),
        ],
    )


def _record(work: Workload, wav: Path) -> list[str | Path]:
    # Node and time are those of the log before: it must not find it.
    logs = work.folder / f"logs-{wav.stem}"
    return ["record", wav, "--model", work.model_file, "--output", logs]
