"""Export of a selection: tables of topics, output files, and the run of a format."""

import io
import os
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol, cast

from numpy.typing import NDArray

from hearthlog.analyzer.export import ExportFormat, file_stem, unused_name
from hearthlog.analyzer.logs.selection import (
    Described,
    LogSelection,
    TypedColumns,
    decode_all,
    is_compatible,
)
from hearthlog.schemas.errors import (
    HearthlogWarning,
    LogError,
    Progress,
    abridged,
    ignore_progress,
    listed,
)
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages.fields import (
    DURATION,
    TIME,
    Field,
    common_fields,
    fields_of,
    optional_fields,
)
from hearthlog.schemas.messages.message_types import number_type
from hearthlog.schemas.messages.type_definitions import message_type
from hearthlog.schemas.new_files import new_file, new_folder

MOST_COLUMNS = 4096  # per array without element names; images have more
_NAMED = 8  # fields per line


class Table(NamedTuple):
    """Messages of one topic and type that fit one table, across definition changes."""

    topic: str
    type: str
    number: int  # 0 for the first table of its topic
    fields: Mapping[str, Field]  # by path: union of all definitions, wide enough for each
    definitions: Sequence[Mapping[str, Field]]  # fields of each definition
    channels: Sequence[Described]  # with messages of this table

    @property
    def optional(self) -> list[str]:
        """Paths of the fields that some definitions lack."""
        return [path for path in self.fields if any(path not in d for d in self.definitions)]

    @property
    def stem(self) -> str:
        """File name without suffix."""
        return file_stem(f"{self.topic} {self.type}" if self.number else self.topic)


def tables_of(topic: str, channels: Iterable[Described]) -> list[Table]:
    """Divide the messages of a topic, with channels of readable definitions, into tables.

    There is one, unless the topic has several types, or a field's type changed so that no column
    type holds all its values.
    """
    groups: list[tuple[str, list[Mapping[str, Field]], list[Described]]] = []
    for channel, schema in channels:
        assert schema is not None
        fields = fields_of(message_type(schema.name, schema.encoding, schema.data))
        for name, definitions, same in groups:
            if name == schema.name and _fits(fields, definitions):
                same.append((channel, schema))
                break
        else:
            groups.append((schema.name, [fields], [(channel, schema)]))
    return [
        Table(topic, name, number, common_fields(definitions), definitions, same)
        for number, (name, definitions, same) in enumerate(groups)
    ]


def _fits(fields: Mapping[str, Field], definitions: list[Mapping[str, Field]]) -> bool:
    """Add a definition to others if one table fits all of them; return whether it does."""
    if any(fields == other for other in definitions):
        return True
    try:
        common_fields([*definitions, fields])
    except LogError:
        return False
    definitions.append(fields)
    return True


def table_of(piece: TypedColumns, tables: Sequence[Table]) -> Table:
    """Return the table of decoded messages among the tables of their topic."""
    if len(tables) == 1:
        return tables[0]
    return next(
        table
        for table in tables
        if table.type == piece.columns.type and piece.fields in table.definitions
    )


def with_numbers(columns: Columns, table: Table, paths: Collection[str]) -> Columns:
    """Select fields of messages that have them, with numbers converted to the table's types."""
    fields: dict[str, NDArray[Any]] = {}
    for path in paths:
        fields[path] = columns[path]
        field = table.fields[path]
        if columns[path].dtype != object and field.type not in {TIME, DURATION}:
            fields[path] = columns[path].astype(number_type(field.type), copy=False)
    return replace(columns, fields=fields)


def warn_of_changes(tables: Sequence[Table]) -> None:
    """Warn of definition changes within a topic, and of their effect on the export."""
    for table in tables:
        optional = optional_fields(table.definitions)
        if optional:
            text = (
                f"{table.type} is defined in {len(table.definitions)} ways; not in all messages, "
                f"and empty in the others: {abridged(optional, _NAMED)}"
            )
            warnings.warn(HearthlogWarning(text, table.topic), stacklevel=2)
    if len(tables) > 1:
        text = f"{_why_apart(tables)}: there is a table for each"
        warnings.warn(HearthlogWarning(text, tables[0].topic), stacklevel=2)


def one_table(tables: Sequence[Table], remedy: str) -> Table:
    """Return the only table of a topic, and warn of fields that some messages lack.

    Raise `LogError` if there are several, with the remedy.
    """
    if len(tables) > 1:
        raise LogError(f"{tables[0].topic}: {_why_apart(tables)}, which is no table; {remedy}")
    warn_of_changes(tables)
    return tables[0]


