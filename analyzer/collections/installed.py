"""The collections that can be read: the one table of them.

A collection is a module of this folder, with a function `read` as `esc50` has, a map in `maps`, and
a row here.
"""

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.collections.clip import CollectionClip
from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.errors import listed


class Collection(NamedTuple):
    """A collection.

    Attributes
    ----------
    markers : tuple of str
        Files or folders, or patterns of them, of which one is in every folder of the collection;
        empty for any folder.
    """

    name: str
    title: str
    markers: tuple[str, ...]

    @property
    def read(self) -> Callable[[Path], Iterator[CollectionClip]]:
        """The reader of the collection."""
        module = import_module(f"{__package__}.{self.name.replace('-', '_')}")
        return module.read


FOLDER = Collection("folder", "", ())
COLLECTIONS = (
    Collection("esc50", "ESC-50", ("meta/esc50.csv",)),
    Collection("fsd50k", "FSD50K", ("FSD50K.ground_truth",)),
    Collection("urbansound8k", "UrbanSound8K", ("metadata/UrbanSound8K.csv",)),
    Collection("desed", "DESED", ("metadata/validation", "metadata/eval", "metadata/train")),
    Collection("vocalsound", "VocalSound", ("audio_16k", "audio_44k")),
    Collection("audioset-strong", "AudioSet", ("mid_to_display_name.tsv",)),
    Collection("ravdess", "RAVDESS", ("Actor_??", "*/Actor_??")),
    Collection("emodb", "EmoDB", ("wav/??[ab]??[WLEAFTN]*.wav",)),
    Collection("voxceleb", "VoxCeleb", ("wav/id?????", "aac/id?????")),
    FOLDER,
)
NAMES = tuple(collection.name for collection in COLLECTIONS)


def find_collection(name: str) -> Collection | None:
    """Return the collection of a name; None if there is none."""
    return next((each for each in COLLECTIONS if each.name == name), None)


def check_folder(folder: Path, collection: Collection) -> None:
    """Check that a folder looks as that of a collection.

    Raise `DataError` if there is no such folder, or it looks as another, or another version of
    it.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    if not collection.markers or _is_of(folder, collection):
        return
    wanted = listed(collection.markers)
    for inner in sorted(folder.iterdir()):
        if inner.is_dir() and _is_of(inner, collection):
            raise DataError(f"{folder}: has no {wanted}, but {inner} has; give that folder")
    others = [each for each in COLLECTIONS if each.markers and _is_of(folder, each)]
    if others:
        raise DataError(
            f"{folder}: has no {wanted}, and looks as {others[0].title}; use `hearthlog manifest "
            f"{others[0].name}`"
        )
    raise DataError(
        f"{folder}: has no {wanted}, so this is not the folder of {collection.title}, or of "
        "another version of it"
    )


def _is_of(folder: Path, collection: Collection) -> bool:
    return any(True for marker in collection.markers for _ in folder.glob(marker))
