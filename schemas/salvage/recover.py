"""Recovery of damaged logs, and thinning of logs to save space."""

import fcntl
import os
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Message

from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.files import open_regular
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, stem
from hearthlog.schemas.logs.metadata import (
    HEARTHLOG_METADATA,
    ROSBAG2_METADATA,
    THINNED,
    THINNED_OF,
    TopicCount,
    log_digest,
    provenance_records,
    rosbag2_counts,
    rosbag2_metadata,
)
from hearthlog.schemas.logs.writer import ENCODING, PROFILE, CountedWriter
from hearthlog.schemas.mcap.chunks import in_parts, read_in_batches
from hearthlog.schemas.mcap.compressed_chunk import most_content
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import HEAD, LAST_TIME, LIMIT, MAGIC, Definition, not_mcap
from hearthlog.schemas.messages.message_types import EMBEDDING, LOG_DAMAGED, encode_gap
from hearthlog.schemas.messages.topics import LIVE, is_scenario, parse_topic
from hearthlog.schemas.new_files import (
    check_new,
    create_file,
    hand_over,
    readers_of,
    sync_file,
    sync_folder,
)
from hearthlog.schemas.salvage import Piece, Salvage
from hearthlog.schemas.salvage.damage import Damage
from hearthlog.schemas.salvage.intact_records import (
    IntactAttachment,
    IntactChunk,
    LargeChunk,
    UnknownRecord,
    chunk_messages,
    encode_attachment,
)
from hearthlog.schemas.salvage.lost_frames import FrameSearch, LostFrames, gap_channel


@dataclass
class TopicRecovery:
    """Recovery result of a topic."""

    type: str
    messages: int = 0
    stated: int = 0  # new gap messages that describe lost data
    expected: int | None = None  # message count in the index of the log, if there is one
    end: int = 0  # log time of the last message, in nanoseconds
    unread: int = 0  # messages copied without reading, as they are too large


@dataclass(frozen=True)
class RecoveryReport:
    """Recovery result of a log: saved messages and losses."""

    topics: dict[str, TopicRecovery]
    damages: list[Damage]
    complete: bool  # whether the log was finished, and its index is complete
    escaped: Sequence[str] = ()  # names of records with texts that are not UTF-8

    @property
    def messages(self) -> int:
        """Number of saved messages."""
        return sum(topic.messages for topic in self.topics.values())

    @property
    def lossless(self) -> bool:
        """Whether nothing was lost."""
        return not self.losses

    @property
    def losses(self) -> list[str]:
        """Description of each damage, or one description if only frame numbers reveal a loss."""
        losses = [str(damage) for damage in self.damages if not damage.lossless]
        if not losses and any(topic.stated for topic in self.topics.values()):
            return ["frames are missing, or lie elsewhere in the log: see its gaps"]
        return losses


_REST = "all but labels, segments and gaps"
STEPS = ("", "statistics", "statistics and features", _REST)  # dropped message kinds of each step
_SOUND = {"statistics", "features", "embedding"}
_DROPPED = (set[str](), {"statistics"}, _SOUND, _SOUND)
_KEPT = {"info", "label", "segment", "gap"}


class Thinning(NamedTuple):
    """Step of thinning."""

    step: int
    note: Mapping[str, str]

    def drops(self, topic: str) -> bool:
        """Return whether the messages of a topic are dropped."""
        parts = parse_topic(topic)
        if STEPS[self.step] == _REST:
            if parts is None or parts.kind not in _KEPT:
                return True
            return parts.labelling != LIVE and not is_scenario(parts.labelling)
        return parts is not None and parts.kind in _DROPPED[self.step]


