"""Logs and their layers: discovery, succession and coverage of time."""

import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.analyzer.logs.selection import select
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import iterate_columns
from hearthlog.schemas.logs.files import (
    REVIEW_LAYER,
    SUFFIX,
    find_logs,
    is_active,
    is_layer,
    is_log,
    log_name,
    stated_span,
    stem,
    time_span,
)
from hearthlog.schemas.logs.metadata import read_provenance
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import topic

_DAY = re.compile(r"\d{4}/\d\d/\d\d")
_DAYS = "[0-9]*/[0-9]*/[0-9]*/*"


class TimedFile(NamedTuple):
    """A log or a layer with messages."""

    path: Path
    first: int  # log times in nanoseconds
    last: int
    size: int  # stored size in bytes
    layer: str  # as `LogName.layer`


class Chain(NamedTuple):
    """The logs of a node of a home."""

    logs: Sequence[Path]  # in order of time; the last may still be written
    requested: Mapping[int, Path]  # requested logs, by position


def with_layers(path: Path) -> list[Path]:
    """List a log, then the layers next to it by name; only the folder for a folder of logs."""
    if not path.is_file():
        return [path]
    siblings = (each for each in path.parent.iterdir() if each.name.startswith(f"{stem(path)}."))
    layers = (each for each in siblings if each.name.endswith(SUFFIX) and is_log(each))
    return [path, *sorted(layers)]


def find_with_layers(paths: Iterable[Path]) -> list[Path]:
    """List logs with the layers next to them, and all logs and layers in folders.

    Raise `LogError` if there is no such log, or none in a folder.
    """
    files = (file for path in paths for each in with_layers(path) for file in find_logs(each))
    return list({file.resolve(): file for file in files}.values())


def find_timed_files(
    paths: Iterable[Path], start: int | None, end: int | None, losses: list[str]
) -> list[TimedFile]:
    """Find the logs and layers that may cover the time from `start` on, before `end`.

    Times are nanoseconds of UTC; None is no limit. Raise `LogError` if there is no such log, or
    none in a folder.
    """
    files = []
    for path in find_with_layers(paths):
        try:
            stated = stated_span(path)
            span = stated[0] if stated is not None else time_span(path)
            if span is None and stated is None:
                losses += _cut_off(path, "and nothing of it is whole")
            if span is None or (start is not None and span[1] < start):
                continue
            # A segment in the span may be logged later, so only the start of a log excludes it.
            if end is not None and span[0] >= end:
                continue
            size = path.stat().st_size
        except (LogError, OSError) as error:
            losses.append(str(error))
            continue
        if stated is None:
            losses += _cut_off(path, "read up to the last whole chunk")
        files.append(TimedFile(path, *span, size, log_name(path).layer))
    return sorted(files, key=lambda file: (file.first, file.path.name))


def _cut_off(path: Path, what: str) -> list[str]:
    """Return the loss of a truncated file; none for active logs and review layers."""
    if is_active(path) or log_name(path).layer == REVIEW_LAYER:
        return []
    with LogFile(path) as log:
        return [] if log.complete else [f"{path}: unfinished, {what}"]


def latest_records(logs: Iterable[Path]) -> Iterator[Mapping[str, str]]:
    """Yield the first `hearthlog` record of each log that has one, latest log first.

    Layers and unreadable logs are skipped.
    """
    for path in reversed(list(logs)):
        if is_layer(path):
            continue
        with suppress(LogError), LogFile(path) as file:  # reading the log will report the error
            yield from read_provenance(file)[:1]


def zone_of(paths: Iterable[Path], name: str | None) -> tzinfo:
    """Find the time zone of a home by IANA name, such as `Europe/Vienna`.

    None is for the zone recorded in the latest log with one, or UTC. Raise `DataError` if there is
    no such zone, `LogError` if there is no log.
    """
    return home_zone(name, latest_records([log for path in paths for log in find_logs(path)]))


def find_chains(paths: Iterable[Path]) -> list[Chain]:
    """Find all logs of the nodes that wrote the given logs.

    Raise `LogError` if there is no such log, or it is a layer.
    """
    requested: dict[str, Path] = {}
    for path in paths:
        if is_layer(path):
            raise LogError(f"{path}: is a layer; name the log that it speaks of")
        requested |= {str(log): log for log in find_logs(path) if not is_layer(log)}
    homes = {str(folder): folder for folder in map(home_folder, requested.values())}
    chains = []
    for root in homes.values():
        for logs in _logs_by_node(root):
            places = {i: log for i, log in enumerate(logs) if str(log) in requested}
            if places:
                chains.append(Chain(logs, places))
    return chains


