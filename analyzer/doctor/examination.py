"""Examination of logs: single files, and the series of files in a folder."""

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from hearthlog.analyzer.doctor import DISTRUST, RECOVER, REINDEX, Findings
from hearthlog.analyzer.doctor.column_checks import ALWAYS, LOG_NAME, split_topic
from hearthlog.analyzer.doctor.frame_sequence import FrameSequence
from hearthlog.analyzer.doctor.message_checks import (
    ALLOWED_DELAY,
    ATTACHMENTS,
    DAY_FOLDERS,
    MessageChecks,
    MetadataChecks,
)
from hearthlog.analyzer.doctor.records import ROS_ENCODINGS, MessageBatch, RecordWalk
from hearthlog.analyzer.doctor.sections import DataSection, SummarySection
from hearthlog.schemas.errors import HearthlogWarning, LogError, Progress, ignore_progress
from hearthlog.schemas.files import LocalFile
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, millisecond_text
from hearthlog.schemas.logs.columns import decode, faults, unreadable
from hearthlog.schemas.logs.contents import CONTENTS_METADATA as CONTENTS
from hearthlog.schemas.logs.contents import LogContents, stated_contents
from hearthlog.schemas.logs.files import SUFFIX, check_allowed, find_logs, is_layer, log_of_layer
from hearthlog.schemas.logs.metadata import HEARTHLOG_METADATA, provenance_records, unknown_version
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA as ROSBAG2
from hearthlog.schemas.logs.writer import ENCODING
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import FOOTER_SIZE, HEAD, MAGIC, not_mcap, read_footer

LIBRARY = "hearthlog"
_LAYER = re.compile(r".+_\d{8}T\d{6}Z\.[^.]+\.mcap(\.active)?")
_MOST_WRONG = 20_000  # distinct faults of a channel, after which its messages are skipped
_KEPT = {HEARTHLOG_METADATA, ROSBAG2, CONTENTS, *ATTACHMENTS}


@dataclass
class ExaminedFile:
    """Result of the checks of one file."""

    findings: Findings
    ours: bool = False  # whether it is a log of hearthlog, and not a layer
    node: str = ""
    span: tuple[int, int] | None = None  # first and last log time, in nanoseconds
    frames: dict[str, FrameSequence] = field(default_factory=dict)  # by microphone


def examine_file(path: Path, progress: Progress = ignore_progress) -> ExaminedFile:
    """Check one file against the MCAP specification and, if it is ours, docs/log.md.

    `progress` receives the share of the bytes that is done, 0 to 1.
    """
    examined = ExaminedFile(Findings(path))
    try:
        with closing(LocalFile(path)) as file:
            _examine(file, examined, progress)
    except LogError as error:
        examined.findings.error("unreadable", str(error).removeprefix(f"{path}: "))
    return examined


def _examine(file: LocalFile, examined: ExaminedFile, progress: Progress) -> None:
    findings, size = examined.findings, file.size
    active = findings.path.name.endswith(ACTIVE_SUFFIX)
    start = file.read(0, 2 * len(MAGIC))
    magic = start[: len(MAGIC)]
    if magic != MAGIC and not (active and MAGIC.startswith(magic)):
        what = not_mcap(start)
        if what == not_mcap(b""):
            what = f"{what}: it does not begin as one"
        findings.error("magic", what)
        return
    tail = file.read(max(size - FOOTER_SIZE, 0), FOOTER_SIZE)
    finished = size > len(MAGIC) and tail.endswith(MAGIC)
    footer = read_footer(tail)
    summary_start = 0 if footer is None else footer.summary_start
    offsets, ours = _index_of(findings.path)
    if HEAD.size < summary_start < size:
        offsets.append(summary_start)
    checks = MessageChecks if ours else ForeignMessages
    data = DataSection(findings, _KEPT, size, checks, ours=ours)
    walk = RecordWalk(file, findings, sorted(offsets), finished=finished)
    complete = _walk(walk, data, summary_start, progress)
    is_readable = data.is_readable and not walk.damaged
    if complete:
        _check_end(walk, findings)
    elif finished:
        findings.error("footer", "there is no Footer at the end", RECOVER)
    elif active:
        advice = "unless a recorder is writing it, `hearthlog recover` completes it"
        findings.warning("unfinished", "is unfinished", advice)
    else:
        what = "is unfinished: it was cut off"
        findings.error("cut", what, "`hearthlog recover` completes it")
    records = data.metadata.get(HEARTHLOG_METADATA, [])
    for text in sorted({unknown_version(record) for record in records} - {""}):
        findings.warning("newer", text)
    if isinstance(data.checks, MessageChecks):
        data.checks.finish()
        MetadataChecks(
            data, data.checks, findings, finished=complete, is_readable=is_readable
        ).check()
        examined.ours, examined.frames = True, data.checks.frames
        examined.node = records[0].get("node", "") if records else ""
    if CONTENTS in data.metadata and complete and is_readable:
        _check_contents(findings)
    examined.span = data.span


