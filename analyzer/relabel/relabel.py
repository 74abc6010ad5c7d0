"""Relabelling: jobs for the workers, and the order in which layers are completed."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path
from typing import Any

from hearthlog.analyzer.errors import LostClusterError
from hearthlog.analyzer.logs.layers import Chain, find_chains
from hearthlog.analyzer.relabel.layer import (
    Job,
    LayerMetadata,
    OpenRuns,
    UnfinishedLayer,
    complete_layer,
    is_current,
    label_logs,
    make_job,
    read_layer_metadata,
)
from hearthlog.analyzer.workers import Workers
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import HearthlogError, Progress, ignore_progress
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.logs.files import is_active, relabel_path
from hearthlog.schemas.logs.metadata import check_version, log_digest

_LONGEST_STRETCH = 8  # maximum number of contiguous logs labelled in one task


@dataclass
class Relabelled:
    """Result for each log."""

    layers: list[Path] = field(default_factory=list)  # written layers
    frames: int = 0  # number of labelled frames
    current: list[Path] = field(default_factory=list)  # layers already up to date
    active: list[Path] = field(default_factory=list)  # logs still being written
    lost: dict[Path, str] = field(default_factory=dict)  # unreadable parts of relabelled logs
    failed: dict[Path, str] = field(default_factory=dict)  # errors of logs that were not relabelled
    # Feature sets of microphones that the model does not support, by name.
    left_out: dict[str, str] = field(default_factory=dict)

    by_features: list[Path] = field(default_factory=list)  # logs without the model's embeddings

    @property
    def logs(self) -> int:
        """Number of finished logs."""
        return sum(map(len, (self.layers, self.current, self.active, self.failed)))


def relabel(
    paths: Iterable[Path],
    model: Model,
    model_path: Path,
    workers: Workers,
    progress: Progress = ignore_progress,
) -> Relabelled:
    """Relabel logs into layers next to them; layers that are up to date are kept.

    The same logs and the same model give the same labels and segments, independent of the selection
    of logs in one call and of the number of parallel tasks.

    Parameters
    ----------
    progress : callable, optional
        Called with the finished share of the logs, 0 to 1.

    Returns
    -------
    Relabelled
        The result for each log; a failed log is recorded there, and does not stop others.

    Raises
    ------
    LogError
        If a log does not exist, or is a layer.
    LostClusterError
        If the workers' cluster is gone; completed layers stay.
    """
    chains = find_chains(paths)
    total = sum(len(chain.asked) for chain in chains)
    work = _Relabelling(chains, model, model_path, workers)
    work.run(lambda done: progress(done / max(total, 1)))
    return work.result


class _State(Enum):
    CURRENT = auto()  # the layer may stay, if it continues the previous layer
    WAITING = auto()  # for a worker
    RUNNING = auto()
    LABELLED = auto()  # the layer can be completed after the previous layer


@dataclass(eq=False)
class _Task:
    """A log in progress."""

    place: int  # in its chain
    job: Job
    metadata: LayerMetadata | None  # of an existing layer that may be replaced
    state: _State
    labelled: UnfinishedLayer | None = None


class _ChainQueue:
    """Tasks of one chain, in time order; layers are completed from its head."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.tasks: deque[_Task] = deque()
        self.open_runs: OpenRuns = {}  # at the end of the last layer
        self._last: int | None = None  # place of the last log with a complete or current layer

    def follows_layer(self, task: _Task) -> bool:
        """Return whether `open_runs` are the segments open at the start of a task's log."""
        return self._last is not None and self._last == task.place - 1

    def pop(self, open_at_end: OpenRuns) -> None:
        """Remove the first task; its layer ends with these open segments."""
        self._last, self.open_runs = self.tasks.popleft().place, open_at_end


