"""Workers of a running Dask cluster, and the check of their versions."""

import asyncio
import gc
import logging
import pickle
import time
import warnings
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar
from uuid import uuid4

import numpy as np

from hearthlog.analyzer.errors import LostClusterError, WorkerError, remedy
from hearthlog.schemas.errors import HearthlogWarning

if TYPE_CHECKING:
    from distributed import Client


_SILENT_SECONDS = 20.0  # timeout after which a scheduler counts as gone
_CONNECT_SECONDS = 10.0
_WORKERS_SECONDS = 30.0  # wait for workers that are started together with the run
_CLOSE_SECONDS = 3.0
_LOOK_SECONDS = 1.0  # interval of cluster queries
_DESERTED_SECONDS = 600.0  # without a worker, before giving up
_RETRIES = 2  # of a task that raises an error, which may be a temporary storage error
_LOSSES = 4  # of a task's worker before the task is given up, as in Dask
_SENT_ONCE = 100_000  # bytes from which an array is sent once to each worker, not with each task
_GONE = "is gone; start it"
_NOISY = ("distributed", "tornado")  # loggers

P = ParamSpec("P")
T = TypeVar("T")


@contextmanager
def connected(scheduler: str) -> Iterator["Cluster"]:
    """Connect to a Dask cluster whose workers have this version of hearthlog.

    Workers of another version that join later get no tasks; they are listed in a HearthlogWarning
    when the block ends.

    Raise `WorkerError` if Dask is not installed, the scheduler does not exist, it has no workers,
    or a worker has another version of hearthlog.
    """
    try:
        from distributed import Client  # noqa: PLC0415  part of the extra `cluster`
    except ModuleNotFoundError as error:
        raise WorkerError(f"Dask is not installed; {remedy('distributed')}") from error
    with _silence():
        client = None
        with suppress(OSError, ValueError):
            client = Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
        if client is None:
            gc.collect()  # otherwise a later collection may block the next client
            raise WorkerError(f"no Dask scheduler at {scheduler}; start one with: dask scheduler")
        cluster = Cluster(client, scheduler)
        # Otherwise Dask prints errors when the process ends, if it has lost a scheduler.
        cluster.loop.set_exception_handler(lambda *_: None)
        try:
            cluster.open()
            yield cluster
        finally:
            cluster.close()
            with suppress(Exception):  # the rest of a lost connection ends with the process
                client.close(timeout=_CLOSE_SECONDS)
    for worker, has in cluster.refused.items():
        what = f"the Dask worker has {has}, this is {cluster.version}: not used"
        warnings.warn(HearthlogWarning(what, worker, each=True), stacklevel=3)


