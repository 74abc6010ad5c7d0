"""Writer of a catalogue: workers take inventories of new and changed logs."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.catalog import (
    FINISHED,
    LOG,
    UNFINISHED,
    Catalog,
    CatalogRow,
    home_of,
    text_of,
)
from hearthlog.analyzer.logs.labelling import MOST_CLASSES
from hearthlog.analyzer.logs.locations import ListedLog, list_logs, size_and_time
from hearthlog.analyzer.logs.selection import decode_types, is_compatible
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, NONE, Spans, union
from hearthlog.analyzer.workers import InlineWorkers, Workers
from hearthlog.schemas.errors import HearthlogError, LogError, Progress, ignore_progress
from hearthlog.schemas.files import map_logs
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import find_logs, log_name, log_of_layer, time_span
from hearthlog.schemas.logs.metadata import read_provenance, recorded_scenarios
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    RELABEL,
    REVIEW,
    SCENARIO,
    microphone_of,
    parse_topic,
    scenario_name,
)

_FEATURES: dict[str, Sequence[str]] = {message_types.FEATURES: ("header.stamp", "frame")}
_EVENTS: dict[str, Sequence[str]] = {
    message_types.SEGMENT: ("header.stamp", "duration", "label"),
    message_types.GAP: ("duration",),
}
_OTHERS: dict[str, Sequence[str]] = dict.fromkeys(
    (message_types.STREAM_INFO, message_types.STATISTICS, message_types.LABEL), ()
)
_LONGEST = 1000  # maximum characters of a text from a log
_LAST = (1 << 63) - 1  # the largest number of a frame in a catalogue
_MOST_EVENTS = 1_000_000  # of a class in a log; a day has 8,640 at most, ten seconds apart


@dataclass
class LabelInventory:
    """Segments and events of one label."""

    segments: int = 0
    seconds: float = 0.0
    events: Spans = NONE  # of all microphones


@dataclass
class LogInventory:
    """Contents of a log."""

    complete: bool  # whether the log is finished
    span: tuple[int, int] | None  # first and last log time
    # values of the `hearthlog` records, where all records agree
    record: dict[str, str] = field(default_factory=dict)
    microphones: list[str] = field(default_factory=list)
    frames: int = 0  # number of feature messages
    # number and stamp of the first and of the last frame; None without features, or with features
    # of several microphones
    first: tuple[int, int] | None = None
    last: tuple[int, int] | None = None
    gaps: int = 0
    gap_seconds: float = 0.0
    # by scenario (empty for the sounds of the home) and by label
    labels: dict[str, dict[str, LabelInventory]] = field(default_factory=dict)


def read_contents(path: Path, labelling: str) -> LogInventory:
    """Read the inventory of a log, without decoding its features.

    Only segments of the labelling, `live`, `relabel` or `review`, and of its scenarios, are
    counted. Raise `LogError` if the log cannot be read, or a required part is damaged.
    """
    span = time_span(path)
    with LogFile(path) as file:
        contents = LogInventory(file.complete, span, _common_record(file))
        reading = _Reading(file, contents, labelling)
        if file.statistics is None:  # message counts and positions are unknown
            reading.read(file.chunks, _EVENTS | _FEATURES)
        else:
            reading.read(reading.chunks_with(_EVENTS), _EVENTS)
            reading.read(_ends(reading.chunks_with(_FEATURES)), _FEATURES)
            counts = file.statistics.channel_message_counts
            ids = reading.channels_of(_FEATURES)
            contents.frames = min(sum(counts.get(i, 0) for i in ids), file.size)
        ours = [file.channels[i].topic for i in reading.channels_of(_OTHERS | _FEATURES | _EVENTS)]
        contents.microphones = sorted({microphone_of(topic)[:_LONGEST] for topic in ours} - {""})
        if len(reading.channels_of(_FEATURES)) > 1:
            contents.first = contents.last = None
    return contents


def _common_record(file: LogFile) -> dict[str, str]:
    """Return the metadata values on which all `hearthlog` records agree."""
    values_by_name: dict[str, set[str]] = {}
    for record in read_provenance(file):
        for name, value in record.items():
            values_by_name.setdefault(name, set()).add(value[:_LONGEST])
    return {name: values.pop() for name, values in values_by_name.items() if len(values) == 1}


def _ends(chunks: NDArray[np.void]) -> NDArray[np.void]:
    """Return the first and the last of some chunks."""
    return chunks[np.unique([0, chunks["end"].argmax()])] if len(chunks) else chunks


class _Reading:
    """Reader of one log that adds its messages to an inventory."""

    def __init__(self, file: LogFile, contents: LogInventory, labelling: str) -> None:
        self._file = file
        self._contents = contents
        self._labelling = labelling

    def channels_of(self, kinds: Mapping[str, Collection[str]]) -> set[int]:
        """Return the channels of some types with the required fields."""
        schemas = self._file.schemas
        return {
            number
            for number, channel in self._file.channels.items()
            if any(
                is_compatible(channel, schemas.get(channel.schema_id), *k) for k in kinds.items()
            )
        }

    def chunks_with(self, kinds: Mapping[str, Collection[str]]) -> NDArray[np.void]:
        """Return the chunks with messages of some types."""
        return self._file.with_channels(self._file.chunks, self.channels_of(kinds))

    def read(self, chunks: NDArray[np.void], types: Mapping[str, Collection[str]]) -> None:
        """Read chunks in batches, and add their messages of some types to the inventory."""
        topics = None
        if self._file.statistics is not None:
            topics = {self._file.channels[i].topic for i in self.channels_of(types)}
        for batch in read_in_batches(self._file, chunks, topics):
            for columns in decode_types(self._file.path, batch, types):
                self._note(columns)

    def _note(self, columns: Columns) -> None:
        if columns.type == message_types.FEATURES:
            self._note_features(columns)
        elif columns.type == message_types.GAP:
            self._contents.gaps += len(columns)
            self._contents.gap_seconds += float(columns["duration"].sum(dtype=float)) / NANOSECONDS
        else:
            topic = parse_topic(columns.topic)
            root = "" if topic is None else topic.labelling.partition("/")[0]
            is_own = (LIVE if root == SCENARIO else root) == self._labelling
            if topic is not None and topic.kind == "segment" and is_own:
                self._note_segments(columns, scenario_name(topic.labelling))

    def _note_features(self, columns: Columns) -> None:
        ends = columns.take(np.array([0, len(columns) - 1]))
        numbers = np.minimum(ends["frame"], np.uint64(_LAST)).tolist()
        pairs = zip(numbers, ends["header.stamp"].tolist(), strict=True)
        first, self._contents.last = pairs
        self._contents.first = self._contents.first or first
        self._contents.frames += len(columns)

    def _note_segments(self, columns: Columns, scenario: str) -> None:
        labelled = self._contents.labels.setdefault(scenario, {})
        starts, ends = columns["header.stamp"], columns["header.stamp"] + columns["duration"]
        labels, numbers = np.unique(columns["label"], return_inverse=True)
        seconds = np.bincount(numbers, columns["duration"] / NANOSECONDS).tolist()
        for number, label in enumerate(labels.tolist()):
            rows = numbers == number
            own = labelled.setdefault(label[:_LONGEST], LabelInventory())
            own.segments += int(rows.sum())
            own.seconds += seconds[number]
            own.events = union(own.events, Spans(starts[rows], ends[rows]), pause=EVENT_PAUSE)
        if len(self._contents.labels) > MOST_CLASSES:
            raise LogError(f"{self._file.path}: has more than {MOST_CLASSES} scenarios")
        if any(len(own.events.starts) > _MOST_EVENTS for own in labelled.values()):
            raise LogError(
                f"{self._file.path}: has more than {_MOST_EVENTS} events of a label; no recorder "
                "writes so many"
            )
        if len(labelled) > MOST_CLASSES:
            raise LogError(
                f"{self._file.path}: has more than {MOST_CLASSES} different labels; "
                "no classifier has so many"
            )


def read_rows(folder: Path, names: Sequence[str]) -> list[CatalogRow]:
    """Build the catalogue rows of some files: the task of a worker."""
    paths = [folder.joinpath(*name.split("/")) for name in names]
    rows = map_logs(partial(_read_row, folder), paths)
    return [row for row in rows if row is not None]


def _read_row(folder: Path, path: Path) -> CatalogRow | None:
    """Build the row of a file; None if the file no longer exists."""
    name = log_name(path)
    kind = name.layer.partition("-")[0]
    if kind not in {RELABEL, REVIEW}:  # audio layers are no labelling
        kind = LOG
    try:
        size, mtime = size_and_time(path)
    except LogError:
        return None
    row = CatalogRow(
        path=path.relative_to(folder).as_posix(),
        home=home_of(path.parent.relative_to(folder).as_posix()),
        node=text_of(name.node) or None,
        kind=kind,
        log=None if kind == LOG else text_of(log_of_layer(path).name),
        size=size,
        mtime=mtime,
    )
    try:
        return _filled(row, read_contents(path, LIVE if kind == LOG else kind))
    except LogError as error:
        if not path.exists():  # a recorder finished and renamed the file
            return None
        return replace(row, error=str(error).removeprefix(f"{path}: "))


def _filled(row: CatalogRow, contents: LogInventory) -> CatalogRow:
    """Return the row with the inventory added."""
    record = {name: value for name, value in contents.record.items() if value}
    start, end = contents.span or (None, None)
    first, last = contents.first or (None, None), contents.last or (None, None)
    names = "feature_set", "model", "model_sha256", "input_sha256", "version"
    own: dict[str, Any] = {name: record.get(name) for name in names}
    return replace(
        row,
        **own,
        node=record.get("node", row.node),
        state=FINISHED if contents.complete else UNFINISHED,
        microphones=contents.microphones,
        start=start,
        end=end,
        frames=contents.frames,
        first_frame=first[0],
        first_stamp=first[1],
        last_frame=last[0],
        last_stamp=last[1],
        gaps=contents.gaps,
        gap_seconds=contents.gap_seconds,
        labels=list(_labels(contents, "")),
        scenarios=[
            {"scenario": scenario, "model": _model(record, scenario), **labelled}
            for scenario in sorted(contents.labels.keys() - {""})
            for labelled in _labels(contents, scenario)
        ],
    )


def _labels(contents: LogInventory, scenario: str) -> Iterator[dict[str, Any]]:
    for label, own in sorted(contents.labels.get(scenario, {}).items()):
        yield {
            "label": label,
            "minutes": own.seconds / 60,
            "segments": own.segments,
            "events": len(own.events.starts),
            "first": int(own.events.starts[0]),
            "last": int(own.events.ends[-1]),
        }


def _model(record: Mapping[str, str], scenario: str) -> str:
    """Return the models of a scenario, of all microphones, comma-separated; empty for a person."""
    models = {one.model for one in recorded_scenarios(record) if one.name == scenario}
    return ", ".join(sorted(models))


_TASK = 100  # files per task


def write_catalog(
    folder: Path,
    before: Catalog | None = None,
    progress: Progress = ignore_progress,
    workers: Workers | None = None,
) -> Catalog:
    """Build the catalogue of a folder, and replace the changed parts of an older one.

    Unchanged files of `before` are not read again, except damaged ones. `progress` receives the
    share of the files that is done, 0 to 1. Raise `LogError` if there is no log, or the catalogue
    cannot be written; `WorkerError` if workers are lost, or `KeyboardInterrupt` if interrupted: the
    catalogue then has the files read so far.
    """
    listing = list_logs(folder)
    if not listing.logs:
        find_logs(folder)  # raises the error with its reason
    catalog = Catalog(folder)
    if before is not None:
        before.database.backup(catalog.database)
    new = catalog.keep(listing)
    kept = len(listing.logs) - len(new)
    stopped: BaseException | None = None
    try:
        for rows, done in _read(folder, new, workers or InlineWorkers()):
            catalog.add(rows)
            progress((kept + done) / len(listing.logs))
    except (KeyboardInterrupt, HearthlogError) as error:
        stopped = error
        catalog.forget_times()
    catalog.write()
    if stopped is not None:
        raise stopped
    return catalog


def _read(
    folder: Path, logs: Sequence[ListedLog], workers: Workers
) -> Iterable[tuple[list[CatalogRow], int]]:
    """Yield the rows of files in batches, with the number of files done."""
    tasks = (logs[first : first + _TASK] for first in range(0, len(logs), _TASK))
    running: dict[Future[list[CatalogRow]], int] = {}
    done = 0
    while True:
        most = 2 * workers.parallel if workers.parallel > 1 else 1  # keeps all workers busy
        while len(running) < most and (task := next(tasks, None)):
            names = [log.name for log in task]
            running[workers.submit(read_rows, folder, names)] = len(names)
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            done += running.pop(future)
            yield future.result(), done
