"""Rings that are to be told, on the disk until everybody was."""

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

from hearthlog.analyzer.bridge.alerts.ring import Ring
from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import private_folder, replaced_file

MOST = 1000
UNREAD = "?"  # who is meant by a line that cannot be read, in the place of the name of a target
_UNREAD_LONGEST = 24 * 3600 * NANOSECONDS  # that a ring waits for such a line to be mended
_SUFFIX = ".json"
_LONGEST = 1 << 16  # bytes of a ring
_DAMAGED = (ValueError, TypeError, KeyError, RecursionError, HearthlogError)


@dataclass
class Waiting:
    """A ring, and who was told of it."""

    ring: Ring
    told: set[str] = field(default_factory=set)


class Outbox:
    """Keeps rings until each target was told; other threads may look into it.

    Parameters
    ----------
    most : int, optional
        Rings, at most: beyond them the oldest are dropped.

    Raises
    ------
    OSError
        If the folder cannot be made or read.
    """

    def __init__(
        self, folder: Path, targets: Sequence[str], say: Callable[[str], None], most: int = MOST
    ) -> None:
        self._folder = folder
        self._targets = frozenset(targets)
        self._say = say
        self._most = most
        self._lock = Lock()
        self._waiting: dict[str, Waiting] = {}
        private_folder(folder)
        for path in sorted(folder.glob(f"*{_SUFFIX}")):
            self._load(path)
        self._early = frozenset(self._waiting)  # what was there may be evaluated once more

    def __len__(self) -> int:
        return len(self._waiting)

    def set_targets(self, targets: Iterable[str], now: int) -> None:
        """Name those who are to be told from now on; what waits for nobody else is removed.

        Parameters
        ----------
        targets : iterable of str
            With `UNREAD` rings wait for a day, and are there for a target that comes.
        """
        with self._lock:
            self._targets = frozenset(targets)
            self._remove_done(now)

    def replace_targets(self, former: Mapping[str, str]) -> None:
        """Take targets for those whose place they have now: they know what those were told."""
        with self._lock:
            for waiting in self._waiting.values():
                told = {now for now, before in former.items() if before in waiting.told}
                if told - waiting.told:
                    waiting.told |= told
                    self._write(waiting)

    def _remove_done(self, now: int) -> None:
        for name in [n for n, each in self._waiting.items() if self._is_done(each, now)]:
            self._remove(name)

    def _is_done(self, waiting: Waiting, now: int) -> bool:
        missing = self._targets - waiting.told
        is_old = now - waiting.ring.time > _UNREAD_LONGEST
        return not missing or (is_old and missing == {UNREAD})

    def put(self, rings: Iterable[Ring]) -> None:
        """Keep rings, unless they are known; they are on the disk on return."""
        with self._lock:
            self._remove_done(time.time_ns())
            for ring in rings:
                if ring.id not in self._waiting and ring.id not in self._early:
                    self._waiting[ring.id] = waiting = Waiting(ring)
                    self._write(waiting)
            self._drop_oldest()

    def waiting_for(self, target: str, now: int) -> list[Ring]:
        """Return the rings of which a target is to be told now, the oldest first."""
        with self._lock:
            rings = [each.ring for each in self._waiting.values() if target not in each.told]
        return sorted((ring for ring in rings if ring.due <= now), key=lambda ring: ring.time)

    def note_told(self, target: str, ring: Ring) -> None:
        """Note that a target was told of a ring, which is removed when all of them were."""
        with self._lock:
            waiting = self._waiting.get(ring.id)
            if waiting is None:
                return
            waiting.told.add(target)
            if waiting.told >= self._targets:
                self._remove(ring.id)
            else:
                self._write(waiting)

    def forget_after(self, time: int) -> None:
        """Forget the rings of a time to come, which rang while the clock was ahead."""
        with self._lock:
            for name in [n for n, each in self._waiting.items() if each.ring.time > time]:
                self._remove(name)

    def _drop_oldest(self) -> None:
        number = len(self._waiting) - self._most
        if number > 0:
            for name in sorted(self._waiting, key=lambda each: self._waiting[each].ring.time)[
                :number
            ]:
                self._remove(name)
            self._say(
                f"{self._folder}: {self._most} alerts wait to be told, and the oldest are dropped; "
                "see above which target cannot be reached, and mend it, or take it out of urls_file"
            )

    def _remove(self, name: str) -> None:
        del self._waiting[name]
        try:
            self._path(name).unlink(missing_ok=True)
        except OSError as error:
            self._say(f"{self._path(name)}: cannot be removed ({error.strerror}); do so by hand")

    def _write(self, waiting: Waiting) -> None:
        content = {**waiting.ring._asdict(), "told": sorted(waiting.told)}
        path = self._path(waiting.ring.id)
        try:
            with replaced_file(path) as temporary:
                temporary.write_text(json.dumps(content), "utf-8")
        except LogError as error:
            self._say(f"{error}; until it can, alerts are only kept in memory")

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}{_SUFFIX}"

    def _load(self, path: Path) -> None:
        try:
            waiting = _waiting(json.loads(read_whole(path, "alert", _LONGEST, LogError)))
            if waiting.ring.id != path.name.removesuffix(_SUFFIX):
                raise ValueError
        except _DAMAGED:
            self._say(f"{path}: no alert that was kept here; remove it")
            return
        if waiting.told >= self._targets:
            path.unlink(missing_ok=True)
        else:
            self._waiting[waiting.ring.id] = waiting


def _waiting(content: Any) -> Waiting:
    ring = Ring(**{name: content[name] for name in Ring._fields})
    whole = isinstance(ring.time, int) and isinstance(ring.due, int)
    if not whole or not isinstance(ring.rule, str) or not isinstance(ring.text, str):
        raise ValueError
    return Waiting(ring, {str(name) for name in content["told"]})
