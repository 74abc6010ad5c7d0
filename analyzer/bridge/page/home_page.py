"""Page of the home: parts as JSON, updated once a second."""

import json
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import tzinfo
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hearthlog.analyzer.activity.events import ANY_SOUND, HOLD_SECONDS, SoundEvent
from hearthlog.analyzer.activity.sources import source_microphone, source_parts
from hearthlog.analyzer.bridge.commands import EventCorrections, class_of, explained
from hearthlog.analyzer.bridge.home_state import HomeState, ListeningThreshold, LiveMicrophone
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.page.recurring import Moment, RecurringSounds
from hearthlog.analyzer.bridge.page.server import Board, PageAdmission, PageServer
from hearthlog.analyzer.bridge.secret_files import cookie_key, keep_address, page_token
from hearthlog.analyzer.bridge.settings import PageSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.bridge.wording import (
    class_words,
    clock,
    length,
    long_date,
    reason,
    room,
    sureness,
    times,
    told,
    when,
)
from hearthlog.analyzer.colours import colour_on_paper
from hearthlog.analyzer.logs.local_time import (
    EVENING,
    MORNING,
    Today,
    at_hour,
    day_span,
    local_time,
)
from hearthlog.analyzer.logs.never_tell import read_list, write_list
from hearthlog.analyzer.logs.spans import joined
from hearthlog.models.classes import SILENCE, in_words, ordered
from hearthlog.recorder.host import writes_to_journal
from hearthlog.schemas.errors import HearthlogError, listed
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import is_sound

_QUIETEST = -80.0  # dBFS at the left end of the bar
_GOES_ON = (HOLD_SECONDS + 5) * NANOSECONDS  # after the end of a segment
_NOT_LISTENING = "Not listening"


class _Heard(NamedTuple):
    words: str
    since: int  # in nanoseconds of UTC; 0: unknown


class CurrentSounds:
    """Current sounds of each microphone, with their start times."""

    def __init__(self) -> None:
        self._last: dict[str, _Heard] = {}

    def describe(self, news: News) -> Any:
        """Return the current sounds for JSON."""
        microphones = news.state.present()
        return {
            "is_recording": news.state.is_recording(),
            "rooms": [
                self._room(each, news, is_alone=len(microphones) == 1) for each in microphones
            ],
        }

    def _room(self, microphone: LiveMicrophone, news: News, *, is_alone: bool) -> Any:
        words = _sentence(microphone)
        last = self._last.get(microphone.name)
        if last is None or last.words != words:
            since = _active_since(microphone) or (news.today.now if last is not None else 0)
            last = self._last[microphone.name] = _Heard(words, since)
        shown = f"since {when(last.since, news.today.now, news.zone)}" if last.since else ""
        health = news.state.health.get(microphone.name)
        is_listening = microphone.is_listening()
        return {
            "room": "" if is_alone else room(microphone.name),
            "words": words,
            "since": shown,
            "why": reason(told(health.text)) if health is not None and not is_listening else "",
            "level": _level(microphone) if is_listening else None,
        }


def _sentence(microphone: LiveMicrophone) -> str:
    if not microphone.is_listening():
        return _NOT_LISTENING
    names = [class_words(label) for label in active_classes(microphone)]
    if names:
        return listed([names[0], *map(str.lower, names[1:])], "and")
    return "A sound" if microphone.heard.is_heard(ANY_SOUND) else in_words(SILENCE)


def active_classes(microphone: LiveMicrophone) -> list[str]:
    """Return the active classes except silence, the most important first."""
    return [
        label
        for label in ordered(microphone.classes)
        if is_sound(label) and microphone.heard.is_heard(label)
    ]


def _active_since(microphone: LiveMicrophone) -> int:
    """Return the start of the microphone's current state, from the log; 0 if unknown."""
    if not microphone.is_listening():
        return microphone.heard.time
    heard = active_classes(microphone)
    if heard:
        last = [microphone.last_event(label) for label in heard]
        end = microphone.heard.time - _GOES_ON
        going = [event.start for event in last if event is not None and event.end >= end]
        return max(going) if len(going) == len(heard) else 0
    last = [microphone.last_event(label) for label in microphone.labels()]
    return max((event.end for event in last if event is not None), default=0)


def _level(microphone: LiveMicrophone) -> Any:
    """Return the level as a share of the bar and as text; None if unknown."""
    level = microphone.level_dbfs
    if not math.isfinite(level):
        return None
    return min(max(round(1 - level / _QUIETEST, 2), 0.0), 1.0), f"{level:.0f} dB".replace(
        "-", "\N{MINUS SIGN}"
    )


