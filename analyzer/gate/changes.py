"""What another labelling changes, in minutes for each pair of classes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.evaluation.difference import Difference
from hearthlog.models.classes import SILENCE, find_class
from hearthlog.schemas.arrays import Float64, Indices

A_DAY = " a day"
_LEAST_MINUTES = 0.5  # of a change that is told


class Change(NamedTuple):
    """Time that one labelling gives to a class and the other to another class."""

    before: str
    after: str
    minutes: float
    each: str  # a word for the time they are of, as in `Changes`

    def __str__(self) -> str:
        """Say it: `20 h 15 min a day from silence to household sounds`."""
        before, after = class_words(self.before), class_words(self.after)
        return f"{time_words(self.minutes)}{self.each} from {before} to {after}"


@dataclass(frozen=True, eq=False)
class Changes:
    """Two labellings of the same time.

    Attributes
    ----------
    minutes : np.ndarray [shape=(C, C)], float64
        That have the class of the row in the first labelling and that of the column in the second.
    each : str, optional
        ` a day` if the minutes are of a mean day; empty if they are of all that was recorded.
    """

    classes: Sequence[str]
    minutes: Float64
    each: str = A_DAY

    @property
    def before(self) -> Float64:
        """Minutes of each class in the first labelling."""
        return self.minutes.sum(axis=1)

    @property
    def after(self) -> Float64:
        """Minutes of each class in the second labelling."""
        return self.minutes.sum(axis=0)

    def pairs(self) -> list[Change]:
        """List the changes of half a minute or more, the longest first."""
        told = (self.minutes >= _LEAST_MINUTES) & ~np.eye(len(self.classes), dtype=bool)
        places = np.argwhere(told)
        changes = [
            Change(self.classes[i], self.classes[j], float(self.minutes[i, j]), self.each)
            for i, j in places.tolist()
        ]
        return sorted(changes, key=lambda change: -change.minutes)

    def words(self, minutes: float) -> str:
        """Write some of the minutes: `20 h 15 min a day`."""
        return time_words(minutes) + self.each


def changes_of_frames(
    classes: Sequence[str],
    before: Indices,
    after: Indices,
    minutes: Float64,
    each: str = A_DAY,
) -> Changes:
    """Count the changes of frames.

    Parameters
    ----------
    before, after : np.ndarray [shape=(n,)], int
        Indices of the classes of the same frames in both labellings.
    minutes : np.ndarray [shape=(n,)], float64
        That each frame stands for.
    """
    counts = np.bincount(before * len(classes) + after, minutes, len(classes) ** 2)
    table = counts.reshape(len(classes), len(classes)).astype(np.float64)
    return Changes(classes, table, each)


def changes_of_labellings(difference: Difference) -> Changes:
    """Count the changes of two labellings that were compared, in a mean day of what both label."""
    minutes = np.array(difference.confusion, np.float64)
    return Changes(difference.classes, minutes / len(difference.days))


def class_words(name: str) -> str:
    """Name a class in the middle of a sentence."""
    row = None if name == SILENCE else find_class(name)
    return name.replace("_", " ") if row is None else row.words.lower()


def time_words(minutes: float) -> str:
    """Write a length of time: `20 h 15 min`, `0.7 min`."""
    if minutes < 10:
        return f"{minutes:.1f} min"
    hours, rest = divmod(round(minutes), 60)
    return f"{hours} h {rest:02} min" if hours else f"{rest} min"
