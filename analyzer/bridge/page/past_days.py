"""Past days on the page, read from the logs when somebody asks for one."""

import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from datetime import date, timedelta, tzinfo
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.activity.segments import is_of_activity, is_of_scenario, labelling_source
from hearthlog.analyzer.bridge.home_state import FIELDS, HomeState
from hearthlog.analyzer.bridge.page.sounds import Doubts, doubtful, read_doubts
from hearthlog.analyzer.bridge.settings import RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.logs.hidden_classes import common_names_of
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs, find_home_logs
from hearthlog.analyzer.logs.local_time import (
    EVENING,
    MORNING,
    Today,
    at_hour,
    evening_before,
    local_time,
    midnight,
)
from hearthlog.analyzer.logs.selection import array_names, select
from hearthlog.analyzer.logs.spans import SEGMENT_DELAY
from hearthlog.analyzer.marks.marks import Mark, read_marks
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import review_path
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import parse_topic

_MOST_DAYS = 10  # in memory
_NO_LOGS = "There are no logs of this day."
_FRESH_SECONDS = 300.0  # after which a day is read again: a late segment may belong to it


class PastDay(NamedTuple):
    """A past day of a home; its state has no labels."""

    moment: Today
    state: HomeState
    marks: Sequence[Mark]  # of people in the logs of the day
    events: Mapping[str, SoundEvent]  # by id
    doubts: Doubts  # by the ids of events


class PastDays:
    """The past days of a home; days that were read are kept for a while, up to a number."""

    def __init__(self, home: RecorderAddress) -> None:
        self._folder, self._node, self._zone = home.folder, home.node, home.zone
        self._days: OrderedDict[date, tuple[float, PastDay]] = OrderedDict()
        self._lock = Lock()  # one reader at a time

    def dates(self) -> list[date]:
        """Return the days that have logs, the newest first; an evening is of the next day."""
        return sorted(self._days_of(self._logs()), reverse=True)

    def read(self, day: date, hidden_classes: frozenset[str]) -> PastDay:
        """Read a day, unless it was read in the last five minutes.

        Raise `BridgeError` if there are no logs of the day.
        """
        with self._lock:
            made, found = self._days.get(day, (0.0, None))
            if found is None or time.monotonic() - made > _FRESH_SECONDS:
                logs = self._logs()
                if day not in self._days_of(logs):
                    raise BridgeError(_NO_LOGS)
                found = _read(logs, self._node, day, self._zone)
                self._days[day] = time.monotonic(), found
            self._days.move_to_end(day)
            while len(self._days) > _MOST_DAYS:
                self._days.popitem(last=False)
            found.state.hidden_classes = hidden_classes
            return found

    def find_event(self, identifier: str) -> tuple[PastDay, SoundEvent] | None:
        """Return an event of a day that was read, with the day; None if there is none."""
        with self._lock:
            for _, day in self._days.values():
                if identifier in day.events:
                    return day, day.events[identifier]
        return None

    def _days_of(self, logs: HomeLogs) -> set[date]:
        """Return the days that have logs: those of the clock, and the next of a past evening."""
        now = local_time(time.time_ns(), self._zone).date()
        days = {*logs.days(self._zone)}
        return days | {
            after
            for day in days
            if (after := day + timedelta(days=1)) <= now
            and len(logs.between(at_hour(day, EVENING, self._zone), midnight(after, self._zone)))
        }

    def _logs(self) -> HomeLogs:
        try:
            return find_home_logs([self._folder])
        except HearthlogError as error:
            raise BridgeError(_NO_LOGS) from error


def _read(logs: HomeLogs, node: str, day: date, zone: tzinfo) -> PastDay:
    start, end = midnight(day, zone), at_hour(day, EVENING, zone)
    night = evening_before(day, zone), at_hour(day, MORNING, zone)
    late = end + SEGMENT_DELAY  # a segment is written at its end
    entries = [each for each in logs.between(night[0], late) if each.node == node]
    state, marks = HomeState(), list[Mark]()
    for entry in entries:
        marks += _read_log(entry, (night[0], late), end, state)
    for each in state.every():
        each.forget(night[0], end - 1)
        each.since = min(each.since, end) if each.since else 0
    events = {
        event.id: event
        for each in state.microphones.values()
        for label in each.all_labels()
        for event in each.events(label, night[0])
    }
    unsure = doubtful(state.microphones.values(), events.values())
    doubts = read_doubts(entries, unsure)
    return PastDay(Today(end - 1, start, *night), state, marks, events, doubts)


def _read_log(entry: HomeLog, limits: tuple[int, int], end: int, state: HomeState) -> list[Mark]:
    """Add the segments and gaps of a log; return its marks.

    A log that cannot be read adds nothing: its time then counts as not listened to.
    """
    try:
        for kind in (message_types.GAP, message_types.SEGMENT):
            topics = [
                topic
                for topic in select([entry.path]).topics_of(kind, FIELDS[kind])
                if is_of_activity(topic)
            ]
            columns = read_columns([entry.path], topics, *limits, FIELDS[kind])
            state.push([*columns.values()])
        if entry.start < end:
            _name_classes(entry.path, state)
            return read_marks(entry.path) if review_path(entry.path).exists() else []
    except HearthlogError:
        pass
    return []


def _name_classes(log: Path, state: HomeState) -> None:
    """Set the classes of the models that labelled a log."""
    for topic, channels in select([log]).channels.items():
        name = parse_topic(topic)
        source = labelling_source(name) if name is not None and name.kind == "label" else None
        if source is None or is_of_scenario(source) or source not in state.microphones:
            continue
        for channel, _ in channels:
            own = array_names(channel.metadata, "probabilities")
            state.name_in_common(common_names_of(log, own))
            state.microphones[source].names = own or state.microphones[source].names
