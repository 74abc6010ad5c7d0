"""Wait until something changes in folders, told by the file system where it tells."""

import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any, Self

_SETTLES = 10  # milliseconds in which a change goes on


class FolderChanges:
    """Tells of files that are made, written, renamed or removed in folders.

    Where the file system does not tell, as one of the network, or on a system without inotify,
    `wait` lasts as long as it is asked to.
    """

    def __init__(self) -> None:
        self._inotify: Any = None
        self._mask = 0
        self._watches: dict[Path, int] = {}
        if sys.platform == "linux":
            from inotify_simple import INotify, flags  # noqa: PLC0415  elsewhere there is none

            with suppress(OSError):  # a machine has so many and no more
                self._inotify = INotify()
            changes = flags.CREATE | flags.MODIFY | flags.MOVED_TO
            self._mask = changes | flags.DELETE_SELF | flags.MOVE_SELF | flags.ONLYDIR

    @property
    def tells(self) -> bool:
        """Whether the system can tell of changes."""
        return self._inotify is not None

    def watch(self, folders: Iterable[Path]) -> None:
        """Be told of these folders too, and of those that have the names of watched ones since."""
        if self._inotify is None:
            return
        for folder in set(folders):
            with suppress(OSError):  # it was removed, or there are too many
                # Asked each time: no event tells that a disk was mounted over a watched folder.
                watch = self._inotify.add_watch(folder, self._mask)
                before = self._watches.get(folder, watch)
                self._watches[folder] = watch
                if before != watch:
                    self._inotify.rm_watch(before)  # if it has moved away

    def wait(self, seconds: float, stop: Event) -> bool:
        """Wait until something changes, or for some time; tell whether something did.

        Parameters
        ----------
        stop : threading.Event
            Ends the waiting when it is set, at the latest after `seconds`.
        """
        if self._inotify is None:
            stop.wait(seconds)
            return False
        return not stop.is_set() and bool(self._inotify.read(round(1000 * seconds), _SETTLES))

    def close(self) -> None:
        """Be told no more."""
        if self._inotify is not None:
            self._inotify.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
