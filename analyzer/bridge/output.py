"""Outputs of the bridge: their protocol, their news, and the totals of classes."""

from collections.abc import Sequence
from contextlib import suppress
from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hearthlog.analyzer.bridge.events import SoundEvent
from hearthlog.analyzer.bridge.home import Today
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import replaced_file

RECENT = 60 * NANOSECONDS  # after its end an event is no news


class News(NamedTuple):
    """What there is to tell.

    Attributes
    ----------
    begun, ended : sequence of SoundEvent
        Those of the last minute that were not told of before, and those that are over since.
    """

    state: HomeState
    begun: Sequence[SoundEvent]
    ended: Sequence[SoundEvent]
    today: Today
    zone: tzinfo


class Output(Protocol):
    """Tells somebody; never waits, for the others wait for it."""

    def update(self, news: News) -> None:
        """Tell what is new, several times a second."""

    def close(self) -> None:
        """End within seconds."""


TOTALS = "totals.json"  # in the folder of the state
_LIMIT = 1 << 20  # bytes


class Total(NamedTuple):
    """What was heard of a class by a microphone, or by a scenario of it."""

    microphone: str  # as `LiveMicrophone.name`
    label: str
    events: int
    seconds: float


class _Kept(BaseModel):
    model_config = ConfigDict(extra="forbid")

    time: int = Field(ge=0)
    totals: list[Total]


class Totals:
    """Events and seconds by microphone and class, which no restart takes back.

    What began before a time is kept in a file; the rest is counted from the state of the home.

    Parameters
    ----------
    time : int
        When the first event that counts may begin if there is no file; in nanoseconds of UTC.

    Raises
    ------
    BridgeError
        If the file is damaged.
    """

    def __init__(self, path: Path, time: int) -> None:
        self._path = path
        self.time, self._kept = time, list[Total]()
        if (kept := _read(path)) is not None:
            self.time, self._kept = kept.time, kept.totals

    def count(self, state: HomeState, end: int | None = None) -> list[Total]:
        """Return what was heard, by who heard it and class; 0 of a class that was not yet.

        Parameters
        ----------
        end : int, optional
            Before which events begin that count, in nanoseconds of UTC; by default all do.
        """
        sums = {total[:2]: total for total in self._kept}
        for microphone in state.every():
            known = (label for label in microphone.classes if label != SILENCE)
            for label in dict.fromkeys([*known, *microphone.labels()]):
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
        """Put what began before a time into the file, unless it is there already.

        Raise `BridgeError` if the file cannot be written.
        """
        if time <= self.time:
            return
        kept = _Kept(time=time, totals=self.count(state, time))
        try:
            with replaced_file(self._path) as temporary:
                temporary.write_text(kept.model_dump_json(), encoding="utf-8")
        except (OSError, HearthlogError) as error:
            raise BridgeError(f"{self._path}: cannot be written ({error})") from error
        self.time, self._kept = kept.time, kept.totals


def kept_until(path: Path, default: int) -> int:
    """Return before which time events are in a file, in nanoseconds of UTC.

    Parameters
    ----------
    default : int
        What is returned if there is none of use.
    """
    with suppress(HearthlogError):
        kept = _read(path)
        return default if kept is None else kept.time
    return default


def _read(path: Path) -> _Kept | None:
    if not path.exists():
        return None
    data = read_whole(path, "file of totals", _LIMIT, BridgeError)
    try:
        return _Kept.model_validate_json(data)
    except ValidationError as error:
        raise BridgeError(f"{path}: is damaged; delete it, and counts begin anew") from error
