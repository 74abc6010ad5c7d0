"""When logs begin and end: from the index of a catalogue where one knows, else from the logs."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.listing import list_logs, size_and_time
from hearthlog.analyzer.logs.span_index import NEVER, SpanIndex, read_index
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.merged_reading import time_spans

SpanOf = Callable[[Path], tuple[int, int] | None]
LogSpan = tuple[int, int, Path]  # log times of the first and the last message (ns of UTC), the log


class _Known(NamedTuple):
    """Logs of a folder of which the index of its catalogue knows the spans."""

    folder: Path
    by: SpanIndex
    logs: Int64

    def path(self, number: int) -> Path:
        return self.by.path(self.folder, int(self.logs[number]))


class LogSpans:
    """The spans of many logs: a path costs more than all else here, so few are made."""

    def __init__(self, opened: Sequence[LogSpan], known: Sequence[_Known]) -> None:
        self._opened = opened
        self._known = known
        spans = [each.by.spans[each.logs] for each in known]
        firsts, lasts = [first for first, _, _ in opened], [last for _, last, _ in opened]
        self._firsts: Int64 = np.concatenate(
            [np.array(firsts, np.int64), *(s["start"] for s in spans)]
        )
        self._lasts: Int64 = np.concatenate([np.array(lasts, np.int64), *(s["end"] for s in spans)])
        self._begins = np.cumsum([len(opened), *(len(each.logs) for each in known)])

    def within(self, start: int | None, end: int | None) -> list[LogSpan]:
        """Return the logs with messages in a span of time, each once, in the order of time."""
        return self._in_time(np.flatnonzero(overlaps(self._firsts, self._lasts, start, end)))

    def before(self, time: int) -> Iterator[Path]:
        """Return the logs with messages before a time, each once, the last first."""
        numbers = np.flatnonzero(self._firsts < time)
        order = numbers[np.lexsort((self._lasts[numbers], self._firsts[numbers]))[::-1]]
        for _, same in groupby(order, lambda number: (self._firsts[number], self._lasts[number])):
            yield from (path for _, _, path in reversed(self._in_time(sorted(same))))

    def _in_time(self, numbers: Iterable[int]) -> list[LogSpan]:
        spans = ((int(self._firsts[n]), int(self._lasts[n]), self._path(n)) for n in numbers)
        once = {str(span[2].resolve()): span for span in spans}  # a log may have several names
        # Paths of this machine and of a store do not compare; their parts do.
        return sorted(once.values(), key=lambda span: (*span[:2], span[2].parts))

    def _path(self, number: int) -> Path:
        group = int(np.searchsorted(self._begins, number, side="right"))
        if group == 0:
            return self._opened[number][2]
        return self._known[group - 1].path(number - int(self._begins[group - 1]))


def overlaps(firsts: Int64, lasts: Int64, start: int | None, end: int | None) -> Bool:
    """Tell of spans of time whether they have a part in another one."""
    chosen = np.ones(len(firsts), bool)
    if start is not None:
        chosen &= lasts >= start
    if end is not None:
        chosen &= firsts < end
    return chosen


def find_spans(
    paths: Iterable[Path], span_of: SpanOf, start: int | None = None, end: int | None = None
) -> LogSpans:
    """Find the logs of some folders, and when they begin and end.

    Parameters
    ----------
    span_of : callable
        Returns first and last log time of a log of which no catalogue knows them as it is now; None
        leaves it out.
    start, end : int, optional
        Log times in nanoseconds of UTC, from `start` on, before `end`: of finished logs outside of
        them the catalogue is believed.

    Raises
    ------
    LogError
        If there is no such log, or none in a folder.
    """
    known: list[_Known] = []
    unknown: dict[str, Path] = {}
    for path in paths:
        index = read_index(path)
        if index is None:
            logs = find_logs(path)
        else:
            found, logs = _looked_up(path, index, start, end)
            known.append(found)
        unknown |= {str(log.resolve()): log for log in logs}
    return LogSpans(time_spans(unknown.values(), span_of), known)


def _looked_up(
    folder: Path, index: SpanIndex, start: int | None, end: int | None
) -> tuple[_Known, list[Path]]:
    """Divide the logs of a folder into those whose spans are known, and those to be asked."""
    listing = list_logs(folder, index.folders)
    logs = index.logs_in(listing.unchanged)
    spans = index.spans[logs]
    timed = spans["start"] != NEVER
    doubtful = timed & (overlaps(spans["start"], spans["end"], start, end) | ~spans["finished"])
    known: list[int] = logs[timed & ~doubtful].tolist()
    asked = [index.path(folder, log) for log in logs[~timed].tolist()]
    for log in logs[doubtful].tolist():
        path = index.path(folder, log)
        if _is_current(index, log, path):
            known.append(log)
        else:
            asked.append(path)
    for listed in listing.logs:
        found = index.find(listed)
        if found is None or index.spans["start"][found] == NEVER:
            asked.append(folder.joinpath(*listed.name.split("/")))
        else:
            known.append(found)
    return _Known(folder, index, np.array(known, np.int64)), asked


def _is_current(index: SpanIndex, log: int, path: Path) -> bool:
    try:
        return index.is_as(log, *size_and_time(path))
    except LogError:
        return False
