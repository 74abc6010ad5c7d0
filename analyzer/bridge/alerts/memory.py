"""The memory of rules and addresses between two starts of the bridge, in files."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hearthlog.analyzer.bridge.alerts.ring import RuleState
from hearthlog.analyzer.bridge.alerts.rules import AlertRule
from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.new_files import replaced_file

_LIMIT = 1 << 20  # bytes
_DAMAGED = (ValueError, TypeError, KeyError, AttributeError, RecursionError, HearthlogError)


@dataclass
class Progress:
    """How far a rule is evaluated.

    Attributes
    ----------
    until : int
        Log time, in nanoseconds of UTC; 0 for one that is new.
    """

    until: int = 0
    state: RuleState = field(default_factory=RuleState)


class Memory:
    """Remembers how far each rule is evaluated; one that was changed begins anew."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self._path = path
        self._say = say

    def load(self, rules: Sequence[AlertRule]) -> dict[str, Progress]:
        """Return how far rules are evaluated, by name."""
        known = {}
        try:
            if self._path.exists():
                content = json.loads(read_whole(self._path, "memory", _LIMIT, LogError))
                known = {name: _progress(each) for name, each in content.items()}
        except _DAMAGED:
            self._say(f"{self._path}: cannot be read; all rules begin anew")
        return {rule.name: known.get(rule.fingerprint, Progress()) for rule in rules}

    def save(self, rules: Sequence[AlertRule], progress: dict[str, Progress]) -> None:
        """Keep how far rules are evaluated; it is on the disk on return."""
        content = {
            rule.fingerprint: {"until": own.until, **own.state._asdict()}
            for rule in rules
            for own in [progress[rule.name]]
        }
        try:
            with replaced_file(self._path) as temporary:
                temporary.write_text(json.dumps(content), "utf-8")
        except LogError as error:
            self._say(f"{error}; alerts may come twice after the next start")


class KnownLines:
    """Remembers the lines of the file of addresses, by the names of their targets."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self._path = path
        self._say = say
        self.names: list[str] = []
        try:
            if path.exists():
                content = json.loads(read_whole(path, "memory", _LIMIT, LogError))
                self.names = [str(name) for name in content]
        except _DAMAGED:
            say(f"{path}: cannot be read; whoever is on an edited line may be told twice")

    def keep(self, names: Sequence[str]) -> None:
        """Remember the lines that there are now."""
        if names == self.names:
            return
        self.names = list(names)
        try:
            with replaced_file(self._path) as temporary:
                temporary.write_text(json.dumps(self.names), "utf-8")
        except LogError as error:
            self._say(f"{error}; whoever is on an edited line may be told twice")


def _progress(content: dict[str, int]) -> Progress:
    state = RuleState(int(content["last"]), bool(content["has_rung"]), int(content["since"]))
    return Progress(int(content["until"]), state)
