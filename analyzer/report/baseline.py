"""What is usual in this home: the same figure on its last days."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.report.values import Value, whole

DAYS = 28
FEWEST = 7


class Usual(NamedTuple):
    """Median, lowest and highest of some days."""

    median: float
    lowest: float
    highest: float


def usual(values: Sequence[Value | None]) -> Usual | None:
    """Return what is usual; None if there are too few days.

    Parameters
    ----------
    values : sequence of (Count, Minutes, Clock or None)
        The same figure on each day; None where it is not known.

    Returns
    -------
    Usual or None
        Of the `middle` of each value; None if fewer than seven days have one.
    """
    numbers = [value.middle for value in values if value is not None]
    if len(numbers) < FEWEST:
        return None
    return Usual(float(np.median(numbers)), min(numbers), max(numbers))


def compared(value: Value, baseline: Usual) -> int:
    """Compare a figure, as labelled, with what is usual.

    Returns
    -------
    int
        1: more than on any of those days, or later; -1: less, or earlier; 0: as usual.
    """
    if whole(value.middle) > whole(baseline.highest):
        return 1
    return -1 if whole(value.middle) < whole(baseline.lowest) else 0
