"""Giving completed logs their names: written anew in longer chunks, by a process of its own.

A log that is recorded live has chunks of half a second, so that little is lost when the recorder
is killed, and is read three times as fast with chunks of ten.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from hearthlog.recorder.log.recovery import complete_log
from hearthlog.recorder.modules import module_command
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import SUFFIX, stem
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.new_files import sync_folder

_COMMAND = module_command("hearthlog.recorder.log.finishing")
_NICENESS = 19
_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # it ends within seconds


class LogFinisher:
    """Has completed logs written anew while the recorder goes on.

    The processes end with this one: what they leave is completed at the next start.
    """

    def __init__(self) -> None:
        self._left: list[Path] = []
        self._processes: list[subprocess.Popen[bytes]] = []

    def add(self, active: Sequence[Path]) -> None:
        """Begin to write logs anew that are completed or cut, but not named; return at once."""
        self._forget([process for process in self._processes if process.poll() is not None])
        self._left = [path for path in dict.fromkeys([*self._left, *active]) if path.exists()]
        command = [*_COMMAND, *map(str, self._left)]
        with suppress(OSError, RuntimeError):  # no memory: the next one does it
            process = subprocess.Popen(command, stdin=subprocess.PIPE)  # noqa: S603
            self._processes.append(process)
            # Collects its status as soon as it ends, which the next log may do an hour later.
            threading.Thread(target=process.wait, daemon=True).start()

    def close(self) -> None:
        """Give all logs their names that can get them.

        Whoever ends the recorder waits: on a busy machine a process of low priority takes minutes.
        """
        for process in self._processes:
            process.kill()
        self._forget(list(self._processes))
        for active in self._left:
            finish_log(active)

    def _forget(self, processes: list[subprocess.Popen[bytes]]) -> None:
        for process in processes:
            process.wait()
            assert process.stdin is not None
            process.stdin.close()
            self._processes.remove(process)


def finish_log(active: Path) -> None:
    """Write a completed log anew and give it its name; if that fails, name it as it is.

    Parameters
    ----------
    active : Path
        Its active name. If it is gone, or somebody else is at it, nothing is done. What is damaged
        in it is said on standard error.
    """
    try:
        for recovered in complete_log(active):
            if recovered.damage:
                sys.stderr.write(f"hearthlog: {recovered.damage}\n")
    except (LogError, OSError):  # there is no room for a copy
        with suppress(LogError, OSError):  # else it is left for the next start
            _name_as_it_is(active)


def _name_as_it_is(active: Path) -> None:
    path = active.with_name(stem(active) + SUFFIX)
    with LogFile(active) as file:
        complete = file.complete
    if complete and not path.exists():
        active.rename(path)
        sync_folder(path.parent)


def main() -> None:
    """Finish the logs that the arguments name, unless the process that asks for it ends."""
    for number in _IGNORED:
        signal.signal(number, signal.SIG_IGN)
    os.nice(_NICENESS)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for name in sys.argv[1:]:
        finish_log(Path(name))


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # its end comes with the end of the other process
    os._exit(1)


if __name__ == "__main__":
    main()
