"""One file, from its first byte to its last."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Footer

from hearthlog.analyzer.doctor.findings import RECOVER, REINDEX, Findings
from hearthlog.analyzer.doctor.frame_sequence import Frames
from hearthlog.analyzer.doctor.mcap.batch import Batch
from hearthlog.analyzer.doctor.mcap.byte_source import Source
from hearthlog.analyzer.doctor.mcap.data_section import Data
from hearthlog.analyzer.doctor.mcap.summary_section import Summary
from hearthlog.analyzer.doctor.mcap.walk import Walk
from hearthlog.analyzer.doctor.message_checks import ALWAYS, NAME, Contract, place_of
from hearthlog.analyzer.doctor.metadata_checks import About
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import decode
from hearthlog.schemas.logs.provenance import METADATA, provenance_records, unknown_version
from hearthlog.schemas.mcap.formats import FOOTER_SIZE, HEAD, MAGIC
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile
from hearthlog.schemas.mcap.records import parse
from hearthlog.schemas.progress import Progress, ignore_progress

LIBRARY = "hearthlog"
_LAYER = re.compile(r".+_\d{8}T\d{6}Z\.[^.]+\.mcap(\.active)?")
_ENCODINGS = ("ros2msg", "ros2idl")


@dataclass
class Examined:
    """What one file was found to be.

    Attributes
    ----------
    findings : Findings
    ours : bool
        Whether it is a log of hearthlog, and no layer beside one.
    node : str
    span : tuple of int, or None
        First and last log time.
    frames : dict of str to Frames
        By microphone.
    """

    findings: Findings
    ours: bool = False
    node: str = ""
    span: tuple[int, int] | None = None
    frames: dict[str, Frames] = field(default_factory=dict)


def examine_file(path: Path, progress: Progress = ignore_progress) -> Examined:
    """Check one file against the specification of MCAP and, if it is ours, against the contract.

    Parameters
    ----------
    path : Path
    progress : callable
        Told the share of the file that was read.
    """
    examined = Examined(Findings(path))
    try:
        with Source(path) as source:
            _examine(source, examined, progress)
    except OSError as error:
        examined.findings.error("unreadable", f"cannot be read ({error.strerror})")
    return examined


class _Known(NamedTuple):
    """What can be known of a file before it is read from its beginning.

    Attributes
    ----------
    places : list of int
        Offsets of records, ascending.
    summary_start : int
        0 if there is no summary.
    ours : bool
    """

    places: list[int]
    summary_start: int
    ours: bool


def _examine(source: Source, examined: Examined, progress: Progress) -> None:
    findings = examined.findings
    active = findings.path.name.endswith(ACTIVE_SUFFIX)
    magic = source.take(len(MAGIC))
    if magic != MAGIC and not (active and MAGIC.startswith(magic)):
        findings.error("magic", "is no MCAP file: it does not begin as one")
        return
    finished = source.size > len(MAGIC) and source.at(source.size - len(MAGIC), 8) == MAGIC
    known = _known(findings.path, source)
    data = Data(findings, ours=known.ours)
    contract = Contract(data, findings) if known.ours else _Plain(data, findings)
    walk = Walk(source, findings, known.places, finished=finished)
    complete = _walk(walk, data, contract, known, lambda offset: progress(offset / source.size))
    if complete:
        _check_end(source, findings)
    elif finished:
        findings.error("footer", "there is no Footer at the end", RECOVER)
    else:
        _say_unfinished(findings, active=active)
    for text in {unknown_version(record) for record in data.metadata.get(METADATA, [])} - {""}:
        findings.warning("newer", text)
    if isinstance(contract, Contract):
        contract.finish()
        whole = data.whole and not walk.damaged
        About(data, contract, findings, finished=complete, whole=whole).check()
        examined.ours, examined.frames = True, contract.frames
        about = data.metadata.get(METADATA, [{}])[0]
        examined.node = about.get("node", "")
    examined.span = data.span


def _known(path: Path, source: Source) -> _Known:
    """Look at the index of a file, as far as it has one."""
    start = 0
    tail = source.at(max(source.size - FOOTER_SIZE, 0), FOOTER_SIZE)
    if tail[:1] == bytes([Opcode.FOOTER]) and tail.endswith(MAGIC):
        footer = parse(Opcode.FOOTER, tail[HEAD.size :])
        assert isinstance(footer, Footer)
        start = footer.summary_start
    try:
        with LogFile(path) as file:
            ours = _is_ours(file)
            places = file.chunks["offset"].tolist()
            places += [location.offset for location in file.record_locations]
    except LogError:
        places, ours = [], False
    if HEAD.size < start < source.size:
        places += [start]
    return _Known(sorted(places), start, ours)


def _is_ours(file: LogFile) -> bool:
    """Tell whether a recorder wrote this file, and not what merges logs or cuts parts out."""
    if _LAYER.fullmatch(file.path.name):
        return False
    records = provenance_records(file)
    made = file.header is not None and file.header.library == LIBRARY
    if NAME.fullmatch(file.path.name):
        return made or len(records) > 0
    kinds = {place_of(channel.topic)[1] for channel in file.channels.values()}
    part = bool(file.channels) and not kinds >= ALWAYS
    return (made or len(records) > 0) and len(records) < 2 and not part


def _walk(
    walk: Walk, data: Data, contract: "Contract | _Plain", known: _Known, at: Callable[[int], None]
) -> bool:
    """Go through all records; tell whether the last one is a footer."""
    summary: Summary | None = None
    losses = 0
    for record in walk:
        if walk.losses > losses:
            losses = walk.losses
            _hand_on([*data.finish(cut=True), None], contract)
        if (
            summary is None
            and not data.ended
            and (record.opcode == Opcode.FOOTER or record.offset == known.summary_start)
        ):
            what = "the data section has no Data End"
            data.findings.error("data-end", what, REINDEX, offset=record.offset)
            data.ended = True
        if summary is None and data.ended:
            _hand_on(data.finish(cut=False), contract)
            summary = Summary(data, data.findings, whole=data.whole and not walk.damaged)
        if summary is None:
            _hand_on(data.add(record), contract)
            at(record.offset)
        elif record.opcode == Opcode.FOOTER:
            summary.finish(record)
            return True
        else:
            summary.add(record)
    _hand_on(data.finish(cut=True), contract)
    return False


def _hand_on(batches: "Iterable[Batch | None]", contract: "Contract | _Plain") -> None:
    for batch in batches:
        if batch is None:
            contract.interrupt()
        else:
            contract.add(batch)


def _check_end(source: Source, findings: Findings) -> None:
    offset = source.offset
    rest = source.size - offset
    if source.take(len(MAGIC)) != MAGIC:
        findings.error("magic", "the Footer is not followed by the magic", REINDEX, offset=offset)
    elif rest > len(MAGIC):
        what = f"{rest - len(MAGIC)} bytes follow the end"
        findings.error("after-end", what, REINDEX, offset=offset + len(MAGIC))


def _say_unfinished(findings: Findings, *, active: bool) -> None:
    if active:
        advice = "unless a recorder is writing it, `hearthlog recover` completes it"
        findings.warning("unfinished", "is unfinished", advice)
    else:
        what = "is unfinished: it was cut off"
        findings.error("cut", what, "`hearthlog recover` completes it")


class _Plain:
    """The messages of a file that is not ours: they must be of the types that it says."""

    def __init__(self, data: Data, findings: Findings) -> None:
        self._data = data
        self._findings = findings

    def add(self, batch: Batch) -> None:
        """Take the next messages of the file."""
        definitions = self._data.definitions
        for raw in batch.by_channel(definitions.channels, definitions.schemas):
            if raw.channel.message_encoding != "cdr":
                continue
            if raw.schema is None or raw.schema.encoding not in _ENCODINGS:
                continue
            try:
                decode([raw])
            except LogError as error:
                what = f"cannot be read: {error}"
                self._findings.error("cdr", what, time=int(raw.log_times[0]))

    def interrupt(self) -> None:
        """Take note that messages are missing here."""