def _why_apart(tables: Sequence[Table]) -> str:
    types = list(dict.fromkeys(table.type for table in tables))
    if len(types) > 1:
        return f"has messages of {listed(types, 'and')}"
    try:
        common_fields([fields for table in tables for fields in table.definitions])
    except LogError as error:
        return f"{types[0]} is defined in ways that differ ({error})"
    return f"{types[0]} is defined in ways that differ"


class OutputFiles:
    """Files of an export, under temporary names until all are written.

    The path is the single output file, which must not exist, or an empty folder.
    """

    def __init__(self, path: Path, output: Path, suffix: str) -> None:
        self.path, self.output = path, output
        self._suffix = suffix
        self._names: dict[str, int] = {}
        self.made: list[Path] = []

    @property
    def remedy(self) -> str:
        """Advice for exports that need more than one file."""
        return f"name a folder, with --format {self._suffix}, for a file of each"

    def new(self, stem: str) -> Path:
        """Return the path of a new file in the folder, or of the single file.

        In a folder its name is `stem`, with a number if that is taken. Raise `LogError` if the
        single file already exists.
        """
        path = self.path
        if path.is_dir():
            path /= unused_name(f"{stem}.{self._suffix}", self._names)
        elif path.exists():
            raise LogError(
                f"{self.output}: there is more than one clip; name a folder, with --format wav"
            )
        self.made.append(path)
        return path


class Exporter(NamedTuple):
    """Export function of a format.

    Attributes
    ----------
    save : callable
        Writes a selection to files; returns the number of messages omitted as duplicates of
        other logs. Raises LogError if a log is damaged, if there is no message, or if the format
        cannot hold a message.
    type : str
        The only supported message type; empty for any.
    """

    save: Callable[[LogSelection, OutputFiles, Progress], int | None]
    type: str = ""
    fields: Collection[str] = ()


class TableWriter(Protocol):
    """Writer of one table's files."""

    def write(self, pieces: Sequence[TypedColumns]) -> None:
        """Append messages of the table.

        Parameters
        ----------
        pieces : sequence of TypedColumns
            Messages of the next time span, one definition per piece; at least one.

        Raises
        ------
        LogError
            If the format cannot hold the messages.
        """

    def finish(self) -> bool | None:
        """Complete the files; return whether the messages must be read once more.

        May raise LogError, as `write` does.
        """


def write_tables(
    selection: LogSelection,
    files: OutputFiles,
    progress: Progress,
    opened: Callable[[Table], TableWriter],
    type_: str = "",
) -> None:
    """Write the messages of each table, by default of any type, with a separate writer.

    Topics that the format cannot hold are skipped with a warning, unless no topic is left.
    `progress` receives the completed share, 0 to 1. Raise `LogError` if a log is damaged, if there
    is no message, or if the format can hold none of them.
    """
    writing = _Writing(files, opened, type_)
    selection = selection.decodable()
    again: Collection[str] = writing.read(selection, progress)
    while again:
        again = writing.read(selection.only(again), progress)
    if not writing.finish():
        raise selection.nothing()


def by_topic(pieces: Iterable[TypedColumns]) -> dict[str, list[TypedColumns]]:
    """Group decoded messages by topic."""
    topics: dict[str, list[TypedColumns]] = {}
    for piece in pieces:
        topics.setdefault(piece.columns.topic, []).append(piece)
    return topics


