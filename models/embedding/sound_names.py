"""What AudioSet has names for: sounds that are named by the network alone, without training.

A name is an *event* only where a threshold was measured on recordings; others are *hints*, said
too often to be counted. `audioset_names.csv` has names, words and durations, and what
`hearthlog.tools.lab.names` measured.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hearthlog.models.embedding.embeddings import HOP_FRAMES, WINDOW_FRAMES, Embeddings
from hearthlog.models.embedding.projection import Projection
from hearthlog.schemas.arrays import Float64, Int64

_FILE = Path(__file__).with_name("audioset_names.csv")
RELEASE = 1.0  # logits below the threshold at which a sound still goes on
_PAUSE_FRAMES = 2 * HOP_FRAMES  # between windows of one sound at most
_MARGIN = (WINDOW_FRAMES - HOP_FRAMES) // 2  # frames of a window before and behind its middle


class SoundName(NamedTuple):
    """A name of a sound, and how well it is heard.

    Attributes
    ----------
    is_event : bool
        Whether it was measured to be right often enough; else it is a hint.
    precision, recall, false_an_hour : float
        Of an event on sources that its threshold was not chosen on, of a hint on all; NaN where
        there are too few.
    """

    name: str
    words: str
    group: str
    seconds: float
    windows: int
    threshold: float = 0.0
    is_event: bool = False
    clips: int = 0
    sources: int = 0
    precision: float = math.nan
    recall: float = math.nan
    false_an_hour: float = math.nan


@cache
def audioset_names() -> tuple[SoundName, ...]:
    """Return the names that hearthlog knows."""
    return tuple(read_names(_FILE))


def read_names(path: Path) -> list[SoundName]:
    """Read a table of names.

    Parameters
    ----------
    path : Path
        CSV, with the fields of `SoundName` as columns; numbers may be left out.
    """
    types = SoundName.__annotations__
    with path.open(newline="", encoding="utf-8") as stream:
        rows = [{key: text for key, text in row.items() if text} for row in csv.DictReader(stream)]
    return [SoundName(**{key: _VALUES[types[key]](row[key]) for key in row}) for row in rows]


def write_names(names: Sequence[SoundName], path: Path) -> None:
    """Write a table of names, as `read_names` reads it."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(SoundName._fields)
        writer.writerows(map(_text, row) for row in names)


class NamedSound(NamedTuple):
    """A sound that the network named.

    Attributes
    ----------
    first, end : int
        Numbers of its first frame, and of the one behind its last.
    """

    name: SoundName
    first: int
    end: int
    logit: float


def named_sounds(
    embeddings: Embeddings, projection: Projection, names: Sequence[SoundName] | None = None
) -> list[NamedSound]:
    """Find the sounds that the network names in windows of one stream.

    A sound begins with a window above the threshold, and goes on while windows no more than a
    second apart are above it or a little below.

    Raise `ValueError` if the projection has not the group of a name.
    """
    names = audioset_names() if names is None else names
    columns, sounds = _columns(projection, names), list[NamedSound]()
    if not len(embeddings.frames):
        return sounds
    logits = projection.values(embeddings.values)[:, columns]
    above_low = (projection.lows + projection.steps)[columns]  # the low itself is nothing heard
    for place, name in enumerate(names):
        sounds += _named(name, logits[:, place], embeddings.frames, float(above_low[place]))
    return sorted(sounds, key=lambda sound: sound.first)


def _named(name: SoundName, logits: Float64, frames: Int64, above_low: float) -> list[NamedSound]:
    """Return the sounds of one name."""
    above = logits >= name.threshold
    rows = np.flatnonzero(above | (logits >= max(name.threshold - RELEASE, above_low)))
    if not len(rows):
        return []
    begins = np.flatnonzero(np.diff(frames[rows], prepend=-_PAUSE_FRAMES - 1) > _PAUSE_FRAMES)
    counts = np.add.reduceat(above[rows].astype(np.int64), begins)
    highest = np.maximum.reduceat(logits[rows], begins)
    never = len(frames)
    first = np.minimum.reduceat(np.where(above[rows], rows, never), begins)
    last = rows[np.append(begins[1:], len(rows)) - 1]
    found = np.flatnonzero((counts > 0) & (counts >= name.windows))
    return [
        NamedSound(
            name,
            int(frames[first[run]]) + _MARGIN,
            int(frames[last[run]]) + WINDOW_FRAMES - _MARGIN,
            float(highest[run]),
        )
        for run in found.tolist()
    ]


def _columns(projection: Projection, names: Sequence[SoundName]) -> list[int]:
    missing = {name.group for name in names}.difference(projection.names)
    if missing:
        raise ValueError(f"the projection has no group {', '.join(sorted(missing))}")
    return [projection.names.index(name.group) for name in names]


def _yes(text: str) -> bool:
    return text == "yes"


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:g}"
    return str(value)


_VALUES: Mapping[object, Callable[[str], Any]] = {str: str, float: float, int: int, bool: _yes}
