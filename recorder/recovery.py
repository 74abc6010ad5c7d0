"""Complete, at its start, the logs that a recorder that was killed left behind."""

from dataclasses import dataclass
from pathlib import Path

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, is_layer, is_log, stem
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.salvage.recover import (
    NothingWholeError,
    check_copy,
    lock_abandoned,
    recover_log,
)
from hearthlog.schemas.salvage.salvaged_copy import Recovery
from hearthlog.schemas.storage.new_files import sync_file, sync_folder
from hearthlog.schemas.times import NANOSECONDS

_CHUNK_SPAN = 10 * NANOSECONDS  # of a finished log: it is read as a whole, not as it grows


@dataclass(frozen=True)
class Recovered:
    """A log that was completed.

    Attributes
    ----------
    end : int
        End of the last frame or gap, in nanoseconds of UTC; 0 if the log has none.
    damage : str
        What is damaged in the file, and what was lost; empty if the file only ended early.
    completed : bool
        False for clips that cannot be completed now.
    """

    path: Path
    end: int
    damage: str
    completed: bool = True


def recover_active(root: Path, node: str) -> list[Recovered]:
    """Complete all logs of a node that no recorder writes any more.

    What is whole is copied to the final name, read again and counted; only then the original is
    removed. A log that is damaged, or holds no message, is kept beside it as `*.damaged`. Layers
    of sound are not kept, for they are to be forgotten some day, and none of them keeps the
    recorder from starting.

    Parameters
    ----------
    root : Path
        Folder of the logs.
    node : str
        Name of the node.

    Returns
    -------
    list of Recovered
        By name; a log without a message is not there.

    Raises
    ------
    LogError
        If a log cannot be read or completed.
    """
    completed = []
    for active in sorted(filter(is_log, root.rglob(f"{node}_*{ACTIVE_SUFFIX}"))):
        with lock_abandoned(active) as is_abandoned:
            if is_abandoned:
                recover = _recover_clips if is_layer(active) else _recover
                completed += recover(active, active.with_name(stem(active) + SUFFIX))
    return completed


def complete_log(active: Path) -> None:
    """Complete one log as `recover_active` does.

    Parameters
    ----------
    active : Path
        If it is gone, or somebody else is at it, nothing is done.

    Raises
    ------
    LogError
        If it cannot be read or completed.
    """
    if not active.exists():
        return
    with lock_abandoned(active) as is_abandoned:
        if is_abandoned:
            _recover(active, active.with_name(stem(active) + SUFFIX))


def _recover_clips(active: Path, path: Path) -> list[Recovered]:
    try:
        recovery = _complete(active, path)
        active.unlink(missing_ok=True)
        sync_folder(path.parent)
    except NothingWholeError:
        active.unlink()
        return []
    except (LogError, OSError) as error:
        what = error if isinstance(error, LogError) else error.strerror or error
        text = f"{active}: cannot be completed ({what}); it is left as it is"
        return [Recovered(path, 0, text, completed=False)]
    damages = [damage for damage in recovery.damages if not damage.cut]
    damage = f"{active}: {damages[0]}; this sound is deleted" if damages else ""
    return [Recovered(path, 0, damage)] if recovery.messages else []


def _recover(active: Path, path: Path) -> list[Recovered]:
    try:
        recovery = _complete(active, path)
    except NothingWholeError:
        recovery = Recovery({}, [], complete=False)
    except OSError as error:
        what = error.strerror or str(error)
        raise LogError(f"{active}: cannot be completed ({what}); it is left as it is") from error
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
    return [Recovered(path, _end_of_frames(recovery), damage)]


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


def _end_of_frames(recovery: Recovery) -> int:
    ends = {message_types.FEATURES: FRAME_NANOSECONDS, message_types.GAP: 0}
    return max(
        (
            topic.end + ends[topic.type]
            for topic in recovery.topics.values()
            if topic.type in ends and topic.end
        ),
        default=0,
    )
