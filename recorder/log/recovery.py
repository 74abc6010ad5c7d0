"""Recovery of interrupted logs, and the final rewrite of closed ones in a child process.

A live log has chunks of half a second, so that little is lost when the recorder is killed. It is
read three times as fast with chunks of ten, in which it is written anew.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from hearthlog.recorder.host import module_command
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, is_layer, is_log, log_name, log_path, stem
from hearthlog.schemas.mcap.chunks import read_chunks
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.messages.topics import topic
from hearthlog.schemas.new_files import sync_file, sync_folder
from hearthlog.schemas.salvage.recover import (
    NothingWholeError,
    Recovery,
    check_copy,
    lock_abandoned,
    recover_log,
)

_CHUNK_SPAN = 10 * NANOSECONDS  # of a finished log: it is read as a whole, not as it grows


@dataclass(frozen=True)
class Recovered:
    """A log that was completed.

    Attributes
    ----------
    damage : str
        What is damaged in the file, and what was lost; empty if the file only ended early.
    completed : bool
        False for a log that cannot be completed now, or that was empty.
    """

    path: Path
    damage: str
    completed: bool = True


def recover_active(root: Path, node: str) -> list[Recovered]:
    """Complete all logs of a node that no recorder writes any more.

    What is whole is copied to the final name, read again and counted; only then the original is
    removed. A log that is damaged, or holds no message, is kept beside it as `*.damaged`. Layers
    of sound are not kept, for they are to be forgotten some day. A log that cannot be completed is
    left for the next start; an empty file, as a power cut leaves it, is deleted.

    Returns
    -------
    list of Recovered
        By name; a log that begins but has no message is not there.
    """
    completed = []
    for active in active_logs(root, node):
        try:
            completed += complete_log(active)
        except (LogError, OSError) as error:
            what = error if isinstance(error, LogError) else error.strerror or error
            text = f"{active}: cannot be completed ({what}); it is left as it is"
            completed.append(Recovered(active, text, completed=False))
    return completed


def active_logs(root: Path, node: str) -> list[Path]:
    """Return the logs of a node, and their clips, that have no final name yet, by name."""
    return sorted(filter(is_log, root.rglob(f"{node}_*{ACTIVE_SUFFIX}")))


def complete_log(active: Path) -> list[Recovered]:
    """Complete one log as `recover_active` does.

    Parameters
    ----------
    active : Path
        If it is gone, or somebody else is at it, nothing is done.

    Returns
    -------
    list of Recovered
        None or one.

    Raises
    ------
    LogError, OSError
        If it cannot be read or completed.
    """
    if not active.exists():
        return []
    with lock_abandoned(active) as is_abandoned:
        if not is_abandoned:
            return []
        if not active.stat().st_size:
            active.unlink()
            return [Recovered(active, f"{active}: was empty, and is deleted", completed=False)]
        recover = _recover_clips if is_layer(active) else _recover
        return recover(active, active.with_name(stem(active) + SUFFIX))


def end_of_sound(root: Path, node: str, microphone: str, before: int) -> int:
    """Find until when a node has recorded a microphone, in all its logs.

    Parameters
    ----------
    before : int
        Logs that begin later are not looked at: the clock was wrong when they were made. In
        nanoseconds of UTC.

    Returns
    -------
    int
        End of the last frame, or of the gap behind it, in nanoseconds of UTC; 0 if there is none.
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


def _recover_clips(active: Path, path: Path) -> list[Recovered]:
    try:
        recovery = _complete(active, path)
        active.unlink(missing_ok=True)
        sync_folder(path.parent)
    except NothingWholeError:
        active.unlink()
        return []
    damages = [damage for damage in recovery.damages if not damage.cut]
    damage = f"{active}: {damages[0]}; this sound is deleted" if damages else ""
    return [Recovered(path, damage)] if recovery.messages else []


def _recover(active: Path, path: Path) -> list[Recovered]:
    try:
        recovery = _complete(active, path)
    except NothingWholeError:
        recovery = Recovery({}, [], complete=False)
    damages = [damage for damage in recovery.damages if not damage.cut]
    if damages or not recovery.messages:
        active.rename(active.with_name(path.name + ".damaged"))
    else:
        active.unlink(missing_ok=True)
    sync_folder(path.parent)
    if not recovery.messages:
        return []
    more = f", and in {len(damages) - 1} more places" if len(damages) > 1 else ""
    kept = "; the original is kept as *.damaged"
    damage = f"{active}: {damages[0]}{more}{kept}" if damages else ""
    return [Recovered(path, damage)]


def _complete(active: Path, path: Path) -> Recovery:
    """Copy what is whole in a log to its final name, unless an earlier start has done so."""
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
            with lock_abandoned(copy):  # the log has one name at any time, and one owner
                copy.replace(active)
                active.rename(path)
        else:
            copy.rename(path)
    finally:
        copy.unlink(missing_ok=True)
    return recovery


_COMMAND = module_command("hearthlog.recorder.log.recovery")
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
