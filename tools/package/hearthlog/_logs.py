"""Logs as arrays, tables, segments and marks: `open_logs` and `follow`."""

import warnings
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cached_property
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import require
from hearthlog.analyzer.export.exporter import (
    MOST_COLUMNS,
    Table,
    one_table,
    table_of,
    tables_of,
    with_numbers,
)
from hearthlog.analyzer.logs.labelling import Labelling, Labellings, find_labellings
from hearthlog.analyzer.logs.layers import with_layers
from hearthlog.analyzer.logs.selection import (
    Damages,
    LogSelection,
    TypedColumns,
    array_names,
    decode_all,
    select,
)
from hearthlog.analyzer.logs.sound_vectors import Bearings, as_vectors, mean_bearings
from hearthlog.analyzer.marks.marks import Mark, read_marks
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.logs import follow as growing
from hearthlog.schemas.logs.columns import Columns, decode, join, read_columns
from hearthlog.schemas.logs.files import is_layer
from hearthlog.schemas.messages.cdr_codec import ragged
from hearthlog.schemas.messages.fields import DURATION, TIME, Field
from hearthlog.schemas.messages.message_types import PACKAGE
from hearthlog.schemas.messages.topics import microphone_of

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

__all__ = ["Bearings", "Columns", "Labelling", "Logs", "Mark", "follow", "open_logs"]


