"""A relabelling: its tasks, what becomes of them, and in which order layers are completed."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hearthlog.analyzer.logs.layers import Chain, find_chains
from hearthlog.analyzer.relabel.labels import Job, Labelled, complete_layer, label_log
from hearthlog.analyzer.relabel.layer import About, digest, read_about
from hearthlog.analyzer.workers import Workers
from hearthlog.models.classifiers.model import Model
from hearthlog.models.labels.segments import Run
from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.logs.files import is_active, relabel_path, stem
from hearthlog.schemas.logs.provenance import check_version
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.storage.byte_ranges import map_logs

_MOST_BEFORE = 24  # logs: within as many a model forgets what was before them


@dataclass
class Relabelled:
    """What became of the logs.

    Attributes
    ----------
    layers : list of Path
        Those that were written.
    frames : int
        That were labelled.
    current : list of Path
        Layers that were there already.
    active : list of Path
        Logs that are still being written.
    lost : dict of Path to str
        What could not be read of logs that were relabelled.
    failed : dict of Path to str
        Logs that were not relabelled, and why.
    """

    layers: list[Path] = field(default_factory=list)
    frames: int = 0
    current: list[Path] = field(default_factory=list)
    active: list[Path] = field(default_factory=list)
    lost: dict[Path, str] = field(default_factory=dict)
    failed: dict[Path, str] = field(default_factory=dict)

    @property
    def logs(self) -> int:
        """How many logs are done with."""
        return sum(map(len, (self.layers, self.current, self.active, self.failed)))


def relabel(
    paths: Iterable[Path],
    model: Model,
    model_path: Path,
    workers: Workers,
    progress: Progress = ignore_progress,
) -> Relabelled:
    """Label logs anew, in layers beside them; layers that would be the same are left alone.

    The same logs and the same model give the same labels and segments, whichever of the logs
    are asked for together, and in however many tasks at once.

    Parameters
    ----------
    paths : iterable of Path
        Logs, or folders of logs.
    model : Model
    model_path : Path
        Where workers find it.
    workers : Workers
    progress : callable
        Told the share of the logs that is done.

    Raises
    ------
    LogError
        If there is no such log.
    """
    chains = find_chains(paths)
    total = sum(len(chain.asked) for chain in chains)
    work = _Relabelling(chains, model, model_path, workers)
    work.run(lambda done: progress(done / max(total, 1)))
    return work.result


@dataclass(eq=False)
class _Item:
    """A log, and how far it is."""

    place: int  # in its chain
    job: Job
    about: About | None = None  # what the layer says that is there, and may be replaced
    current: bool = False  # that layer may stay, if it continues what is before it
    running: bool = False
    labelled: Labelled | None = None


class _Line:
    """The items of one chain, completed one after the other."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.items: deque[_Item] = deque()
        self._known: int | None = None  # the place behind which it is known what is open
        self.open: Run | None = None

    def knows(self, item: _Item) -> bool:
        """Tell whether it is known what is open before an item."""
        return self._known is not None and self._known == item.place - 1

    def pass_by(self, ended: Run | None) -> None:
        """Leave the first item behind; `ended` is what is open there."""
        self._known, self.open = self.items.popleft().place, ended


