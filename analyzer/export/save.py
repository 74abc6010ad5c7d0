"""A part of some logs in another format: in one file, or in a folder with a file for each topic."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO, Protocol

from hearthlog.analyzer.export import audacity
from hearthlog.analyzer.export.audacity import LabelTrack
from hearthlog.analyzer.export.csvfile import CsvFile
from hearthlog.analyzer.export.file_names import file_stem, unused_name
from hearthlog.analyzer.export.npz import save_npz
from hearthlog.analyzer.export.parquet import ParquetFile
from hearthlog.analyzer.export.rosbag1 import save_rosbag1
from hearthlog.analyzer.export.rosbag2 import save_rosbag2
from hearthlog.analyzer.export.wav import WavFiles
from hearthlog.analyzer.logs.clips import CLIP_FIELDS
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.analyzer.logs.typed_columns import TypedColumns, decode_all, is_compatible
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.storage.new_files import check_new, new_file, sync_folder
from hearthlog.schemas.times import NANOSECONDS


class ExportFormat(StrEnum):
    """What logs can be exported as; for those that are files, also their suffix."""

    parquet = "parquet"
    csv = "csv"
    npz = "npz"
    wav = "wav"
    txt = "txt"
    bag = "bag"
    rosbag2 = "rosbag2"


ONE_TOPIC = {
    ExportFormat.parquet,
    ExportFormat.csv,
    ExportFormat.npz,
    ExportFormat.txt,
    ExportFormat.wav,
}
_TYPES = {
    ExportFormat.txt: (message_types.SEGMENT, audacity.FIELDS),
    ExportFormat.wav: (message_types.RAW_AUDIO, CLIP_FIELDS),
}


class Sink(Protocol):
    """A file, or some, being written."""

    def write(self, piece: TypedColumns) -> None:
        """Append messages of the topic."""

    def finish(self) -> None:
        """Complete what was written."""


_TABLES: dict[ExportFormat, Callable[[BinaryIO, str, Selection], Sink]] = {
    ExportFormat.parquet: ParquetFile,
    ExportFormat.csv: CsvFile,
    ExportFormat.txt: LabelTrack,
}


def fitting(selection: Selection, form: ExportFormat) -> Selection:
    """Leave out the topics that this format is not for: labels are segments, WAV is clips.

    Raises
    ------
    LogError
        If none is left.
    """
    wanted = _TYPES.get(form)
    if wanted is None:
        return selection
    left = {
        topic
        for topic, same in selection.channels.items()
        if any(is_compatible(*described, *wanted) for described in same)
    }
    if selection.logs and not left:
        raise LogError(f"no topic of type {wanted[0]}; there are {', '.join(selection.channels)}")
    return selection.only(left)


def export(
    selection: Selection,
    output: Path,
    form: ExportFormat,
    progress: Progress = ignore_progress,
    *,
    folder: bool,
) -> None:
    """Write messages in another format.

    Parameters
    ----------
    selection : Selection
        As `fitting` returns it.
    output : Path
        Must not exist.
    form : ExportFormat
    progress : callable
        Is told the share that is done.
    folder : bool
        Make a folder with one file for each topic (WAV: for each clip); otherwise one file, which
        formats of `ONE_TOPIC` can only do for one topic. `rosbag2` is always a folder.

    Raises
    ------
    LogError
        If a log is damaged, if there is no message, or one that the format has no place for, or
        if the output cannot be written; there is no output then.
    """
    if form is ExportFormat.rosbag2:
        with new_folder(output) as made:
            save_rosbag2(made, output.name, selection, progress)
    elif form is ExportFormat.bag:
        with new_file(output) as made:
            selection.verify()
            save_rosbag1(made, selection, progress)
    elif folder:
        names: set[str] = set()
        with new_folder(output) as made:
            _save(
                selection, form, progress, lambda stem: made / unused_name(f"{stem}.{form}", names)
            )
    else:
        with new_file(output) as made:
            _save(selection, form, progress, lambda _: _once(made, output))


def _once(path: Path, output: Path) -> Path:
    if path.exists():
        raise LogError(f"{output}: there is more than one clip; name a folder, with --format wav")
    return path


def _save(
    selection: Selection, form: ExportFormat, progress: Progress, name: Callable[[str], Path]
) -> None:
    """Write one file for each topic, or more, under names made from what they hold."""
    selection.verify()
    if form is ExportFormat.npz:
        saved = [save_npz(topic, selection, name) for topic in selection.channels]
        if not any(saved):
            raise selection.nothing()
        return
    sinks: dict[str, Sink] = {}
    with ExitStack() as stack:
        for batch in selection.messages(progress):
            for piece in decode_all(batch):
                topic = piece.columns.topic
                if topic not in sinks:
                    sinks[topic] = stack.enter_context(_sink(form, topic, selection, name))
                sinks[topic].write(piece)
    if not sinks:
        raise selection.nothing()


@contextmanager
def _sink(
    form: ExportFormat, topic: str, selection: Selection, name: Callable[[str], Path]
) -> Iterator[Sink]:
    stem = file_stem(topic)
    with ExitStack() as stack:
        sink: Sink
        if form is ExportFormat.wav:
            sink = WavFiles(lambda start: name(f"{stem}_{_moment(start)}"))
        else:
            stream = stack.enter_context(name(stem).open("xb"))
            sink = _TABLES[form](stream, topic, selection)
        stack.callback(sink.finish)
        yield sink


def _moment(time: int) -> str:
    seconds, rest = divmod(time, NANOSECONDS)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y%m%dT%H%M%S}.{rest // 1000:06}Z"


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder: yield one with a temporary name, and give it its own when that went well.

    Raises
    ------
    LogError
        If there is such a folder or file already, or if it cannot be written.
    """
    check_new(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir()
        yield temporary
        for file in temporary.iterdir():
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
        sync_folder(temporary)
        path.mkdir()  # the name is ours now; only an empty folder is replaced
        temporary.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise LogError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