class Logs:
    """A log or a folder of logs with their layers, as returned by `open_logs`.

    All times are integers: nanoseconds of UTC since 1970. A topic without messages in the time span
    is read as a table without rows.

    Attributes
    ----------
    path : Path
        Path of the log or the folder.
    start, end : int or None
        Time span to read, as log times: from `start` on, before `end`; None for no limit.
    """

    def __init__(self, path: Path, start: int | None = None, end: int | None = None) -> None:
        self.path = path
        self.start = start
        self.end = end
        self._selection = select(with_layers(path), (), start, end)

    @property
    def paths(self) -> list[Path]:
        """Logs and layers with messages in the time span, in order of time."""
        return list(self._selection.logs)

    @property
    def topics(self) -> dict[str, str]:
        """Topics of these logs and layers, with their message types."""
        channels = self._selection.channels
        named = {topic: schema for topic, same in channels.items() for _, schema in same}
        return {topic: schema.name if schema else "" for topic, schema in sorted(named.items())}

    @property
    def microphones(self) -> list[str]:
        """Names of the microphones."""
        ours = (topic for topic, kind in self.topics.items() if kind.startswith(f"{PACKAGE}/"))
        return sorted({microphone_of(topic) for topic in ours})

    @property
    def span(self) -> tuple[int, int]:
        """Log times of the first and the last message."""
        return self._selection.span

    @property
    def labellings(self) -> dict[str, list[str]]:
        """Names of the labellings of each microphone, for `segments`."""
        named = {name: self._labellings.names(name) for name in self.microphones}
        return {name: names for name, names in named.items() if names}

    def columns(self, topic: str, fields: Collection[str] | None = None) -> Columns:
        """Read a topic as numpy arrays, one row per message.

        Parameters
        ----------
        topic : str
            One of `topics`, or a topic of another time span.
        fields : collection of str, optional
            Paths of the fields to read, such as `header.stamp`; all by default.

        Returns
        -------
        Columns

        Raises
        ------
        LogError
            If there is no such topic.

        Warns
        -----
        HearthlogWarning
            If a damaged chunk is skipped.

        Examples
        --------
        >>> features = hearthlog.open_logs("logs").columns("/mic/features")
        >>> features["values"].shape, features["values"].dtype
        ((3600, 33), dtype('float32'))
        """
        selection = self._select(topic)
        damages = Damages()
        span = self.start, self.end
        columns = read_columns(selection.logs, [topic], *span, fields, on_damage=damages.add)
        damages.warn_of_more()
        return columns[topic] if columns else join(decode(selection.no_messages(), fields))

    def arrow(self, topic: str) -> "pa.Table":
        """Read a topic as an Arrow table, with the same columns as `hearthlog export` to Parquet.

        Parameters
        ----------
        topic : str
            As in `columns`.

        Returns
        -------
        pyarrow.Table
            A field that only some definitions of the type have is null in the other messages, with
            a `HearthlogWarning`.

        Raises
        ------
        LogError
            If there is no such topic, or the topic has several types, or a field changed its type
            so that no column holds all of its values.
        HearthlogError
            If pyarrow is not installed; also a `ModuleNotFoundError`.

        Examples
        --------
        >>> table = hearthlog.open_logs("logs").arrow("/mic/segment")
        >>> table.schema.field("header.stamp").type, table.schema.field("duration").type
        (TimestampType(timestamp[ns, tz=UTC]), DurationType(duration[ns]))
        """
        table = _optional("pyarrow").Table
        from hearthlog.analyzer.export.arrow import batch_of, schema_of  # noqa: PLC0415  an extra

        selection = self._select(topic)
        only, batches = _read_table(selection)
        schema = schema_of(only, selection)
        return table.from_batches([batch_of(pieces, only, schema) for pieces in batches], schema)

    def pandas(self, topic: str) -> "pd.DataFrame":
        """Read a topic as a DataFrame, with a column for each element of an array.

        Parameters
        ----------
        topic : str
            As in `columns`.

        Returns
        -------
        pandas.DataFrame
            One row per message; the index is the log time, of type `datetime64[ns, UTC]`. Elements
            of arrays are named as in the log (`values.energy`, `probabilities.speech`), else by
            number (`values.0`); an image, or another array of more than 4096 elements without
            names, is one column. A field that only some definitions of the type have is
            missing in the other messages, with a `HearthlogWarning`.

        Raises
        ------
        LogError
            If there is no such topic.
        HearthlogError
            If pandas is not installed; also a `ModuleNotFoundError`.

        Examples
        --------
        >>> day = hearthlog.open_logs("logs").pandas("/mic/features")
        >>> day["values.energy"].dtype, int(day["header.stamp"].diff().max().total_seconds() * 1000)
        (dtype('float32'), 50)
        """
        pandas = _optional("pandas")
        table, batches = _read_table(self._select(topic))
        parts = [piece.columns for pieces in batches for piece in pieces]
        required = [path for path in table.fields if path not in table.optional]
        columns = join([with_numbers(part, table, required) for part in parts])
        series: dict[str, Any] = {}
        for path, field in table.fields.items():
            if path in columns.fields:
                series |= _series(pandas, columns, path, field)
                continue
            having = [part for part in parts if path in part.fields]
            rows = np.flatnonzero(np.concatenate([[path in p.fields] * len(p) for p in parts]))
            if having:
                some = _series(
                    pandas, join([with_numbers(p, table, [path]) for p in having]), path, field
                )
                series |= {
                    name: _with_missing(pandas.Series(values), rows, len(columns))
                    for name, values in some.items()
                }
        index = pandas.to_datetime(columns.log_times, unit="ns", utc=True).rename("log_time")
        frame = pandas.DataFrame(series, index, copy=False)
        return frame if index.is_monotonic_increasing else frame.sort_index(kind="stable")

    def segments(self, labelling: str = "live", microphone: str | None = None) -> Labelling:
        """Read the labelled time spans of a recorder, a relabelling or a reviewer.

        Parameters
        ----------
        labelling : str
            `live`, `review`, the name of a model, or `relabel` if there is only one.
        microphone : str, optional
            Name of the microphone; by default the only microphone.

        Returns
        -------
        Labelling
            In order of time; no two segments overlap.

        Raises
        ------
        DataError
            If there is no such labelling, or there are several microphones.
        LogError
            If there is no segment in the time span.

        Warns
        -----
        HearthlogWarning
            If a damaged log is skipped.

        Examples
        --------
        >>> spans = hearthlog.open_logs("logs").segments()
        >>> spans.labels[0], float(spans.ends[0] - spans.starts[0]) / 1e9
        ('silence', 3.7)
        """
        microphone = self._labellings.microphone(microphone)
        name = self._labellings.find(microphone, labelling)
        segments = self._labellings.read(microphone, name, self.start, self.end).labelling
        for loss in self._labellings.losses:
            warnings.warn(HearthlogWarning(loss, self.path), stacklevel=2)
        return segments

    def directions(self, labelling: str = "live", microphone: str | None = None) -> Bearings:
        """Compute the direction of the sound of each segment, for a microphone array.

        Parameters
        ----------
        labelling, microphone : str, optional
            As in `segments`.

        Returns
        -------
        Bearings
            One row per segment of `segments`.

        Raises
        ------
        DataError
            As `segments` does.
        LogError
            As `segments` does; if there is no topic `/<microphone>/direction`.

        Examples
        --------
        >>> import math
        >>> came = hearthlog.open_logs("array").directions()
        >>> round(math.degrees(came.azimuths[came.counts > 0][0]))
        45
        """
        segments = self.segments(labelling, microphone)
        name = self._labellings.microphone(microphone)
        fields = "header.stamp", "azimuth", "confidence"
        columns = self.columns(f"/{name}/direction", fields)
        vectors = as_vectors(columns["azimuth"], columns["confidence"])
        return mean_bearings(columns["header.stamp"], vectors, segments.starts, segments.ends)

    def marks(self, scenario: str = "") -> list[Mark]:
        """Read the marks with which reviewers corrected labels.

        Parameters
        ----------
        scenario : str, optional
            Name of a scenario, to read its marks instead of the marks of the home's sounds.

        Returns
        -------
        list of Mark
            Marks that begin or end in the time span, or last all through it; in order of start.

        Raises
        ------
        LogError
            If a review layer is damaged.

        Examples
        --------
        >>> [(mark.label, mark.reviewer) for mark in hearthlog.open_logs("logs").marks()]
        [('coughing', 'ada')]
        """
        logs = [path for path in self.paths if not is_layer(path)]
        marks = [mark for path in logs for mark in read_marks(path, scenario)]
        marks = [mark for mark in marks if self.start is None or mark.end > self.start]
        marks = [mark for mark in marks if self.end is None or mark.start < self.end]
        return sorted(marks, key=attrgetter("start"))

    @cached_property
    def _labellings(self) -> Labellings:
        return find_labellings(self.path)

    def _select(self, topic: str) -> LogSelection:
        """Select one topic, which may have messages only outside the time span."""
        selection = self._selection
        if topic not in selection.channels:
            selection = replace(selection, channels=select(with_layers(self.path)).channels)
        if topic not in selection.channels:
            there = ", ".join(sorted(selection.channels)) or "none"
            raise LogError(f"{self.path}: no topic {topic}; there are {there}")
        return selection.only([topic]).decodable()


