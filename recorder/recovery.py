"""Make a valid log of what is whole in one that was cut or damaged."""

import fcntl
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.records import Message

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs import rosbag2
from hearthlog.schemas.logs.files import SUFFIX, is_layer, is_log, stem
from hearthlog.schemas.mcap.chunk_writer import ChunkWriter
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.salvage.damage import Damage
from hearthlog.schemas.salvage.record_verifier import WholeAttachment, WholeChunk
from hearthlog.schemas.salvage.salvage import Definition, Piece, Salvage
from hearthlog.schemas.storage.new_files import check_new, sync_folder
from hearthlog.schemas.storage.regular_file import open_regular

_PROFILE = "ros2"  # where the header is lost, and messages are encoded as in ROS 2
_ENCODING = "cdr"


@dataclass
class Topic:
    """What was saved of a topic.

    Attributes
    ----------
    type : str
    messages : int
    expected : int or None
        How many there should be, if the log says so.
    end : int
        Log time of the last one.
    """

    type: str
    messages: int = 0
    expected: int | None = None
    end: int = 0


@dataclass(frozen=True)
class Recovery:
    """What became of a log.

    Attributes
    ----------
    topics : dict of str to Topic
    damages : list of Damage
    complete : bool
        Whether the log was finished, and its index whole.
    """

    topics: dict[str, Topic]
    damages: list[Damage]
    complete: bool

    @property
    def messages(self) -> int:
        """How many were saved."""
        return sum(topic.messages for topic in self.topics.values())

    @property
    def lossless(self) -> bool:
        """Whether nothing was lost."""
        return all(damage.lossless for damage in self.damages)


def recover_log(
    source: Path, copy: Path, name: str, progress: Progress = ignore_progress
) -> Recovery:
    """Copy what is whole in a log to a new one, read that again and count it.

    Parameters
    ----------
    source, copy : Path
    name : str
        Name that the copy will have in the end.
    progress : callable, optional
        Is given the share that is done, 0 to 1.

    Raises
    ------
    NothingWholeError
        If the source is no MCAP file, or nothing in it is whole.
    LogError
        If it cannot be read, or the copy does not hold what was written to it.
    OSError
        If the copy cannot be written.
    """
    known: list[Definition] = []
    profile = ""
    while True:
        with Salvage(source, known) as salvage, copy.open("wb") as stream:
            attempt = _Copy(stream, salvage, profile)
            attempt.write(name, progress)
        if not attempt.could_be_better():
            break
        known = [*salvage.definitions.schemas.values(), *salvage.definitions.channels.values()]
        profile = attempt.profile()
    if not attempt.pieces:
        if not salvage.is_mcap:
            raise NothingWholeError(f"{source}: is no MCAP file, and holds no whole piece of one")
        raise NothingWholeError(f"{source}: holds nothing that could be saved")
    recovery = attempt.recovery()
    _check(copy, recovery.topics)
    return recovery


def recover_in_place(log: Path, progress: Progress = ignore_progress) -> tuple[Path, Recovery]:
    """Put a log in the place of a damaged one, which is kept beside it as `*.damaged`.

    Returns
    -------
    path : Path
        Its name: that of the damaged one, without `.active`.
    recovery : Recovery

    Raises
    ------
    LogError
        As `recover_log`, or if the log is being written, or there is a file of a name needed here.
    """
    path = log.with_name(stem(log) + SUFFIX)
    kept = path.with_name(path.name + ".damaged")
    copy = path.with_name(f".{path.name}.{os.getpid()}.recovering")
    check_new(kept)
    if path != log:
        check_new(path)
    with _abandoned(log) as is_abandoned:
        if not is_abandoned:
            raise LogError(f"{log}: is being written; stop the recorder first")
        try:
            recovery = recover_log(log, copy, path.name, progress)
            _sync(copy)
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


def _sync(path: Path) -> None:
    with path.open("rb") as stream:
        os.fsync(stream.fileno())


class NothingWholeError(LogError):
    """Of a log nothing is left."""


