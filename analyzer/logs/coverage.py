"""Coverage: when a microphone was recording, log by log."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.selection import select
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import iterate_columns
from hearthlog.schemas.logs.files import time_span
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import topic

_KIND = "features"
_FIELDS = {"header.stamp"}
ROUNDING = 1_000_000  # ns; times that passed through a label file are off by up to this
_TAIL = 60 * NANOSECONDS


@dataclass(frozen=True)
class Coverage:
    """When a microphone was recording, by its frames."""

    logs: Sequence[Path]  # in the order of time
    # of the frames of each, in nanoseconds of UTC; they ascend, and do not overlap
    starts: Sequence[int]
    ends: Sequence[int]

    def split(self, start: int, end: int) -> list[tuple[Path, int, int]]:
        """Divide a span of time among the logs.

        Returns
        -------
        list of (Path, int, int)
            Log, start and end (nanoseconds of UTC) of each part, in the order of time. Empty if
            more than a frame of the span is in no log.
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
    """Find when each microphone of a log, or of a folder of logs, was recording.

    Raise `DataError` if there are no features of a microphone. Raise `LogError` if there is no
    log, or one is damaged.
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
    """Make a coverage from the spans of logs.

    A log that ends no more than a frame before the next one begins, or after that, gets the end
    at which the next one begins.

    Parameters
    ----------
    spans : sequence of (int, int, Path)
        Start and end (nanoseconds of UTC) of the frames of each log, in the order of time.
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
