"""The sounds that recur in a home, for its page: read where they are others, and named."""

from pathlib import Path
from typing import Any

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.page.group_naming import GroupNaming
from hearthlog.analyzer.bridge.page.recurring_list import Moment, recurring_list, shown_groups
from hearthlog.analyzer.bridge.page.said import class_of
from hearthlog.analyzer.bridge.page.words import told
from hearthlog.analyzer.discover.summary import SUMMARY, GroupsSummary, load_summary
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.errors import HearthlogError

_NOTHING: dict[str, Any] = {"looked": "", "more": "", "groups": []}


class Recurring:
    """The groups that `hearthlog discover` has found, if it has.

    Attributes
    ----------
    problem : str
        Why they are not shown; empty if nothing is wrong.
    """

    def __init__(self, folder: Path) -> None:
        self.problem = ""
        self._file = folder / SUMMARY
        self._seen: tuple[int, ...] = ()
        self._looked = 0
        self._summary: GroupsSummary | None = None
        self._naming = GroupNaming(folder)
        self._state: Any = None
        self._described: Any = _NOTHING

    def describe(self, moment: Moment) -> Any:
        """Describe the groups for JSON; there are none without a summary that can be read."""
        self._look()
        if self._summary is None:
            return _NOTHING
        said = dict(self._naming.said)
        state = self._seen, said, local_time(*moment).date()
        if state != self._state:
            self._state = state
            self._described = recurring_list(self._summary, self._looked, said, moment)
        return self._described

    def name(self, key: str, text: str) -> str:
        """Begin to name a group, and say so.

        Parameters
        ----------
        text : str
            A class, by its name or in words; empty to take the name back.

        Raises
        ------
        BridgeError
            If there is no such group any more, the text cannot be a class, or it cannot be done.
        """
        summary = self._summary
        group = None if summary is None else shown_groups(summary).get(key)
        if group is None:
            raise BridgeError("These sounds were grouped anew meanwhile: look at the list again.")
        label = class_of(text) if text else ""
        if label == SILENCE:
            raise BridgeError("Write what it was: a sound that recurs cannot be named silence.")
        return self._naming.start(key, group.number, label)

    def close(self) -> None:
        """Name no more."""
        self._naming.close()

    def _look(self) -> None:
        """Read the summary if it is another file than before."""
        try:
            status = self._file.stat()
        except OSError:
            self._seen, self._summary, self.problem = (), None, ""
            return
        seen = status.st_ino, status.st_size, status.st_mtime_ns
        if seen == self._seen:
            return
        self._seen, self._looked, self.problem = seen, status.st_mtime_ns, ""
        try:
            self._summary = load_summary(self._file)
        except HearthlogError as error:
            self._summary, self.problem = None, told(str(error))
