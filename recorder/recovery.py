"""Complete, at its start, the logs that a recorder that was killed left behind."""

from dataclasses import dataclass
from pathlib import Path

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, is_layer, is_log
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


@dataclass(frozen=True)
class Recovered:
    """A log that was completed.

    Attributes
    ----------
    path : Path
    end : int
        End of its last frame, in nanoseconds of UTC; 0 if it has none.
    damage : str
        What is wrong with the file, and was lost; empty if it only ended early.
    completed : bool
        False for clips of which nothing is left, or that cannot be completed now.
    """

    path: Path
    end: int
    damage: str
    completed: bool = True


def recover_active(root: Path, node: str) -> list[Recovered]:
    """Complete all logs of a node that nobody writes any more.

    What is whole is copied to the final name, read again and counted; only then is the original
    removed. One that is damaged, or holds no message, is kept beside it as `*.damaged`; but no
    layer of sound, which is to be forgotten some day, and which keeps nobody from recording.
    """
    found = []
    for active in sorted(filter(is_log, root.rglob(f"{node}_*{ACTIVE_SUFFIX}"))):
        with lock_abandoned(active) as is_abandoned:
            if is_abandoned:
                found += _recover_clips(active) if is_layer(active) else _recover(active)
    return found


def _recover_clips(active: Path) -> list[Recovered]:
    path = active.with_name(active.name.removesuffix(ACTIVE_SUFFIX) + SUFFIX)
    copy = active.with_name(path.name + ".recovering")
    try:
        recovery = recover_log(active, copy, path.name)
        if recovery.messages:
            _put_in_place(copy, path, recovery)
        active.unlink()
        sync_folder(path.parent)
    except NothingWholeError:
        active.unlink()
        return []
    except (LogError, OSError) as error:
        what = error if isinstance(error, LogError) else error.strerror or error
        text = f"{active}: cannot be completed ({what}); it is left as it is"
        return [Recovered(path, 0, text, completed=False)]
    finally:
        copy.unlink(missing_ok=True)
    damages = [damage for damage in recovery.damages if not damage.cut]
    damage = f"{active}: {damages[0]}; this sound is deleted" if damages else ""
    return [Recovered(path, 0, damage)] if recovery.messages else []


def _recover(active: Path) -> list[Recovered]:
    path = active.with_name(active.name.removesuffix(ACTIVE_SUFFIX) + SUFFIX)
    copy = active.with_name(path.name + ".recovering")
    try:
        try:
            recovery = recover_log(active, copy, path.name)
        except NothingWholeError:
            recovery = Recovery({}, [], complete=False)
        if recovery.messages:
            _put_in_place(copy, path, recovery)
    except OSError as error:
        what = error.strerror or str(error)
        raise LogError(f"{active}: cannot be completed ({what}); it is left as it is") from error
    finally:
        copy.unlink(missing_ok=True)
    damages = [damage for damage in recovery.damages if not damage.cut]
    if damages or not recovery.messages:
        active.rename(active.with_name(path.name + ".damaged"))
    else:
        active.unlink()
    sync_folder(path.parent)
    if not recovery.messages:
        return []
    ends = [
        t.end + FRAME_NANOSECONDS
        for t in recovery.topics.values()
        if t.type == message_types.FEATURES and t.messages
    ]
    more = f", and in {len(damages) - 1} more places" if len(damages) > 1 else ""
    kept = "; the original is kept as *.damaged"
    damage = f"{active}: {damages[0]}{more}{kept}" if damages else ""
    return [Recovered(path, max(ends, default=0), damage)]


def _put_in_place(copy: Path, path: Path, recovery: Recovery) -> None:
    if path.exists():
        check_copy(path, recovery.topics)  # an earlier start got as far as this, and no further
        return
    sync_file(copy)
    copy.rename(path)
