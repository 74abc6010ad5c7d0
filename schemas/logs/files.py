"""Log files `<logs>/YYYY/MM/DD/<node>_YYYYMMDDTHHMMSSZ.mcap` (UTC) and their time spans."""

import os
import re
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from hearthlog.schemas.errors import HearthlogWarning, LogError, abridged
from hearthlog.schemas.files import (
    LocalFile,
    StoredFile,
    denied_text,
    is_denied,
    is_local,
    may_be_regular,
    open_regular,
    store_errors,
)
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, LogFile, open_log
from hearthlog.schemas.mcap.raw_messages import iterate_records
from hearthlog.schemas.mcap.records import (
    COMPRESSED_SUFFIXES,
    FOOTER,
    FOOTER_SIZE,
    HEAD,
    LAST_TIME,
    LIMIT,
    OTHER_SUFFIXES,
    SUMMARY_OFFSET,
    not_mcap,
    parse,
    read_footer,
)
from hearthlog.schemas.new_files import readers_of

SUFFIX = ".mcap"
AUDIO_LAYER, REVIEW_LAYER = "audio", "review"
RELABEL_LAYER = "relabel-"  # followed by the name of a model
AUDIO_SUFFIX = f".{AUDIO_LAYER}{SUFFIX}"
_NAME = re.compile(rf"(.+?)(?:\.({RELABEL_LAYER}.+|{REVIEW_LAYER}|{AUDIO_LAYER}))?", re.DOTALL)
_RECORDED = re.compile(r"(.+)_(\d{8}T\d{6}Z.*)", re.DOTALL)
CATALOG = "catalog.sqlite"  # in the folder of its logs
ENROLLED = "enrolled"  # folder of training sounds among the logs of a home
_MOST_ENTRIES = 1000  # maximum number of entries inspected in a folder without logs
CUT = "_cut"  # ends the name, without suffix, of a file cut from a log


def check_node_name(name: str) -> str:
    """Return the name of a node if it is valid at the start of a file name on all systems.

    Raise `LogError` if it is not at most 64 letters, digits, '-' and '_', a letter or digit first.
    """
    if not is_node_name(name):
        raise LogError(
            f"node name {name!r} cannot be part of a file name: use at most 64 letters, digits, "
            "'-' and '_'"
        )
    return name


def is_node_name(name: str) -> bool:
    """Return whether a name passes `check_node_name`."""
    return re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name) is not None


