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
    """Return what is usual; None if there are too few days."""
    numbers = [value.middle for value in values if value is not None]
    if len(numbers) < FEWEST:
        return None
    return Usual(float(np.median(numbers)), min(numbers), max(numbers))


def compared(value: Value, baseline: Usual) -> int:
    """Compare a figure, as far as it is sure, with what is usual.

    Returns
    -------
    int
        1: more than on any of those days, or later; -1: less, or earlier; 0: as usual.
    """
    if whole(value.low) > whole(baseline.highest):
        return 1
    return -1 if whole(value.high) < whole(baseline.lowest) else 0
