"""Check one file, from its first byte to its last."""

import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode

from hearthlog.analyzer.doctor.findings import DISTRUST, RECOVER, REINDEX, Findings
from hearthlog.analyzer.doctor.frame_sequence import FrameSequence
from hearthlog.analyzer.doctor.mcap.byte_source import ByteSource
from hearthlog.analyzer.doctor.mcap.checked_definitions import ROS_ENCODINGS
from hearthlog.analyzer.doctor.mcap.data_section import DataSection
from hearthlog.analyzer.doctor.mcap.message_batch import MessageBatch
from hearthlog.analyzer.doctor.mcap.record_walk import RecordWalk
from hearthlog.analyzer.doctor.mcap.summary_section import SummarySection
from hearthlog.analyzer.doctor.message_checks import MessageChecks
from hearthlog.analyzer.doctor.metadata_checks import ATTACHMENTS, MetadataChecks
from hearthlog.analyzer.doctor.topic_types import ALWAYS, LOG_NAME, split_topic
from hearthlog.schemas.errors import HearthlogWarning, LogError, Progress, ignore_progress
from hearthlog.schemas.logs.columns import decode, faults, unreadable
from hearthlog.schemas.logs.contents import CONTENTS_METADATA as CONTENTS
from hearthlog.schemas.logs.contents import LogContents, stated_contents
from hearthlog.schemas.logs.metadata import HEARTHLOG_METADATA, provenance_records, unknown_version
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA as ROSBAG2
from hearthlog.schemas.logs.writer import ENCODING
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.mcap.records import FOOTER_SIZE, HEAD, MAGIC, not_mcap, read_footer

LIBRARY = "hearthlog"
_LAYER = re.compile(r".+_\d{8}T\d{6}Z\.[^.]+\.mcap(\.active)?")
_MOST_WRONG = 20_000  # faults of a channel that are unlike, before the rest is passed over
_KEPT = {HEARTHLOG_METADATA, ROSBAG2, CONTENTS, *ATTACHMENTS}


@dataclass
class ExaminedFile:
    """A file that was checked."""

    findings: Findings
    ours: bool = False  # whether it is a log of hearthlog, and no layer beside one
    node: str = ""
    span: tuple[int, int] | None = None  # first and last log time, in nanoseconds
    frames: dict[str, FrameSequence] = field(default_factory=dict)  # by microphone


def examine_file(path: Path, progress: Progress = ignore_progress) -> ExaminedFile:
    """Check one file against the specification of MCAP and, if it is ours, docs/log.md.

    Parameters
    ----------
    progress : callable, optional
        Is told the share of the bytes that is done, 0 to 1.
    """
    examined = ExaminedFile(Findings(path))
    try:
        with ByteSource(path) as source:
            _examine(source, examined, progress)
    except OSError as error:
        examined.findings.error("unreadable", f"cannot be read ({error.strerror})")
    return examined


class _Outline(NamedTuple):
    """What the index of a file tells before the file is read from its beginning."""

    offsets: list[int]  # bytes at which records begin, ascending
    summary_start: int  # 0 if there is no summary
    ours: bool  # whether a recorder of hearthlog wrote the file


def _examine(source: ByteSource, examined: ExaminedFile, progress: Progress) -> None:
    findings = examined.findings
    active = findings.path.name.endswith(ACTIVE_SUFFIX)
    magic = source.take(len(MAGIC))
    if magic != MAGIC and not (active and MAGIC.startswith(magic)):
        what = not_mcap(source.at(0, 2 * len(MAGIC)))
        if what == not_mcap(b""):
            what = f"{what}: it does not begin as one"
        findings.error("magic", what)
        return
    finished = source.size > len(MAGIC) and source.tail(len(MAGIC)) == MAGIC
    outline = _outline(findings.path, source)
    data = DataSection(findings, _KEPT, source.size, ours=outline.ours)
    checks = MessageChecks(data, findings) if outline.ours else ForeignMessages(data, findings)
    walk = RecordWalk(source, findings, outline.offsets, finished=finished)
    complete = _walk(walk, data, checks, outline, lambda offset: progress(offset / source.size))
    if complete:
        _check_end(source, findings)
    elif finished:
        findings.error("footer", "there is no Footer at the end", RECOVER)
    else:
        _report_unfinished(findings, active=active)
    for text in {
        unknown_version(record) for record in data.metadata.get(HEARTHLOG_METADATA, [])
    } - {""}:
        findings.warning("newer", text)
    if isinstance(checks, MessageChecks):
        checks.finish()
        whole = data.whole and not walk.damaged
        MetadataChecks(data, checks, findings, finished=complete, whole=whole).check()
        examined.ours, examined.frames = True, checks.frames
        examined.node = data.metadata.get(HEARTHLOG_METADATA, [{}])[0].get("node", "")
    if CONTENTS in data.metadata and complete and data.whole and not walk.damaged:
        _check_contents(findings)
    examined.span = data.span


