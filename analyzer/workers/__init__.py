"""Workers that run tasks: this process, local processes, or a Dask cluster."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from contextvars import ContextVar
from importlib import import_module
from multiprocessing.connection import Connection, Pipe
from queue import SimpleQueue
from threading import Lock
from typing import Any, ParamSpec, Protocol, TypeVar

from hearthlog.analyzer.errors import WorkerError
from hearthlog.analyzer.workers.cluster import Cluster, connected
from hearthlog.recorder.host import keep_freed_blocks, module_command
from hearthlog.schemas.blas import kernel_environment
from hearthlog.schemas.errors import HearthlogError, HearthlogWarning

MAX_ATTEMPTS = 3  # of a task whose worker is killed
_TIDY_SECONDS = 3.0  # for a task to remove unfinished files
_SERVE = module_command("hearthlog.analyzer.workers")
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

P = ParamSpec("P")
T = TypeVar("T")


# Neither concurrent.futures.ProcessPoolExecutor nor loky suffices: one killed worker fails all
# tasks, as does an exception that cannot be unpickled; a shutdown leaves tasks no time to remove
# their files; and workers outlive a killed parent.
class Processes:
    """Local processes, each with a thread in this process that sends it one task after the other.

    The count is at least 1. The processes import the module of the tasks at once; without it each
    process starts with its first task.
    """

    def __init__(self, count: int, module: str | None = None) -> None:
        self.parallel = count
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="worker")
        self._processes = [_Process() for _ in range(count)]
        self._idle = list(self._processes)  # the last one used is the next: it has started
        if module is not None:
            for _ in range(count):
                self.submit(import_module, module)

    def submit(self, function: Callable[P, T], *args: P.args, **_: P.kwargs) -> Future[T]:
        """Run a function once a process is free."""
        return self._threads.submit(self._run, function, args)

    def close(self) -> None:
        """Give up unfinished tasks, and end the processes.

        A task that has not begun is cancelled: its future raises CancelledError.
        """
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in self._processes:
            process.hang_up()
        self._threads.shutdown()
        for process in self._processes:
            process.end()

    def _run(self, function: Callable[..., T], args: tuple[Any, ...]) -> T:
        call = pickle.dumps((function, args))
        process = self._idle.pop()
        try:
            for _ in range(MAX_ATTEMPTS):
                try:
                    return process.run(call)
                except _LostError:
                    process.end()
        finally:
            self._idle.append(process)
        raise WorkerError(
            f"the task lost its worker {MAX_ATTEMPTS} times: killed, or out of memory"
        )


class _LostError(Exception):
    """The process ended before it replied."""


class _Process:
    """A process that answers calls; it starts with the first call, and again after its end."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._closed = False
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, call: bytes) -> Any:
        """Return the result of a call, or raise its exception; `_LostError` if the process ends.

        An exception has its traceback as a note, unless it is an error of hearthlog. One that
        cannot be pickled is a WorkerError.
        """
        with self._lock:
            if self._closed:
                raise WorkerError("given up")
            if self._process is None:
                self._start()
        try:
            self._calls.send_bytes(call)
            reply = self._replies.recv_bytes()
        except (EOFError, OSError) as lost:
            raise _LostError from lost
        value, error = pickle.loads(reply)  # noqa: S301  sent by our own worker
        if error is not None:
            raise error
        return value

    def _start(self) -> None:
        calls, self._calls = Pipe(duplex=False)
        self._replies, replies = Pipe(duplex=False)
        with calls, replies:
            self._process = subprocess.Popen(  # noqa: S603  our own module
                _SERVE,
                stdin=calls.fileno(),
                stdout=replies.fileno(),
                env=dict.fromkeys(_THREADS, "1")
                | kernel_environment()
                | os.environ
                | {"PYTHONPATH": os.pathsep.join(sys.path)},
                process_group=0,  # Ctrl-C reaches the parent only, which then hangs up
            )

    def hang_up(self) -> None:
        """Close the pipe of calls, so that the process ends; refuse further calls."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._calls.close()

    def end(self) -> None:
        """End the process, even if it hangs."""
        if self._process is None:
            return
        self._calls.close()
        try:
            self._process.wait(2 * _TIDY_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._replies.close()
        self._process = None


def serve() -> None:
    """Answer calls from standard input on standard output, until the parent hangs up or dies."""
    calls = Connection(os.dup(0), writable=False)
    replies = Connection(os.dup(1), readable=False)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)  # what a task prints must not get into the replies
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that a task can clean up
    warnings.simplefilter("ignore", HearthlogWarning)  # the parent warns once
    keep_freed_blocks()
    waiting: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(calls, waiting), daemon=True).start()
    while True:
        replies.send_bytes(_reply(waiting.get()))


def _listen(calls: Connection, waiting: "SimpleQueue[bytes]") -> None:
    """Receive calls, and end the process when the parent hangs up or dies, even during a task."""
    try:
        while True:
            waiting.put(calls.recv_bytes())
    except (EOFError, OSError):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_TIDY_SECONDS)
        os._exit(1)


def _reply(call: bytes) -> bytes:
    """Run a call, and pickle its result or its exception."""
    try:
        function, args = pickle.loads(call)  # noqa: S301  sent by our own parent
        return pickle.dumps((function(*args), None))
    except Exception as error:  # noqa: BLE001  raised again by the parent
        if not isinstance(error, HearthlogError):
            error.add_note("in a worker:\n" + "".join(traceback.format_exception(error)))
        reply = pickle.dumps((None, WorkerError(f"{type(error).__name__}: {error}")))
        with suppress(Exception):  # an error of any library, with anything in it
            portable = pickle.dumps((None, error))
            pickle.loads(portable)  # noqa: S301  made here
            reply = portable
        return reply


class Workers(Protocol):
    """Interface of workers, which run tasks.

    A task is a top-level function of a module, with small arguments that can be pickled: paths, not
    arrays. It may run more than once, if its worker is lost.
    """

    @property
    def parallel(self) -> int:
        """Current number of parallel tasks; at least 1."""

    def submit(self, function: Callable[P, T], *args: P.args, **_: P.kwargs) -> Future[T]:
        """Run a task.

        Parameters
        ----------
        function : callable
            Top-level function of a module.
        *args
            Arguments of the function, which are small and can be pickled.

        Returns
        -------
        concurrent.futures.Future
            Raises the function's exception, WorkerError if the worker was lost three times, and
            LostClusterError if the cluster is gone.
        """


@contextmanager
def open_workers(
    count: int = 1, scheduler: str | None = None, module: str | None = None
) -> Iterator[Workers]:
    """Open workers; unfinished tasks are given up when the block ends.

    The number of processes is at least 1; with 1 each task runs in this process, when it is
    submitted. Processes import the module of the tasks at once, not with the first task. Raise
    `WorkerError` if Dask is not installed, the scheduler does not exist, it has no workers, or a
    worker has another version.
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
        except Exception as error:  # noqa: BLE001  raised where the result is requested
            future.set_exception(error)
        return future


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
    """Run the calls of `in_parallel` in this block on a Dask cluster, if one is given.

    Its address is as `tcp://host:port`. Raise `WorkerError` as `connected` does, and if the cluster
    goes away or a fit kills its workers.
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
    """Limits linear algebra libraries to one thread while any thread is inside.

    The limit of a BLAS is per process, so the first thread that leaves must not lift it.
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
            with threadpool_limits(1, user_api="openmp"):  # for this thread alone
                yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    _forget_controlling_thread()
                    self._limits.restore_original_limits()
                    _forget_controlling_thread()


def _forget_controlling_thread() -> None:
    """Allow this thread to set limits: threadpoolctl >= 3.8 accepts only the last setter's."""
    import threadpoolctl  # noqa: PLC0415  as joblib

    openblas = getattr(threadpoolctl, "OpenBLASController", None)
    if openblas is not None and hasattr(openblas, "clear_controlling_thread"):
        openblas.clear_controlling_thread(force=True)


single_thread = _SingleThread()  # a sum depends on how many threads share it


def kernel_in_use() -> str:
    """Return the BLAS library and kernel of this process, such as "openblas SkylakeX".

    Empty for a library other than OpenBLAS, or without threadpoolctl.
    """
    try:
        from threadpoolctl import threadpool_info  # noqa: PLC0415  part of the extra `headless`
    except ModuleNotFoundError:
        return ""
    kernels = (each.get("architecture") for each in threadpool_info())
    return next((f"openblas {kernel}" for kernel in kernels if kernel), "")