_SHOWN = 20
_DAY = 24 * 3600 * NANOSECONDS


def last_events(
    news: News, said_of: Callable[[SoundEvent], str]
) -> tuple[dict[str, SoundEvent], Any]:
    """Return the last events by id, and their description for JSON.

    Parameters
    ----------
    said_of : callable
        Returns the correction of an event in words; empty if there is none.
    """
    microphones = news.state.microphones.values()
    found: list[SoundEvent] = []
    for microphone in microphones:
        for label in microphone.labels():
            found += microphone.events(label, news.today.midnight - _DAY)[-_SHOWN:]
    found = sorted(found, key=lambda event: (event.start, event.id), reverse=True)[:_SHOWN]
    names = ordered(label for each in microphones for label in [*each.classes, *each.labels()])
    shown = {
        "events": [
            _described(event, news, said_of(event), is_alone=len(microphones) == 1)
            for event in found
        ],
        "classes": [(label, class_words(label)) for label in names if is_sound(label)],
        "hidden": [(label, class_words(label)) for label in ordered(news.state.never_tell)],
    }
    return {event.id: event for event in found}, shown


def _described(event: SoundEvent, news: News, said: str, *, is_alone: bool) -> Any:
    return {
        "id": event.id,
        "label": event.label,
        "words": class_words(event.label),
        "colour": colour_on_paper(event.label),
        "time": when(event.start, news.today.now, news.zone, seconds=True),
        "length": length(event.seconds),
        "sure": sureness(event.confidence),
        "room": "" if is_alone else room(event.microphone),
        "said": said,
    }


_WELL, _WARNING, _WRONG = 0, 1, 2  # as in diagnostics
_THINGS = {"disk": "Disk", "machine": "Clock and computer"}


def _line(what: str, level: int, text: str) -> dict[str, Any]:
    return {"what": what, "level": level, "text": text}


def health_list(news: News, node: str, started: int, recurring: str = "") -> list[Any]:
    """Return the health of all subjects for JSON.

    Parameters
    ----------
    started : int
        Start of the bridge, in nanoseconds of UTC.
    recurring : str, optional
        Problem with the recurring sounds; empty for none.
    """
    lines = [*_lines(news, node, started)]
    if recurring:
        lines.append(_line("Sounds that recur", _WARNING, recurring))
    return lines


def _lines(news: News, node: str, started: int) -> Iterator[Any]:
    state = news.state
    for microphone in state.present():
        yield _of_microphone(microphone, state)
    is_recording = state.is_recording()
    yield _line(
        "Recorder",
        _WELL if is_recording else _WRONG,
        "recording" if is_recording else "nothing has been written for more than 15 seconds",
    )
    for subject, health in sorted(state.health.items()):
        if subject not in state.microphones:
            yield _line(_thing(subject, node), min(health.level, _WRONG), told(health.text))
    yield _line(
        "Bridge", _WELL, f"follows the recorder since {when(started, news.today.now, news.zone)}"
    )


def _of_microphone(microphone: LiveMicrophone, state: HomeState) -> Any:
    health = state.health.get(microphone.name)
    text, level = ("", _WELL) if health is None else (told(health.text), health.level)
    is_alone = len(state.present()) == 1
    what = "Microphone" if is_alone else f"Microphone, {room(microphone.name)}"
    if not microphone.is_listening():
        why = reason(text)
        return _line(what, _WRONG, f"not listening: {why}" if why else "not listening")
    return _line(what, min(level, _WRONG), f"listening: {text}" if level else "listening")


def _thing(subject: str, node: str) -> str:
    whose, _, part = subject.partition(" ")
    if whose == node and part in _THINGS:
        return _THINGS[part]
    return told(subject.replace("_", " ")).capitalize()


def scenario_lines(news: News) -> list[Any]:
    """Return a line for each scenario of each microphone, for JSON."""
    state, midnight = news.state, news.today.midnight
    lines = []
    for name in sorted(state.scenarios):
        own = state.scenarios[name]
        today = _today(own, midnight)
        if own.is_listening() or today:
            where = [room(source_microphone(name))] if len(state.microphones) > 1 else []
            what = " · ".join([room(source_parts(name)[1]), *where])
            lines.append({"what": what, "about": f"Now {_now(own)}. Today {today or 'nothing'}."})
    return lines


