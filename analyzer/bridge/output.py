"""Protocol of the bridge's outputs, their updates, and totals by class."""

from collections.abc import Sequence
from datetime import tzinfo
from typing import NamedTuple, Protocol

from pydantic import BaseModel, Field

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.state import BridgeState, Report, StateEntry
from hearthlog.analyzer.logs.local_time import Today
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns

RECENT = 60 * NANOSECONDS  # after its end an event is no longer reported


class OutputUpdate(NamedTuple):
    """An update for the outputs."""

    state: HomeState
    begun: Sequence[SoundEvent]  # events of the last minute not reported before
    ended: Sequence[SoundEvent]  # since the last update
    today: Today
    zone: tzinfo
    columns: Sequence[Columns] = ()  # messages since the last update, except labels


class Output(Protocol):
    """Output of the bridge; its methods must not block, as all outputs share a thread."""

    def update(self, update: OutputUpdate) -> None:
        """Process an update; called several times a second."""

    def close(self) -> None:
        """Stop within seconds."""


class Total(NamedTuple):
    """Totals of a class by microphone or scenario."""

    microphone: str  # as `LiveMicrophone.name`
    label: str
    events: int
    seconds: float


class _Kept(BaseModel, extra="forbid"):
    time: int = Field(ge=0)
    totals: list[Total]


class Totals:
    """Totals of events and seconds by microphone and class, kept across restarts.

    Events before a time are saved; later ones are counted from the state of the home. If nothing is
    saved, the count starts at `time`, in nanoseconds of UTC.
    """

    def __init__(self, state: BridgeState, time: int, report: Report) -> None:
        damaged, unsaved = "cannot be read; counts start over", "saved again in ten seconds"
        self._entry = StateEntry(state, "totals", _Kept, report, damaged, unsaved)
        self._kept = self._entry.load() or _Kept(time=time, totals=[])

    @property
    def time(self) -> int:
        """Time before which events are saved, in nanoseconds of UTC."""
        return self._kept.time

    def count(self, state: HomeState, end: int | None = None) -> list[Total]:
        """Return the totals by microphone and class, of events that begin before `end`, if given.

        `end` is in nanoseconds of UTC. A class without events has 0.
        """
        sums = {total[:2]: total for total in self._kept.totals}
        for microphone in state.every():
            sounds = (label for label in microphone.classes if label != SILENCE)
            for label in dict.fromkeys([*sounds, *microphone.all_labels()]):
                events = [
                    event
                    for event in microphone.events(label, self.time)
                    if end is None or event.start < end
                ]
                before = sums.get((microphone.name, label), Total(microphone.name, label, 0, 0.0))
                seconds = before.seconds + sum(event.seconds for event in events)
                sums[before[:2]] = before._replace(
                    events=before.events + len(events), seconds=seconds
                )
        return [sums[key] for key in sorted(sums)]

    def keep(self, state: HomeState, time: int) -> None:
        """Save the totals of events that began before a time, unless saved already."""
        if time <= self.time:
            return
        kept = _Kept(time=time, totals=self.count(state, time))
        if self._entry.save(kept):
            self._kept = kept
