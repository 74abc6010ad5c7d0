"""What AudioSet has names for: sounds that are named by the network alone, without training.

A name is an *event* only where a threshold was measured on recordings; others are *hints*, said
too often to be counted. `audioset_names.csv` has names, words and durations, and what
`hearthlog.tools.bench.names` measured.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hearthlog.models.embedding.embeddings import HOP_FRAMES, WINDOW_FRAMES, Embeddings, Int8
from hearthlog.models.embedding.projection import Projection
from hearthlog.schemas.arrays import Float64

_FILE = Path(__file__).with_name("audioset_names.csv")
RELEASE = 1.0  # logits below the threshold at which a sound still goes on
_PAUSE_FRAMES = 2 * HOP_FRAMES  # between windows of one sound at most
_MARGIN = (WINDOW_FRAMES - HOP_FRAMES) // 2  # frames of a window before and behind its middle


class SoundName(NamedTuple):
    """A name of a sound, and how well it is heard.

    Attributes
    ----------
    name : str
        Of the class; that of `hearthlog.models.classes` where it means the same.
    words : str
        What people call the sound.
    group : str
        The group of AudioSet's names that says it.
    seconds : float
        Expected duration without a pause.
    windows : int
        How many windows must say it.
    threshold : float
        Logit from which a window says it.
    is_event : bool
        Whether it was measured to be right often enough; else it is a hint.
    clips, sources : int
        Recordings of it that it was measured with.
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
    """Write a table of names, as `read_names` reads it.

    Parameters
    ----------
    names : sequence of SoundName
    path : Path
    """
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(SoundName._fields)
        writer.writerows(map(_text, row) for row in names)


class NamedSound(NamedTuple):
    """A sound that the network named.

    Attributes
    ----------
    name : SoundName
    first, end : int
        Numbers of its first frame, and of the one behind its last.
    logit : float
        The highest.
    """

    name: SoundName
    first: int
    end: int
    logit: float


def name_logits(values: Int8, projection: Projection, names: Sequence[SoundName]) -> Float64:
    """Return what is logged of some names.

    Parameters
    ----------
    values : np.ndarray [shape=(m, W)], int8
        Of windows.
    projection : Projection
    names : sequence of SoundName

    Returns
    -------
    np.ndarray [shape=(m, K)], float64

    Raises
    ------
    ValueError
        If the projection has not the group of a name.
    """
    return projection.values(values)[:, _columns(projection, names)]


class NamedSounds:
    """Finds the sounds that the network names in successive windows.

    A sound begins with a window above the threshold, and goes on while windows no more than a
    second apart are above it or a little below. Between sounds there is no window, so nothing
    depends on how many are pushed at once.

    Parameters
    ----------
    projection : Projection
        With which the windows were logged.
    names : sequence of SoundName, optional
        Those to look for; `audioset_names` by default.
    """

    def __init__(self, projection: Projection, names: Sequence[SoundName] | None = None) -> None:
        self._projection = projection
        self._names = audioset_names() if names is None else tuple(names)
        self._thresholds = np.array([name.threshold for name in self._names])
        self._columns = columns = _columns(projection, self._names)
        above_low = (projection.lows + projection.steps)[columns]  # the low itself is nothing heard
        self._release = np.maximum(self._thresholds - RELEASE, above_low)
        self._least = np.array([name.windows for name in self._names])
        count = len(self._names)
        self._first = np.full(count, -1, np.int64)  # where a sound goes on
        self._last, self._above = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._highest = np.zeros(count)

    def push(self, embeddings: Embeddings, begun: int) -> list[NamedSound]:
        """Add successive windows.

        Parameters
        ----------
        embeddings : Embeddings
        begun : int
            Number of a frame; windows that are still to come begin with it or later ones.

        Returns
        -------
        list of NamedSound
            The sounds that have ended, in the order in which they did.
        """
        ended: list[NamedSound] = []
        if len(embeddings.frames):
            logits = self._projection.values(embeddings.values)[:, self._columns]
            for frame, row in zip(embeddings.frames.tolist(), logits, strict=True):
                ended += self._ended(frame)
                self._add(frame, row)
        return ended + self._ended(begun)

    def close(self) -> list[NamedSound]:
        """End the sounds that go on; windows that follow are of another time."""
        return self._ended(np.iinfo(np.int64).max)

    def _add(self, frame: int, logits: Float64) -> None:
        above = logits >= self._thresholds
        begins, goes_on = above & (self._first < 0), logits >= self._release
        self._first[begins], self._above[begins], self._highest[begins] = frame, 0, -np.inf
        goes_on &= self._first >= 0
        self._last[goes_on] = frame
        self._above[above] += 1
        self._highest[above] = np.maximum(self._highest, logits)[above]

    def _ended(self, frame: int) -> list[NamedSound]:
        """End the sounds that no window from a frame on belongs to."""
        over = (self._first >= 0) & (frame - self._last > _PAUSE_FRAMES)
        told = np.flatnonzero(over & (self._above >= self._least))
        ended = [
            NamedSound(
                self._names[place],
                int(self._first[place]) + _MARGIN,
                int(self._last[place]) + WINDOW_FRAMES - _MARGIN,
                float(self._highest[place]),
            )
            for place in told[np.argsort(self._last[told], kind="stable")]
        ]
        self._first[over] = -1
        return ended


def named_sounds(
    embeddings: Embeddings, projection: Projection, names: Sequence[SoundName] | None = None
) -> list[NamedSound]:
    """Find the sounds that the network names in windows of one stream.

    Parameters
    ----------
    embeddings : Embeddings
    projection : Projection
        With which they were logged.
    names : sequence of SoundName, optional
        Those to look for; `audioset_names` by default.

    Returns
    -------
    list of NamedSound
        In the order of their first frames.
    """
    finder = NamedSounds(projection, names)
    sounds = [*finder.push(embeddings, 0), *finder.close()]
    return sorted(sounds, key=lambda sound: sound.first)


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
