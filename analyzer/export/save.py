"""A part of some logs in another format: in one file, or in a folder with a file for each topic."""

from importlib import import_module
from pathlib import Path
from typing import cast

from hearthlog.analyzer.export.exporter import Exporter, OutputFiles
from hearthlog.analyzer.export.formats import ExportFormat
from hearthlog.analyzer.logs.selection import LogSelection, is_compatible
from hearthlog.schemas.errors import LogError, Progress, abridged, ignore_progress
from hearthlog.schemas.new_files import new_file, new_folder


def exportable(selection: LogSelection, format_: ExportFormat) -> LogSelection:
    """Leave out the topics that a format is not for, as WAV is for clips of sound.

    Raise `LogError` if the selection has logs, and no topic is left.
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

    Parameters
    ----------
    progress : callable
        Is told the share that is done, 0 to 1.
    folder : bool
        Make a folder with one file for each topic (WAV: for each clip); otherwise one file, of one
        topic if the format is `by_topic`.

    Raises
    ------
    LogError
        If a log is damaged, if there is no message, or one that the format has no place for, or
        if the output cannot be written; there is no output then.
    """
    new = new_folder if folder or format_.is_folder else new_file
    with new(output) as temporary:
        files = OutputFiles(temporary, output, format_.name)
        return _exporter(format_).save(selection, files, progress) or 0


def _exporter(format_: ExportFormat) -> Exporter:
    return cast(Exporter, import_module(f"{__package__}.{format_.module}").EXPORTER)
