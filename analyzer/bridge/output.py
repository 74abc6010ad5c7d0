"""What the bridge tells somebody: one of any number of outputs."""

from collections.abc import Sequence
from datetime import tzinfo
from typing import NamedTuple, Protocol

from hearthlog.analyzer.bridge.day import Today
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.schemas.frames import NANOSECONDS

RECENT = 60 * NANOSECONDS  # after its end an event is no news


class News(NamedTuple):
    """What there is to tell.

    Attributes
    ----------
    begun, ended : sequence of Event
        Those of the last minute that were not told of before, and those that are over since.
    """

    state: HomeState
    begun: Sequence[Event]
    ended: Sequence[Event]
    today: Today
    zone: tzinfo


class Output(Protocol):
    """Tells somebody; never waits, for the others wait for it."""

    def update(self, news: News) -> None:
        """Tell what is new, several times a second."""

    def close(self) -> None:
        """End within seconds."""
