"""The lanes of a watch: which there are, how they look, and how they change."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.colours import GAP, Colour, colour
from hearthlog.analyzer.review.timeline.model import LabelledSpans
from hearthlog.schemas.arrays import Int64

_TROUBLE: Colour = (240, 140, 40)
_TROUBLES = {"warning": _TROUBLE, "error": (230, 60, 60), "stale": (150, 90, 160)}
TROUBLES = tuple(_TROUBLES)  # texts of a live lane, by the level of a diagnostic status less one
NOT_HEARD = "not heard"


@dataclass(frozen=True)
class LaneKind:
    """How lanes of one kind look; the viewer shows them in the order of their names."""

    name: str
    colours: Callable[[Iterable[str]], dict[str, Colour]]  # of states
    states: Sequence[str] = ()  # that a watch announces to the viewer before they occur


def _class_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: colour(state) for state in states}


def _trouble_colours(states: Iterable[str]) -> dict[str, Colour]:
    return {state: _TROUBLES.get(state, _TROUBLE) for state in states}


RECORDER = LaneKind("Heard", _class_colours)
GAPS = LaneKind("Not_heard", lambda states: dict.fromkeys(states, GAP), [NOT_HEARD])
TROUBLE = LaneKind("Trouble", _trouble_colours, TROUBLES)


def scenario_kind(labelling: str) -> LaneKind:
    """Return the kind of lane of a scenario, which shows its segments once they are closed."""
    return LaneKind(labelling.replace("/", "_").capitalize(), _class_colours)


class Changes(NamedTuple):
    """When a lane changes, and to which states.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    states : list of (str or None)
        None is no state.
    """

    times: Int64
    states: list[str | None]


class StateLane(NamedTuple):
    """What is new in a lane."""

    kind: LaneKind
    microphone: str
    changes: Changes


def changes(spans: LabelledSpans) -> Changes:
    """Turn spans into changes of a lane.

    Returns
    -------
    Changes
        Each span begins with its text, and ends with None unless the next one follows at once.
    """
    followed = np.append(spans.starts[1:], np.iinfo(np.int64).max)
    last = np.flatnonzero(spans.ends < followed)
    times = np.concatenate([spans.ends[last], spans.starts])
    states = [*[None] * len(last), *spans.texts]
    order = np.argsort(times, kind="stable")
    return Changes(times[order], [states[i] for i in order])
