"""Forgetting sound: clips are deleted when they are old enough. Nothing else ever is."""

import os
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from hearthlog.schemas.logs.files import AUDIO_SUFFIX
from hearthlog.schemas.times import NANOSECONDS

_DAY = 86_400 * NANOSECONDS
_EVERY = 3600 * NANOSECONDS
_TIME = "%Y%m%dT%H%M%SZ"


class Retention:
    """Deletes the clips of a recorder once an hour, by the time of what it hears.

    Parameters
    ----------
    root : Path
        Folder of logs; links in it are not followed.
    node : str
        Of whose clips.
    days : int
        How long they are kept at most: a layer goes when its log began so long ago.
    """

    def __init__(self, root: Path, node: str, days: int) -> None:
        self._root = root
        self._node = node
        self._kept = days * _DAY
        self._last: int | None = None

    def attend(self, now: int) -> list[tuple[int, str]]:
        """Delete what is old now (nanoseconds of UTC), unless an hour has not passed since.

        Returns
        -------
        list of (int, str)
            What is to be said, with its level of `diagnostic_msgs`.
        """
        if self._last is not None and abs(now - self._last) < _EVERY:
            return []
        self._last = now
        deleted = 0
        failures: list[OSError] = []
        for layer in self._old(now - self._kept, failures):
            try:
                layer.unlink()
                deleted += 1
            except OSError as error:
                failures.append(error)
        said = []
        if deleted:
            days = self._kept // _DAY
            said.append((0, f"clips of {deleted} logs deleted: they were {days} days old"))
        if failures:
            more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
            first = f"{failures[0].filename}: {failures[0].strerror}"
            said.append((1, f"clips cannot be looked through or deleted: {first}{more}"))
        return said

    def _old(self, limit: int, failures: list[OSError]) -> Iterator[Path]:
        for layer, start in find_clips(self._root, self._node, failures):
            if start < limit:
                yield layer


def find_clips(root: Path, node: str, failures: list[OSError]) -> Iterator[tuple[Path, int]]:
    """Find the layers of sound of a node, whole or damaged, and when their logs began.

    Parameters
    ----------
    root : Path
    node : str
    failures : list of OSError
        Is added to, where a folder cannot be read.
    """
    name = re.compile(rf"{re.escape(node)}_(\d{{8}}T\d{{6}}Z){re.escape(AUDIO_SUFFIX)}(\.damaged)?")
    for folder, folders, files in os.walk(root, onerror=failures.append):
        folders[:] = [each for each in folders if each.isdigit()]
        for file in files:
            if (match := name.fullmatch(file)) and (start := _start(match[1])) is not None:
                yield Path(folder, file), start


def _start(text: str) -> int | None:
    try:
        moment = datetime.strptime(text, _TIME).replace(tzinfo=UTC)
    except ValueError:  # digits, but no time
        return None
    return int(moment.timestamp()) * NANOSECONDS
