"""Workers that are processes of this machine.

concurrent.futures.ProcessPoolExecutor does not suffice: one killed worker fails all running tasks,
so does an exception that cannot be unpickled, and workers outlive a parent that was killed.
"""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, ParamSpec, TypeVar

from hearthlog.analyzer.errors import WorkerError
from hearthlog.analyzer.workers.pickled_calls import attempt, pack_call, read_reply
from hearthlog.recorder.host import keep_freed_blocks, module_command
from hearthlog.schemas.blas import kernel_environment
from hearthlog.schemas.errors import HearthlogWarning

MAX_ATTEMPTS = 3  # of a task whose worker is killed
_TIDY_SECONDS = 3.0  # for a task to remove unfinished files
_SERVE = module_command("hearthlog.analyzer.workers")
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

P = ParamSpec("P")
T = TypeVar("T")


class Processes:
    """Processes, each with a thread here that gives it one task after the other.

    Parameters
    ----------
    count : int
        Number of processes, at least 1.
    module : str, optional
        Name of the module of the tasks. The processes are started at once and import it while there
        is no task yet; without it each is started by its first task.
    """

    def __init__(self, count: int, module: str | None = None) -> None:
        self.parallel = count
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="worker")
        self._mine = threading.local()
        self._lock = threading.Lock()
        self._alive: set[_Process] = set()
        self._closed = False
        if module is not None:
            for _ in range(count):
                self.submit(import_module, module)

    def submit(self, function: Callable[P, T], *args: P.args, **_: P.kwargs) -> Future[T]:
        """Run a function once a process is free."""
        return self._threads.submit(self._run, function, args)

    def close(self) -> None:
        """Give up the tasks that are not done, and end the processes.

        A task that has not begun is cancelled: its future raises CancelledError.
        """
        with self._lock:
            self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in list(self._alive):
            process.hang_up()
        self._threads.shutdown()
        for process in self._alive:
            process.end()

    def _run(self, function: Callable[..., T], args: tuple[Any, ...]) -> T:
        call = pack_call(function, args)
        for _ in range(MAX_ATTEMPTS):
            process = self._process()
            try:
                return read_reply(process.ask(call))
            except _LostError:
                self._drop(process)
        raise WorkerError(
            f"the task lost its worker {MAX_ATTEMPTS} times: killed, or out of memory"
        )

    def _process(self) -> "_Process":
        """Return the process of this thread; start one if there is none."""
        process: _Process | None = getattr(self._mine, "process", None)
        if process is None:
            with self._lock:
                if self._closed:
                    raise WorkerError("given up")
                process = self._mine.process = _Process()
                self._alive.add(process)
        return process

    def _drop(self, process: "_Process") -> None:
        process.end()
        self._mine.process = None
        with self._lock:
            if not self._closed:
                self._alive.discard(process)


class _LostError(Exception):
    """The process ended before it answered."""


class _Process:
    """A process that answers calls, until the other end of its pipe is closed."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(  # noqa: S603  our own module
            _SERVE,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env=dict.fromkeys(_THREADS, "1")
            | kernel_environment()
            | os.environ
            | {"PYTHONPATH": os.pathsep.join(sys.path)},
            process_group=0,  # Ctrl-C reaches the parent only, which then hangs up
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._calls = Connection(os.dup(self._process.stdin.fileno()), readable=False)
        self._replies = Connection(os.dup(self._process.stdout.fileno()), writable=False)
        self._process.stdin.close()
        self._process.stdout.close()

    def ask(self, call: bytes) -> bytes:
        """Return the reply to a call."""
        try:
            self._calls.send_bytes(call)
            return self._replies.recv_bytes()
        except (EOFError, OSError) as error:
            raise _LostError from error

    def hang_up(self) -> None:
        """Let the process end: nobody will call it again."""
        self._calls.close()

    def end(self) -> None:
        """End the process, even if it hangs."""
        self._calls.close()
        try:
            self._process.wait(2 * _TIDY_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._replies.close()


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
        replies.send_bytes(attempt(waiting.get()))


def _listen(calls: Connection, waiting: "SimpleQueue[bytes]") -> None:
    """Receive calls, and end the process when the parent hangs up or dies, even during a task."""
    try:
        while True:
            waiting.put(calls.recv_bytes())
    except (EOFError, OSError):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_TIDY_SECONDS)
        os._exit(1)
