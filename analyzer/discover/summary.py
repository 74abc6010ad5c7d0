"""What there is to say of each group of sounds."""

from dataclasses import dataclass
from datetime import date, tzinfo
from pathlib import Path

import numpy as np

from hearthlog.analyzer.discover.groups import Groups
from hearthlog.analyzer.discover.read_sounds import HomeSounds
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.times import NANOSECONDS

_HOURS = 24
_USUAL = 0.8  # of the sounds are in the usual hours
_SHOWN = 3


@dataclass(frozen=True)
class Example:
    """A sound that stands for its group; times in nanoseconds of UTC."""

    log: Path
    microphone: str
    start: int
    end: int


@dataclass(frozen=True)
class GroupSummary:
    """A group of sounds that are alike.

    Attributes
    ----------
    number : int
    name : str
        The class that a person named it; empty where nobody did.
    times : int
        How many sounds there are of it.
    days : int
        On how many days, at home.
    hours : list of int
        How many of them began in each hour of the day, at home.
    seconds : float
        Their median length.
    alike : float
        0: they differ as any sounds of the home do; 1: they are all the same.
    labels : dict of str to float
        What share of them each label has, the most frequent first.
    microphones : list of str
        Which heard them.
    examples : list of Example
        Those in the middle of the group.
    """

    number: int
    name: str
    times: int
    days: int
    hours: list[int]
    seconds: float
    alike: float
    labels: dict[str, float]
    microphones: list[str]
    examples: list[Example]


def summarise(
    sounds: HomeSounds, groups: Groups, of: Int64, points: Float64, zone: tzinfo
) -> list[GroupSummary]:
    """Summarise the groups that some sounds are of, the largest first.

    Parameters
    ----------
    sounds : HomeSounds
    groups : Groups
    of, points : np.ndarray
        As `discover` returns them.
    zone : tzinfo
        Of the home.
    """
    apart = _typical_distance(points)
    found = []
    for row, number in enumerate(groups.numbers.tolist()):
        rows = np.flatnonzero(of == row)
        if len(rows):
            found.append(_summary(sounds, groups.names[row], number, rows, points, apart, zone))
    return sorted(found, key=lambda each: (-each.times, each.number))


def _summary(  # noqa: PLR0913, PLR0917
    sounds: HomeSounds,
    name: str,
    number: int,
    rows: Int64,
    points: Float64,
    apart: float,
    zone: tzinfo,
) -> GroupSummary:
    spans = sounds.spans
    moments = [local_time(start, zone) for start in spans.starts[rows].tolist()]
    days: set[date] = {moment.date() for moment in moments}
    hours = np.bincount([moment.hour for moment in moments], minlength=_HOURS)
    labels, counts = np.unique(spans.labels[rows], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    away = np.linalg.norm(points[rows] - np.median(points[rows], axis=0), axis=1)
    seconds = np.median(spans.ends[rows] - spans.starts[rows]) / NANOSECONDS
    middle = rows[np.argsort(away, kind="stable")[:_SHOWN]]
    return GroupSummary(
        number,
        name,
        len(rows),
        len(days),
        hours.tolist(),
        float(seconds),
        max(1.0 - float(np.median(away)) / apart, 0.0) if apart else 1.0,
        {str(labels[i]): float(counts[i]) / len(rows) for i in order},
        sorted({sounds.microphones[i] for i in sounds.microphone[rows]}),
        [_example(sounds, row) for row in middle.tolist()],
    )


def _example(sounds: HomeSounds, row: int) -> Example:
    spans = sounds.spans
    return Example(
        sounds.logs[sounds.log[row]],
        sounds.microphones[sounds.microphone[row]],
        int(spans.starts[row]),
        int(spans.ends[row]),
    )


def _typical_distance(points: Float64) -> float:
    if not len(points):
        return 0.0
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


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
