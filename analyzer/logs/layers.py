"""Which logs there are of a home, and of which time each of them may speak, by their names."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, tzinfo
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labelling import with_layers
from hearthlog.analyzer.logs.local_time import day_span, local_time
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import find_logs, is_layer, stem
from hearthlog.schemas.logs.provenance import read_provenance
from hearthlog.schemas.mcap.logfile import LogFile, time_span
from hearthlog.schemas.times import NANOSECONDS

REVIEW, RELABEL = "review", "relabel-"
_NAME = re.compile(
    r"(?P<node>.+?)(?:_(?P<start>\d{8}T\d{6})Z)?(?:\.(?P<layer>relabel-.+|review))?", re.DOTALL
)
_NEVER = 1 << 62
_TAIL = 60 * NANOSECONDS  # of a day that may be missing from a whole one


class Entry(NamedTuple):
    """A log or a layer.

    Attributes
    ----------
    path : Path
    node : str
    layer : str
        Empty for a log, else `review` or `relabel-<model>`.
    start, end : int
        What it says is of this span (ns of UTC); what ends later may have begun in it.
    """

    path: Path
    node: str
    layer: str
    start: int
    end: int


@dataclass(frozen=True)
class Shelf:
    """The logs of a home with their layers, in the order of time.

    Attributes
    ----------
    entries : list of Entry
    losses : list of str
        What cannot be read, and why.
    """

    entries: Sequence[Entry]
    losses: Sequence[str]

    def between(self, start: int, end: int, layer: str = "") -> list[Entry]:
        """List the logs, or the layers of one name, that may speak of a span of time."""
        return [e for e in self.entries if e.layer == layer and e.start < end and e.end > start]

    @property
    def layers(self) -> list[str]:
        """Names of the models that have relabelled logs."""
        found = {entry.layer for entry in self.entries}
        return sorted(layer.removeprefix(RELABEL) for layer in found if layer.startswith(RELABEL))

    def records(self) -> Iterator[Mapping[str, str]]:
        """Go through the `hearthlog` records of the logs, the last log first."""
        for entry in reversed(self.between(0, _NEVER)):
            try:
                found = _record(entry.path)
            except LogError:
                continue  # it is named when it is read
            if found is not None:
                yield found
                return

    def days(self, zone: tzinfo) -> list[date]:
        """List the days on which there are logs."""
        found = {local_time(entry.start, zone).date() for entry in self.between(0, _NEVER)}
        end = self.end()
        if end is not None:
            found.add(local_time(end - 1, zone).date())
        return sorted(found)

    def last_whole_day(self, zone: tzinfo) -> date:
        """Return the last day that the logs reach beyond, or the last one if there is none."""
        days = self.days(zone)
        if not days:
            raise LogError(self.losses[0] if self.losses else "there is no message in these logs")
        end = self.end() or 0
        whole = [day for day in days if day_span(day, zone)[1] - _TAIL <= end]
        return whole[-1] if whole else days[-1]

    def end(self) -> int | None:
        """Return the log time of the last message of the logs."""
        for entry in reversed(self.between(0, _NEVER)):
            try:
                span = time_span(entry.path)
            except LogError:
                continue
            if span is not None:
                return span[1]
        return None


def find_shelf(paths: Iterable[Path]) -> Shelf:
    """Look which logs there are, by their names; only others are opened.

    Raises
    ------
    LogError
        If there is none.
    """
    found = {
        log.resolve(): log
        for path in paths
        for each in with_layers(path)
        for log in find_logs(each)
    }
    losses: list[str] = []
    entries = []
    for path in found.values():
        try:
            entry = _entry(path)
        except LogError as error:
            losses.append(str(error))
            continue
        if entry is not None:
            entries.append(entry)
    return Shelf(sorted(_closed(entries), key=lambda entry: (entry.start, entry.path.name)), losses)


def days_in_words(days: Sequence[date]) -> str:
    """Name days, those that follow each other as one: `2026-03-01 to 2026-03-04, 2026-03-09`."""
    numbered = enumerate(days)
    runs = [list(run) for _, run in groupby(numbered, lambda pair: pair[1].toordinal() - pair[0])]
    texts = [f"{run[0][1]}" if len(run) == 1 else f"{run[0][1]} to {run[-1][1]}" for run in runs]
    return ", ".join(texts[-5:]) if len(texts) <= 5 else f"{texts[0]} … {', '.join(texts[-4:])}"


def check_day(shelf: Shelf, first: date, last: date, zone: tzinfo) -> None:
    """Raise DataError unless there is a log on one of some days."""
    days = shelf.days(zone)
    if any(first <= day <= last for day in days):
        return
    when = f"{first}" if first == last else f"{first} to {last}"
    there = f"there are {days_in_words(days)}" if days else "nor of any other day"
    loss = f"; {shelf.losses[0]}" if shelf.losses else ""
    raise DataError(f"no logs of {when} in the home's time zone, {zone}; {there}{loss}")


def _entry(path: Path) -> Entry | None:
    """Tell by its name what a file is; None if there is nothing in it."""
    match = _NAME.fullmatch(stem(path))
    assert match is not None
    layer = match["layer"] or ""
    if not layer and is_layer(path):
        return None  # of sound
    try:
        moment = datetime.strptime(match["start"] or "", "%Y%m%dT%H%M%S").replace(tzinfo=UTC)
        return Entry(path, match["node"], layer, int(moment.timestamp()) * NANOSECONDS, _NEVER)
    except ValueError:
        span = time_span(path)
        return None if span is None else Entry(path, "", layer, span[0], span[1] + 1)


def _closed(entries: Iterable[Entry]) -> Iterator[Entry]:
    """End each log where the next one of its kind begins."""
    by_kind: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        by_kind.setdefault((entry.node, entry.layer), []).append(entry)
    for same in by_kind.values():
        same.sort(key=lambda entry: entry.start)
        starts = sorted({entry.start for entry in same})
        following = dict(zip(starts, [*starts[1:], _NEVER], strict=True))
        for entry in same:
            yield entry if entry.end < _NEVER else entry._replace(end=following[entry.start])


def _record(path: Path) -> Mapping[str, str] | None:
    with LogFile(path) as file:
        return next(iter(read_provenance(file)), None)
