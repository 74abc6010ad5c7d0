"""Retention of clips: they are deleted once they are old enough, without a question."""

from collections.abc import Iterator
from pathlib import Path

from hearthlog.recorder.disk.recorded import recorded_days, start_of, walk
from hearthlog.recorder.events import OK, WARNING, Notice
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import AUDIO_LAYER, AUDIO_SUFFIX, log_name

_EVERY = 3600 * NANOSECONDS


class ClipRetention:
    """Deletes the old clips of a recorder once an hour, by the days that were recorded since.

    Parameters
    ----------
    days : int
        Age at which a layer is deleted: on so many later days something was recorded.
    """

    def __init__(self, root: Path, node: str, days: int) -> None:
        self._root = root
        self._node = node
        self._days = days
        self._last: int | None = None

    def tick(self, now: int) -> list[Notice]:
        """Delete old clips, unless the last time was less than an hour ago.

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
        days = recorded_days(self._root, self._node)
        for layer, start in find_clips(self._root, self._node, failures):
            if days.since(start) >= self._days:
                try:
                    layer.unlink()
                    deleted += 1
                except OSError as error:
                    failures.append(error)
        notices = []
        if deleted:
            text = f"clips of {deleted} logs deleted: they were {self._days} days old"
            notices.append(Notice(OK, text))
        if failures:
            more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
            first = f"{failures[0].filename}: {failures[0].strerror}"
            text = f"clips cannot be looked through or deleted: {first}{more}"
            notices.append(Notice(WARNING, text))
        return notices


def find_clips(root: Path, node: str, failures: list[OSError]) -> Iterator[tuple[Path, int]]:
    """Find the layers of sound of a node, whole or damaged.

    Yields
    ------
    start : int
        When its log began, in nanoseconds of UTC.
    """
    for folder, files in walk(root, failures):
        for file in files:
            name = file.removesuffix(".damaged")
            if not name.endswith(AUDIO_SUFFIX) or log_name(Path(name)).layer != AUDIO_LAYER:
                continue
            if (start := start_of(name, node)) is not None:
                yield folder / file, start