def open_logs(path: Path | str, start: int | None = None, end: int | None = None) -> Logs:
    """Open a log or a folder of logs.

    Parameters
    ----------
    path : Path or str
        Logs in a folder may lie at any depth. The layers next to a log are included.
    start, end : int, optional
        Log times in nanoseconds of UTC: from `start` on, before `end`.

    Returns
    -------
    Logs

    Raises
    ------
    LogError
        If there is no log, or no part of the logs can be read.

    Examples
    --------
    >>> logs = hearthlog.open_logs("logs")
    >>> logs.microphones, logs.labellings
    (['mic'], {'mic': ['live', 'review']})
    >>> logs.topics["/mic/label"]
    'hearthlog_msgs/msg/AudioLabel'
    """
    return Logs(Path(path), start, end)


def follow(
    path: Path | str,
    topics: Collection[str] | None = None,
    start: int | None = None,
    stop: Event | None = None,
) -> Iterator[list[Columns]]:
    """Follow the logs of a folder while a recorder writes them, from file to file.

    Parameters
    ----------
    path : Path or str
    topics : collection of str, optional
        Names of the topics; all by default.
    start : int, optional
        Log time of the first message, in nanoseconds of UTC; by default only new messages.
    stop : threading.Event, optional
        Ends the iteration when set; by default it never ends.

    Yields
    ------
    list of Columns
        New messages of one log, in order of time.

    Raises
    ------
    LogError
        If the folder does not exist or disappears, or if a log cannot be read or is damaged.

    Examples
    --------
    >>> for batch in hearthlog.follow("logs", ["/mic/label"], start=0):
    ...     print(batch[0].topic, batch[0]["label"][0])
    ...     break
    /mic/label silence
    """
    return growing.follow(Path(path), topics, start, stop=stop)


def _read_table(selection: LogSelection) -> tuple[Table, list[list[TypedColumns]]]:
    """Read a topic whose messages fit into one table; raise LogError if they do not."""
    ((topic, channels),) = selection.channels.items()
    batches = list(filter(None, map(decode_all, selection.messages())))
    batches = batches or [decode_all(selection.no_messages())]
    tables = tables_of(topic, channels)
    used = {table_of(piece, tables).number for pieces in batches for piece in pieces}
    found = [table for table in tables if table.number in used]
    return one_table(found, "choose other logs, or use columns or hearthlog export"), batches


def _series(pandas: Any, columns: Columns, path: str, field: Field) -> dict[str, Any]:
    """Make the columns of a field; an array gives one per element, unless it is an image."""
    values = columns[path]
    if (
        values.ndim == 2
        and values.shape[1] > MOST_COLUMNS
        and not array_names(columns.metadata, path)
    ):
        return {path: ragged(values)}
    if values.ndim == 2:
        return _elements(columns, path)
    if field.size is None and field.type == TIME:
        return {path: pandas.to_datetime(values, unit="ns", utc=True)}
    if field.size is None and field.type == DURATION:
        return {path: pandas.to_timedelta(values, unit="ns")}
    return {path: values}


def _with_missing(series: Any, rows: NDArray[np.intp], count: int) -> Any:
    """Spread values over rows; other rows are missing values, and integers stay integers."""
    kind = series.dtype.kind
    if kind in "iub":
        name = {"i": "Int", "u": "UInt", "b": "boolean"}[kind]
        series = series.astype(name if kind == "b" else f"{name}{series.dtype.itemsize * 8}")
    return series.set_axis(rows).reindex(range(count)).array


def _elements(columns: Columns, path: str) -> dict[str, NDArray[Any]]:
    """Make a column of each element of an array, named as in the log, else by index."""
    names, values = array_names(columns.metadata, path), columns[path]
    if values.shape == (0, 0):  # without messages, the number of elements is unknown
        values = values.reshape(0, len(names))
    if len(names) != values.shape[1]:
        names = [f"{i}" for i in range(values.shape[1])]
    return {f"{path}.{name}": element for name, element in zip(names, values.T, strict=True)}


def _optional(module: str) -> Any:
    """Import a module of the extra `headless`."""
    require(module)
    return import_module(module)
