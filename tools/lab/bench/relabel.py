"""Days relabelled: read, classified, smoothed and written; ours, and with the libraries alone."""

import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.hidden_markov import viterbi
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.rbf_machines import RBF_LANDMARKS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import (
    LABEL,
    definition,
    encode,
    header,
    message,
    nanoseconds,
)
from hearthlog.tools.lab.bench.hours import DENSE, KINDS, QUIET
from hearthlog.tools.lab.bench.inference import fit_scikit_learn, inputs_above_floor
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import HEARTHLOG, BenchError, Seconds
from hearthlog.tools.lab.bench.workload import Workload

_CALL = 1000  # rows
_WORKERS = 2
_TURNS = 2  # of a day: others on the machine slow one of two workers, and so both
_SHARE = Target(0.925)  # of the gain that the cores allow: 1.85 of 2
_SECONDS = {DENSE: Target(10, at_most=True), QUIET: Target(6, at_most=True)}
_RUN = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:], capture_output=True, text=True)
sys.stderr.write(done.stderr)
print(done.stdout)
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)
sys.exit(done.returncode)
"""


class _Run(NamedTuple):
    seconds: Seconds
    frames: int
    megabytes: float  # of the largest process


def measure(work: Workload) -> Table:
    """Measure relabelling days of hourly logs, and hours; one beside the libraries alone.

    An unfinished log is not relabelled, but counted as still being written.
    """
    path = work.model_file
    days = {kind: _best(work.day_of(kind), path, _WORKERS) for kind in KINDS}
    one, two = _best(work.day_of(DENSE), path, 1), days[DENSE]
    halves = _halves(work, path)
    hour, completed = (_ours(log.parents[3], path, 1) for log in work.live[:0:-1])
    peer = _peer(work.live.finished, work.model, work.training[0], work.folder / "peer.mcap")
    ratio, possible = (one.seconds.elapsed / least for least in (two.seconds.elapsed, halves))
    limit = f"{possible:.2f} would be possible: by two runs that share nothing"
    what, megabytes = "an hour by rosbags, scikit-learn, hmmlearn and mcap", two.megabytes
    rows = [
        *(_by_the_clock(kind, run, _SECONDS.get(kind)) for kind, run in days.items()),
        Row("dense, one worker, by the clock", one.seconds.elapsed, "s"),
        Row("half of the dense day twice at once, one worker each", halves, "s"),
        Row("one worker / two, by the clock", ratio, "", note=limit),
        Row("one worker / two: share of what the cores allow", ratio / possible, target=_SHARE),
        _of_cpu("dense, one worker", one),
        _of_cpu("an hour, its start included", hour),
        _of_cpu("an hour in chunks of 0.5 s, its start included", completed),
        Row(what, peer.cpu, "s", peer.cpu / hour.seconds.cpu, Target(10), elapsed=peer.elapsed),
        Row("peak memory of a process", megabytes, "MB", target=Target(500, at_most=True)),
    ]
    size, classes = RBF_LANDMARKS.summary(work.model), len(work.model.classes)
    title = f"relabel: days of {two.frames:,} frames, {size}, {classes} classes, CPU time"
    return Table(title, rows)


def _by_the_clock(kind: str, run: _Run, target: Target | None) -> Row:
    what, note = f"{kind}, two workers, by the clock", f"{run.seconds.cpu:.1f} s of CPU"
    return Row(what, run.seconds.elapsed, "s", target=target, note=note)


def _of_cpu(what: str, run: _Run) -> Row:
    return Row(what, run.seconds.cpu, "s", elapsed=run.seconds.elapsed)


def _halves(work: Workload, model: Path) -> float:
    """Relabel both halves of the dense day at once, and return the seconds until both are done."""
    logs = find_logs(work.day_of(DENSE))
    middle = len(logs) // 2
    halves = work.folder / "first-half", work.folder / "second-half"
    for folder, some in zip(halves, (logs[:middle], logs[middle:]), strict=True):
        folder.mkdir()
        for log in some:
            (folder / log.name).hardlink_to(log)
    with ThreadPoolExecutor(len(halves)) as pool:
        turns = [
            list(pool.map(lambda folder: _ours(folder, model, 1).seconds.elapsed, halves))
            for _ in range(_TURNS)
        ]
    return min(map(max, turns))


def _best(logs: Path, model: Path, workers: int) -> _Run:
    """Return the run that took least by the clock."""
    runs = [_ours(logs, model, workers) for _ in range(_TURNS)]
    return min(runs, key=lambda run: run.seconds.elapsed)


def _ours(logs: Path, model: Path, workers: int) -> _Run:
    for layer in logs.rglob("*.relabel-*.mcap"):
        layer.unlink()
    arguments = ["relabel", logs, "--model", model, "--workers", workers, "--json"]
    began = time.perf_counter()
    done = subprocess.run(  # noqa: S603  ours
        [sys.executable, "-c", _RUN, *HEARTHLOG, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - began
    if done.returncode != 0:
        raise BenchError(f"hearthlog relabel failed: {done.stderr.strip()[-300:]}")
    text, _, numbers = done.stdout.rstrip().rpartition("\n")
    cpu, megabytes = map(float, numbers.split())
    return _Run(Seconds(cpu, seconds), json.loads(text)["frames"], megabytes)


def _peer(log: Path, model: Model, data: Dataset, output: Path) -> Seconds:
    """Relabel a log message by message, and return the time it takes."""
    machine = fit_scikit_learn(data)
    classes = model.classes
    began, used = time.perf_counter(), time.process_time()
    with AnyReader([log]) as reader:
        chosen = [c for c in reader.connections if c.topic == "/mic/features"]
        read = (reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(chosen))
        frames: list[Any] = list(read)
    values = np.array([m.values for m in frames])
    rows = inputs_above_floor(Classifier(model).feature_set, values).astype(np.float64)
    calls = [rows[first : first + _CALL] for first in range(0, len(rows), _CALL)]
    posteriors = np.concatenate([machine.predict_proba(call) for call in calls]).astype(np.float32)
    viterbi(posteriors, model.transitions, model.description.smoothing.weight)
    with output.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(LABEL, "ros2msg", definition(LABEL).encode())
        channel = writer.register_channel("/mic/label", "cdr", schema)
        for frame, probabilities in zip(frames[-len(posteriors) :], posteriors, strict=True):
            best = int(probabilities.argmax())
            stamp = nanoseconds(frame.header.stamp)
            label = message(
                LABEL,
                header=header(stamp, "mic"),
                frame=frame.frame,
                label=classes[best],
                confidence=float(probabilities[best]),
                novelty=float("nan"),
                probabilities=probabilities,
            )
            writer.add_message(channel, stamp, encode(label), stamp)
        writer.finish()
    return Seconds(time.process_time() - used, time.perf_counter() - began)
