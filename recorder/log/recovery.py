"""Recovery of interrupted logs, and the final rewrite of closed ones in a child process.

A live log has chunks of half a second, so that a killed recorder loses little. The rewrite has
chunks of ten seconds and is read three times as fast.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from hearthlog.recorder.host import module_command
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, is_layer, is_log, log_name, log_path, stem
from hearthlog.schemas.mcap.chunks import read_chunks
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.messages.topics import topic
from hearthlog.schemas.new_files import sync_file, sync_folder

if TYPE_CHECKING:
    from hearthlog.schemas.salvage.recover import RecoveryReport

_CHUNK_SPAN = 10 * NANOSECONDS  # of a finished log, which is read completely, not followed


@dataclass(frozen=True)
class RecoveredLog:
    """A completed log."""

    path: Path
    damage: str  # damage in the file and losses; empty if the file only ended early
    completed: bool = True  # False for a log that cannot be completed now, or was empty


def recover_active(root: Path, node: str) -> list[RecoveredLog]:
    """Complete all logs of a node that no recorder is writing; return those with messages, by name.

    Intact messages are copied to the final name, read again and counted; only then the original is
    removed. A log that is damaged, or has no message, is also kept as `*.damaged`. Audio layers are
    not kept, as they must expire some day. A log that cannot be completed is left for the next
    start; an empty file, as left by a power cut, is deleted.
    """
    completed = []
    for active in active_logs(root, node):
        try:
            completed += complete_log(active)
        except (LogError, OSError) as error:
            what = error if isinstance(error, LogError) else error.strerror or error
            text = f"{active}: cannot be completed ({what}); it is left as it is"
            completed.append(RecoveredLog(active, text, completed=False))
    return completed


def active_logs(root: Path, node: str) -> list[Path]:
    """Return the logs and clips of a node without a final name, by name."""
    return sorted(filter(is_log, root.rglob(f"{node}_*{ACTIVE_SUFFIX}")))


def complete_log(active: Path) -> list[RecoveredLog]:
    """Complete one log as `recover_active` does, unless it is gone, or another process uses it.

    Raise `LogError` or `OSError` if it cannot be read or completed.
    """
    if not active.exists():
        return []
    # Here, as few recorders have a log to complete.
    from hearthlog.schemas.salvage.recover import lock_abandoned  # noqa: PLC0415

    with lock_abandoned(active) as is_abandoned:
        if not is_abandoned:
            return []
        if not active.stat().st_size:
            active.unlink()
            return [RecoveredLog(active, f"{active}: was empty, and is deleted", completed=False)]
        return _recover(active, active.with_name(stem(active) + SUFFIX))


def end_of_sound(root: Path, node: str, microphone: str, before: int) -> int:
    """Return the end of a node's recordings of a microphone, in nanoseconds of UTC; 0 for none.

    It is the end of the last frame, or of the gap after it, over all logs that begin before
    `before`, in nanoseconds of UTC; the clock of later logs was wrong.
    """
    latest = log_path(root, node, before).name
    ours = [path for path in root.rglob(f"{node}_*{SUFFIX}*") if _is_log_of(path, node)]
    for path in sorted(ours, key=lambda path: path.name, reverse=True):
        if path.name > latest:
            continue
        try:
            with LogFile(path) as file:
                end = _end_in(file, microphone)
        except LogError:
            continue
        if end:
            return end
    return 0


def _is_log_of(path: Path, node: str) -> bool:
    return is_log(path) and not is_layer(path) and log_name(path).node == node


def _end_in(file: LogFile, microphone: str) -> int:
    later = {topic(microphone, "features"): FRAME_NANOSECONDS, topic(microphone, "gap"): 0}
    for number in reversed(range(len(file.chunks))):
        read = read_chunks(file, file.chunks[number : number + 1], later)
        if read:
            return max(int(raw.log_times.max()) + later[raw.channel.topic] for raw in read)
    return 0


def _recover(active: Path, path: Path) -> list[RecoveredLog]:
    recovery = _complete(active, path)
    damages = [damage for damage in recovery.damages if not damage.cut]
    if not is_layer(active) and (damages or not recovery.messages):
        active.rename(active.with_name(path.name + ".damaged"))
    else:
        active.unlink(missing_ok=True)
    sync_folder(path.parent)
    if not recovery.messages:
        return []
    if not damages:
        return [RecoveredLog(path, "")]
    if is_layer(active):
        return [RecoveredLog(path, f"{active}: {damages[0]}; this sound is deleted")]
    more = f", and in {len(damages) - 1} more places" if len(damages) > 1 else ""
    damage = f"{active}: {damages[0]}{more}; the original is kept as *.damaged"
    return [RecoveredLog(path, damage)]


def _complete(active: Path, path: Path) -> "RecoveryReport":
    """Copy the intact part of a log to its final name, unless an earlier start has done so."""
    from hearthlog.schemas.salvage.recover import (  # noqa: PLC0415  as above
        NothingIntactError,
        RecoveryReport,
        check_copy,
        lock_abandoned,
        recover_log,
    )

    copy = active.with_name(path.name + ".recovering")
    try:
        recovery = recover_log(active, copy, path.name, chunk_span=_CHUNK_SPAN)
        if not recovery.messages:
            return recovery
        if path.exists():
            check_copy(path, recovery.topics)
            return recovery
        sync_file(copy)
        if all(damage.cut for damage in recovery.damages):
            with lock_abandoned(copy):  # the log has one name and one owner at any time
                copy.replace(active)
                active.rename(path)
        else:
            copy.rename(path)
    except NothingIntactError:
        return RecoveryReport({}, [], complete=False)
    finally:
        copy.unlink(missing_ok=True)
    return recovery


_COMMAND = module_command("hearthlog.recorder.log.recovery")
_NICENESS = 19
_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # it ends within seconds


class LogFinisher:
    """Rewrites completed logs in child processes while the recorder continues.

    The children end with this process; unfinished logs are completed at the next start.
    """

    def __init__(self) -> None:
        # Now, as the disk may be full later, or hold another version.
        import_module("hearthlog.schemas.salvage.recover")
        self._left: list[Path] = []
        self._processes: list[subprocess.Popen[bytes]] = []

    def add(self, active: Sequence[Path]) -> None:
        """Start to rewrite completed or cut logs under their final names; return immediately."""
        self._forget([process for process in self._processes if process.poll() is not None])
        self._left = [path for path in dict.fromkeys([*self._left, *active]) if path.exists()]
        command = [*_COMMAND, *map(str, self._left)]
        with suppress(OSError, RuntimeError):  # no memory: the next process does it
            process = subprocess.Popen(command, stdin=subprocess.PIPE)  # noqa: S603
            self._processes.append(process)
            # Reaps the process as soon as it ends; the next log may come an hour later.
            threading.Thread(target=process.wait, daemon=True).start()

    def close(self) -> None:
        """Give all logs their final names, as far as possible, in the foreground.

        On a busy machine a process of low priority takes minutes.
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
    """Rewrite a completed log under its final name; if that fails, only rename it.

    A log that is gone, or in use by another process, is ignored. Damage is reported on standard
    error.
    """
    try:
        for recovered in complete_log(active):
            if recovered.damage:
                sys.stderr.write(f"hearthlog: {recovered.damage}\n")
    except (LogError, OSError):  # no space for a copy
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
    """Finish the logs named by the arguments; exit if the parent process ends."""
    for number in _IGNORED:
        signal.signal(number, signal.SIG_IGN)
    os.nice(_NICENESS)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for name in sys.argv[1:]:
        finish_log(Path(name))


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # end of file when the parent ends
    os._exit(1)


if __name__ == "__main__":
    main()