class SalvagedCopy:
    """Copy of the undamaged pieces of a log in a new log.

    Chunks are merged up to `chunk_span` nanoseconds of log time; 0 copies them unchanged. Merging
    puts embeddings in separate chunks.
    """

    def __init__(
        self,
        stream: BinaryIO,
        salvage: Salvage,
        profile: str,
        chunk_span: int = 0,
        selection: Thinning | None = None,
    ) -> None:
        self.pieces = 0
        self._salvage = salvage
        self._profile = profile
        self._chunk_span = chunk_span
        self._selection = selection
        self._search = FrameSearch(salvage)
        self._writer = CountedWriter(stream, salvage.definitions)
        self._begun = False
        self._counted: dict[str, int] = {}  # messages by topic, from the `rosbag2` record
        self._written: set[tuple[type, int]] = set()
        self._counts: Counter[int] = Counter()
        self._stated: Counter[int] = Counter()  # new gap messages
        self._unread: Counter[int] = Counter()
        self._ends: dict[int, int] = {}
        self._span = (1 << 63, 0)

    def write(self, name: str, progress: Progress) -> None:
        """Write all pieces, and finish the file; report the share of the damaged log, 0 to 1."""
        for piece in self._salvage.pieces():
            self._add(piece)
            progress(self._salvage.offset / self._salvage.size)
            del piece  # frees memory before the next piece, which may be as large
        self._begin()
        for lost in self._search.at_end(self._ends):
            self._add_gap(lost)
        self._writer.flush()
        definitions = self._salvage.definitions
        schemas = definitions.schemas
        channels = [c for c in definitions.channels.values() if c.schema_id in {0, *schemas}]
        metadata = self._rosbag2(name)
        if metadata is not None:
            self._writer.add_metadata(ROSBAG2_METADATA, metadata)
        self._writer.define(list(schemas.values()), channels)
        self._writer.finish()

    def could_be_better(self) -> bool:
        """Return whether a second attempt would have definitions or a profile from the start."""
        defines = self._salvage.definitions.defines
        late = any(defines(channel) for channel in self._salvage.unnamed)
        return late or (self._salvage.header is None and self.profile() != self._profile)

    def profile(self) -> str:
        """Guess the profile of a log without header: `ros2` if a channel is CDR, else empty."""
        channels = self._salvage.definitions.channels.values()
        return PROFILE if any(c.message_encoding == ENCODING for c in channels) else ""

    def recovery(self) -> RecoveryReport:
        """Count saved messages, and list losses."""
        topics: dict[str, TopicRecovery] = {}
        expected = self._salvage.expected
        for number, channel, kind in self._channel_types():
            topic = topics.setdefault(channel.topic, TopicRecovery(kind))
            topic.messages += self._counts[number] - self._stated[number]
            topic.stated += self._stated[number]
            topic.unread += self._unread[number]
            topic.end = max(topic.end, self._ends.get(number, 0))
            if expected is not None and not self._drops(number):
                topic.expected = (topic.expected or 0) + expected.get(number, 0)
        if expected is None and self._selection is None:
            for name, count in self._counted.items():
                if name in topics and count > topics[name].messages:
                    topics[name].expected = count
        damages = self._salvage.damages()
        untraced = [] if self._salvage.unnamed else _untraced(topics, damages)
        escaped = list(self._salvage.escaped)
        return RecoveryReport(topics, [*damages, *untraced], self._salvage.complete, escaped)

    def _channel_types(self) -> Iterator[tuple[int, Channel, str]]:
        definitions = self._salvage.definitions
        for number, channel in definitions.channels.items():
            schema = definitions.schemas.get(channel.schema_id)
            yield number, channel, "" if schema is None else schema.name

    def _add(self, piece: Piece) -> None:
        self._begin()
        self.pieces += 1
        if self._chunk_span and not isinstance(piece, IntactChunk):
            self._writer.flush()
        if isinstance(piece, IntactChunk):
            self._add_chunk(piece, self._search.before(piece))
        elif isinstance(piece, Message):
            for lost in self._search.before(piece):
                self._add_gap(lost)
            self._add_message(piece)
        elif isinstance(piece, LargeChunk):
            self._add_large(piece)
        elif isinstance(piece, UnknownRecord):
            self._writer.copy_record(self._salvage.stored(*piece.data))
        elif isinstance(piece, IntactAttachment):
            self._writer.copy_attachment(self._record_of(piece), piece.index_record)
        elif piece.name == HEARTHLOG_METADATA and self._selection is not None:
            self._writer.add_metadata(piece.name, {**piece.metadata, **self._selection.note})
        elif piece.name == ROSBAG2_METADATA:
            self._counted = rosbag2_counts(piece.metadata)
        else:
            self._writer.add_metadata(piece.name, piece.metadata)

    def _add_chunk(self, piece: IntactChunk, losses: Sequence[LostFrames]) -> None:
        """Copy a chunk, unchanged unless messages are dropped or gaps inserted."""
        chunk = piece.stored
        if any(lost.end > chunk.start for lost in losses):
            self._add_messages(piece, losses)
            return
        for lost in losses:
            self._add_gap(lost)
        dropped = {number for number in chunk.entries if self._drops(number)}
        kept = [number for number in chunk.entries if number not in dropped]
        if not kept:
            return
        self._define(kept, piece.definitions[: piece.leading])
        if self._chunk_span:
            gathered = {number for number in kept if self._is_gathered(number)}
            self._writer.join_chunk(chunk, self._chunk_span, dropped, gathered)
        else:
            self._writer.copy_chunk(chunk)
        for number in kept:
            times = chunk.times(number)
            self._count(number, len(times), int(times.min()), int(times.max()))

    def _record_of(self, piece: IntactAttachment) -> Iterator[bytes | memoryview]:
        stored = self._salvage.stored
        if piece.escaped:
            yield from encode_attachment(piece.index_record, stored(*piece.inner))
            return
        start, end = piece.data
        yield HEAD.pack(Opcode.ATTACHMENT, end - start - HEAD.size)  # the one there may be wrong
        yield from stored(start + HEAD.size, end)

    def _add_large(self, piece: LargeChunk) -> None:
        chunk, (start, end) = piece.stored, piece.data
        dropped = [self._drops(number) for number in chunk.entries]
        if dropped and all(dropped):
            return
        if any(dropped):
            what = f"a chunk at byte {start} is too large to be thinned"
            raise LogError(f"{self._salvage.path}: {what}")
        self._define(chunk.entries, piece.definitions[: piece.leading])
        self._writer.copy_large_chunk(chunk, end - start, self._salvage.stored(start, end))
        self._unread.update(piece.unread)
        for number in chunk.entries:
            times = chunk.times(number)
            times = times[times.astype(np.uint64) <= LAST_TIME]
            if len(times):
                self._count(number, len(times), int(times.min()), int(times.max()))

    def _drops(self, number: int) -> bool:
        if self._selection is None:
            return False
        return self._selection.drops(self._salvage.definitions.channels[number].topic)

    def _is_gathered(self, number: int) -> bool:
        """Return whether the messages of a channel get separate chunks.

        Mixed with features, which are nearly incompressible, embeddings take 1.5 times the space.
        """
        definitions = self._salvage.definitions
        schema = definitions.schemas.get(definitions.channels[number].schema_id)
        return schema is not None and schema.name == EMBEDDING

    def _add_messages(self, piece: IntactChunk, losses: Sequence[LostFrames]) -> None:
        waiting = deque(losses)
        for message in chunk_messages(piece.stored):
            while waiting and waiting[0].end <= message.log_time:
                self._add_gap(waiting.popleft())
            self._add_message(message)
        for lost in waiting:
            self._add_gap(lost)

    def _add_message(self, message: Message) -> None:
        number, time = message.channel_id, message.log_time
        if self._drops(number):
            return
        self._define([number])
        self._writer.add_message(number, time, message.data, message.publish_time, message.sequence)
        self._count(number, 1, time, time)

    def _add_gap(self, lost: LostFrames) -> None:
        """Write a gap message for lost frames, unless log time is already later."""
        end, start, microphone, frames = lost
        number = gap_channel(self._salvage.definitions, microphone)
        if number is None or end < self._span[1]:
            return
        self._add_message(
            Message(number, end, encode_gap(microphone, start, end, LOG_DAMAGED, frames), end, 0)
        )
        self._stated[number] += 1

    def _begin(self) -> None:
        if not self._begun:
            header = self._salvage.header or Header(self._profile, library="")
            self._writer.start(header.profile, header.library)
            self._begun = True

    def _define(self, numbers: Iterable[int], inside: Iterable[Definition] = ()) -> None:
        """Write the definitions of channels before their first message, unless they are written."""
        self._written.update((type(record), record.id) for record in inside)
        definitions = self._salvage.definitions
        for number in numbers:
            channel = definitions.channels[number]
            schema = definitions.schemas.get(channel.schema_id)
            for record in (schema, channel):
                if record is not None and (type(record), record.id) not in self._written:
                    if self._chunk_span:
                        self._writer.flush()  # its buffer may hold related definitions
                    self._writer.write_definition(record)
                    self._written.add((type(record), record.id))

    def _count(self, number: int, count: int, first: int, last: int) -> None:
        self._counts[number] += count
        self._ends[number] = max(self._ends.get(number, 0), last)
        self._span = min(self._span[0], first), max(self._span[1], last)

    def _rosbag2(self, name: str) -> dict[str, str] | None:
        """Build the `rosbag2` record, the source of rosbag2's topic list; None if impossible."""
        topics: dict[str, TopicCount] = {}
        for number, channel, kind in self._channel_types():
            topic = topics.setdefault(channel.topic, TopicCount(kind, channel.metadata))
            topic.messages += self._counts[number]
        try:
            return rosbag2_metadata(name, topics, self._span if self._counts else (0, 0))
        except (KeyError, ValueError, RecursionError):  # others describe channels differently
            return None


