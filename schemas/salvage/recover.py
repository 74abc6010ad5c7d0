"""Make a valid log of what is whole in one that was cut or damaged."""

import fcntl
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import SUFFIX, stem
from hearthlog.schemas.mcap.chunks import in_parts, read_in_batches
from hearthlog.schemas.mcap.definitions import Definition
from hearthlog.schemas.mcap.formats import MAGIC, not_mcap
from hearthlog.schemas.mcap.large_chunks import most_content
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import LIMIT
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.salvage.salvage import Salvage
from hearthlog.schemas.salvage.salvaged_copy import Recovery, SalvagedCopy, TopicRecovery
from hearthlog.schemas.storage.new_files import (
    check_new,
    create_file,
    hand_over,
    readers_of,
    sync_file,
    sync_folder,
)
from hearthlog.schemas.storage.regular_file import open_regular


class NothingWholeError(LogError):
    """Nothing in a log is whole."""


def recover_log(
    source: Path,
    copy: Path,
    name: str,
    progress: Progress = ignore_progress,
    *,
    chunk_span: int = 0,
) -> Recovery:
    """Copy what is whole in a log to a new one, and check the copy.

    Parameters
    ----------
    progress : callable, optional
        Called with the share that is done, 0 to 1; starts again if a second attempt is needed.
    chunk_span : int
        Nanoseconds of log time up to which chunks are joined; 0 to copy them unchanged.

    Raises
    ------
    NothingWholeError
        If the source is not an MCAP file, or nothing in it is whole.
    LogError
        If it cannot be read, or the copy does not hold what was written to it.
    OSError
        If the copy cannot be written.
    """
    definitions: list[Definition] = []
    profile = ""
    while True:
        copy.unlink(missing_ok=True)
        with Salvage(source, definitions) as salvage, create_file(copy, 0o666) as stream:
            attempt = SalvagedCopy(stream, salvage, profile, chunk_span)
            attempt.write(name, progress)
        if not attempt.could_be_better():
            break
        definitions = [
            *salvage.definitions.schemas.values(),
            *salvage.definitions.channels.values(),
        ]
        profile = attempt.profile()
    recovery = attempt.recovery()
    if not attempt.pieces and (recovery.damages or not recovery.complete):
        if not salvage.is_mcap:
            with source.open("rb") as stream:
                what = not_mcap(stream.read(2 * len(MAGIC)))
            if what != not_mcap(b""):
                raise NothingWholeError(f"{source}: {what}")
            raise NothingWholeError(
                f"{source}: is not an MCAP file, and holds no whole piece of one"
            )
        raise NothingWholeError(f"{source}: holds nothing that could be saved")
    check_copy(copy, recovery.topics)
    return recovery


def recover_in_place(log: Path, progress: Progress = ignore_progress) -> tuple[Path, Recovery]:
    """Put a whole log in the place of a damaged one, which is kept beside it as `*.damaged`.

    Parameters
    ----------
    progress : callable, optional
        Called with the share that is done, 0 to 1.

    Raises
    ------
    NothingWholeError
        If the log is not an MCAP file, or nothing in it is whole.
    LogError
        If it is being written, cannot be read, or there is a file of a name needed here; or if the
        copy cannot be written, or does not hold what was written to it.
    """
    path = log.with_name(stem(log) + SUFFIX)
    kept = path.with_name(path.name + ".damaged")
    copy = path.with_name(f".{path.name}.{os.getpid()}.recovering")
    check_new(kept)
    if path != log:
        check_new(path)
    with lock_abandoned(log) as is_abandoned:
        if not is_abandoned:
            raise LogError(f"{log}: is being written; stop the recorder first")
        try:
            recovery = recover_log(log, copy, path.name, progress)
            hand_over(copy, 0o600 | readers_of(log))
            sync_file(copy)
            _keep(log, kept)
            copy.replace(path)
            if path != log:
                log.unlink(missing_ok=True)
            sync_folder(path.parent)
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror or error})") from error
        finally:
            copy.unlink(missing_ok=True)
    return path, recovery


def _keep(log: Path, name: Path) -> None:
    try:
        name.hardlink_to(log)  # so that there is a file of its own name at any time
    except OSError:  # FAT knows no links
        log.rename(name)


def check_copy(path: Path, topics: dict[str, TopicRecovery]) -> None:
    """Read a recovered log with all its checksums, and count its messages.

    Raise `LogError` if it is damaged or cannot be read, or does not hold the messages that were
    recovered.
    """
    expected = Counter(
        {name: each.messages + each.stated - each.unread for name, each in topics.items()}
    )
    counts: Counter[str] = Counter()
    with LogFile(path) as file:
        for location in file.record_locations:
            if location.length <= LIMIT:
                file.record(location)
        opened = file.chunks["size"] <= most_content(file.chunks["length"])
        chunks = in_parts(file, file.chunks[opened])
        for batch in read_in_batches(file, chunks[chunks["size"] <= LIMIT]):
            for messages in batch:
                counts[messages.channel.topic] += len(messages)
    if counts != expected:
        raise LogError(
            f"{path}: holds {counts.total()} messages of {expected.total()} that were recovered"
        )


@contextmanager
def lock_abandoned(path: Path) -> Iterator[bool]:
    """Hold the lock of a log, unless the process that writes the log holds it.

    Raise `LogError` if the log cannot be read.
    """
    try:
        stream = os.fdopen(open_regular(path), "rb")
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield _is_at(stream, path)


def _is_at(stream: BinaryIO, path: Path) -> bool:
    """Tell whether a path still leads to an open file."""
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except OSError:
        return False
