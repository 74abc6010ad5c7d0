"""Many fits at once, in threads or on a Dask cluster, with the same code."""

import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock
from typing import Any

from hearthlog.analyzer.workers.cluster import Cluster, connected

_MOST_THREADS = 4
_CLUSTER: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


def in_parallel(calls: Iterable[Any]) -> Iterator[Any]:
    """Yield the results of calls, in their order."""
    cluster = _CLUSTER.get()
    if cluster is not None:
        yield from _on(cluster, calls)
        return
    import joblib  # noqa: PLC0415  part of the extra `headless`

    threads = min(os.cpu_count() or 1, _MOST_THREADS)
    yield from joblib.Parallel(threads, prefer="threads", return_as="generator")(calls)


def _on(cluster: Cluster, calls: Iterable[Any]) -> Iterator[Any]:
    waiting: deque[Future[Any]] = deque()
    for function, args, _ in calls:
        waiting.append(cluster.submit(function, *args))
        if len(waiting) >= 2 * cluster.parallel:  # so that no worker waits for the next one
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


@contextmanager
def fits_on(scheduler: str | None) -> Iterator[None]:
    """Let `in_parallel` run calls in this block on a Dask cluster, if one is named.

    Parameters
    ----------
    scheduler : str or None
        Address of the scheduler, as `tcp://host:port`; None changes nothing.

    Raises
    ------
    WorkerError
        As `connected` does, and if the cluster goes away or a fit kills its workers.
    """
    if scheduler is None:
        yield
        return
    with connected(scheduler) as cluster:
        token = _CLUSTER.set(cluster)
        try:
            yield
        finally:
            _CLUSTER.reset(token)


class _SingleThread:
    """Lets libraries of linear algebra use one thread while anybody is inside.

    The limit of a BLAS is of the process: who leaves first must not lift it for the others.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0
        self._limits: Any = None

    @contextmanager
    def __call__(self) -> Iterator[None]:
        from threadpoolctl import threadpool_limits  # noqa: PLC0415  as joblib

        with self._lock:
            if not self._inside:
                _forget_controlling_thread()
                self._limits = threadpool_limits(1, user_api="blas")
            self._inside += 1
        try:
            with threadpool_limits(1, user_api="openmp"):  # of this thread alone
                yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    _forget_controlling_thread()
                    self._limits.restore_original_limits()
                    _forget_controlling_thread()


def _forget_controlling_thread() -> None:
    """Let this thread set limits: since 3.8 threadpoolctl heeds only the one that did last."""
    import threadpoolctl  # noqa: PLC0415  as joblib

    openblas = getattr(threadpoolctl, "OpenBLASController", None)
    if openblas is not None and hasattr(openblas, "clear_controlling_thread"):
        openblas.clear_controlling_thread(force=True)


single_thread = _SingleThread()  # a sum depends on how many threads share it
