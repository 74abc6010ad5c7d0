"""A catalogue is made, or brought up to date: what changed is read, by workers."""

from collections.abc import Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from hearthlog.analyzer.logs.catalog.catalog import DAMAGED, FINISHED, Catalog
from hearthlog.analyzer.logs.catalog.file import SCHEMA
from hearthlog.analyzer.logs.catalog.parts import divided, write_parts
from hearthlog.analyzer.logs.catalog.rows import read_rows
from hearthlog.analyzer.logs.listing import ListedLog, list_logs
from hearthlog.analyzer.logs.span_index import NEVER, SPAN, write_index
from hearthlog.analyzer.workers.workers import InlineWorkers, Workers
from hearthlog.schemas.errors import HearthlogError, Progress, ignore_progress
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX

_TASK = 100  # files


def write_catalog(
    folder: Path,
    before: Catalog | None = None,
    progress: Progress = ignore_progress,
    workers: Workers | None = None,
) -> Catalog:
    """Make the catalogue of a folder, and replace those parts of an older one that changed.

    Parameters
    ----------
    before : Catalog, optional
        What there is: files that are as it says are not read again, damaged ones excepted. By
        default all files are read.
    progress : callable, optional
        Is told the share of the files that is done, 0 to 1.

    Raises
    ------
    LogError
        If there is no log, or the catalogue cannot be written.
    WorkerError
        If workers are lost; the catalogue then has what was read so far.
    KeyboardInterrupt
        If interrupted; the catalogue then has what was read so far.
    """
    listing = list_logs(folder)
    listed = listing.logs
    kept, new = _divided(listed, before)
    rows = pa.array(kept, pa.int64())
    tables = [SCHEMA.empty_table() if before is None else before.table.take(rows)]
    stopped: BaseException | None = None
    try:
        for read, done in _read(folder, new, workers or InlineWorkers()):
            tables.append(read)
            progress((len(kept) + done) / len(listed))
    except (KeyboardInterrupt, HearthlogError) as error:
        stopped = error
    parts = dict(divided(pa.concat_tables(tables)))
    old = {} if before is None else dict(divided(before.table))
    write_parts(folder, parts, old)
    ordered = [parts[name] for name in sorted(parts)]
    catalog = Catalog(folder, pa.concat_tables([SCHEMA.empty_table(), *ordered]))
    write_index(folder, listing, _spans(listed, catalog))
    if stopped is not None:
        raise stopped
    return catalog


def _spans(listed: Sequence[ListedLog], catalog: Catalog) -> NDArray[np.void]:
    """Tell the spans of files as they were listed; what was not read, or was changed, has none."""
    numbers = catalog.files.rows_of(listed)
    read = [place for place, number in enumerate(numbers) if number is not None]
    rows = catalog.table.take(pa.array((n for n in numbers if n is not None), pa.int64()))
    spans = np.full(len(listed), NEVER, SPAN)
    for name in ("start", "end", "size", "mtime"):
        spans[name][read] = pc.fill_null(rows[name].cast(pa.int64()), NEVER).to_numpy()
    spans["finished"] = [not log.name.endswith(ACTIVE_SUFFIX) for log in listed]
    spans["finished"][read] &= pc.equal(rows["state"], FINISHED).to_numpy()
    return spans


def _divided(
    listed: Sequence[ListedLog], before: Catalog | None
) -> tuple[list[int], list[ListedLog]]:
    """Tell which rows are still true, and which files are to be read."""
    if before is None:
        return [], list(listed)
    kept: list[int] = []
    new: list[ListedLog] = []
    damaged = np.array(before.table["state"].to_pylist()) == DAMAGED
    for log, number in zip(listed, before.files.rows_of(listed), strict=True):
        # What could not be read then may be readable now, though the file is the same.
        if number is None or damaged[number]:
            new.append(log)
        else:
            kept.append(number)
    return kept, new


def _read(
    folder: Path, logs: Sequence[ListedLog], workers: Workers
) -> Iterable[tuple[pa.Table, int]]:
    """Yield the rows of files, some at a time, and how many files are done."""
    tasks = (logs[first : first + _TASK] for first in range(0, len(logs), _TASK))
    running: dict[Future[pa.Table], int] = {}
    done = 0
    while True:
        most = 2 * workers.parallel if workers.parallel > 1 else 1  # no worker waits for the next
        while len(running) < most and (task := next(tasks, None)):
            names = [log.name for log in task]
            running[workers.submit(read_rows, folder, names)] = len(names)
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            done += running.pop(future)
            yield future.result(), done