def _now(own: LiveMicrophone) -> str:
    if not own.is_listening():
        return "not listening"
    return listed([class_words(label).lower() for label in active_classes(own)], "and") or "nothing"


def _today(own: LiveMicrophone, midnight: int) -> str:
    """Format count and total length of each class since midnight, longest first."""
    events = {label: own.events(label, midnight) for label in own.labels()}
    seconds = {label: sum(each.seconds for each in same) for label, same in events.items() if same}
    return ", ".join(
        f"{class_words(label).lower()} {times(len(events[label]))} ({length(seconds[label])})"
        for label in sorted(seconds, key=lambda label: -seconds[label])
    )


BIN = 120 * NANOSECONDS  # as in the picture of the report
_HOUR = 3600 * NANOSECONDS
_LEAST = 3  # of nine: lowest height of a bar, to keep short events visible
_MOST_TIMES = 40  # of a count
_SILENT = 60 * NANOSECONDS  # shortest gap that is drawn
_DIGITS = 4  # decimals of a position in the day, 0 to 1


class DaySpan(NamedTuple):
    """A local day from midnight to midnight, in nanoseconds of UTC."""

    start: int
    end: int
    zone: tzinfo

    def place(self, time: int) -> float:
        """Return the position of a time in the day, 0 to 1."""
        inside = min(max(time, self.start), self.end)
        return round((inside - self.start) / (self.end - self.start), _DIGITS)


def day_picture(microphones: Iterable[LiveMicrophone], today: Today, zone: tzinfo) -> Any:
    """Return the picture of a day for JSON."""
    date = local_time(today.midnight, zone).date()
    day = DaySpan(*day_span(date, zone), zone)
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


def _room(microphone: LiveMicrophone, day: DaySpan, today: Today) -> Any:
    known = microphone.known_of(today)
    return {
        "room": room(microphone.name),
        "gaps": [(day.place(a), day.place(b)) for a, b in _unheard(microphone, day, today)],
        "lanes": [
            _lane(microphone, label, day, today, known)
            for label in ordered([*microphone.classes, *microphone.labels()])
            if label != SILENCE
        ],
    }


def _lane(
    microphone: LiveMicrophone, label: str, day: DaySpan, today: Today, known: ListeningThreshold
) -> Any:
    count, night = microphone.counts(label, today, known)
    last = microphone.last_event(label)
    last_heard = "" if last is None else when(last.end, today.now, day.zone)
    words = class_words(label)
    how_often = "not known" if count is None else times(count)
    summary = f"{words}: {how_often} today" + (f", last at {last_heard}" if count else "")
    events = microphone.events(label, day.start - 24 * _HOUR)
    of_night = [e for e in events if today.night <= e.start < today.morning]
    of_day = [e for e in events if e.start >= today.midnight]
    return {
        "label": label,
        "words": words,
        "colour": colour_on_paper(label),
        "bars": bars((event for event in events if event.end > day.start), day),
        "told": summary,
        "today": count,
        "night": night,
        "last": last_heard,
        "times": [_times(of_day, day.zone), _times(of_night, day.zone)],
    }


def _times(events: Sequence[SoundEvent], zone: tzinfo) -> str:
    """Return when events began, newest first; the oldest of many are counted."""
    shown = [clock(event.start, zone) for event in reversed(events[-_MOST_TIMES:])]
    left = len(events) - len(shown)
    return ", ".join(shown) + (f" and {left} before" if left else "")


