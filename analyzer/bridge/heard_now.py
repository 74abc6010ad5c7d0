"""Which classes a microphone hears now, from its labels."""

from collections.abc import Sequence

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

ANY_SOUND = ""  # in place of a class: whatever is not silence
HOLD_SECONDS = 10  # after the last frame of a class, it is over; as events are
_SECOND = 20  # frames
_LEAST = 8  # of them: fewer flicker, more come late


class HeardNow:
    """Tells which classes are heard: eight of the labels of a second name them.

    What it tells does not depend on how the labels are divided among calls, and of labels older
    than a second and the hold nothing is left.

    Attributes
    ----------
    time : int
        Of the newest label, in nanoseconds of UTC; 0 before the first.
    """

    def __init__(self, classes: Sequence[str]) -> None:
        self.time = 0
        self._classes = list(classes)
        self._last_heard = dict.fromkeys([*classes, ANY_SOUND], 0)
        self._last_labels = np.empty(0, np.int64)  # of less than a second

    def push(self, labels: Sequence[str], times: Int64) -> None:
        """Add labels.

        Parameters
        ----------
        times : np.ndarray [shape=(n,)], int64
            When they were known, in nanoseconds of UTC.
        """
        if not len(times):
            return
        if times[0] < self.time:  # the clock was set back: what was heard then was not just now
            self._last_heard = dict.fromkeys(self._last_heard, 0)
            self._last_labels = self._last_labels[:0]
        places = {name: place for place, name in enumerate(self._classes)}
        new = np.array([places.get(label, -1) for label in labels])
        known = np.concatenate([self._last_labels, new])
        silence = places.get(SILENCE, -2)
        for name in self._last_heard:
            is_of = known != silence if name == ANY_SOUND else known == places[name]
            sums = np.concatenate([np.zeros(_SECOND, np.int64), np.cumsum(is_of)])
            heard = (sums[_SECOND:] - sums[:-_SECOND])[len(self._last_labels) :] >= _LEAST
            if heard.any():
                self._last_heard[name] = int(times[np.flatnonzero(heard)[-1]])
        self._last_labels = known[-_SECOND + 1 :]
        self.time = int(times[-1])

    def is_heard(self, name: str) -> bool:
        """Tell whether a class was heard in the last ten seconds before the newest label."""
        last = self._last_heard.get(name, 0)
        return last > 0 and self.time - last <= HOLD_SECONDS * NANOSECONDS
