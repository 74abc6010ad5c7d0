"""From a WAV file to a labelled log: the whole command, its start included."""

from pathlib import Path

from hearthlog.models.classifiers.landmarks import RBF_LANDMARKS
from hearthlog.tools.bench.table import Row, Table, Target
from hearthlog.tools.bench.timing import best_of_processes
from hearthlog.tools.bench.workload import Workload

_REPEATS = 3
_FAST = Target(1_500)


def measure(work: Workload) -> Table:
    """Measure `hearthlog record FILE` on one core."""
    second = work.write_wav("second.wav", 1.0)
    whole = best_of_processes([_record(work, work.wav, i) for i in range(_REPEATS)])
    start = best_of_processes([_record(work, second, i) for i in range(_REPEATS)])
    speed = work.seconds / whole.cpu, work.seconds / whole.elapsed
    size = RBF_LANDMARKS.summary(work.model)
    return Table(
        f"recording: {work.seconds:.0f} s of WAV to a labelled log on one core, {size}",
        [
            Row("hearthlog record", speed[0], "x real time", target=_FAST, elapsed=speed[1]),
            Row(
                "from start to end, a second of sound",
                start.cpu,
                "s",
                note="part of the above",
                elapsed=start.elapsed,
            ),
        ],
    )


def _record(work: Workload, wav: Path, number: int) -> list[str | Path]:
    logs = work.folder / f"logs-{wav.stem}-{number}"  # no log is written over
    return ["record", wav, "--model", work.model_file, "--output", logs]