def bars(events: Iterable[SoundEvent], day: DaySpan) -> str:
    """Return how much of each two minutes of a day events fill: one digit per bin, 9 for full.

    Returns
    -------
    str
        Empty without events.
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


def _unheard(microphone: LiveMicrophone, day: DaySpan, today: Today) -> list[tuple[int, int]]:
    """Return the gaps of a microphone in a day, up to now, without short ones."""
    spans = [(day.start, microphone.since or today.now), *microphone.gaps]
    if not microphone.is_listening():
        spans.append((max(microphone.heard.time, day.start), today.now))
    inside = [(max(a, day.start), min(b, today.now)) for a, b in spans]
    long = np.array([(a, b) for a, b in inside if b - a >= _SILENT], np.int64).reshape(-1, 2)
    gaps = joined(long[:, 0], long[:, 1], BIN - 1)  # with two minutes and more between them
    return [*zip(gaps.starts.tolist(), gaps.ends.tolist(), strict=True)]


_EVERY_SECONDS = 1.0
_SHOW = {"yes": True, "no": False}


class HomePage:
    """Output that serves the page of a home, and accepts corrections of sounds.

    Raise `BridgeError` if the token cannot be read or created, or the port cannot be opened.
    """

    def __init__(
        self, settings: PageSettings, home: RecorderAddress, state: Path, say: Callable[[str], None]
    ) -> None:
        bind = ip_address(settings.bind)
        self._node, self._say = home.node, say
        self._started = time.time_ns()
        self._made = -_EVERY_SECONDS
        self._day_key: Any = None
        self._events: dict[str, SoundEvent] = {}
        self._now = CurrentSounds()
        self._corrections = EventCorrections(home.folder, home.node)
        self._recurring = RecurringSounds(home.folder)
        self._is_read_back = False
        token = page_token(settings.token_file, state)
        names = frozenset(settings.names)
        admission = PageAdmission(settings.bind, settings.port, token, cookie_key(state), names)
        self._board = Board()
        self._home = home
        actions = {"/mark": self._mark, "/group": self._recurring.name, "/show": self._show}
        self._server = PageServer(admission, self._board, actions, settings.frames)
        host = f"[{settings.bind}]" if bind.version == 6 else settings.bind
        address = f"http://{host}:{settings.port}/"
        whole = f"{address}?token={token}"
        try:
            file = keep_address(whole, state)
        except BridgeError:
            self._server.end()
            raise
        # Other users may read the journal, so it must not have the token.
        if writes_to_journal():
            whole = f"{address}; its full address is in {file.absolute()}"
        say(f"the page of the home: {whole}")
        if not bind.is_loopback:
            say(
                f"the page listens on {settings.bind}: it crosses the network unencrypted, and "
                "others on the network can read it and its token"
            )

    def update(self, news: News) -> None:
        """Update the page, at most once a second."""
        self._board.keep_fresh()
        if time.monotonic() - self._made < _EVERY_SECONDS:
            return
        self._made = time.monotonic()
        if not self._is_read_back:
            self._is_read_back = True
            threading.Thread(target=self._read_back, daemon=True).start()
        self._events, last = last_events(news, self._corrections.of)
        self._put("now", self._now.describe(news))
        self._put("scenarios", scenario_lines(news))
        self._put("home", {"home": room(self._node), "clock": clock(news.today.now, news.zone)})
        self._put("events", last)
        self._put("recurring", self._recurring.describe(Moment(news.today.now, news.zone)))
        self._put("health", health_list(news, self._node, self._started, self._recurring.problem))
        key = _day_key(news)
        if key != self._day_key:
            self._day_key = key
            self._put("day", day_picture(news.state.microphones.values(), news.today, news.zone))

    def close(self) -> None:
        """Stop the server and its streams."""
        self._server.end()
        self._recurring.close()

    def _put(self, name: str, content: Any) -> None:
        self._board.put(name, json.dumps(content, allow_nan=False).encode())

    def _mark(self, event: str, label: str) -> str:
        found = self._events.get(event)
        if found is None:
            raise BridgeError("This event is too long ago for the page: `hearthlog review` has it.")
        return self._corrections.add(found, label)

    def _show(self, choice: str, label: str) -> str:
        """Hide a class from all outputs and reports, or show it again."""
        name = class_of(label)
        if name == SILENCE or choice not in _SHOW:
            raise BridgeError("Only a sound can be hidden.")
        if name in self._home.never_tell:
            raise BridgeError("The configuration of the box hides this sound: never_tell.")
        folder = self._home.folder
        try:
            names = read_list(folder)
            write_list(folder, names - {name} if _SHOW[choice] else names | {name})
        except (HearthlogError, OSError) as error:
            raise explained(error) from error
        self._day_key = None
        return f"{class_words(name)} is {'shown again' if _SHOW[choice] else 'shown nowhere now'}."

    def _read_back(self) -> None:
        try:
            self._corrections.read_back()
        except HearthlogError as error:
            self._say(f"page: earlier marks are not shown: {error}")


def _day_key(news: News) -> Any:
    """Return a key that changes whenever the picture of the day changes."""
    microphones = news.state.microphones.values()
    return news.today.now // BIN, [
        (
            each.name,
            each.is_listening(),
            each.since,
            len(each.gaps),
            [(label, each.last_event(label)) for label in each.labels()],
            list(each.classes),
        )
        for each in microphones
    ]
