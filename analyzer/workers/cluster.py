"""Workers of a Dask cluster that runs already."""

import gc
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from hearthlog.analyzer.errors import WorkerError
from hearthlog.analyzer.extras import remedy
from hearthlog.analyzer.workers.pickled_calls import pack_call, read_reply

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_SECONDS = 10.0

P = ParamSpec("P")
T = TypeVar("T")


@contextmanager
def connected(scheduler: str) -> Iterator["Client"]:
    """Connect to a Dask cluster whose workers have this version of hearthlog.

    Parameters
    ----------
    scheduler : str
        Address of the scheduler, as `tcp://host:port`.

    Yields
    ------
    distributed.Client
        Open until the block ends.

    Raises
    ------
    WorkerError
        If Dask is not installed, there is no such scheduler, it has no workers, or a worker has
        another version of hearthlog.
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
            gc.collect()  # else the remains may block the next client, if they are collected then
            raise WorkerError(f"no Dask scheduler at {scheduler}; start one with: dask scheduler")
        try:
            _check_versions(client, scheduler)
            yield client
        finally:
            client.close(timeout=_CONNECT_SECONDS)


@contextmanager
def _silence() -> Iterator[None]:
    """Keep Dask from logging, since errors are reported once, by us."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def gone(scheduler: str) -> WorkerError:
    """Make the error that says that the scheduler was lost.

    Parameters
    ----------
    scheduler : str
        Address of the scheduler, as `tcp://host:port`.
    """
    return WorkerError(f"the Dask scheduler at {scheduler} is gone; start it, and run this again")


class Cluster:
    """Workers of a Dask cluster.

    Parameters
    ----------
    client : distributed.Client
        From `connected`.
    scheduler : str
        Address of the scheduler, for messages.
    """

    def __init__(self, client: "Client", scheduler: str) -> None:
        self._client, self._scheduler = client, scheduler
        self._executor = client.get_executor(pure=False)
        self._guard = _guard(version("hearthlog"))

    @property
    def parallel(self) -> int:
        """Number of threads of all workers at the moment; at least 1."""
        if self._client.status != "running":
            return 1
        return max(sum(self._client.nthreads().values()), 1)

    def submit(self, function: Callable[P, T], *args: P.args, **_: P.kwargs) -> Future[T]:
        """Run a function on any worker of the cluster.

        Parameters
        ----------
        function : callable
            At the top level of a module, which the worker imports.
        *args
            Arguments of the function, which can be pickled.

        Returns
        -------
        concurrent.futures.Future
            It raises what the function raises, and WorkerError if the scheduler is gone, if the
            task killed its workers, or if the worker has another version of hearthlog.
        """
        future: Future[T] = Future()
        if self._client.status != "running":
            future.set_exception(gone(self._scheduler))
            return future
        sent = self._executor.submit(self._guard, pack_call(function, args))
        sent.add_done_callback(lambda done: self._deliver(done, future))
        return future

    def _deliver(self, done: Future[Any], future: Future[Any]) -> None:
        if not future.set_running_or_notify_cancel():
            return
        try:
            future.set_result(self._read(done))
        except Exception as error:  # noqa: BLE001  raised where the result is asked for
            future.set_exception(error)

    def _read(self, done: Future[Any]) -> Any:
        try:
            refusal, reply = done.result()
        except CancelledError as error:
            raise gone(self._scheduler) from error
        except Exception as error:
            raise_if_killed(error)
            raise
        if refusal:
            raise WorkerError(refusal)
        return read_reply(reply)


def raise_if_killed(error: Exception) -> None:
    """Raise WorkerError if an error of Dask says that a task killed its workers.

    Parameters
    ----------
    error : Exception
        Any error of a task or a future; all but `distributed.KilledWorker` are left alone.

    Raises
    ------
    WorkerError
        If the task has lost its worker more often than Dask allows.
    """
    from distributed import KilledWorker  # noqa: PLC0415  part of the extra `cluster`

    if isinstance(error, KilledWorker):
        times = error.allowed_failures + 1
        raise WorkerError(
            f"the task lost its worker {times} times: killed, or out of memory"
        ) from error


def _check_versions(client: "Client", scheduler: str) -> None:
    """Refuse a cluster with no workers, or with workers of another version."""
    try:
        client.wait_for_workers(1, timeout=_CONNECT_SECONDS)
    except TimeoutError as error:
        raise WorkerError(
            f"the Dask scheduler at {scheduler} has no workers; start some with: "
            f"dask worker {scheduler}"
        ) from error
    ours = version("hearthlog")
    # A function of the standard library, so that a worker without hearthlog can answer.
    versions = client.run(version, "hearthlog", on_error="return")
    for worker, theirs in versions.items():
        if theirs != ours:
            raise WorkerError(_refusal(worker, theirs, ours))


def _refusal(worker: str, theirs: Any, ours: str) -> str:
    has = f"hearthlog {theirs}" if isinstance(theirs, str) else "no hearthlog"
    return f"the Dask worker at {worker} has {has}, this is {ours}; install {ours} there"


def _guard(ours: str) -> Callable[[bytes], tuple[str, bytes]]:
    """Make the function that workers run: it refuses calls on a worker of another version.

    It is a nested function, which Dask sends as code, since a worker that joins later may have no
    hearthlog to import it from.
    """

    def guarded(call: bytes) -> tuple[str, bytes]:
        from importlib import metadata  # noqa: PLC0415  runs elsewhere

        from distributed import get_worker  # noqa: PLC0415  runs elsewhere

        try:
            theirs = metadata.version("hearthlog")
        except metadata.PackageNotFoundError:
            theirs = ""
        if theirs != ours:
            has = f"hearthlog {theirs}" if theirs else "no hearthlog"
            worker = get_worker().address
            return f"the Dask worker at {worker} has {has}, this is {ours}: not used", b""
        from hearthlog.analyzer.workers.pickled_calls import attempt  # noqa: PLC0415  not before it is known to be there

        return "", attempt(call)

    return guarded