class _Relabelling:
    def __init__(
        self, chains: Sequence[Chain], model: Model, model_path: Path, workers: Workers
    ) -> None:
        self.result = Relabelled()
        self._chains = chains
        self._model = model
        self._model_path = model_path
        self._workers = workers
        self._running: dict[Future[Any], tuple[_Line, _Item]] = {}
        self._waiting: set[Path] = set()  # parts of layers that are not complete

    def run(self, progress: Callable[[int], None]) -> None:
        """Do all of it."""
        tasks = self._tasks()
        try:
            while True:
                while len(self._running) < self._at_once and (task := next(tasks, None)):
                    self._submit(*task)
                progress(self.result.logs)
                if not self._running:
                    return
                for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                    self._take(future)
        finally:
            for part in tuple(self._waiting):  # none, unless something stopped us
                self._throw_away(part)

    @property
    def _at_once(self) -> int:
        """Tasks that are handed out: enough that no worker waits for the next one."""
        parallel = self._workers.parallel
        return 2 * parallel if parallel > 1 else 1

    def _tasks(self) -> Iterator[tuple[_Line, _Item]]:
        """Look at the logs of one chain after the other, and yield those that are to be done."""
        for chain in self._chains:
            line = _Line(chain)
            there = map_logs(self._look_at, list(chain.asked.values()))
            for place, found in zip(chain.asked, there, strict=True):
                item = self._item(chain, place, found)
                if item is not None:
                    line.items.append(item)
                    if not item.current:
                        yield line, item
                    self._advance(line)

    def _look_at(self, log: Path) -> tuple[About | None, str] | HearthlogError:
        """Read what the layer of a log says of itself, and the digest of the log."""
        try:
            return read_about(relabel_path(log, self._model.name)), digest(log)
        except HearthlogError as error:
            return error

    def _item(
        self, chain: Chain, place: int, found: tuple[About | None, str] | HearthlogError
    ) -> _Item | None:
        """Decide what is to be done with a log; None if nothing is."""
        log = chain.logs[place]
        if is_active(log):
            self.result.active.append(log)
            return None
        job = self._job(chain, place, carried=place - 1 in chain.asked)
        try:
            if isinstance(found, HearthlogError):
                raise found
            about, sha256 = found
            current = about is not None and _is_current(job, about, sha256)
        except HearthlogError as error:
            self.result.failed[log] = str(error)
            return None
        return _Item(place, job._replace(replaces=about is not None), about, current)

    def _job(self, chain: Chain, place: int, *, carried: bool) -> Job:
        log = chain.logs[place]
        first = max(place - _MOST_BEFORE, 0) if carried else 0
        return Job(
            log=log,
            layer=relabel_path(log, self._model.name),
            before=tuple(reversed(chain.logs[first:place])),
            behind=chain.logs[place + 1] if place + 1 < len(chain.logs) else None,
            model=self._model_path,
            model_sha256=self._model.sha256,
            replaces=False,
            carried=carried,
        )

    def _submit(self, line: _Line, item: _Item) -> None:
        item.running = True
        self._running[self._workers.submit(label_log, item.job)] = line, item

    def _take(self, future: Future[Any]) -> None:
        """Look what became of a task."""
        line, item = self._running.pop(future)
        error = future.exception()
        if error is not None:
            if not isinstance(error, Exception):
                raise error
            self._fail(line, item, error)
        elif isinstance(found := future.result(), Labelled):
            item.running, item.labelled = False, found
            check_version(found.provenance, item.job.log)
            self._waiting.add(found.part)
        else:
            self._note(item)
        self._advance(line)

    def _fail(self, line: _Line, item: _Item, error: Exception) -> None:
        """Note that a log was not relabelled; what is wrong with it must not stop the others."""
        what = str(error)
        if not isinstance(error, HearthlogError):
            what = f"{item.job.log}: {type(error).__name__}: {what.partition(chr(10))[0]}"
        self.result.failed[item.job.log] = what
        if item in line.items:  # it is not, once its layer was to be completed
            line.items.remove(item)

    def _advance(self, line: _Line) -> None:
        """Complete what can be completed, in the order of time."""
        while line.items and not line.items[0].running:
            item = line.items[0]
            known = line.knows(item)
            if item.labelled is not None and (known or not item.labelled.begins):
                labelled = item.labelled.joined(line.open)
                line.pass_by(labelled.ended)
                item.labelled = labelled
                self._running[self._workers.submit(complete_layer, item.job, labelled)] = line, item
            elif item.labelled is not None:  # the layer before was not made
                self._throw_away(item.labelled.part)
                job = self._job(line.chain, item.place, carried=False)
                item.job = job._replace(replaces=item.job.replaces)
                item.labelled = None
                self._submit(line, item)
            elif item.current and (not known or _continues(item, line.open)):
                assert item.about is not None
                self.result.current.append(item.job.layer)
                line.pass_by(item.about.ended)
            elif item.current:
                item.current = False
                self._submit(line, item)
            else:
                return  # it is the next to be handed out

    def _throw_away(self, part: Path) -> None:
        self._waiting.discard(part)
        with suppress(OSError):
            part.unlink()

    def _note(self, item: _Item) -> None:
        assert item.labelled is not None
        self._waiting.discard(item.labelled.part)
        self.result.layers.append(item.job.layer)
        self.result.frames += item.labelled.frames
        if item.labelled.lost:
            self.result.lost[item.job.log] = item.labelled.lost


def _is_current(job: Job, about: About, sha256: str) -> bool:
    """Tell whether a layer is what would be made again, but for what is open before it.

    Raises
    ------
    LogError
        If it is of another model, or of another log.
    """
    source = about.source
    if source.model_sha256 != job.model_sha256:
        raise LogError(
            f"{job.layer}: was made by another model of this name ({source.model_sha256[:12]}, not "
            f"{job.model_sha256[:12]}); move it away, or give the model another name"
        )
    if source.input_sha256 != sha256:
        raise LogError(
            f"{job.layer}: was made from another log of this name; move it away, and run again"
        )
    # Where a log beside it has been deleted since, the layer knows more than one made now would.
    before = not job.before or stem(job.before[0]) == source.before
    behind = job.behind is None or stem(job.behind) == source.behind
    return before and behind and not about.lost


def _continues(item: _Item, before: Run | None) -> bool:
    return item.about is not None and item.about.began == before
