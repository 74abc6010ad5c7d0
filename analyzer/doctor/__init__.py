"""Check logs: against the specification of MCAP, against docs/log.md, and with each other."""

from collections.abc import Sequence
from pathlib import Path

from hearthlog.analyzer.doctor.file_checks import ExaminedFile, examine_file
from hearthlog.analyzer.doctor.findings import Finding, Findings
from hearthlog.analyzer.doctor.folder_checks import check_leftovers, check_series
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.progress import Progress, ignore_progress

__all__ = ["ExaminedFile", "Finding", "Findings", "examine", "examine_file"]


def examine(path: Path, progress: Progress = ignore_progress) -> list[Findings]:
    """Check a log, or all logs of a folder and how they follow each other.

    Parameters
    ----------
    path : Path
        A log, or a folder of logs.
    progress : callable, optional
        Is told the share of the bytes that is done, 0 to 1.

    Returns
    -------
    list of Findings
        One for each log, in the order of their paths, sound ones too; then one for each file that
        a killed recorder or command has left behind.

    Raises
    ------
    LogError
        If there is neither a log nor such a file.
    """
    left = list(check_leftovers(path)) if path.is_dir() else []
    try:
        logs = find_logs(path, enrolled=True)
    except LogError:
        if not left:
            raise
        logs = []
    files = _examine_all(logs, progress)
    check_series(files)
    return [*(file.findings for file in files), *left]


def _examine_all(logs: Sequence[Path], progress: Progress) -> list[ExaminedFile]:
    sizes = [log.stat().st_size if log.is_file() else 0 for log in logs]
    whole = max(sum(sizes), 1)
    files = []
    done = 0
    for log, size in zip(logs, sizes, strict=True):

        def tell(share: float, done: int = done, size: int = size) -> None:
            progress((done + share * size) / whole)

        files.append(examine_file(log, tell))
        done += size
    return files
