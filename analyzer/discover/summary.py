"""What there is to say of each group of sounds."""

from datetime import date, tzinfo

import numpy as np

from hearthlog.analyzer.discover.groups import Groups
from hearthlog.analyzer.discover.read_sounds import HomeSounds
from hearthlog.analyzer.discover.summary_file import (
    LONGEST_TEXT,
    MOST_LABELS,
    MOST_MICROPHONES,
    Example,
    GroupSummary,
)
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import printable, shortened
from hearthlog.schemas.frames import NANOSECONDS, time_text

_HOURS = 24
_SHOWN = 3


def summarise(
    sounds: HomeSounds, groups: Groups, of: Int64, points: Float64, zone: tzinfo
) -> list[GroupSummary]:
    """Summarise the groups that some sounds are of, the largest first."""
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
    names = {sounds.microphones[i] for i in sounds.microphone[rows]}
    return GroupSummary(
        number=number,
        name=name,
        times=len(rows),
        days=len(days),
        hours=hours.tolist(),
        seconds=float(seconds),
        alike=max(1.0 - float(np.median(away)) / apart, 0.0) if apart else 1.0,
        labels={
            shortened(str(labels[i]), LONGEST_TEXT): float(counts[i]) / len(rows)
            for i in order[:MOST_LABELS]
        },
        microphones=[shortened(each, LONGEST_TEXT) for each in sorted(names)[:MOST_MICROPHONES]],
        examples=[_example(sounds, row) for row in middle.tolist()],
    )


def _example(sounds: HomeSounds, row: int) -> Example:
    spans = sounds.spans
    return Example(
        log=printable(sounds.logs[sounds.log[row]]),
        microphone=shortened(sounds.microphones[sounds.microphone[row]], LONGEST_TEXT),
        start=time_text(int(spans.starts[row])),
        end=time_text(int(spans.ends[row])),
    )


def _typical_distance(points: Float64) -> float:
    if not len(points):
        return 0.0
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