def _index_of(path: Path) -> tuple[list[int], bool]:
    """Read the index of a file: offsets of records, and whether hearthlog's recorder wrote it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HearthlogWarning)  # the checks report more details
            file = LogFile(path)
        with file:
            offsets = [location.offset for location in file.record_locations]
            return file.chunks["offset"].tolist() + offsets, _is_ours(file)
    except LogError:
        return [], False


def _is_ours(file: LogFile) -> bool:
    """Whether a recorder wrote this file, rather than a merge or a cut of logs."""
    if _LAYER.fullmatch(file.path.name):
        return False
    records = provenance_records(file)
    is_made = len(records) > 0 or (file.header is not None and file.header.library == LIBRARY)
    if LOG_NAME.fullmatch(file.path.name):
        return is_made
    kinds = {split_topic(channel.topic)[1] for channel in file.channels.values()}
    is_part = bool(file.channels) and not kinds >= ALWAYS
    return is_made and len(records) < 2 and not is_part


def _walk(walk: RecordWalk, data: DataSection, summary_start: int, progress: Progress) -> bool:
    """Check all records; return whether the last one is a footer."""
    summary: SummarySection | None = None
    losses = 0
    for record in walk:
        if walk.losses > losses:
            losses = walk.losses
            data.definitions.incomplete |= walk.skipped
            data.finish(cut=True)
            data.checks.interrupt()
        is_summary = record.opcode == Opcode.FOOTER or record.offset == summary_start
        if is_summary and not data.ended:
            what = "the data section has no Data End"
            data.findings.error("data-end", what, REINDEX, offset=record.offset)
            data.ended = True
        if summary is None and data.ended:
            data.finish(cut=False)
            summary = SummarySection(
                data, data.findings, is_readable=data.is_readable and not walk.damaged
            )
        if summary is None:
            data.add(record)
            progress(record.offset / walk.size)
        elif record.opcode == Opcode.FOOTER:
            summary.finish(record)
            return True
        else:
            summary.add(record)
    data.finish(cut=True)
    return False


def _check_end(walk: RecordWalk, findings: Findings) -> None:
    offset = walk.offset
    rest = walk.size - offset
    if walk.take(len(MAGIC)) != MAGIC:
        findings.error("magic", "the Footer is not followed by the magic", REINDEX, offset=offset)
    elif rest > len(MAGIC):
        what = f"{rest - len(MAGIC)} bytes follow the end"
        findings.error("after-end", what, REINDEX, offset=offset + len(MAGIC))


def _check_contents(findings: Findings) -> None:
    """Compare the file's contents record with its messages."""
    try:
        with LogFile(findings.path) as file:
            stated, actual = stated_contents(file), LogContents()
            for batch in read_in_batches(file, file.chunks):
                actual.add(batch)
    except LogError:
        return  # already reported
    if stated is None:
        what = f"metadata {CONTENTS} is damaged, or of other messages"
        findings.warning("contents", what, "it is not read: the messages tell what is in the file")
    elif differing := stated.differing(actual):
        what = f"metadata {CONTENTS} says otherwise than the messages: {', '.join(differing)}"
        findings.error("contents", what, DISTRUST)


