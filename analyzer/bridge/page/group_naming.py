"""Names for the sounds that recur: `hearthlog discover` gives them, in a process of its own."""

import os
import subprocess
from contextlib import suppress
from pathlib import Path
from threading import Lock, Thread, Timer
from typing import IO, cast

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.page.said import READ_ONLY, REVIEWER
from hearthlog.analyzer.bridge.page.words import class_words, told
from hearthlog.recorder.host import module_command

_LONGEST_SECONDS = 6 * 3600.0
_NICE = 10
_LONGEST_LINE = 4096  # characters
_PREFIX = "hearthlog: "
_DONE_WITH_LOSSES = 3  # exit status


class GroupNaming:
    """Names groups of sounds, one at a time.

    All logs are read for that: too much for the bridge, which lives on a small box.
    """

    def __init__(self, folder: Path) -> None:
        self.said: dict[str, str] = {}
        self._folder = folder
        self._process: subprocess.Popen[str] | None = None
        self._thread: Thread | None = None
        self._lock = Lock()

    def start(self, key: str, number: int, label: str) -> str:
        """Begin to mark the sounds of a group, and say so.

        Parameters
        ----------
        label : str
            The class that they are; empty to take the marks back.

        Raises
        ------
        BridgeError
            If another group is being named, or nothing can be written there.
        """
        asked = ["--undo", str(number)]
        text = "The name is being taken back …"
        if label:
            asked = ["--name", f"{number}={label}", "--reviewer", REVIEWER]
            text = (
                f"Being marked: {class_words(label)}. The box reads all its logs for that, which "
                "can take many minutes."
            )
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise BridgeError("The box still marks another sound: try again when it is done.")
            if not os.access(self._folder, os.W_OK):
                raise BridgeError(READ_ONLY)
            process = self._process = _started([*asked, "--json", "--", str(self._folder)])
            self.said[key] = text
            self._thread = Thread(target=self._follow, args=(process, key, number), daemon=True)
            self._thread.start()
        return text

    def close(self) -> None:
        """End what goes on; what has been marked stays, and is completed by naming again."""
        with self._lock:
            if self._process is not None:
                self._process.terminate()

    def _follow(self, process: subprocess.Popen[str], key: str, number: int) -> None:
        """Wait for the end, and keep what it says."""
        timer = Timer(_LONGEST_SECONDS, process.kill)
        timer.daemon = True
        timer.start()
        with process:
            result, last = _read(cast(IO[str], process.stderr), f"{_PREFIX}group {number}:")
            self.said[key] = _outcome(process.wait(), result, last)
        timer.cancel()


def _started(asked: list[str]) -> subprocess.Popen[str]:
    """Start `hearthlog discover`, which lets others go first."""
    try:
        process = subprocess.Popen(  # noqa: S603  a list of arguments, without a shell
            [*module_command("hearthlog.tools.cli.main"), "discover", *asked],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
        )
    except OSError as error:
        raise BridgeError(f"It was not saved: {error.strerror}") from error
    with suppress(OSError):  # a sandbox may forbid it
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
    return process


def _read(stream: IO[str], wanted: str) -> tuple[str, str]:
    """Return the line that begins as wanted, and the last one, without what begins each."""
    result = last = ""
    while line := stream.readline(_LONGEST_LINE):
        last = line.removeprefix(_PREFIX)
        if line.startswith(wanted):
            result = line.removeprefix(wanted)
    return told(result), told(last)


def _outcome(status: int, result: str, last: str) -> str:
    if status < 0:
        return f"It was not done: the process was ended by signal {-status}."
    if not result or status not in {0, _DONE_WITH_LOSSES}:
        return f"It was not done: {last or f'exit status {status}'}"
    return result if status == 0 else f"{result}; not all could be read: {last}"
