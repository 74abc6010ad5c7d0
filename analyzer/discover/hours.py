"""At which hours of the day the sounds of a group are."""

import numpy as np

_HOURS = 24
_USUAL = 0.8  # of the sounds are in the usual hours


def usual_hours(hours: list[int]) -> str:
    """Return the shortest span of the day that has four fifths of the sounds, as `07 to 09`.

    Parameters
    ----------
    hours : list of int
        How many began in each hour of the day.

    Returns
    -------
    str
        Empty if that takes more than half of the day.
    """
    twice = np.cumsum([0, *hours, *hours])
    for length in range(1, _HOURS // 2 + 1):
        sums = twice[length : length + _HOURS] - twice[:_HOURS]
        if sums.max() >= _USUAL * sum(hours):
            first = int(sums.argmax())
            return f"{first:02d} to {(first + length) % _HOURS:02d}"
    return ""