class ForeignMessages:
    """Checks of messages in a file that is not ours: whether they match their types."""

    def __init__(self, data: DataSection, findings: Findings) -> None:
        self._data = data
        self._findings = findings
        self._wrong: Counter[int] = Counter()  # distinct faults, by channel

    def add(self, batch: MessageBatch) -> None:
        """Decode the next messages of the file, and report undecodable ones."""
        definitions = self._data.definitions
        for raw in batch.by_channel(definitions.channels, definitions.schemas):
            if self._wrong[raw.channel.id] > _MOST_WRONG:
                continue
            if raw.channel.message_encoding != ENCODING:
                continue
            if raw.schema is None or raw.schema.encoding not in ROS_ENCODINGS:
                continue
            if unreadable(raw.channel, raw.schema):
                continue  # reported for the definition
            try:
                decode([raw])
            except LogError as error:
                self._report(raw, error)

    def _report(self, raw: RawMessages, error: LogError) -> None:
        """Report messages that do not match their type, or else texts that are not UTF-8."""
        wrong = faults(raw)
        topic = raw.channel.topic
        rows = np.zeros(len(raw), bool)
        rows[list(wrong)] = True

        def what(row: int) -> str:
            return f"cannot be read: {topic}: {wrong[row]}"

        self._findings.rows("cdr", rows, raw.log_times, what, advice="")
        self._wrong[raw.channel.id] += len(set(map(id, wrong.values())))
        if self._wrong[raw.channel.id] > _MOST_WRONG:
            text = f"messages of {topic} cannot be read, each for another reason"
            self._findings.error("unchecked", f"{text}: the rest of them is not checked")
        if not wrong:
            advice = "readers put U+FFFD in the place of what cannot be read"
            self._findings.warning("text", str(error), advice, time=int(raw.log_times[0]))

    def interrupt(self) -> None:
        """Ignore missing messages: each message is checked on its own."""


_TOLERANCE = 0.01  # share of the time between two files, for the error of a sound card's clock
_MARGIN = 60 * NANOSECONDS  # maximum extent of a layer beyond its log
_LEFT = {
    f"{SUFFIX}.damaged": "is what could not be recovered whole; `hearthlog recover` may save more",
    f"{SUFFIX}.recovering": "was left by a recovery that was cut short; the next one makes it anew",
    f"{SUFFIX}.thinning": "was left by a recorder that was killed; the next one deletes it",
    ".tmp": "was left by a command that was cut short; delete it",
}


def check_leftovers(folder: Path) -> Iterator[Findings]:
    """Find the files left by killed recorders and commands."""
    for path in sorted(folder.rglob("*")):
        for suffix, what in _LEFT.items():
            if path.name.endswith(suffix) and SUFFIX in path.name:
                findings = Findings(path)
                findings.warning("leftover", what)
                yield findings


def check_series(files: Sequence[ExaminedFile]) -> None:
    """Compare the logs of each node of a home, in any order, and add to their findings.

    Files that are not ours, or have no messages, are skipped.
    """
    paths = [file.findings.path for file in files]
    homes = {
        path.parents[3] for path in paths if DAY_FOLDERS.fullmatch("/".join(path.parts[-4:-1]))
    }
    nodes: dict[tuple[Path | None, str], list[ExaminedFile]] = {}
    for file in files:
        if file.ours and file.span is not None:
            home = next((each for each in file.findings.path.parents if each in homes), None)
            nodes.setdefault((home, file.node), []).append(file)
    for same in nodes.values():
        same.sort(key=lambda file: (file.span or (0, 0))[0])
        _check_overlaps(same)
        for microphone in sorted({name for file in same for name in file.frames}):
            _check_frames(microphone, [file for file in same if microphone in file.frames])
    _check_layers(files)


def _check_layers(files: Sequence[ExaminedFile]) -> None:
    """Report layers outside of the time of the log with the same name."""
    spans = {file.findings.path: file.span for file in files if file.span is not None}
    for path in filter(is_layer, spans):
        log, (start, end) = log_of_layer(path), spans[path]
        first, last = spans.get(log, (start, end))
        if end < first - _MARGIN or last + _MARGIN < start:
            findings = next(file.findings for file in files if file.findings.path == path)
            what = f"speaks of a time when {log.name} was not recorded"
            advice = "it belongs to another log; move it beside that"
            findings.warning("layer", what, advice, time=start)


def _check_overlaps(files: Sequence[ExaminedFile]) -> None:
    """Report logs of one node that overlap, unless the clock was set back."""
    twice = [again for file in files if (again := _repeated_time_span(file)) is not None]
    latest = files[0]
    for file in files[1:]:
        assert file.span is not None
        assert latest.span is not None
        start, end = file.span[0], min(file.span[1], latest.span[1])
        delay = ALLOWED_DELAY if len(file.frames) > 1 else 0
        if start < latest.span[1] - delay and not any(a <= start and end <= b for a, b in twice):
            what = f"begins before {latest.findings.path.name} of the same node ends"
            advice = "move the one away that does not belong here"
            file.findings.error("overlap", what, advice, time=start)
        if file.span[1] > latest.span[1]:
            latest = file


