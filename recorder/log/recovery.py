"""Complete, at its start, the logs that a recorder that was killed left behind."""

from dataclasses import dataclass
from pathlib import Path

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