def log_path(root: Path, node: str, start: int) -> Path:
    """Return the path of the log of a node that starts at a time."""
    moment = datetime.fromtimestamp(start // NANOSECONDS, UTC)
    return root / f"{moment:%Y/%m/%d}" / f"{node}_{moment:%Y%m%dT%H%M%SZ}{SUFFIX}"


def free_log_path(root: Path, node: str, start: int) -> Path:
    """Return an unused path for the log of a node that starts at a time."""
    path = first = log_path(root, node, start)
    for number in count(2):
        if not (path.exists() or active_path(path).exists()):
            break
        path = first.with_name(f"{stem(first)}_{number}{SUFFIX}")  # '_' sorts behind '.'
    return path


def log_readers(folder: Path) -> int:
    """Return the group and other read permissions of new logs in a folder, as `readers_of` does."""
    if not (is_local(folder) and folder.is_dir()):
        return 0
    years = [each for each in folder.iterdir() if re.fullmatch(r"\d{4}", each.name, re.ASCII)]
    return readers_of(max(years)) if years else 0


def active_path(path: Path) -> Path:
    """Return the path of a log while it is being written."""
    return path.with_name(path.name.removesuffix(SUFFIX) + ACTIVE_SUFFIX)


class LogName(NamedTuple):
    """Parts of the file name of a log or a layer."""

    log: str  # name of the log without suffix; for a layer, the name of its log
    layer: str  # `audio`, `review` or `relabel-<model>`; empty for a log
    node: str  # empty if the name is not a recorder's
    time: str  # `20260301T120000Z` with an optional ending; empty like `node`


def log_name(path: Path) -> LogName:
    """Split the name of a log or a layer into its parts."""
    parts = _NAME.fullmatch(stem(path))
    if parts is None:  # only a suffix
        return LogName("", "", "", "")
    log, layer = parts.groups("")
    recorded = _RECORDED.fullmatch(log)
    return LogName(log, layer, *(recorded.groups() if recorded else ("", "")))


def audio_path(log: Path) -> Path:
    """Return the path of the layer with the audio clips of a log."""
    return log.with_name(stem(log) + AUDIO_SUFFIX)


def review_path(log: Path) -> Path:
    """Return the path of the review layer of a log."""
    return log.with_name(f"{stem(log)}.{REVIEW_LAYER}{SUFFIX}")


def relabel_path(log: Path, model: str) -> Path:
    """Return the path of the layer with a model's labels of a log."""
    return log.with_name(f"{stem(log)}.{RELABEL_LAYER}{model}{SUFFIX}")


def log_of_layer(layer: Path) -> Path:
    """Return the path of the finished log of a layer."""
    return layer.with_name(log_name(layer).log + SUFFIX)


def stem(log: Path) -> str:
    """Return the file name of a log without its suffix."""
    return log.name.removesuffix(ACTIVE_SUFFIX).removesuffix(SUFFIX)


def is_active(path: Path) -> bool:
    """Return whether a log is still being written, judged by its name."""
    return path.name.endswith(ACTIVE_SUFFIX)


def is_layer(path: Path) -> bool:
    """Return whether a log is a layer of another log, judged by its name."""
    return bool(log_name(path).layer)


def is_log(path: Path) -> bool:
    """Return whether a path is a regular file with the name of a log or a layer.

    In a store only the name is checked.
    """
    named = path.name.endswith((SUFFIX, ACTIVE_SUFFIX))
    return named and (not is_local(path) or may_be_regular(path))


def find_logs(path: Path, *, enrolled: bool = False) -> list[Path]:
    """List logs and layers, also active ones, in a folder, recursively, or one log; sorted by name.

    Training sounds in folders `enrolled` are only included on request. Unreadable logs in the
    folder are skipped with a `HearthlogWarning`. Raise `LogError` if there is no log, this user may
    not read it, the path is a pipe, a socket or a device, or the store of the path cannot be used.
    """
    every = _find_local(path) if is_local(path) else _find_stored(path)
    depth = len(path.parts)
    logs = [log for log in every if enrolled or ENROLLED not in log.parts[depth:-1]]
    if not logs:
        raise LogError(
            f"{path}: no log (*{SUFFIX}) in this folder but enrolled sounds; name their folder "
            f"{ENROLLED!r} to read those"
        )
    return logs


def check_allowed(path: Path) -> None:
    """Raise `LogError` if this user may not read a log, or list a folder; a missing path passes."""
    if is_local(path) and is_denied(path):
        raise LogError(f"{path}: {denied_text(path)}")


def _find_local(path: Path) -> list[Path]:
    check_allowed(path)
    if path.is_dir():
        denied: list[str] = []
        compressed: list[str] = []
        logs: list[str] = []
        for entry in walk_logs(path, denied, compressed):
            allowed = os.access(entry.path, os.R_OK) or not is_denied(entry.path)
            (logs if allowed else denied).append(entry.path)
        if denied and not logs:
            raise LogError(f"{path}: what is in it {denied_text(denied[0])}")
        if denied:
            text = f"{len(denied)} of its files and folders, left out, {denied_text(denied[0])}"
            warnings.warn(HearthlogWarning(text, path), stacklevel=3)
        if not logs:
            raise LogError(f"{path}: no log (*{SUFFIX}) in this folder{_others_in(path)}")
        _warn_of_compressed(path, compressed)
        return sorted(map(Path, logs))
    if not path.exists():
        raise LogError(f"{path}: no such log")
    if not may_be_regular(path):
        raise LogError(f"{path}: cannot be read (Not a regular file)")
    return [path]


def _warn_of_compressed(folder: Path, names: Sequence[str]) -> None:
    """Warn of skipped logs that are compressed files."""
    if names:
        text = f"compressed as a whole, and left out: {abridged(sorted(names), 5)}; unpack first"
        warnings.warn(HearthlogWarning(text, folder, each=True), stacklevel=4)


def _others_in(folder: Path) -> str:
    """Return the name of a log in another format in a folder without logs."""
    entries = islice(folder.rglob("*"), _MOST_ENTRIES)
    for other in sorted(entry for entry in entries if entry.suffix in OTHER_SUFFIXES):
        with suppress(OSError), os.fdopen(open_regular(other), "rb") as stream:
            return f": {other.name} {not_mcap(stream.read(16))}"
    return ""


def walk_logs(
    folder: Path, denied: list[str] | None = None, compressed: list[str] | None = None
) -> Iterator["os.DirEntry[str]"]:
    """List the logs in a local folder, unordered, except in linked and unreadable folders."""
    waiting = [os.fspath(folder)]
    while waiting:
        inside = look_into(path := waiting.pop())
        waiting += [entry.path for entry in inside.folders]
        yield from inside.logs
        if compressed is not None:
            compressed += inside.compressed
        if denied is not None and not inside.is_all and is_denied(path):
            denied.append(path)


class Inside(NamedTuple):
    """Content of a local folder."""

    folders: list["os.DirEntry[str]"]
    logs: list["os.DirEntry[str]"]
    compressed: list[str]
    # whether any change of the content changes the folder itself. Targets of links may change
    # elsewhere
    is_all: bool


def look_into(folder: str) -> Inside:
    """List the subfolders and logs of one local folder."""
    folders: list[os.DirEntry[str]] = []
    named: list[os.DirEntry[str]] = []
    compressed: list[str] = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry)
                elif entry.name.endswith((SUFFIX, ACTIVE_SUFFIX)):
                    named.append(entry)
                elif entry.name.endswith(COMPRESSED_SUFFIXES):
                    compressed.append(entry.name)
        is_all = not any(entry.is_symlink() for entry in named)
    except OSError:  # ignored, as by Path.rglob
        is_all = False
    logs = [
        entry
        for entry in named
        if entry.is_file() or not os.path.exists(entry)  # noqa: PTH110  avoids a Path per file
    ]
    return Inside(folders, logs, compressed, is_all)


