"""One way to run tasks: in this process, in several processes, or on a Dask cluster."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager
from typing import ParamSpec, Protocol, TypeVar

from hearthlog.analyzer.workers.cluster import connected
from hearthlog.analyzer.workers.processes import Processes
from hearthlog.recorder.host import keep_freed_blocks

P = ParamSpec("P")
T = TypeVar("T")


class Workers(Protocol):
    """Workers, which run tasks.

    A task is a function of the top level of a module, with arguments that are small and can be
    pickled: paths, not arrays. It may run more than once, if its worker is lost.
    """

    @property
    def parallel(self) -> int:
        """Number of tasks that run at once at the moment; at least 1."""

    def submit(self, function: Callable[P, T], *args: P.args, **_: P.kwargs) -> Future[T]:
        """Run a task.

        Parameters
        ----------
        function : callable
            At the top level of a module.
        *args
            Arguments of the function, which are small and can be pickled.

        Returns
        -------
        concurrent.futures.Future
            It raises what the function raises, WorkerError if the worker was lost three times, and
            LostClusterError if the cluster is gone.
        """


@contextmanager
def open_workers(
    count: int = 1, scheduler: str | None = None, module: str | None = None
) -> Iterator[Workers]:
    """Open workers; tasks that are not done when the block ends are given up.

    Parameters
    ----------
    count : int
        Number of processes, at least 1; with 1 each task runs in this process, when it is
        submitted.
    module : str, optional
        Name of the module of the tasks: processes start and import it at once, not with the first
        task.

    Raises
    ------
    WorkerError
        If Dask is not installed, there is no such scheduler, it has no workers, or one of another
        version.
    """
    if scheduler is not None:
        with connected(scheduler) as cluster:
            yield cluster
    elif count == 1:
        keep_freed_blocks()
        yield InlineWorkers()
    else:
        with closing(Processes(count, module)) as processes:
            yield processes


class InlineWorkers:
    """Runs each task in this process, when it is submitted."""

    parallel = 1

    def submit(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run a function at once."""
        future: Future[T] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:  # noqa: BLE001  raised where the result is asked for
            future.set_exception(error)
        return future
