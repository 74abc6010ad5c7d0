"""Extensions: objects of other distributions, by name."""

from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Generic, Protocol, TypeVar

from hearthlog.schemas.errors import HearthlogError, ModelError

_OF_EXAMPLES = {  # extensions in `examples` of a clone of hearthlog, by distribution
    "hearthlog-classifiers": (
        *("layers", "neighbours", "one-class", "trees"),
        *("boosting", "extra-trees", "forest", "logistic", "perceptron"),
    ),
    "hearthlog-example": ("octaves", "nearest-mean", "nearest-octaves"),
    "hearthlog-feature-sets": ("logmel", "plp", "rasta", "sai"),
}


class Named(Protocol):
    """An object with a name."""

    @property
    def name(self) -> str:
        """Name in entry points and model files."""


T = TypeVar("T", bound=Named)


class Extensions(Generic[T]):
    """Objects of one kind, by name: built-in objects, and entry points of other distributions.

    Entry points are only looked up for names that are not built in, so a recorder with a built-in
    model imports nothing else. The error `missing` is raised if there is no object of a name.
    """

    def __init__(
        self,
        group: str,
        kind: type[T],
        word: str,
        ours: Sequence[T],
        missing: type[HearthlogError] = ModelError,
    ) -> None:
        self._group = group
        self._word = word
        self._missing = missing
        self._kind = kind
        self._ours = {one.name: one for one in ours}
        self._loaded = dict(self._ours)

    def names(self) -> list[str]:
        """Return all names: built-in names first, then the others in alphabetical order."""
        theirs = {point.name for point in entry_points(group=self._group)}
        return [*self._ours, *sorted(theirs - self._ours.keys())]

    def has(self, name: str) -> bool:
        """Return whether there is an object of this name, without importing it."""
        return name in self._loaded or bool(entry_points(group=self._group, name=name))

    def distribution(self, name: str) -> str:
        """Return the distribution and version of an extension; empty for built-in objects."""
        points = () if name in self._ours else entry_points(group=self._group, name=name)
        names = [f"{p.dist.name} {p.dist.version}" for p in points if p.dist is not None]
        return names[0] if names else ""

    def get(self, name: str) -> T:
        """Return an object by its name.

        Raise the error `missing` if there is none, `ModelError` if its entry point cannot be
        imported, or is not an object of this kind and name.
        """
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
        if name not in self._loaded:
            installed = ", ".join(self.names())
            raise self._missing(
                f"{self._word} {name[:64]!r} is not installed; {_brought_by(name)}there is "
                f"{installed}"
            )
        return self._loaded[name]


def _brought_by(name: str) -> str:
    """Name our example distribution that provides a name, if there is one."""
    for distribution, names in _OF_EXAMPLES.items():
        if name in names:
            return (
                f"distribution {distribution}, in examples of a clone of hearthlog, provides it; "
            )
    return ""