class _Copy:
    """The whole pieces of a log, on their way into another one."""

    def __init__(self, stream: BinaryIO, salvage: Salvage, profile: str) -> None:
        self.pieces = 0
        self._salvage = salvage
        self._profile = profile
        self._writer = ChunkWriter(stream)
        self._begun = False
        self._written: set[tuple[type, int]] = set()
        self._counts: dict[int, int] = {}
        self._ends: dict[int, int] = {}
        self._span = (1 << 63, 0)

    def write(self, name: str, progress: Progress) -> None:
        """Write all, and complete the file, which will bear this name."""
        for piece in self._salvage.pieces():
            self._add(piece)
            progress(self._salvage.offset / self._salvage.size)
            del piece  # before the next is read, which may be as large
        self._begin()
        self._writer.flush()
        used = self._salvage.definitions
        channels = [c for c in used.channels.values() if c.schema_id in {0, *used.schemas}]
        about = self._rosbag2(name)
        if about is not None:
            self._writer.add_metadata(rosbag2.METADATA, about)
        self._writer.define(list(used.schemas.values()), channels)
        self._writer.finish()

    def could_be_better(self) -> bool:
        """Whether another attempt would know what this one learned too late."""
        defines = self._salvage.definitions.defines
        late = any(defines(channel) for channel in self._salvage.unnamed)
        return late or (self._salvage.header is None and self.profile() != self._profile)

    def profile(self) -> str:
        """Guess the profile from the channels."""
        channels = self._salvage.definitions.channels.values()
        return _PROFILE if any(c.message_encoding == _ENCODING for c in channels) else ""

    def recovery(self) -> Recovery:
        """Say what was saved and what was not."""
        topics: dict[str, Topic] = {}
        for number, channel in self._salvage.definitions.channels.items():
            schema = self._salvage.definitions.schemas.get(channel.schema_id)
            topic = topics.setdefault(channel.topic, Topic("" if schema is None else schema.name))
            topic.messages += self._counts.get(number, 0)
            topic.end = max(topic.end, self._ends.get(number, 0))
            if self._salvage.expected is not None:
                expected = self._salvage.expected.get(number, 0)
                topic.expected = (topic.expected or 0) + expected
        damages = self._salvage.damages()
        return Recovery(topics, [*damages, *_untraced(topics, damages)], self._salvage.complete)

    def _add(self, piece: Piece) -> None:
        self._begin()
        self.pieces += 1
        if isinstance(piece, WholeChunk):
            chunk = piece.stored
            self._define(chunk.entries, piece.definitions)
            self._writer.copy_chunk(chunk)
            for number, entries in chunk.entries.items():
                times = np.frombuffer(entries, np.int64)[::2]
                self._count(number, len(times), int(times.min()), int(times.max()))
        elif isinstance(piece, Message):
            self._define([piece.channel_id])
            number, time = piece.channel_id, piece.log_time
            self._writer.add_message(number, time, piece.data, piece.publish_time, piece.sequence)
            self._count(number, 1, time, time)
        elif isinstance(piece, WholeAttachment):
            self._writer.copy_attachment(piece.record, piece.about)
        elif piece.name != rosbag2.METADATA:
            self._writer.add_metadata(piece.name, piece.metadata)

    def _begin(self) -> None:
        if not self._begun:
            header = self._salvage.header
            profile, library = (
                (self._profile, "") if header is None else (header.profile, header.library)
            )
            self._writer.start(profile, library)
            self._begun = True

    def _define(self, numbers: Iterable[int], inside: Iterable[Definition] = ()) -> None:
        """Write what defines these channels before their first message, unless it is with them."""
        self._written.update((type(record), record.id) for record in inside)
        known = self._salvage.definitions
        for number in numbers:
            channel = known.channels[number]
            schema = known.schemas.get(channel.schema_id)
            for record in (schema, channel):
                if record is not None and (type(record), record.id) not in self._written:
                    self._writer.write_definition(record)
                    self._written.add((type(record), record.id))

    def _count(self, number: int, count: int, first: int, last: int) -> None:
        self._counts[number] = self._counts.get(number, 0) + count
        self._ends[number] = max(self._ends.get(number, 0), last)
        self._span = min(self._span[0], first), max(self._span[1], last)

    def _rosbag2(self, name: str) -> dict[str, str] | None:
        """Make the record for rosbag2, which reads the index where there is none."""
        definitions = self._salvage.definitions
        topics: dict[str, rosbag2.TopicCount] = {}
        for number, channel in definitions.channels.items():
            schema = definitions.schemas.get(channel.schema_id)
            kind = "" if schema is None else schema.name
            topic = topics.setdefault(channel.topic, rosbag2.TopicCount(kind, channel.metadata))
            topic.messages += self._counts.get(number, 0)
        try:
            return rosbag2.file_metadata(name, topics, self._span if self._counts else (0, 0))
        except (KeyError, ValueError, RecursionError):  # other writers describe channels otherwise
            return None


def _untraced(topics: dict[str, Topic], damages: list[Damage]) -> list[Damage]:
    """List messages that the log counts, while nothing shows where they were."""
    if not all(damage.exact for damage in damages):
        return []
    missing = {
        name: topic.expected - topic.messages - sum(d.messages.get(name, 0) for d in damages)
        for name, topic in topics.items()
        if topic.expected is not None
    }
    missing = {name: count for name, count in missing.items() if count > 0}
    return [Damage(0, 0, "its statistics count more", missing)] if missing else []


def _check(path: Path, topics: dict[str, Topic]) -> None:
    """Raise LogError unless a log, read with all its checksums, holds what it should."""
    expected = {name: topic.messages for name, topic in topics.items() if topic.messages}
    found: dict[str, int] = {}
    with LogFile(path) as file:
        for place in file.record_locations:
            file.record(place)
        for batch in read_in_batches(file, file.chunks, check=True):
            for messages in batch:
                topic = messages.channel.topic
                found[topic] = found.get(topic, 0) + len(messages)
    if found != expected:
        raise LogError(
            f"{path}: holds {sum(found.values())} messages of {sum(expected.values())} that were "
            "recovered"
        )


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
        with _abandoned(active) as is_abandoned:
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
        _check(path, recovery.topics)  # an earlier start got as far as this, and no further
        return
    _sync(copy)
    copy.rename(path)


@contextmanager
def _abandoned(path: Path) -> Iterator[bool]:
    """Hold the file's lock, unless a recorder does."""
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
            yield True