def _find_stored(path: Any) -> list[Path]:
    """List the logs under a prefix in a store, in which folders are parts of names."""
    with store_errors(path):
        names = path.fs.find(path.path)
    if names == [path.path]:
        return [path]
    logs = [name for name in names if name.endswith((SUFFIX, ACTIVE_SUFFIX))]
    if not logs:
        raise LogError(f"{path}: no log (*{SUFFIX}) under this name")
    compressed = [name for name in names if name.endswith(COMPRESSED_SUFFIXES)]
    _warn_of_compressed(path, [name.rpartition("/")[2] for name in compressed])
    return [path.with_segments(path.fs.unstrip_protocol(name)) for name in sorted(logs)]


_SIZE_LIMIT = 1 << 20  # maximum bytes of the records of one kind


def time_span(path: Path, *, partial: bool = False) -> tuple[int, int] | None:
    """Return a log's first and last log time in nanoseconds of UTC; None without messages.

    Raise `LogError` if the log cannot be read, is not an MCAP file, or is damaged.
    """
    stated = stated_span(path)
    if stated is not None:
        return stated[0]
    with LogFile(path, partial=partial) as log:
        return log.span


def stated_span(path: Path) -> tuple[tuple[int, int] | None] | None:
    """Return the result of `time_span` in a tuple, from the log's statistics only.

    None if the log is unfinished or its index is damaged: only a scan finds its span. Raise
    `LogError` if the log cannot be read.
    """
    try:
        _, opened = open_log(path)
        with closing(opened) as file:
            statistics = _statistics(file) if _is_summary_sound(file) else None
    except (McapError, UnicodeDecodeError, struct.error):
        return None
    if statistics is None:
        return None
    times = statistics.message_start_time, statistics.message_end_time
    if max(times) > LAST_TIME:
        return None
    return (times if statistics.message_count else None,)


def topic_counts(path: Path) -> Counter[str]:
    """Return the number of messages by topic from the statistics of a finished log.

    It is limited per channel to the size of the log in bytes. Empty if the log has no statistics,
    they are damaged, or it cannot be read.
    """
    topics: Counter[str] = Counter()
    with suppress(LogError, McapError, UnicodeDecodeError, struct.error):
        _, opened = open_log(path)
        with closing(opened) as file:
            statistics = _statistics(file)
            counts = {} if statistics is None else statistics.channel_message_counts
            for channel in _summary_group(file, Opcode.CHANNEL):
                if isinstance(channel, records.Channel):
                    most = file.size  # each message takes more than one byte
                    topics[channel.topic] += min(counts.get(channel.id, 0), most)
    return topics


def _is_summary_sound(file: LocalFile | StoredFile) -> bool:
    """Verify the checksum of the summary of a finished log, if there is one."""
    end = file.size - FOOTER_SIZE
    footer = read_footer(file.read(max(end, 0), FOOTER_SIZE))
    if footer is None or not footer.summary_crc:
        return True
    start = footer.summary_start
    if not 0 < start <= end or end - start > LIMIT:
        return False
    summary = file.read(start, end - start + HEAD.size + FOOTER.size)
    return zlib.crc32(summary) == footer.summary_crc


def _statistics(file: LocalFile | StoredFile) -> records.Statistics | None:
    """Read the statistics of a finished log, without the rest of its index."""
    for record in _summary_group(file, Opcode.STATISTICS):
        if isinstance(record, records.Statistics):
            return record
    return None


def _summary_group(file: LocalFile | StoredFile, opcode: int) -> list[McapRecord | None]:
    """Read the records of one kind in the summary of a finished log."""
    end = max(file.size - FOOTER_SIZE, 0)
    footer = read_footer(file.read(end, FOOTER_SIZE))
    if footer is None:
        return []
    size = end - footer.summary_offset_start
    if not footer.summary_offset_start or not 0 <= size <= _SIZE_LIMIT:
        return []
    offsets = file.read(footer.summary_offset_start, size)
    for group, start, length in SUMMARY_OFFSET.iter_unpack(offsets):
        if group == opcode and length <= _SIZE_LIMIT and start < end:
            raw = file.read(start, length)
            return [parse(kind, raw[a + HEAD.size : b]) for kind, a, b in iterate_records(raw)]
    return []
