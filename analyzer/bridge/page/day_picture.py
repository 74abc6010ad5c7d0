"""The picture of a day: a lane for each class, and where nothing was heard."""

from collections.abc import Iterable, Sequence
from datetime import tzinfo
from typing import Any, NamedTuple

from hearthlog.analyzer.bridge.day import Today
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.home_state import Known, MicrophoneState
from hearthlog.analyzer.bridge.page.words import class_words, long_date, room, times, when
from hearthlog.analyzer.colours import colour_on_paper
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour, day_span, local_time
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.frames import NANOSECONDS

BIN = 120 * NANOSECONDS  # as wide as in the picture of the report
_HOUR = 3600 * NANOSECONDS
_LEAST = 3  # of nine: what is short has to be seen
_SILENT = 60 * NANOSECONDS  # without a label: shorter is not seen
_DIGITS = 4  # of a place in the day, which is from 0 to 1


class Day(NamedTuple):
    """A day of a home, from midnight to midnight, in nanoseconds of UTC."""

    start: int
    end: int
    zone: tzinfo

    def place(self, time: int) -> float:
        """Return where in the day a time is, from 0 to 1."""
        inside = min(max(time, self.start), self.end)
        return round((inside - self.start) / (self.end - self.start), _DIGITS)


def day_picture(microphones: Iterable[MicrophoneState], today: Today, zone: tzinfo) -> Any:
    """Describe the picture of a day for JSON."""
    date = local_time(today.midnight, zone).date()
    day = Day(*day_span(date, zone), zone)
    hours = range(day.start, day.end, _HOUR)
    nights = [
        (day.start, at_hour(date, MORNING, zone)),
        (at_hour(date, EVENING, zone), day.end),
    ]
    return {
        "title": long_date(today.now, zone),
        "now": day.place(today.now - today.now % BIN),
        "hours": [(day.place(hour), local_time(hour, zone).hour) for hour in hours],
        "nights": [(day.place(start), day.place(end)) for start, end in nights],
        "rooms": [_room(microphone, day, today) for microphone in microphones],
    }


def _room(microphone: MicrophoneState, day: Day, today: Today) -> Any:
    known = microphone.known_of(today)
    return {
        "room": room(microphone.name),
        "gaps": [(day.place(a), day.place(b)) for a, b in _unheard(microphone, day, today)],
        "lanes": [
            _lane(microphone, label, day, today, known)
            for label in dict.fromkeys([*microphone.classes, *microphone.labels()])
            if label != SILENCE
        ],
    }


def _lane(microphone: MicrophoneState, label: str, day: Day, today: Today, known: Known) -> Any:
    count, night = microphone.counts(label, today, known)
    last = microphone.last_event(label)
    last_heard = "" if last is None else when(last.end, today.now, day.zone)
    words = class_words(label)
    how_often = "not known" if count is None else times(count)
    told = f"{words}: {how_often} today" + (f", last at {last_heard}" if count else "")
    events = microphone.events(label, day.start - 24 * _HOUR)
    return {
        "words": words,
        "colour": colour_on_paper(label),
        "bars": bars((event for event in events if event.end > day.start), day),
        "told": told,
        "today": count,
        "night": night,
        "last": last_heard,
    }


def bars(events: Iterable[Event], day: Day) -> str:
    """Return how much of each two minutes of a day events fill: a digit each, 9 for all of it.

    Returns
    -------
    str
        Empty where there is none.
    """
    filled = [0] * -(-(day.end - day.start) // BIN)
    for event in events:
        start, end = max(event.start, day.start), min(max(event.end, event.start + 1), day.end)
        for place in range((start - day.start) // BIN, -(-(end - day.start) // BIN)):
            first = day.start + place * BIN
            filled[place] += min(end, first + BIN) - max(start, first)
    if not any(filled):
        return ""
    return "".join(
        str(max(min(-(-9 * part // BIN), 9), _LEAST)) if part else "0" for part in filled
    )


def _unheard(microphone: MicrophoneState, day: Day, today: Today) -> list[tuple[int, int]]:
    """Return when of a day, up to now, a microphone was not heard; what is short is left out."""
    spans = [(day.start, microphone.since or today.now), *microphone.gaps]
    if not microphone.is_listening():
        spans.append((max(microphone.heard.time, day.start), today.now))
    inside = [(max(a, day.start), min(b, today.now)) for a, b in spans]
    return _joined([(a, b) for a, b in inside if b - a >= _SILENT])


def _joined(spans: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Join spans with less than two minutes between them."""
    joined: list[tuple[int, int]] = []
    for start, end in sorted(spans):
        if joined and start - joined[-1][1] < BIN:
            joined[-1] = joined[-1][0], max(joined[-1][1], end)
        else:
            joined.append((start, end))
    return joined
