"""Which logs, and which layers beside them, a span of time is in."""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import tzinfo
from pathlib import Path

from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import find_logs, is_layer, is_log, stem
from hearthlog.schemas.logs.provenance import read_provenance
from hearthlog.schemas.mcap.logfile import LogFile, time_span


@dataclass(frozen=True)
class File:
    """A log or a layer that has messages in the span that is wanted.

    Attributes
    ----------
    path : Path
    first, last : int
        Log times in nanoseconds.
    size : int
        Bytes, as stored.
    layer : bool
    """

    path: Path
    first: int
    last: int
    size: int
    layer: bool


def find_files(
    paths: Iterable[Path], start: int | None, end: int | None, losses: list[str]
) -> list[File]:
    """Look into logs and layers, in the order of time; those that cannot be read are lost."""
    names = {path.resolve(): path for given in paths for path in _with_layers(given)}
    files = []
    for path in names.values():
        try:
            span = time_span(path)
            if span is None or (start is not None and span[1] < start):
                continue
            # What ends in the span may be logged later, so only the start of a log excludes it.
            if end is not None and span[0] >= end:
                continue
            size = path.stat().st_size
        except (LogError, OSError) as error:
            losses.append(str(error))
            continue
        files.append(File(path, *span, size, is_layer(path)))
    return sorted(files, key=lambda file: (file.first, file.path.name))


def metadata_of(file: LogFile) -> Mapping[str, str]:
    """Return what a log says of itself."""
    return next(iter(read_provenance(file)), {})


def _with_layers(path: Path) -> list[Path]:
    """List logs, and the layers beside one that is named by itself."""
    found = find_logs(path)
    if found != [path] or is_layer(path):
        return found
    beside = path.parent.glob(f"{_escaped(stem(path))}.*.mcap")
    return [path, *sorted(filter(is_log, beside))]


def _escaped(name: str) -> str:
    return re.sub(r"([*?[])", r"[\1]", name)


def zone_of(paths: Iterable[Path], wanted: str | None) -> tzinfo:
    """Find the time zone of a home, without reading more of its logs than it takes.

    Raises
    ------
    DataError
        If there is no such zone.
    LogError
        If there is no log.
    """
    return home_zone(wanted, records_of(log for path in paths for log in find_logs(path)))


def records_of(paths: Iterable[Path]) -> Iterator[Mapping[str, str]]:
    """Yield what logs say of themselves, the latest first."""
    for path in reversed(list(paths)):
        if not is_layer(path):
            with suppress(LogError), LogFile(path) as file:
                yield metadata_of(file)
