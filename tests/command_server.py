"""`hearthlog` in forks of one process, so that no test waits for its imports.

A start of the command costs half a second of a core, most of it imports, and tests start it a few
thousand times. `tests/conftest.py` replaces `subprocess.Popen`: a command line that begins with
`HEARTHLOG` becomes a child of the test's process as before, forked from a server that has imported
everything. `FRESH_HEARTHLOG` starts an interpreter of its own, for what measures one, or replaces
itself.
"""

import atexit
import contextlib
import ctypes
import gc
import json
import os
import pkgutil
import runpy
import socket
import subprocess
import sys
import threading
import time
from importlib import import_module
from pathlib import Path

_MAIN = "hearthlog.tools.cli.main"
HEARTHLOG = [sys.executable, "-m", _MAIN]
FRESH_HEARTHLOG = [sys.executable, "-q", "-m", _MAIN]
_AT_START = (
    "PYTHON",
    "LC_",
    "LANG",
    "OPENBLAS",
    "OMP_",
)  # variables that act before the first line
_LEFT_OUT = (  # not of the product, or with threads, which a fork would lose
    *(_MAIN, "hearthlog.tools.lab", "hearthlog.tools.ros"),
    "hearthlog.analyzer.review.viewer",
)
_SET_CHILD_SUBREAPER = 36  # of prctl(2)
_MADV_COLLAPSE = 25  # of madvise(2)
_HUGE = 1 << 21


class CommandPopen(subprocess.Popen):
    """A child process; one of `HEARTHLOG` is forked from the server."""

    def _execute_child(self, args, *others):
        executable, preexec_fn, _, pass_fds, cwd, env = others[:6]
        pipes = others[9:15]
        special = executable or preexec_fn or pass_fds or others[20]  # a session of its own
        words = [args] if isinstance(args, (str, bytes)) else [os.fspath(word) for word in args]
        if words[:3] != HEARTHLOG or special or _differs(env):
            super()._execute_child(args, *others)
            return
        child_ends = [pipes[0], pipes[3], pipes[5]]
        self.pid = _server().start(words[3:], cwd, env, child_ends)
        self._child_created = True
        self._close_pipe_fds(*pipes)


def _differs(env):
    """Return whether an environment differs where only a new interpreter would see it."""
    changed = {} if env is None else dict(env.items() ^ _environment.items())
    return any(str(name).startswith(_AT_START) for name in changed)


_environment = dict(os.environ)
_lock = threading.Lock()
_servers = {}


def _server():
    with _lock:
        if os.getpid() not in _servers:
            _servers[os.getpid()] = _Server()
        return _servers[os.getpid()]


class _Server:
    """The client's end: the server is a child that lives as long as the test's process."""

    def __init__(self):
        self._socket, theirs = socket.socketpair()
        command = [sys.executable, __file__, str(theirs.fileno()), str(os.getpid())]
        null = subprocess.DEVNULL
        self._process = subprocess.Popen(
            command, stdin=null, stdout=null, pass_fds=[theirs.fileno()]
        )
        theirs.close()
        atexit.register(self._socket.close)

    def start(self, words, cwd, env, descriptors):
        """Return the number of a new child of this process."""
        env = dict(os.environ if env is None else env)
        body = json.dumps([words, os.fspath(cwd or Path.cwd()), env]).encode()
        descriptors = [own if end == -1 else end for own, end in enumerate(descriptors)]
        with _lock, _adopting():
            socket.send_fds(self._socket, [len(body).to_bytes(8, "big")], descriptors)
            self._socket.sendall(body)
            number = self._socket.recv(8, socket.MSG_WAITALL)
        assert number, f"the command server has ended with status {self._process.wait()}"
        return int.from_bytes(number, "big")


@contextlib.contextmanager
def _adopting():
    """Make this process the parent of orphans among its grandchildren."""
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        yield
    finally:
        prctl(_SET_CHILD_SUBREAPER, 0, 0, 0, 0)


def _import_all():
    import hearthlog  # noqa: PLC0415
    from hearthlog.schemas.messages.message_types import recorded_types  # noqa: PLC0415

    for found in pkgutil.walk_packages(hearthlog.__path__, "hearthlog.", onerror=lambda _: None):
        if not found.name.startswith(_LEFT_OUT):
            with contextlib.suppress(Exception):
                import_module(found.name)
    recorded_types()
    gc.collect()
    gc.freeze()
    _collapse_pages()


def _collapse_pages():
    """Have the memory in huge pages where the kernel can, as of 6.1: a fork takes half as long.

    It copies the table of pages, and each one that it then writes to.
    """
    madvise = ctypes.CDLL(None, use_errno=True).madvise
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, rights, *others = line.split()
        start, end = (int(each, 16) for each in span.split("-"))
        start, end = -(-start // _HUGE) * _HUGE, end // _HUGE * _HUGE
        if rights == "rw-p" and (len(others) == 3 or others[3] == "[heap]"):
            for place in range(start, end, _HUGE):
                madvise(ctypes.c_void_p(place), ctypes.c_size_t(_HUGE), _MADV_COLLAPSE)


def _serve(requests, parent):
    """Answer requests until their process ends; returns in each child, with its command line."""
    while True:
        size, descriptors, _, _ = socket.recv_fds(requests, 8, 3)
        if len(size) < 8:
            os._exit(0)
        body = requests.recv(int.from_bytes(size, "big"), socket.MSG_WAITALL)
        read, write = os.pipe()
        middle = os.fork()
        if middle == 0:
            child = os.fork()
            if child:
                os.write(write, child.to_bytes(8, "big"))
                os._exit(0)
            requests.close()
            os.close(read)
            os.close(write)
            while os.getppid() != parent:
                time.sleep(0.0005)
            return json.loads(body), descriptors
        os.waitpid(middle, 0)
        requests.sendall(os.read(read, 8))
        for descriptor in (read, write, *descriptors):
            os.close(descriptor)


def _main():
    requests, parent = socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])
    requests.set_inheritable(False)
    _import_all()
    (words, cwd, env), descriptors = _serve(requests, parent)
    for number, descriptor in enumerate(descriptors):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.argv[1:] = words
    sys.stdout.reconfigure(line_buffering=os.isatty(1))
    status = 0
    try:
        runpy.run_module(_MAIN, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        status = end.code
        if isinstance(status, str):
            sys.stderr.write(f"{status}\n")
    except BaseException:  # noqa: BLE001  as an interpreter would
        sys.excepthook(*sys.exc_info())
        status = 1
    # An interpreter's end without the dismantling of modules, which would copy all of their pages.
    threading._shutdown()
    atexit._run_exitfuncs()
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status if isinstance(status, int) else int(status is not None))


if __name__ == "__main__":
    _main()
