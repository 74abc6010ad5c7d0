"""Relabelling: jobs for the workers, and the order in which layers are completed."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
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
    delete_remains,
    is_current,
    label_logs,
    read_layer_metadata,
)
from hearthlog.analyzer.workers import Workers
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import HearthlogError, Progress, ignore_progress
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.logs.files import is_active, relabel_path
from hearthlog.schemas.logs.metadata import check_version, log_digest

_LONGEST_STRETCH = 8  # maximum number of contiguous logs labelled in one task
_MOST_EARLIER = 1000  # logs: within so many a floor is forgotten, even if each has only a minute


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
    of logs in one call and of the number of parallel tasks. A failed log is recorded in the result,
    and does not stop others. `progress` receives the finished share of the logs, 0 to 1. Raise
    `LogError` if a log does not exist, or is a layer; `LostClusterError` if the workers' cluster is
    gone: completed layers stay.
    """
    chains = find_chains(paths)
    total = sum(len(chain.requested) for chain in chains)
    work = _Relabelling(chains, model, model_path, workers)
    work.run(lambda done: progress(done / max(total, 1)))
    return work.result


@dataclass(eq=False)
class _PendingLayer:
    """Layer of a log, until it is complete."""

    place: int  # of the log in its chain
    job: Job
    existing: LayerMetadata | None  # of a layer that may be replaced
    ready: bool  # for completion after the previous layer: labelled, or the existing one is current
    labelled: UnfinishedLayer | None = None


@dataclass(eq=False)
class _ChainQueue:
    """Layers of one chain, in time order; they are completed from its head."""

    chain: Chain
    layers: deque[_PendingLayer] = field(default_factory=deque)
    last: int | None = None  # place of the last log with a complete or current layer
    open_runs: OpenRuns = field(default_factory=dict)  # segments open at the end of that layer

    def pop(self, open_at_end: OpenRuns) -> None:
        """Remove the first layer, which ends with these open segments."""
        self.last, self.open_runs = self.layers.popleft().place, open_at_end