def _untraced(topics: dict[str, TopicRecovery], damages: list[Damage]) -> list[Damage]:
    """List lost messages that are counted in the log, but leave no trace of their location."""
    if not all(damage.exact for damage in damages):
        return []
    missing = {
        name: topic.expected - topic.messages - sum(d.messages.get(name, 0) for d in damages)
        for name, topic in topics.items()
        if topic.expected is not None
    }
    missing = {name: count for name, count in missing.items() if count > 0}
    return [Damage(0, 0, "a count in the log has more", missing)] if missing else []


class NothingIntactError(LogError):
    """No part of a log is undamaged."""


def recover_log(
    source: Path,
    copy: Path,
    name: str,
    progress: Progress = ignore_progress,
    *,
    chunk_span: int = 0,
) -> RecoveryReport:
    """Copy the undamaged parts of a log to a new log, and check the copy.

    Progress is the completed share, 0 to 1; it restarts at 0 for a second attempt. Chunks are
    merged up to `chunk_span` nanoseconds of log time; 0 copies them unchanged. Raise
    `NothingIntactError` if the source is not an MCAP file, or no part of it is undamaged;
    `LogError` if the source cannot be read, or the copy differs from the written messages;
    `OSError` if the copy cannot be written.
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
        found = salvage.definitions
        definitions = [*found.schemas.values(), *found.channels.values()]
        profile = attempt.profile()
    recovery = attempt.recovery()
    if not attempt.pieces and (recovery.damages or not recovery.complete):
        what = "holds nothing that could be saved"
        if not salvage.is_mcap:
            with source.open("rb") as stream:
                what = not_mcap(stream.read(2 * len(MAGIC)))
            if what == not_mcap(b""):
                what += ", and holds no whole piece of one"
        raise NothingIntactError(f"{source}: {what}")
    check_copy(copy, recovery.topics)
    return recovery


def recover_in_place(
    log: Path, progress: Progress = ignore_progress
) -> tuple[Path, RecoveryReport]:
    """Replace a damaged log by its recovered copy, and keep the original as `*.damaged`.

    Progress is the completed share, 0 to 1. Raise `NothingIntactError` if the log is not an MCAP
    file, or no part of it is undamaged; `LogError` if the log is being written, cannot be read, or
    a required file name is taken, or if the copy cannot be written, or differs from the written
    messages.
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
            try:
                kept.hardlink_to(log)  # keeps a file at the name of the log at any time
            except OSError:  # FAT has no links
                log.rename(kept)
            copy.replace(path)
            if path != log:
                log.unlink(missing_ok=True)
            sync_folder(path.parent)
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror or error})") from error
        finally:
            copy.unlink(missing_ok=True)
    return path, recovery


