"""What the modules of export formats have in common."""

from collections.abc import Callable, Collection
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from hearthlog.analyzer.export.file_names import file_stem, unused_name
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.analyzer.logs.typed_columns import TypedColumns, decode_all
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.progress import Progress


class OutputFiles:
    """The files of an export, under temporary names until all are written.

    Parameters
    ----------
    path : Path
        The only file, which does not exist, or an empty folder.
    output : Path
        The name that it gets.
    suffix : str
        Of the files in a folder, without a dot.

    Attributes
    ----------
    path : Path
        The only file, or the folder.
    output : Path
        The name that it gets.
    """

    def __init__(self, path: Path, output: Path, suffix: str) -> None:
        self.path, self.output = path, output
        self._suffix = suffix
        self._names: set[str] = set()

    def new(self, stem: str) -> Path:
        """Name a new file in the folder, or the only file.

        Parameters
        ----------
        stem : str
            Name without a suffix, for a file in a folder; a number is added if it is taken.

        Raises
        ------
        LogError
            If there is already the only file.
        """
        if self.path.is_dir():
            return self.path / unused_name(f"{stem}.{self._suffix}", self._names)
        if self.path.exists():
            raise LogError(
                f"{self.output}: there is more than one clip; name a folder, with --format wav"
            )
        return self.path


class Exporter(NamedTuple):
    """How a format writes messages.

    Attributes
    ----------
    save : callable
        Writes a selection to files; returns how many messages were left out because several logs
        hold them. Raises LogError if a log is damaged, if there is no message, or one that the
        format has no place for.
    type : str
        The only message type that it takes; empty for any.
    fields : collection of str
        Paths of the fields that messages must have.
    """

    save: Callable[[Selection, OutputFiles, Progress], int | None]
    type: str = ""
    fields: Collection[str] = ()


class TopicWriter(Protocol):
    """A file of one topic being written."""

    def write(self, piece: TypedColumns) -> None:
        """Append messages of the topic.

        Parameters
        ----------
        piece : TypedColumns
            Messages of one definition.

        Raises
        ------
        LogError
            If the format has no place for them.
        """

    def finish(self) -> None:
        """Complete what was written."""


def write_topics(
    selection: Selection, progress: Progress, opened: Callable[[str, ExitStack], TopicWriter]
) -> None:
    """Write the messages of each topic with a writer of its own.

    Parameters
    ----------
    selection : Selection
        Its checksums are compared first.
    progress : callable
        Is told the share that is done, 0 to 1.
    opened : callable
        Is called with a topic, at its first message, and with an `ExitStack`, to which it may
        add what is to be closed after `finish` of the writer that it returns.

    Raises
    ------
    LogError
        If a log is damaged, if there is no message, or one that the format has no place for.
    """
    selection.verify()
    selection = selection.decodable()
    writers: dict[str, TopicWriter] = {}
    with ExitStack() as stack:
        for batch in selection.messages(progress):
            for piece in decode_all(batch):
                topic = piece.columns.topic
                if topic not in writers:
                    writers[topic] = opened(topic, stack)
                    stack.callback(writers[topic].finish)
                writers[topic].write(piece)
    if not writers:
        raise selection.nothing()


def stream_exporter(
    writer: Callable[[BinaryIO, str, Selection], TopicWriter],
    type_: str = "",
    fields: Collection[str] = (),
) -> Exporter:
    """Make the exporter of a format whose files are streams of one topic each.

    Parameters
    ----------
    writer : callable
        Is called with a stream, a topic and the selection, and returns the writer of the topic.
    type_ : str
        Name of the only message type that the format takes; empty for any.
    fields : collection of str
        Paths of the fields that messages must have.
    """

    def save(selection: Selection, files: OutputFiles, progress: Progress) -> None:
        def opened(topic: str, stack: ExitStack) -> TopicWriter:
            stream = stack.enter_context(files.new(file_stem(topic)).open("xb"))
            return writer(stream, topic, selection)

        write_topics(selection, progress, opened)

    return Exporter(save, type_, fields)