class _Relabelling:
    def __init__(
        self, chains: Sequence[Chain], model: Model, model_path: Path, workers: Workers
    ) -> None:
        self.result = Relabelled()
        self._chains = chains
        self._model = model
        self._model_path = model_path
        self._workers = workers
        self._running: dict[Future[Any], tuple[_ChainQueue, Sequence[_PendingLayer]]] = {}
        self._unfinished: dict[Path, UnfinishedLayer] = {}  # by their files

    def run(self, progress: Callable[[int], None]) -> None:
        """Label all logs; `progress` is called with the number of finished logs."""
        waiting = self._stretches()
        try:
            while True:
                parallel = self._workers.parallel
                most = 2 * parallel if parallel > 1 else 1  # so that no worker is idle
                while len(self._running) < most and (some := next(waiting, None)):
                    self._submit(*some)
                progress(self.result.logs)
                if not self._running:
                    break
                for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                    self._receive(future)
            delete_remains([*self.result.layers, *self.result.current])
        finally:
            for layer in self._unfinished.values():  # none, unless an error stopped the run
                layer.delete()

    def _stretches(self) -> Iterator[tuple[_ChainQueue, Sequence[_PendingLayer]]]:
        """Check the logs of one chain after the other, and yield the logs to label.

        Contiguous logs are yielded together, since the sound before the first of them has to be
        labelled, too. Towards the end of a chain the groups get smaller, so that the workers finish
        together.
        """
        for chain in self._chains:
            queue = _ChainQueue(chain)
            found = map_logs(self._look_at, list(chain.requested.values()))
            stretch: list[_PendingLayer] = []
            for number, (place, layer) in enumerate(zip(chain.requested, found, strict=True)):
                pending = self._pending(chain, place, layer)
                waits = pending is not None and not pending.ready
                left = len(chain.requested) - number + len(stretch)
                longest = min(-(-left // self._workers.parallel), _LONGEST_STRETCH)
                follows = bool(stretch) and stretch[-1].place == place - 1
                if stretch and not (waits and follows and len(stretch) < longest):
                    yield queue, stretch
                    stretch = []
                if pending is not None:
                    queue.layers.append(pending)
                    if waits:
                        stretch.append(pending)
                    self._advance(queue)
            if stretch:
                yield queue, stretch

    def _look_at(self, log: Path) -> tuple[LayerMetadata | None, str] | HearthlogError:
        """Read the metadata of a log's layer, and the digest of the log."""
        try:
            return read_layer_metadata(relabel_path(log, self._model.name)), log_digest(log)
        except HearthlogError as error:
            return error

    def _pending(
        self, chain: Chain, place: int, found: tuple[LayerMetadata | None, str] | HearthlogError
    ) -> _PendingLayer | None:
        """Decide what is to be done for a log; None for nothing."""
        log = chain.logs[place]
        if is_active(log):
            self.result.active.append(log)
            return None
        try:
            if isinstance(found, HearthlogError):
                raise found
            existing, sha256 = found
            job = self._job(chain, place, replaces=existing is not None)
            current = existing is not None and is_current(job, existing, sha256)
        except HearthlogError as error:
            self.result.failed[log] = str(error)
            return None
        return _PendingLayer(place, job, existing, ready=current)

    def _job(self, chain: Chain, place: int, *, replaces: bool, alone: bool = False) -> Job:
        """Make the job of a log; `alone` if the layer before it failed."""
        continues = place - 1 in chain.requested and not alone
        log = chain.logs[place]
        first = max(place - _MOST_EARLIER, 0) if continues else 0
        return Job(
            log=log,
            layer=relabel_path(log, self._model.name),
            earlier=tuple(reversed(chain.logs[first:place])),
            next_log=chain.logs[place + 1] if place + 1 < len(chain.logs) else None,
            model=self._model_path,
            model_sha256=self._model.sha256,
            replaces=replaces,
            continues_layer=continues,
        )

    def _submit(self, queue: _ChainQueue, layers: Sequence[_PendingLayer]) -> None:
        for layer in layers:
            layer.ready = False
        future = self._workers.submit(label_logs, [layer.job for layer in layers])
        self._running[future] = queue, layers

    def _receive(self, future: Future[Any]) -> None:
        """Process the result of a worker."""
        queue, layers = self._running.pop(future)
        error = future.exception()
        if error is not None:
            if isinstance(error, LostClusterError) or not isinstance(error, Exception):
                raise error
            if len(layers) == 1:
                self._fail(queue, layers[0], error)
            else:
                for layer in layers:  # one of them is the cause
                    self._submit(queue, [layer])
        elif (results := future.result()) is None:
            self._note_layer(layers[0])
        else:
            for layer, labelled in zip(layers, results, strict=True):
                if labelled is None:
                    self._submit(queue, [layer])  # the error may be a temporary storage error
                else:
                    layer.ready, layer.labelled = True, labelled
                    check_version(labelled.provenance, layer.job.log)
                    self._unfinished[labelled.part] = labelled
        self._advance(queue)

    def _fail(self, queue: _ChainQueue, layer: _PendingLayer, error: Exception) -> None:
        """Record that a log was not relabelled; the others continue."""
        log, text = layer.job.log, str(error)
        if not isinstance(error, HearthlogError):
            text = f"{log}: {type(error).__name__}: {text.partition(chr(10))[0]}"
        self.result.failed[log] = text
        if layer in queue.layers:  # false if it was to be completed
            queue.layers.remove(layer)
        self._delete_labels(layer)

    def _advance(self, queue: _ChainQueue) -> None:
        """Complete layers, in time order, up to the first unlabelled log."""
        while queue.layers and queue.layers[0].ready:
            layer = queue.layers[0]
            follows = queue.last == layer.place - 1  # then it begins with `open_runs`
            if layer.labelled is None:
                assert layer.existing is not None  # it is current
                if follows and layer.existing.open_at_start != queue.open_runs:
                    self._submit(queue, [layer])
                else:
                    self.result.current.append(layer.job.layer)
                    queue.pop(layer.existing.open_at_end)
            elif follows or not layer.labelled.lacks_start:
                layer.labelled = layer.labelled.with_starts(queue.open_runs)
                queue.pop(layer.labelled.metadata.open_at_end)
                future = self._workers.submit(complete_layer, layer.job, layer.labelled)
                self._running[future] = queue, [layer]
            else:  # the previous layer, which it should continue, failed
                self._delete_labels(layer)
                replaces = layer.job.replaces
                layer.job = self._job(queue.chain, layer.place, replaces=replaces, alone=True)
                self._submit(queue, [layer])

    def _delete_labels(self, layer: _PendingLayer) -> None:
        if layer.labelled is not None:
            self._unfinished.pop(layer.labelled.part, None)
            layer.labelled.delete()
            layer.labelled = None

    def _note_layer(self, layer: _PendingLayer) -> None:
        labelled, log = layer.labelled, layer.job.log
        assert labelled is not None
        self._unfinished.pop(labelled.part, None)
        self.result.layers.append(layer.job.layer)
        self.result.frames += sum(labelled.frames.values())
        self.result.left_out |= labelled.left_out
        if labelled.lacks_embeddings:
            self.result.by_features.append(log)
        if labelled.metadata.loss:
            self.result.lost[log] = labelled.metadata.loss
