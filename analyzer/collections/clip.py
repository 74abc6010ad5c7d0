"""What the reader of a collection yields: audio files, and what is heard in them."""

import math
from pathlib import Path
from typing import NamedTuple


class Sound(NamedTuple):
    """What is heard in a file, or in a part of it.

    Attributes
    ----------
    start, end : float
        Seconds; `end` is infinite for the rest of the file.
    """

    categories: tuple[str, ...]
    start: float = 0.0
    end: float = math.inf


class CollectionClip(NamedTuple):
    """An audio file of a collection.

    Attributes
    ----------
    source_group : str
        The original recording or speaker, with a prefix for where its number is from: groups of
        two collections are the same only if their recordings are.
    left_out : str
        Why the clip is of no use; empty if it is.
    """

    path: Path
    sounds: tuple[Sound, ...]
    source_group: str
    licence: str
    seconds: float = math.inf
    left_out: str = ""
