"""The weeks of a simulated quarter: how well they were labelled, and what that took."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hearthlog.analyzer.evaluation import false_alarms_per_day, indexed_events
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import overlay
from hearthlog.models.classes import OTHER_NEGATIVE, SILENCE, UNKNOWN, class_name
from hearthlog.schemas.frames import NANOSECONDS

WRONG_WEEK, MICROPHONE_WEEK = 6, 9  # counted from 1
_NO_EVENTS = {SILENCE, UNKNOWN, OTHER_NEGATIVE}


@dataclass(frozen=True)
class Scored:
    """A labelling against the truth.

    Attributes
    ----------
    seconds : dict of str to dict of str to float
        What is true, what was labelled, and for how long.
    false_events : dict of str to float
        By class, in 24 hours.
    """

    seconds: dict[str, dict[str, float]]
    false_events: dict[str, float]

    def f1(self, classes: Sequence[str]) -> dict[str, float]:
        """Return the F1 of frames of those of some classes that occur.

        Parameters
        ----------
        classes : sequence of str
        """
        true = {name: sum(row.values()) for name, row in self.seconds.items()}
        labelled = {
            name: sum(row.get(name, 0.0) for row in self.seconds.values()) for name in classes
        }
        return {
            name: 2.0 * self.seconds[name].get(name, 0.0) / (true[name] + labelled[name])
            for name in classes
            if true.get(name)
        }

    def macro_f1(self, classes: Sequence[str]) -> float:
        """Return the mean F1 of frames of those of some classes that occur.

        Parameters
        ----------
        classes : sequence of str
        """
        return float(np.mean(list(self.f1(classes).values())))


@dataclass(frozen=True)
class Week:
    """A week of a home.

    Attributes
    ----------
    number : int
        From 1.
    model : str
        That labelled it.
    circle, alone : Scored
        Its labels, and those that the starter model would have given.
    minutes, marks, spans, random : float, int
        What the person was asked: minutes, marks made, spans and minutes gone through.
    trained, promoted : bool
        Whether a model came of it, and was let label.
    said : str
        The last lines of `train` and `promote`.
    """

    number: int
    model: str
    circle: Scored
    alone: Scored
    minutes: float
    marks: int
    spans: int
    random: int
    trained: bool
    promoted: bool
    said: list[str] = field(default_factory=list)


def scored(truth: Labelling, labelled: Labelling) -> Scored:
    """Score a labelling where both it and the truth have labels.

    Parameters
    ----------
    truth, labelled : Labelling
        In the order of time, one label at a time.
    """
    true, own = _named(truth), _named(labelled)
    parts = overlay([true, own]).in_all()
    seconds: dict[str, dict[str, float]] = {}
    pairs = np.stack([true.labels[parts.rows[0]], own.labels[parts.rows[1]]])
    names = sorted({*pairs.ravel()})
    codes = np.searchsorted(names, pairs.astype(str))
    table = np.zeros((len(names), len(names)))
    np.add.at(table, tuple(codes), (parts.ends - parts.starts) / NANOSECONDS)
    for row, column in np.argwhere(table).tolist():
        seconds.setdefault(names[row], {})[names[column]] = round(table[row, column], 3)
    duration = int((parts.ends - parts.starts).sum())
    classes = sorted({*true.labels, *own.labels})
    false = false_alarms_per_day(
        indexed_events(true, classes), indexed_events(own, classes), classes, duration
    )
    return Scored(seconds, {name: n for name, n in false.items() if n and name not in _NO_EVENTS})


def _named(labelling: Labelling) -> Labelling:
    names = {label: class_name(label) for label in set(labelling.labels)}
    names |= {OTHER_NEGATIVE: UNKNOWN}
    return replace(labelling, labels=np.array([names[x] for x in labelling.labels], object))