def _repeated_time_span(file: ExaminedFile) -> tuple[int, int] | None:
    """Return the time span that was repeated because the clock was set back, or None."""
    gaps = [
        gap for frames in file.frames.values() if (gap := frames.gap_before) and gap[1] < gap[0]
    ]
    if not gaps:
        return None
    return min(new for _, new in gaps) - NANOSECONDS, max(old for old, _ in gaps) + NANOSECONDS


def _check_frames(microphone: str, files: Sequence[ExaminedFile]) -> None:
    """Check that frame numbers continue from file to file, or restart at 0."""
    for earlier, file in pairwise(files):
        frames, last = file.frames[microphone], earlier.frames[microphone].last
        if frames.first is None or frames.first[0] == 0 or last is None:
            continue
        missing = frames.first[0] - last[0] - 1 - frames.lost_before
        missing -= earlier.frames[microphone].lost_behind
        if missing and not _continues(frames, [each.frames[microphone] for each in files]):
            _report_missing(microphone, earlier, file, missing)


def _continues(frames: FrameSequence, others: Sequence[FrameSequence]) -> bool:
    """Whether frames continue where any other log ends: the clock may have been set in between."""
    assert frames.first is not None
    number = frames.first[0] - frames.lost_before
    time = frames.first[1] if frames.gap_before is None else frames.gap_before[0]
    ends = (other.last for other in others if other.last is not None)
    return any(last[0] + 1 == number and abs(last[1] - time) < NANOSECONDS for last in ends)


def _report_missing(
    microphone: str, previous: ExaminedFile, file: ExaminedFile, missing: int
) -> None:
    frames, last = file.frames[microphone], previous.frames[microphone].last
    assert frames.first is not None
    assert last is not None
    if frames.gap_before is not None and abs(frames.gap_before[0] - last[1]) >= NANOSECONDS:
        when = millisecond_text(frames.gap_before[0])
        what = f"{microphone}: goes on with a log that ends at {when}, which is not here"
        advice = "the clock was set then; it was deleted, or is missing"
        file.findings.warning("missing-log", what, advice, time=frames.first[1])
        return
    elapsed = frames.first[1] - last[1]
    counted = (frames.first[0] - last[0]) * FRAME_NANOSECONDS
    name = previous.findings.path.name
    if missing > 0 and abs(elapsed - counted) <= _TOLERANCE * elapsed + FRAME_NANOSECONDS:
        what = f"{microphone}: {missing} frames between {name} and this log are in neither"
        advice = f"a log from {millisecond_text(last[1])} on is missing"
        file.findings.warning("missing-log", what, advice, time=frames.first[1])
    else:
        what = (
            f"{microphone}: begins with frame {frames.first[0]}, and {name} ends with {last[0]}; "
            f"gaps between them lost {frames.lost_before}"
        )
        advice = "one of them does not belong here, or was changed"
        file.findings.error("frames-continue", what, advice, time=frames.first[1])


def examine(
    paths: Path | Sequence[Path],
    progress: Progress = ignore_progress,
    missing: list[str] | None = None,
) -> list[Findings]:
    """Check logs, or all logs of folders and their sequence.

    There is one result for each log, in the order of the paths, intact ones too; then one for each
    file left by a killed recorder or command. Of several paths, `missing` receives the errors of
    those without a log, and the others are checked. `progress` receives the share of the bytes that
    is done, 0 to 1. Raise `LogError` if there is neither a log nor a leftover file.
    """
    paths = [paths] if isinstance(paths, Path) else paths
    logs: dict[Path, Path] = {}
    left: list[Findings] = []
    for path in paths:
        own: list[Findings] = []
        try:
            check_allowed(path)
            own = list(check_leftovers(path)) if path.is_dir() else []
            left += own
            found = find_logs(path, enrolled=True)
        except LogError as error:
            if not own and (missing is None or len(paths) == 1):
                raise
            if not own and missing is not None:
                missing.append(str(error))
            continue
        for log in found:
            logs.setdefault(log.resolve(), log)
    files = _examine_all(list(logs.values()), progress)
    check_series(files)
    return [*(file.findings for file in files), *left]


def _examine_all(logs: Sequence[Path], progress: Progress) -> list[ExaminedFile]:
    sizes = [log.stat().st_size if log.is_file() else 0 for log in logs]
    total = max(sum(sizes), 1)
    files = []
    done = 0
    for log, size in zip(logs, sizes, strict=True):

        def notify(share: float, done: int = done, size: int = size) -> None:
            progress((done + share * size) / total)

        files.append(examine_file(log, notify))
        done += size
    return files
