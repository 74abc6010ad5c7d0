"""When logs begin and end: from a catalogue where one knows, else from the logs."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hearthlog.schemas.logs.files import CATALOG, find_logs
from hearthlog.schemas.logs.merged_reading import time_spans
from hearthlog.schemas.storage.byte_ranges import is_local, store_errors

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.catalog.known_files import KnownFiles

SpanOf = Callable[[Path], tuple[int, int] | None]


class LogSpan(NamedTuple):
    """A log and the log times of its first and its last message, in nanoseconds of UTC."""

    first: int
    last: int
    folder: Path
    name: str  # path within the folder, with `/`

    @property
    def path(self) -> Path:
        """The path of the log: a path costs more than all else here, so few are made."""
        return self.folder.joinpath(*self.name.split("/"))


def find_spans(paths: Iterable[Path], span_of: SpanOf) -> list[LogSpan]:
    """Find the logs of some folders, and when they begin and end.

    Parameters
    ----------
    paths : iterable of Path
        Logs, or folders of logs.
    span_of : callable
        Returns first and last log time of a log of which no catalogue knows them as it is now; None
        leaves it out.

    Returns
    -------
    list of LogSpan
        Each log once, in no order.

    Raises
    ------
    LogError
        If there is no such log, or none in a folder.
    """
    known: dict[str, LogSpan] = {}
    unknown: dict[str, Path] = {}
    for path in paths:
        files = _catalogue_of(path)
        if files is None:
            unknown |= {str(log.resolve()): log for log in find_logs(path)}
        else:
            for real, log, span in _listed(path, files):
                if span is None:
                    unknown[real] = LogSpan(0, 0, path, log).path
                else:
                    known[real] = LogSpan(*span, path, log)
    asked = [path for real, path in unknown.items() if real not in known]
    opened = time_spans(asked, span_of)
    return [
        *known.values(),
        *(LogSpan(first, last, path.parent, path.name) for first, last, path in opened),
    ]


def _catalogue_of(folder: Path) -> "KnownFiles | None":
    """Read what the catalogue of a folder knows, if it has one and there is what reads it."""
    try:
        with nullcontext() if is_local(folder) else store_errors(folder):
            exists = (folder / CATALOG).exists()
    except OSError:  # what is wrong with its name is said where its logs are listed
        return None
    if not exists:
        return None
    try:
        from hearthlog.analyzer.logs.catalog.known_files import read_known_files  # noqa: PLC0415  pyarrow is an extra
    except ModuleNotFoundError:
        return None
    return read_known_files(folder)


def _listed(folder: Path, files: "KnownFiles") -> Iterator[tuple[str, str, tuple[int, int] | None]]:
    """Yield of each log in a folder its real path, its name, and its span if that is known."""
    from hearthlog.analyzer.logs.catalog.listing import list_logs  # noqa: PLC0415  with pyarrow

    real_folder = str(folder.resolve()).rstrip("/")
    logs, spans = list_logs(folder), files.spans()
    for log, row in zip(logs, files.rows_of(logs), strict=True):
        real = f"{real_folder}/{log.name}"
        if log.is_link:
            real = str(folder.joinpath(log.name).resolve())
        yield real, log.name, None if row is None else spans[row]
