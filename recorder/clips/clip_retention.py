"""Retention of clips: they are deleted once they are old enough. Nothing else ever is."""

import os
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from hearthlog.recorder.events import OK, WARNING, Notice
from hearthlog.schemas.logs.files import AUDIO_SUFFIX
from hearthlog.schemas.times import NANOSECONDS

_DAY = 86_400 * NANOSECONDS
_EVERY = 3600 * NANOSECONDS
_TIME = "%Y%m%dT%H%M%SZ"


class ClipRetention:
    """Deletes the old clips of a recorder once an hour, by the time of the sound.

    Parameters
    ----------
    root : Path
        Folder of logs; links in it are not followed.
    node : str
        Node whose clips they are.
    days : int
        Age at which a layer is deleted, counted from the start of its log.
    """

    def __init__(self, root: Path, node: str, days: int) -> None:
        self._root = root
        self._node = node
        self._kept = days * _DAY
        self._last: int | None = None

    def tick(self, now: int) -> list[Notice]:
        """Delete old clips, unless the last time was less than an hour ago.

        Parameters
        ----------
        now : int
            In nanoseconds of UTC.

        Returns
        -------
        list of Notice
            At most two: how many layers were deleted, and the first failure.
        """
        if self._last is not None and abs(now - self._last) < _EVERY:
            return []
        self._last = now
        deleted = 0
        failures: list[OSError] = []
        for layer, start in find_clips(self._root, self._node, failures):
            if start < now - self._kept:
                try:
                    layer.unlink()
                    deleted += 1
                except OSError as error:
                    failures.append(error)
        notices = []
        if deleted:
            days = self._kept // _DAY
            text = f"clips of {deleted} logs deleted: they were {days} days old"
            notices.append(Notice(OK, text))
        if failures:
            more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
            first = f"{failures[0].filename}: {failures[0].strerror}"
            text = f"clips cannot be looked through or deleted: {first}{more}"
            notices.append(Notice(WARNING, text))
        return notices


def find_clips(root: Path, node: str, failures: list[OSError]) -> Iterator[tuple[Path, int]]:
    """Find the layers of sound of a node, whole or damaged.

    Parameters
    ----------
    root : Path
        Folder of logs.
    node : str
        Name of the node.
    failures : list of OSError
        Errors of folders that cannot be read are appended.

    Yields
    ------
    path : Path
        The layer.
    start : int
        When its log began, in nanoseconds of UTC.
    """
    time, end = r"(\d{8}T\d{6}Z)(?:_\d+)?", rf"{re.escape(AUDIO_SUFFIX)}(\.damaged)?"
    name = re.compile(rf"{re.escape(node)}_{time}{end}")
    for folder, folders, files in os.walk(root, onerror=failures.append):
        folders[:] = [each for each in folders if each.isdigit()]
        for file in files:
            if (match := name.fullmatch(file)) and (start := _start(match[1])) is not None:
                yield Path(folder, file), start


def _start(text: str) -> int | None:
    try:
        moment = datetime.strptime(text, _TIME).replace(tzinfo=UTC)
    except ValueError:  # digits, but not a time
        return None
    return int(moment.timestamp()) * NANOSECONDS