class _Writing:
    """Tables in progress, and tables that failed."""

    def __init__(
        self, files: OutputFiles, opened: Callable[[Table], TableWriter], type_: str
    ) -> None:
        self._files, self._opened, self._type = files, opened, type_
        self._tables: dict[str, list[Table]] = {}
        self._writers: dict[tuple[str, int], TableWriter] = {}
        self._finished: set[tuple[str, int]] = set()
        self._made: dict[tuple[str, int], list[Path]] = {}
        self._faults: dict[tuple[str, int], LogError] = {}

    def read(self, selection: LogSelection, progress: Progress) -> set[str]:
        """Write the messages of a selection; return the topics that must be read once more."""
        for batch in selection.messages(progress):
            for topic, pieces in by_topic(decode_all(batch)).items():
                self._write(topic, selection.channels[topic], pieces)
        again: set[str] = set()
        for key, writer in list(self._writers.items()):
            if key not in self._finished and self._try(key, writer.finish):
                again.add(key[0])
                del self._writers[key]
            else:
                self._finished.add(key)
        return again

    def _write(
        self, topic: str, channels: Sequence[Described], pieces: Sequence[TypedColumns]
    ) -> None:
        if topic not in self._tables:
            same = [(c, s) for c, s in channels if s is not None and self._type in {"", s.name}]
            self._tables[topic] = tables_of(topic, same)
        tables = self._tables[topic]
        of_table: dict[int, list[TypedColumns]] = {}
        for piece in pieces:
            if self._type in {"", piece.columns.type}:
                of_table.setdefault(table_of(piece, tables).number, []).append(piece)
        for number, same_table in of_table.items():
            key = topic, number
            if key not in self._writers and key not in self._faults:
                self._open(tables, number)
            if key in self._writers and key not in self._finished:
                self._try(key, partial(self._writers[key].write, same_table))

    def _open(self, tables: Sequence[Table], number: int) -> None:
        if self._files.path.is_dir():
            if number == 0:
                warn_of_changes(tables)
        else:
            one_table(tables, self._files.remedy)
        table = tables[number]
        first = len(self._files.made)
        self._writers[table.topic, number] = self._opened(table)
        self._made[table.topic, number] = self._files.made[first:]

    def _try(self, key: tuple[str, int], step: Callable[[], bool | None]) -> bool | None:
        """Write to a table; delete the table if the format cannot hold the data."""
        first = len(self._files.made)
        result = None
        try:
            result = step()
        except LogError as error:
            self._faults[key] = error
            del self._writers[key]
            for path in self._made[key] + self._files.made[first:]:
                path.unlink(missing_ok=True)
        self._made[key] += self._files.made[first:]
        return result

    def finish(self) -> bool:
        """Warn of skipped topics; return whether any topic was written."""
        if self._faults and not self._writers:
            raise next(iter(self._faults.values()))
        for (topic, _), fault in self._faults.items():
            text = str(fault).removeprefix(f"{topic}: ")
            warnings.warn(HearthlogWarning(f"{text}: left out", topic, each=True), stacklevel=2)
        return bool(self._writers)


class TableFile(io.RawIOBase):
    """New file that is open only during writes: there may be thousands.

    Writes after deletion are discarded.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._size = 0
        path.open("xb").close()

    def writable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._size

    def write(self, data: Any, /) -> int:
        """Append bytes."""
        try:
            descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)
        except FileNotFoundError:
            return len(data)
        with open(descriptor, "ab") as stream:  # noqa: PTH123
            count = stream.write(data)
        self._size += count
        return count


def table_exporter(
    writer: Callable[[BinaryIO, Table, LogSelection], TableWriter],
    type_: str = "",
    fields: Collection[str] = (),
) -> Exporter:
    """Return the exporter of a format, of one message type or any, with one stream per table."""

    def save(selection: LogSelection, files: OutputFiles, progress: Progress) -> None:
        def opened(table: Table) -> TableWriter:
            stream = cast(BinaryIO, TableFile(files.new(table.stem)))
            return writer(stream, table, selection)

        write_tables(selection, files, progress, opened, type_)

    return Exporter(save, type_, fields)


def exportable(selection: LogSelection, format_: ExportFormat) -> LogSelection:
    """Drop topics that a format does not support (WAV supports audio clips only).

    Raise `LogError` if the selection has logs but no topic is left.
    """
    exporter = _exporter(format_)
    if not exporter.type:
        return selection
    topics = {
        topic
        for topic, same in selection.channels.items()
        if any(is_compatible(*described, exporter.type, exporter.fields) for described in same)
    }
    if selection.logs and not topics:
        names = abridged(list(selection.channels))
        raise LogError(f"no topic of type {exporter.type}; there are {names}")
    return selection.only(topics)


def export(
    selection: LogSelection,
    output: Path,
    format_: ExportFormat,
    progress: Progress = ignore_progress,
    *,
    folder: bool,
) -> int:
    """Write messages in another format.

    With `folder` write a folder with one file per topic (WAV: per clip); otherwise a single file,
    of one topic if the format is `by_topic`. `progress` receives the completed share, 0 to 1. Raise
    `LogError` if a log is damaged, there is no message, the format cannot hold a message, or the
    output cannot be written; no output is left then.
    """
    new = new_folder if folder or format_.is_folder else new_file
    with new(output) as temporary:
        files = OutputFiles(temporary, output, format_.name)
        return _exporter(format_).save(selection, files, progress) or 0


def _exporter(format_: ExportFormat) -> Exporter:
    module = import_module(f"{__package__}.{format_.module}")
    return cast(Exporter, getattr(module, format_.exporter))
