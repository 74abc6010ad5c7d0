"""What was heard in a home, as arrays: all that rules are evaluated on."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.bridge.alerts.rules import ANY_SOUND
from hearthlog.analyzer.bridge.listeners import is_of_scenario, microphone_of_listener
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, joined
from hearthlog.schemas.arrays import Bool, Float32, Int64


@dataclass(frozen=True)
class Sounds:
    """Segments of one class, or of several.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, in the order of the starts.
    confidences : np.ndarray [shape=(n,)], float32
    microphones : np.ndarray [shape=(n,)] of str
    """

    starts: Int64
    ends: Int64
    confidences: Float32
    microphones: NDArray[np.object_]

    def rows(self, rows: Bool) -> "Sounds":
        """Return some of the segments.

        Parameters
        ----------
        rows : np.ndarray [shape=(n,)], bool
        """
        return Sounds(
            self.starts[rows], self.ends[rows], self.confidences[rows], self.microphones[rows]
        )

    def between(self, start: int, end: int, pause: int) -> "Sounds":
        """Return what was heard in a span of time, with all of the events that go on in it.

        Parameters
        ----------
        pause : int
            Within an event, at most.
        """
        own = self.rows(self.starts < end)
        own = Sounds(own.starts, np.minimum(own.ends, end), own.confidences, own.microphones)
        events = joined(own.starts, own.ends, pause)
        first = np.searchsorted(events.ends, start)
        begin = events.starts[first] if first < len(events.starts) else end
        return own.rows(own.starts >= begin)


NO_SOUNDS = Sounds(NONE.starts, NONE.ends, np.empty(0, np.float32), np.empty(0, object))


def sounds_of(parts: Iterable[Sounds]) -> Sounds:
    """Put segments together, in the order of time."""
    parts = list(parts)
    if not parts:
        return NO_SOUNDS
    columns = [
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("starts", "ends", "confidences", "microphones")
    ]
    order = np.argsort(columns[0], kind="stable")
    return Sounds(*(column[order] for column in columns))


@dataclass(frozen=True)
class HomeHeard:
    """What was heard in a home.

    Attributes
    ----------
    sounds : mapping of str to Sounds
        By class, of the models of the home; silence is none.
    written : Spans
        When the recorder wrote; no more than a minute apart is one span.
    """

    sounds: Mapping[str, Sounds]
    scenario_sounds: Mapping[str, Sounds]
    coverage: Mapping[str, Spans]
    classes: Mapping[str, frozenset[str]]
    written: Spans

    def of(self, label: str) -> Sounds:
        """Return the segments of a class, or of any sound."""
        return sounds_of(self.sounds.values()) if label == ANY_SOUND else self._of(label)

    def _of(self, label: str) -> Sounds:
        own = self.sounds.get(label, NO_SOUNDS)
        others = self.scenario_sounds.get(label)
        return own if others is None else sounds_of([own, others])

    def listened(self, label: str, microphone: str) -> Spans:
        """Return when a class would have been heard.

        Parameters
        ----------
        microphone : str
            Empty: any of those whose models know the class.
        """
        knowing = [
            spans
            for name, spans in self.coverage.items()
            if microphone in {"", microphone_of_listener(name)} and self._knows(name, label)
        ]
        return reduce(_either, knowing, NONE)

    def _knows(self, listener: str, label: str) -> bool:
        known = self.classes.get(listener)
        if is_of_scenario(listener):
            return known is not None and label in known
        return known is None or label == ANY_SOUND or label in known

    def between(self, start: int, end: int, pause: int) -> "HomeHeard":
        """Return what was heard in a span of time, with all of the events that go on in it.

        Parameters
        ----------
        pause : int
            Within an event, at most.
        """
        return HomeHeard(
            {label: sounds.between(start, end, pause) for label, sounds in self.sounds.items()},
            {
                label: sounds.between(start, end, pause)
                for label, sounds in self.scenario_sounds.items()
            },
            {name: cut(spans, start, end) for name, spans in self.coverage.items()},
            self.classes,
            cut(self.written, start, end),
        )


def _either(a: Spans, b: Spans) -> Spans:
    return joined(np.concatenate([a.starts, b.starts]), np.concatenate([a.ends, b.ends]))