def home_folder(log: Path) -> Path:
    """Return the folder of a log's home: the parent of the year folders, else the log's folder."""
    folder = log.parent
    days = "/".join(part.name for part in (folder.parent.parent, folder.parent, folder))
    return folder.parent.parent.parent if _DAY.fullmatch(days) else folder


def _logs_by_node(root: Path) -> list[list[Path]]:
    """List the logs of each node of a home, in order of time."""
    nodes: dict[str, list[tuple[str, Path]]] = {}
    for log in (*root.glob("*"), *root.glob(_DAYS)):
        if home_folder(log) == root and is_log(log) and not is_layer(log):
            name = log_name(log)
            # Labelling a log that cannot be read will report the error.
            time = name.time or f"{(readable_span([log]) or (0, 0))[0]:020}"
            nodes.setdefault(name.node, []).append((time, log))
    return [[log for _, log in sorted(logs)] for _, logs in sorted(nodes.items())]


def readable_span(logs: Iterable[Path]) -> tuple[int, int] | None:
    """Return first and last log time of the first of some logs that has a readable message."""
    for log in logs:
        with suppress(LogError):
            if (span := time_span(log)) is not None:
                return span
    return None


_KIND = "features"
_FIELDS = {"header.stamp"}
ROUNDING = 1_000_000  # ns; maximum error of times from a label file
_TAIL = 60 * NANOSECONDS


@dataclass(frozen=True)
class Coverage:
    """Recorded time of a microphone, from its frames."""

    logs: Sequence[Path]  # in order of time
    # per log, from its frames, in nanoseconds of UTC; ascending, without overlaps
    starts: Sequence[int]
    ends: Sequence[int]

    def split(self, start: int, end: int) -> list[tuple[Path, int, int]]:
        """Divide a span of time among the logs: log, start and end (nanoseconds of UTC), in order.

        Empty if more than a frame of the span is in no log.
        """
        parts: list[tuple[Path, int, int]] = []
        covered = start
        for i in range(bisect_right(self.ends, start), bisect_left(self.starts, end)):
            part = max(start, self.starts[i]), min(end, self.ends[i])
            if part[0] - covered > FRAME_NANOSECONDS:
                return []
            if part == (start, end) or part[1] - part[0] > ROUNDING:
                parts.append((self.logs[i], *part))
            covered = part[1]
        return [] if end - covered > FRAME_NANOSECONDS else parts


def find_coverage(path: Path) -> dict[str, Coverage]:
    """Find the recorded time of each microphone of a log, or of a folder of logs.

    Raise `DataError` if no microphone has features. Raise `LogError` if there is no log, or a log
    is damaged.
    """
    selection = select([path])
    coverage: dict[str, Coverage] = {}
    for name in selection.topics_of(message_types.FEATURES, _FIELDS):
        microphone = name.removeprefix("/").removesuffix(f"/{_KIND}")
        spans = sorted(_spans(selection.logs, name))
        if spans and name == topic(microphone, _KIND):
            coverage[microphone] = coverage_of(spans)
    if not coverage:
        raise DataError(f"{path}: no features of a microphone; name a log, or a folder of logs")
    return coverage


def coverage_of(spans: Sequence[tuple[int, int, Path]]) -> Coverage:
    """Build a coverage from starts and ends (nanoseconds of UTC) of the frames of logs, in order.

    The end of a log is moved to the start of the next one if the pause is at most a frame, or if
    the logs overlap.
    """
    starts = [start for start, _, _ in spans]
    ends = [end for _, end, _ in spans]
    for i, following in enumerate(starts[1:]):
        if following - ends[i] <= FRAME_NANOSECONDS:
            ends[i] = following
    return Coverage([log for _, _, log in spans], starts, ends)


def _spans(logs: Sequence[Path], name: str) -> Iterator[tuple[int, int, Path]]:
    for log in logs:
        span = time_span(log)
        first = next(_stamps(log, name), None)
        if span is None or first is None:
            continue
        tail = _stamps(log, name, span[1] - _TAIL)
        last = max(tail, default=None)
        if last is None:
            last = max(_stamps(log, name))
        yield first, last + FRAME_NANOSECONDS, log


def _stamps(log: Path, name: str, start: int | None = None) -> Iterator[int]:
    """Yield the first and the last stamp of every batch of a log."""
    for batch in iterate_columns([log], {name}, start, fields=_FIELDS):
        for columns in batch:
            yield from columns["header.stamp"][[0, -1]].tolist()