@contextmanager
def _silence() -> Iterator[None]:
    """Disable Dask's logging, since errors are reported once, by hearthlog."""
    inner = (name for name in logging.root.manager.loggerDict if name.split(".")[0] in _NOISY)
    loggers = [logging.getLogger(name) for name in {*_NOISY, *inner}]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class Cluster:
    """Workers of a Dask cluster.

    Everything that waits for the cluster also waits, in the client's event loop, for the end of
    `_watch`, which queries the cluster once a second: so nothing outlives the scheduler, and no
    task costs a query of its own.
    """

    def __init__(self, client: "Client", scheduler: str) -> None:
        self._client, self._scheduler = client, scheduler
        running: Any = client.loop
        self.loop: asyncio.AbstractEventLoop = running.asyncio_loop  # used by the client alone
        self.version = version("hearthlog")
        self.refused: dict[str, str] = {}  # by address, versions of other workers; kept
        self._versions: dict[str, str] = {}  # by address, of current workers
        self._queries: dict[str, asyncio.Task[None]] = {}
        self._threads: dict[str, int] = {}  # by address, of usable workers
        self._manned = asyncio.Event()  # set while there are usable workers
        self._watching: asyncio.Task[LostClusterError]
        self._sent: dict[int, tuple[Any, asyncio.Task[Any]]] = {}  # by array id
        self._open: set[Future[Any]] = set()

    def open(self) -> None:
        """Wait for workers, and compare their versions.

        Raise `WorkerError` as `connected` does.
        """
        self._in_loop(self._begin()).result()

    def close(self) -> None:
        """Give up unfinished tasks; running ones still finish on their workers."""
        for future in tuple(self._open):
            future.cancel()
        if hasattr(self, "_watching"):
            self.loop.call_soon_threadsafe(self._watching.cancel)

    @property
    def parallel(self) -> int:
        """Number of threads of all usable workers at the last query; at least 1."""
        return max(sum(self._threads.values()), 1)

    def submit(self, function: Callable[P, T], *args: P.args, **_: P.kwargs) -> Future[T]:
        """Run a function on any worker of the cluster; its arguments can be pickled.

        A large array shared by several tasks is sent once, and must not change.
        """
        future = self._in_loop(self._until_lost(self._run(function, args)))
        self._open.add(future)
        future.add_done_callback(self._open.discard)
        return future

    def _in_loop(self, work: Coroutine[Any, Any, T]) -> Future[T]:
        return asyncio.run_coroutine_threadsafe(work, self.loop)

    async def _begin(self) -> None:
        self._watching = asyncio.create_task(self._watch())
        try:
            await self._until_lost(self._wait_for_workers())
        except (OSError, TimeoutError) as error:
            raise self._lost(_GONE) from error

    async def _wait_for_workers(self) -> None:
        deadline = time.monotonic() + _WORKERS_SECONDS
        while not self._threads and time.monotonic() < deadline:
            await self._look()
            if self._queries:  # all current workers report their version
                await asyncio.wait(self._queries.values(), timeout=_SILENT_SECONDS)
            await self._look()
            for worker, has in self.refused.items():
                raise WorkerError(
                    f"the Dask worker at {worker} has {has}, this is {self.version}; install "
                    f"{self.version} there"
                )
            await asyncio.sleep(0 if self._threads else _LOOK_SECONDS / 10)
        if not self._threads:
            raise WorkerError(
                f"the Dask scheduler at {self._scheduler} has no workers; start some with: "
                f"dask worker {self._scheduler}"
            )

    async def _look(self) -> None:
        """Query the scheduler for its workers, and new workers for their version.

        Raise `OSError, TimeoutError` if the scheduler does not answer.
        """
        scheduler: Any = self._client.scheduler
        identity = await asyncio.wait_for(scheduler.identity(n_workers=-1), _SILENT_SECONDS)
        workers = identity["workers"]
        for address in self._versions.keys() - workers.keys():
            del self._versions[address]
        for address in workers.keys() - self._versions.keys() - self._queries.keys():
            # Not awaited: a hanging worker must not hide a hanging scheduler.
            self._queries[address] = asyncio.create_task(self._query(address))
        self._threads = {
            address: about["nthreads"]
            for address, about in workers.items()
            if self._versions.get(address) == self.version
        }
        if self._threads:
            self._manned.set()
        else:
            self._manned.clear()

    async def _query(self, address: str) -> None:
        try:
            # A function of the standard library, so that a worker without hearthlog can answer.
            (theirs,) = (
                await self._client.run(version, "hearthlog", workers=[address], on_error="return")
            ).values()
        except (OSError, ValueError):  # it has left
            return
        finally:
            del self._queries[address]
        if isinstance(theirs, PackageNotFoundError):
            self._versions[address], self.refused[address] = "", "no hearthlog"
        elif isinstance(theirs, str):  # else it could not answer this time
            self._versions[address] = theirs
            if theirs != self.version:
                self.refused[address] = f"hearthlog {theirs}"

    async def _watch(self) -> LostClusterError:
        """Query the cluster once a second until it is lost, and return the error."""
        what, manned = _GONE, time.monotonic()
        try:
            while self._client.status == "running":
                await self._look()
                now = time.monotonic()
                manned = now if self._threads else manned
                if now - manned > _DESERTED_SECONDS:
                    minutes = f"{_DESERTED_SECONDS / 60:.0f} minutes"
                    what = f"has had no workers for {minutes}; start some"
                    break
                await asyncio.sleep(_LOOK_SECONDS)
        except TimeoutError:
            what = "does not answer; see what keeps it"
        except Exception:  # noqa: BLE001  whatever a broken connection raises
            what = _GONE
        return self._lost(what)

    def _lost(self, what: str) -> LostClusterError:
        return LostClusterError(
            f"the Dask scheduler at {self._scheduler} {what}, and run this again"
        )

    async def _until_lost(self, work: Coroutine[Any, Any, T]) -> T:
        """Return the result of work; raise LostClusterError once the cluster is lost."""
        working = asyncio.create_task(work)
        try:
            await asyncio.wait({working, self._watching}, return_when=asyncio.FIRST_COMPLETED)
            if self._watching.done() and (not working.done() or working.exception()):
                raise self._watching.result()
            return working.result()
        finally:
            working.cancel()

    async def _run(self, function: Callable[..., T], args: tuple[Any, ...]) -> T:
        """Run a task; repeat it if Dask drops it, or if all its usable workers have left."""
        from distributed import KilledWorker  # noqa: PLC0415  part of the extra `cluster`
        from distributed.comm.core import CommClosedError  # noqa: PLC0415

        with suppress(KilledWorker):
            for _ in range(_LOSSES):
                await self._manned.wait()
                allowed = list(self._threads)
                try:
                    return await self._attempt(function, args, allowed)
                except (CancelledError, CommClosedError):
                    self._sent.clear()
                    await asyncio.sleep(_LOOK_SECONDS)  # for a query, if the scheduler is gone
        raise WorkerError(f"the task lost its worker {_LOSSES} times: killed, or out of memory")

    async def _attempt(
        self, function: Callable[..., T], args: tuple[Any, ...], allowed: list[str]
    ) -> T:
        """Run a task on some workers; raise CancelledError if all of them have left."""
        arrays = [(n, arg) for n, arg in enumerate(args) if isinstance(arg, np.ndarray)]
        places = [n for n, array in arrays if array.nbytes >= _SENT_ONCE]
        sent = [await self._send(args[place], allowed) for place in places]
        others = [None if n in places else arg for n, arg in enumerate(args)]
        name = getattr(function, "__name__", "task").strip("_<>")
        future = self._client.submit(
            _caller(),
            pickle.dumps((function, others, places)),
            *sent,
            key=f"{name}-{uuid4().hex}",  # Dask groups tasks by the key before the number
            workers=allowed,  # excludes workers of another version
            retries=_RETRIES,
            pure=False,
        )
        gathering = asyncio.ensure_future(self._client.gather(future))
        try:
            while not gathering.done():
                await asyncio.wait({gathering}, timeout=_LOOK_SECONDS)
                if not gathering.done() and self._threads.keys().isdisjoint(allowed):
                    raise CancelledError
            return gathering.result()
        finally:
            gathering.cancel()
            future.release()

    async def _send(self, array: Any, allowed: list[str]) -> Any:
        """Send a large array to all workers, once."""
        if id(array) not in self._sent:
            scattered = self._client.scatter(array, workers=allowed, broadcast=True, hash=False)
            self._sent[id(array)] = array, asyncio.ensure_future(scattered)
        try:
            return await asyncio.shield(self._sent[id(array)][1])
        except (OSError, TimeoutError, ValueError) as error:  # a worker left meanwhile
            raise CancelledError from error


def _caller() -> Callable[..., Any]:
    """Make the function that unpickles and runs a call.

    Dask's scheduler unpickles the arguments of a task, too. Bytes and a nested function, which Dask
    sends as code, spare the scheduler the imports that workers need.
    """

    def call(packed: bytes, *sent: Any) -> Any:
        import pickle  # noqa: PLC0415  runs elsewhere

        from hearthlog.recorder.host import keep_freed_blocks  # noqa: PLC0415

        keep_freed_blocks()
        function, args, places = pickle.loads(packed)  # noqa: S301  sent by our own client
        for place, value in zip(places, sent, strict=True):
            args[place] = value
        return function(*args)

    return call