def check_copy(path: Path, topics: dict[str, TopicRecovery]) -> None:
    """Verify all checksums of a recovered log, and count its messages.

    Raise `LogError` if the log is damaged, cannot be read, or lacks recovered messages.
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
    """Hold the lock of a log, unless its writer does; raise `LogError` if it cannot be read."""
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
    """Return whether a path still refers to an open file."""
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except OSError:
        return False


_CHUNK_SPAN = 10 * NANOSECONDS


def dropped_kinds(text: str | None) -> set[str]:
    """Return the dropped kinds of per-frame messages of a log."""
    return _DROPPED[STEPS.index(text)] if text in STEPS else set()


def thinned_step(log: Path) -> int:
    """Return the thinning step of a log, an index of `STEPS`.

    Raise `LogError` if the log cannot be read, is damaged, or was thinned in another way by a newer
    version.
    """
    with LogFile(log) as file:
        texts = {record.get(THINNED, "") for record in provenance_records(file)}
    try:
        return max((STEPS.index(text) for text in texts), default=0)
    except ValueError as error:
        raise LogError(f"{log}: was thinned in a way that this version does not know") from error


def thin_log(source: Path, copy: Path, step: int) -> None:
    """Copy a log without the messages that a thinning step drops, and check the copy.

    Other messages keep content and order. Channels stay defined, without messages. Raise `LogError`
    if the log is damaged, or the copy differs from the written messages, `OSError` if the copy
    cannot be written.
    """
    with LogFile(source) as file:
        before = [record.get(THINNED_OF, "") for record in provenance_records(file)]
    digests = " ".join([*filter(None, before), log_digest(source)])
    thinning = Thinning(step, {THINNED: STEPS[step], THINNED_OF: digests})
    copy.unlink(missing_ok=True)
    with Salvage(source) as salvage, create_file(copy, 0o666) as stream:
        thinned = SalvagedCopy(stream, salvage, PROFILE, _CHUNK_SPAN, thinning)
        thinned.write(source.name, ignore_progress)
    recovery = thinned.recovery()
    if recovery.damages or not recovery.complete:
        raise LogError(f"{source}: is damaged, and not thinned; `hearthlog recover` saves the rest")
    check_copy(copy, recovery.topics)