class _Relabelling:
    def __init__(
        self, chains: Sequence[Chain], model: Model, model_path: Path, workers: Workers
    ) -> None:
        self.result = Relabelled()
        self._chains = chains
        self._model = model
        self._model_path = model_path
        self._workers = workers
        self._running: dict[Future[Any], tuple[_ChainQueue, Sequence[_Task]]] = {}
        self._unfinished: dict[Path, UnfinishedLayer] = {}  # by their files

    def run(self, progress: Callable[[int], None]) -> None:
        """Label all logs; `progress` is called with the number of finished logs."""
        waiting = self._stretches()
        try:
            while True:
                while len(self._running) < self._most_running and (some := next(waiting, None)):
                    self._submit(*some)
                progress(self.result.logs)
                if not self._running:
                    return
                for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                    self._receive(future)
        finally:
            for layer in self._unfinished.values():  # none, unless an error stopped the run
                layer.delete()

    @property
    def _most_running(self) -> int:
        """Return the number of tasks to submit at once, so that no worker is idle."""
        parallel = self._workers.parallel
        return 2 * parallel if parallel > 1 else 1

    def _stretches(self) -> Iterator[tuple[_ChainQueue, Sequence[_Task]]]:
        """Check the logs of one chain after the other, and yield the logs to label.

        Contiguous logs are yielded together, since the sound before the first of them has to be
        labelled, too. Towards the end of a chain the groups get smaller, so that the workers finish
        together.
        """
        for chain in self._chains:
            queue = _ChainQueue(chain)
            layers = map_logs(self._look_at, list(chain.asked.values()))
            stretch: list[_Task] = []
            for number, (place, layer) in enumerate(zip(chain.asked, layers, strict=True)):
                task = self._task(chain, place, layer)
                waits = task is not None and task.state is _State.WAITING
                left = len(chain.asked) - number + len(stretch)
                longest = min(-(-left // self._workers.parallel), _LONGEST_STRETCH)
                follows = bool(stretch) and stretch[-1].place == place - 1
                if stretch and not (waits and follows and len(stretch) < longest):
                    yield queue, stretch
                    stretch = []
                if task is not None:
                    queue.tasks.append(task)
                    if waits:
                        stretch.append(task)
                    self._advance(queue)
            if stretch:
                yield queue, stretch

    def _look_at(self, log: Path) -> tuple[LayerMetadata | None, str] | HearthlogError:
        """Read the metadata of a log's layer, and the digest of the log."""
        try:
            return read_layer_metadata(relabel_path(log, self._model.name)), log_digest(log)
        except HearthlogError as error:
            return error

    def _task(
        self, chain: Chain, place: int, layer: tuple[LayerMetadata | None, str] | HearthlogError
    ) -> _Task | None:
        """Decide the task of a log; None if nothing is to be done."""
        log = chain.logs[place]
        if is_active(log):
            self.result.active.append(log)
            return None
        job = self._job(chain, place, continues_layer=place - 1 in chain.asked)
        try:
            if isinstance(layer, HearthlogError):
                raise layer
            metadata, sha256 = layer
            current = metadata is not None and is_current(job, metadata, sha256)
        except HearthlogError as error:
            self.result.failed[log] = str(error)
            return None
        job = job._replace(replaces=metadata is not None)
        return _Task(place, job, metadata, _State.CURRENT if current else _State.WAITING)

    def _job(self, chain: Chain, place: int, *, continues_layer: bool) -> Job:
        return make_job(
            chain, place, self._model, self._model_path, continues_layer=continues_layer
        )

    def _submit(self, queue: _ChainQueue, tasks: Sequence[_Task]) -> None:
        for task in tasks:
            task.state = _State.RUNNING
        future = self._workers.submit(label_logs, [task.job for task in tasks])
        self._running[future] = queue, tasks

    def _receive(self, future: Future[Any]) -> None:
        """Process the result of a worker."""
        queue, tasks = self._running.pop(future)
        error = future.exception()
        if error is not None:
            if isinstance(error, LostClusterError) or not isinstance(error, Exception):
                raise error
            if len(tasks) == 1:
                self._fail(queue, tasks[0], error)
            else:
                for task in tasks:  # one of them is the cause
                    self._submit(queue, [task])
        elif (layers := future.result()) is None:
            self._note_layer(tasks[0])
        else:
            for task, layer in zip(tasks, layers, strict=True):
                if layer is None:
                    self._submit(queue, [task])  # the error may be a temporary storage error
                else:
                    self._take(task, layer)
        self._advance(queue)

    def _take(self, task: _Task, labelled: UnfinishedLayer) -> None:
        task.state, task.labelled = _State.LABELLED, labelled
        check_version(labelled.provenance, task.job.log)
        self._unfinished[labelled.part] = labelled

    def _fail(self, queue: _ChainQueue, task: _Task, error: Exception) -> None:
        """Record that a log was not relabelled; the others continue."""
        text = str(error)
        if not isinstance(error, HearthlogError):
            text = f"{task.job.log}: {type(error).__name__}: {text.partition(chr(10))[0]}"
        self.result.failed[task.job.log] = text
        if task in queue.tasks:  # false if its layer was to be completed
            queue.tasks.remove(task)
        if task.labelled is not None:
            self._delete(task.labelled)

    def _advance(self, queue: _ChainQueue) -> None:
        """Complete layers, in time order, up to the first unlabelled log."""
        while queue.tasks and queue.tasks[0].state in {_State.CURRENT, _State.LABELLED}:
            task = queue.tasks[0]
            follows = queue.follows_layer(task)
            if task.labelled is not None:
                if follows or not task.labelled.lacks_starts:
                    self._complete(queue, task, task.labelled.with_starts(queue.open_runs))
                else:
                    self._label_alone(queue, task, task.labelled)
            else:
                assert task.metadata is not None  # it is current
                if follows and task.metadata.open_at_start != queue.open_runs:
                    self._submit(queue, [task])
                else:
                    self.result.current.append(task.job.layer)
                    queue.pop(task.metadata.open_at_end)

    def _complete(self, queue: _ChainQueue, task: _Task, labelled: UnfinishedLayer) -> None:
        task.labelled = labelled
        queue.pop(labelled.open_at_end)
        self._running[self._workers.submit(complete_layer, task.job, labelled)] = queue, [task]

    def _label_alone(self, queue: _ChainQueue, task: _Task, labelled: UnfinishedLayer) -> None:
        """Label a log again, separately: the previous layer, which it should continue, failed."""
        self._delete(labelled)
        job = self._job(queue.chain, task.place, continues_layer=False)
        task.job = job._replace(replaces=task.job.replaces)
        task.labelled = None
        self._submit(queue, [task])

    def _delete(self, labelled: UnfinishedLayer) -> None:
        self._unfinished.pop(labelled.part, None)
        labelled.delete()

    def _note_layer(self, task: _Task) -> None:
        assert task.labelled is not None
        self._unfinished.pop(task.labelled.part, None)
        self.result.layers.append(task.job.layer)
        self.result.frames += task.labelled.frames
        self.result.left_out |= task.labelled.left_out
        if task.labelled.lacks_embeddings:
            self.result.by_features.append(task.job.log)
        if task.labelled.loss:
            self.result.lost[task.job.log] = task.labelled.loss
