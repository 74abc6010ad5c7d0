"""Extensions: objects of other distributions, by name."""

from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Generic, Protocol, TypeVar

from hearthlog.models.errors import ModelError


class Named(Protocol):
    """Anything with a name."""

    @property
    def name(self) -> str:
        """Name in entry points and model files."""


T = TypeVar("T", bound=Named)


class Extensions(Generic[T]):
    """Objects of one kind, by name: our own, and those of other distributions' entry points.

    Entry points are only looked up for names that are not ours, so that a recorder with a model
    of ours imports nothing else.

    Parameters
    ----------
    group : str
        Group of entry points, such as "hearthlog.feature_sets". Each is an object of this kind
        whose `name` is the name of the entry point.
    kind : type
        Class of the objects.
    ours : sequence of T
    """

    def __init__(self, group: str, kind: type[T], ours: Sequence[T]) -> None:
        self._group = group
        self._kind = kind
        self._ours = {one.name: one for one in ours}
        self._loaded = dict(self._ours)

    def names(self) -> list[str]:
        """Return all names, ours first."""
        theirs = {point.name for point in entry_points(group=self._group)}
        return [*self._ours, *sorted(theirs - self._ours.keys())]

    def get(self, name: str) -> T | None:
        """Return an object by its name, or None; raises ModelError if it cannot be imported."""
        if name not in self._loaded:
            for point in entry_points(group=self._group, name=name):
                try:
                    loaded = point.load()
                except Exception as error:  # foreign code may raise anything
                    raise ModelError(f"{point.value} cannot be imported: {error!r}") from error
                if not isinstance(loaded, self._kind) or loaded.name != name:
                    what = f"no {self._kind.__name__} of the name {name!r}"
                    raise ModelError(f"{point.value} is {what}; see docs/extending.md")
                self._loaded[name] = loaded
        return self._loaded.get(name)
