"""Many fits at once, in threads or on a Dask cluster, with the same code."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import joblib

from hearthlog.analyzer.workers.cluster import connected, gone, raise_if_killed
from hearthlog.schemas.errors import HearthlogError

_MOST_THREADS = 4


def in_parallel(calls: Iterable[Any]) -> Iterator[Any]:
    """Yield the results of calls, in their order.

    Parameters
    ----------
    calls : iterable of joblib.delayed
        They run in up to four threads, since libsvm releases the lock, or where
        `joblib.parallel_config` says.

    Yields
    ------
    object
        What each call returned; the first error of a call is raised.
    """
    threads = min(os.cpu_count() or 1, _MOST_THREADS)
    return joblib.Parallel(threads, prefer="threads", return_as="generator")(calls)


@contextmanager
def joblib_on(scheduler: str | None) -> Iterator[None]:
    """Let joblib run calls in this block on a Dask cluster, if one is named.

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
    with connected(scheduler) as client, joblib.parallel_config(_backend(client)):
        try:
            yield
        except HearthlogError:
            raise
        except Exception as error:
            if client.status != "running":
                raise gone(scheduler) from error
            raise_if_killed(error)
            raise


def _backend(client: Any) -> Any:
    """Make joblib's Dask backend end where a task has killed its workers, instead of waiting."""
    from joblib._dask import DaskDistributedBackend  # noqa: PLC0415  part of the extra `cluster`

    class Backend(DaskDistributedBackend):  # type: ignore[misc]  # joblib has no types
        def submit(self, func: Any, callback: Any = None) -> Any:
            """Run a batch; report errors to the callback too, which joblib waits for."""

            def tell(done: Any) -> None:
                if (error := done.exception()) is not None:
                    callback(error)

            future = super().submit(func, callback)
            future.add_done_callback(tell)
            return future

    return Backend(client=client)