def _outline(path: Path, source: ByteSource) -> _Outline:
    """Read the index of a file, as far as it has one."""
    footer = read_footer(source.tail(FOOTER_SIZE))
    start = 0 if footer is None else footer.summary_start
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HearthlogWarning)  # the checks tell more of it
            file = LogFile(path)
        with file:
            ours = _is_ours(file)
            offsets = file.chunks["offset"].tolist()
            offsets += [location.offset for location in file.record_locations]
    except LogError:
        offsets, ours = [], False
    if HEAD.size < start < source.size:
        offsets += [start]
    return _Outline(sorted(offsets), start, ours)


def _is_ours(file: LogFile) -> bool:
    """Tell whether a recorder wrote this file, and not what merges logs or cuts parts out."""
    if _LAYER.fullmatch(file.path.name):
        return False
    records = provenance_records(file)
    is_made = file.header is not None and file.header.library == LIBRARY
    if LOG_NAME.fullmatch(file.path.name):
        return is_made or len(records) > 0
    kinds = {split_topic(channel.topic)[1] for channel in file.channels.values()}
    is_part = bool(file.channels) and not kinds >= ALWAYS
    return (is_made or len(records) > 0) and len(records) < 2 and not is_part


def _walk(
    walk: RecordWalk,
    data: DataSection,
    checks: "MessageChecks | ForeignMessages",
    outline: _Outline,
    at: Callable[[int], None],
) -> bool:
    """Go through all records; tell whether the last one is a footer."""
    summary: SummarySection | None = None
    losses = 0
    for record in walk:
        if walk.losses > losses:
            losses = walk.losses
            data.definitions.incomplete |= walk.skipped
            _hand_on([*data.finish(cut=True), None], checks)
        if (
            summary is None
            and not data.ended
            and (record.opcode == Opcode.FOOTER or record.offset == outline.summary_start)
        ):
            what = "the data section has no Data End"
            data.findings.error("data-end", what, REINDEX, offset=record.offset)
            data.ended = True
        if summary is None and data.ended:
            _hand_on(data.finish(cut=False), checks)
            summary = SummarySection(data, data.findings, whole=data.whole and not walk.damaged)
        if summary is None:
            _hand_on(data.add(record), checks)
            at(record.offset)
        elif record.opcode == Opcode.FOOTER:
            summary.finish(record)
            return True
        else:
            summary.add(record)
    _hand_on(data.finish(cut=True), checks)
    return False


def _hand_on(
    batches: Iterable[MessageBatch | None], checks: "MessageChecks | ForeignMessages"
) -> None:
    for batch in batches:
        if batch is None:
            checks.interrupt()
        else:
            checks.add(batch)


def _check_end(source: ByteSource, findings: Findings) -> None:
    offset = source.offset
    rest = source.size - offset
    if source.take(len(MAGIC)) != MAGIC:
        findings.error("magic", "the Footer is not followed by the magic", REINDEX, offset=offset)
    elif rest > len(MAGIC):
        what = f"{rest - len(MAGIC)} bytes follow the end"
        findings.error("after-end", what, REINDEX, offset=offset + len(MAGIC))


def _check_contents(findings: Findings) -> None:
    """Compare what the file says of its messages with what they say."""
    try:
        with LogFile(findings.path) as file:
            stated, actual = stated_contents(file), LogContents()
            for batch in read_in_batches(file, file.chunks):
                actual.add(batch)
    except LogError:
        return  # is reported already
    if stated is None:
        what = f"metadata {CONTENTS} is damaged, or of other messages"
        findings.warning("contents", what, "it is not read: the messages tell what is in the file")
    elif differing := stated.differing(actual):
        what = f"metadata {CONTENTS} says otherwise than the messages: {', '.join(differing)}"
        findings.error("contents", what, DISTRUST)


def _report_unfinished(findings: Findings, *, active: bool) -> None:
    if active:
        advice = "unless a recorder is writing it, `hearthlog recover` completes it"
        findings.warning("unfinished", "is unfinished", advice)
    else:
        what = "is unfinished: it was cut off"
        findings.error("cut", what, "`hearthlog recover` completes it")


class ForeignMessages:
    """Checks that the messages of a file that is not ours are of the types that it names."""

    def __init__(self, data: DataSection, findings: Findings) -> None:
        self._data = data
        self._findings = findings
        self._wrong: Counter[int] = Counter()  # faults that are unlike, by channel

    def add(self, batch: MessageBatch) -> None:
        """Decode the next messages of the file, and report what cannot be decoded."""
        definitions = self._data.definitions
        for raw in batch.by_channel(definitions.channels, definitions.schemas):
            if self._wrong[raw.channel.id] > _MOST_WRONG:
                continue
            if raw.channel.message_encoding != ENCODING:
                continue
            if raw.schema is None or raw.schema.encoding not in ROS_ENCODINGS:
                continue
            if unreadable(raw.channel, raw.schema):
                continue  # which is said of its definition
            try:
                decode([raw])
            except LogError as error:
                self._report(raw, error)

    def _report(self, raw: RawMessages, error: LogError) -> None:
        """Report the messages that are not of their type, or else texts that are not UTF-8."""
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
        """Note that messages are missing here, which makes no difference."""
