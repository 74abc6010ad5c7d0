"""What is true of a day of a composed home, by the definitions of a report."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.daily_metrics import DayMetrics, day_of, metrics_of_home
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.home_data import HomeData
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, difference, joined
from hearthlog.models.classes import (
    FLUSHING_WATER,
    MUSIC,
    OTHER,
    RUNNING_WATER,
    SHOWER,
    SILENCE,
    SPEECH,
    TAP_WATER,
    TELEVISION,
    class_name,
)
from hearthlog.schemas.arrays import Bool
from hearthlog.schemas.frames import NANOSECONDS

NEAR = MINUTE  # of a time that is told
_DEVICES = {"television", "radio"}
_OF_THE_HOME = {"", "resident", "phone", "outside"}
_WATER = {FLUSHING_WATER, SHOWER, TAP_WATER}
_HEARD_SO = {SPEECH, MUSIC}  # talking from a television is talking all the same
_PAUSE = 20 * MINUTE  # of a television, as in a report


@dataclass(frozen=True)
class TrueDay:
    """What is true of a day, by the definitions of a report.

    Attributes
    ----------
    metrics : DayMetrics
        Of the true sounds. The minutes with a television are those of the labels, since what is set
        apart is not counted.
    everywhere : DayMetrics
        The same without minutes set apart.
    television : Spans
        When a television, a radio or company sounded.
    """

    metrics: DayMetrics
    everywhere: DayMetrics
    television: Spans

    def near(self, name: str, start: int) -> bool:
        """Whether a true sound of a class is within a minute of a time."""
        spans = self.everywhere.home.spans.get(name, NONE)
        return bool(cut(spans, start - NEAR, start + NEAR + 1).length)


class TrueSound(NamedTuple):
    """A true sound, in nanoseconds of UTC; `origin` is empty if unknown."""

    start: int
    end: int
    label: str
    origin: str


def read_sounds(home: Path, start: int) -> list[TrueSound]:
    """Read the true sounds of a composed home that can be heard.

    Parameters
    ----------
    start : int
        Time of its first sample, in nanoseconds of UTC.

    Raises
    ------
    DataError
        If the table cannot be read.
    """
    try:
        rows = list(csv.DictReader((home / "events.csv").read_text("utf-8").splitlines()))
        return [
            TrueSound(
                *(start + round(float(row[edge]) * NANOSECONDS) for edge in ("start", "end")),
                class_name(row["label"]),
                row.get("from") or "",
            )
            for row in rows
            if float(row.get("heard_seconds") or 1) > 0
        ]
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"{home}/events.csv: cannot be read ({error})") from error


def true_day(sounds: Sequence[TrueSound], day: DayMetrics) -> TrueDay:
    """Return what is true of a labelled day."""
    known = {*day.home.classes, SPEECH, MUSIC}

    def called(sound: TrueSound) -> str:
        if sound.origin in _DEVICES and sound.label not in _HEARD_SO:
            return TELEVISION
        if RUNNING_WATER in known and sound.label in _WATER:
            return RUNNING_WATER
        return sound.label if sound.label in known or OTHER not in known else OTHER

    rows = sorted((sound.start, sound.end, called(sound)) for sound in sounds)
    starts, ends = (np.array([row[i] for row in rows], np.int64) for i in (0, 1))
    quiet = difference(day.home.coverage, joined(starts, ends))
    labels = np.array([row[2] for row in rows] + [SILENCE] * len(quiet.starts), object)
    order = np.argsort(np.concatenate([starts, quiet.starts]), kind="stable")
    edges = (np.concatenate(both)[order] for both in zip((starts, ends), quiet, strict=True))
    source = ("truth", "mic")
    labelling = Labelling(*edges, labels[order])
    classes = [*dict.fromkeys([*day.home.classes, *labels.tolist()])]
    data = HomeData({source: labelling}, {source: labelling}, {}, {source: classes})
    home = metrics_of_home(data)
    apart = np.isin(home.minutes.starts, day.home.minutes.starts[day.home.minutes.television])
    others = [s for s in sounds if s.origin not in _OF_THE_HOME]
    on = joined(*(np.array([s[i] for s in others], np.int64) for i in (0, 1)), _PAUSE)

    def of(television: Bool) -> DayMetrics:
        minutes = replace(home.minutes, television=television)
        return day_of(replace(home, minutes=minutes), day.day, day.zone)

    return TrueDay(of(apart), of(np.zeros(len(apart), bool)), on)
