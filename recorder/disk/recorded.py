"""What a recorder has left in its folder, by the names of the files, without following links."""

import os
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX, is_layer, log_name
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX

KEEP_SUFFIX = ".keep"  # of a file beside a log that is not to be deleted
THINNING_SUFFIX = ".thinning"  # of a thinner copy of a log in the making
_TIME = "%Y%m%dT%H%M%SZ"
_DAY = 86_400 * NANOSECONDS
# A clock that was never set says 1970, or when its system was made.
_NO_EARLIER = int(datetime(2024, 1, 1, tzinfo=UTC).timestamp()) * NANOSECONDS


class RecordedLog(NamedTuple):
    """A finished log of a node, and the layers beside it.

    Attributes
    ----------
    start : int
        By its name, in nanoseconds of UTC.
    size : int
        Bytes on the disk, of all of them.
    """

    path: Path
    start: int
    layers: tuple[Path, ...]
    size: int
    locked: bool

    @property
    def by_age(self) -> tuple[bool, int, str]:
        """Sorts from old to new; what was recorded without a clock counts as new."""
        return self.start < _NO_EARLIER, self.start, self.path.name


class RecordedDays:
    """The days on which something was recorded: the clock of retention.

    A clock that is wrong makes days that hold little, and never makes what was recorded older than
    the days on which the recorder ran.

    Parameters
    ----------
    starts : iterable of int
        Of logs, in nanoseconds of UTC.
    """

    def __init__(self, starts: Iterable[int]) -> None:
        self._days = sorted({start // _DAY for start in starts if start >= _NO_EARLIER})

    def since(self, start: int) -> int:
        """Count the days with sound after the day of a time.

        Returns
        -------
        int
            0 for the last day, and for a time that no clock can have said.
        """
        if start < _NO_EARLIER:
            return 0
        return len(self._days) - bisect_right(self._days, start // _DAY)


def walk(root: Path, failures: list[OSError]) -> Iterator[tuple[Path, list[str]]]:
    """Go through the folders of a recorder's days."""
    for folder, folders, files in os.walk(root, onerror=failures.append):
        folders[:] = [each for each in folders if each.isdigit()]
        yield Path(folder), files


def start_of(name: str, node: str) -> int | None:
    """Return when a log or a layer of a node began, by its name.

    Returns
    -------
    int or None
        In nanoseconds of UTC; None if the file is no log of this node.
    """
    parts = log_name(Path(name))
    match = re.fullmatch(r"(\d{8}T\d{6}Z)(?:_\d+)?", parts.time)
    if parts.node != node or match is None:
        return None
    try:
        moment = datetime.strptime(match[1], _TIME).replace(tzinfo=UTC)
    except ValueError:  # digits, but not a time
        return None
    return int(moment.timestamp()) * NANOSECONDS


def recorded_days(root: Path, node: str) -> RecordedDays:
    """Find the days on which a node has recorded."""
    names = (name for _, files in walk(root, []) for name in files)
    ours = (start_of(name, node) for name in names if name.endswith((SUFFIX, ACTIVE_SUFFIX)))
    return RecordedDays(start for start in ours if start is not None)


def recorded_logs(root: Path, node: str, failures: list[OSError]) -> list[RecordedLog]:
    """Find the finished logs of a node."""
    logs = []
    for folder, files in walk(root, failures):
        names = set(files)
        layers: dict[str, list[Path]] = {}
        for name in sorted(files):
            if name.endswith(SUFFIX) and is_layer(path := folder / name):
                layers.setdefault(log_name(path).log, []).append(path)
        for name in files:
            start = start_of(name, node)
            path = folder / name
            if start is None or not name.endswith(SUFFIX) or is_layer(path) or path.is_symlink():
                continue
            own = tuple(layers.get(name.removesuffix(SUFFIX), ()))
            size = sum(map(_size, (path, *own)))
            logs.append(RecordedLog(path, start, own, size, name + KEEP_SUFFIX in names))
    return sorted(logs, key=lambda log: log.by_age)


def _size(path: Path) -> int:
    with suppress(OSError):
        return path.lstat().st_blocks * 512
    return 0
