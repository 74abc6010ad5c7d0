"""Labels of a file that cannot be marks: why, how many of each kind, and where the first one is."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.errors import DataError

UNREADABLE, EMPTY, POINT, OVERLAP = "unreadable line", "empty label", "point", "overlap"
WRONG_TIME = "wrong time"
OTHER = "label"


def place_text(path: Path, place: int | str) -> str:
    """Write the place of a label for an error: `file:line`, or `file: place`."""
    return f"{path}:{place}" if isinstance(place, int) else f"{path}: {place}"


class LineError(DataError):
    """A label of a file that cannot be a mark.

    Parameters
    ----------
    alike : str, optional
        What labels of the kind must have in common to be counted together.
    """

    def __init__(self, where: str, kind: str, reason: str, alike: str = "") -> None:
        super().__init__(f"{where}: {reason}")
        self.kind = kind
        self.alike = alike


class LeftOut:
    """Labels of a file that are left out: how many of each kind, and the first of them.

    Parameters
    ----------
    strict : bool
        Whether none may be left out.
    """

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._counts: Counter[tuple[str, str]] = Counter()
        self._first: dict[tuple[str, str], LineError] = {}

    def add(self, error: LineError) -> None:
        """Leave out a label.

        Raise `LineError` if none may be left out.
        """
        if self._strict:
            raise error
        key = error.kind, error.alike
        self._counts[key] += 1
        self._first.setdefault(key, error)

    def kinds(self) -> Iterator[tuple[int, LineError]]:
        """Yield how many there are of each kind, and the first; the most first."""
        for key, count in self._counts.most_common():
            yield count, self._first[key]
