"""Check logs: against the specification of MCAP, against docs/log.md, and with each other."""

from collections.abc import Sequence
from pathlib import Path

from hearthlog.analyzer.doctor.file_checks import ExaminedFile, examine_file
from hearthlog.analyzer.doctor.findings import Finding, Findings
from hearthlog.analyzer.doctor.folder_checks import check_leftovers, check_series
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.logs.files import check_allowed, find_logs

__all__ = ["ExaminedFile", "Finding", "Findings", "examine", "examine_file"]


def examine(
    paths: Path | Sequence[Path],
    progress: Progress = ignore_progress,
    missing: list[str] | None = None,
) -> list[Findings]:
    """Check logs, or all logs of folders and how they follow each other.

    Parameters
    ----------
    progress : callable, optional
        Is told the share of the bytes that is done, 0 to 1.
    missing : list of str, optional
        Is appended to: which of several paths have no log, and why; the others are checked.

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
    paths = [paths] if isinstance(paths, Path) else paths
    logs: dict[Path, Path] = {}
    left: list[Findings] = []
    for path in paths:
        own: list[Findings] = []
        try:
            check_allowed(path)
            own = list(check_leftovers(path)) if path.is_dir() else []
            left += own
            found = find_logs(path, enrolled=True)
        except LogError as error:
            if not own and (missing is None or len(paths) == 1):
                raise
            if not own and missing is not None:
                missing.append(str(error))
            continue
        for log in found:
            logs.setdefault(log.resolve(), log)
    files = _examine_all(list(logs.values()), progress)
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
