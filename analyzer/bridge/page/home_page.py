"""Page of the home: parts as JSON, updated once a second, and what a browser asks for."""

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import date, timedelta, tzinfo
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from typing import Any

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.activity.checked_minutes import UNMEASURED, read_sureness
from hearthlog.analyzer.activity.values import BASELINE_DAYS
from hearthlog.analyzer.bridge.commands import class_of
from hearthlog.analyzer.bridge.corrections import EventCorrections, user_error
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.output import OutputUpdate
from hearthlog.analyzer.bridge.page import (
    Translation,
    clock,
    preferred_language,
    room,
    translation_for,
)
from hearthlog.analyzer.bridge.page.day import BIN, HomeDay, picture_of
from hearthlog.analyzer.bridge.page.past_days import PastDay, PastDays
from hearthlog.analyzer.bridge.page.recurring import Moment, RecurringSounds
from hearthlog.analyzer.bridge.page.server import Board, PageAdmission, PageServer
from hearthlog.analyzer.bridge.page.sounds import (
    Bout,
    CurrentDoubts,
    KeptSounds,
    ShownBouts,
    bouts,
    doubtful,
    events_between,
    events_to_review,
    needs_review,
    uncounted_ids,
)
from hearthlog.analyzer.bridge.page.status import (
    EXPECTED,
    RoomStatus,
    health_list,
    scenario_lines,
)
from hearthlog.analyzer.bridge.settings import (
    PageSettings,
    RecorderAddress,
    cookie_key,
    keep_address,
    page_token,
)
from hearthlog.analyzer.bridge.state import BridgeError, Report
from hearthlog.analyzer.logs.hidden_classes import read_hidden_classes, write_hidden_classes
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import evening_before, local_time
from hearthlog.models.classes import SILENCE, class_name, ordered
from hearthlog.recorder import pause_schedule
from hearthlog.recorder.host import writes_to_journal
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import is_sound

_EVERY_SECONDS = 1.0
_MARKS = {"/mark": False, "/mark-one": True}  # whether a mark is of the event alone
_SHOW = {"yes": True, "no": False}
_PAUSES = {"hour": timedelta(hours=1), "": None}  # by what a person chose; None: it ends
_MOST_TO_REVIEW, _MOST_OTHERS = 24, 20  # bouts of the current day
_MOST_OF_DAY = 200  # bouts of a past day
_MOST_IDS = 50  # events in a request
_DAY = 24 * 3600 * NANOSECONDS


class PageView:
    """The parts of the page in one language."""

    def __init__(self, words: Translation) -> None:
        self.words = words
        self.board = Board()
        self.now = RoomStatus(words)
        self.keys: dict[str, Any] = {}  # of the parts that change seldom

    def put(self, name: str, content: Any) -> None:
        """Replace a part."""
        self.board.put(name, json.dumps(content, allow_nan=False).encode())

    def put_changed(self, name: str, key: Any, describe: Callable[[], Any]) -> None:
        """Replace a part if its key has changed."""
        if self.keys.get(name) != key:
            self.keys[name] = key
            self.put(name, describe())


class HomePage:
    """Output that serves the page of a home, and accepts corrections of sounds.

    Raise `BridgeError` if the token cannot be read or created, or the port cannot be opened.
    """

    actions: Mapping[str, str] = {
        "/mark": "event",
        "/mark-one": "event",
        "/group": "group",
        "/show": "show",
        "/pause": "pause",
    }

    def __init__(
        self, settings: PageSettings, home: RecorderAddress, state: Path, report: Report
    ) -> None:
        bind = ip_address(settings.bind)
        self._settings, self._home, self._report = settings, home, report
        self._started = time.time_ns()
        self._made = -_EVERY_SECONDS
        self._state = HomeState()  # the latest
        self._events: dict[str, SoundEvent] = {}  # of today and the night before, by id
        self._bouts: dict[str, Bout] = {}  # by id
        self._doubtful: list[SoundEvent] = []
        self.is_settled = False  # whether the views show all that was read from the logs
        self._uncounted: frozenset[str] = frozenset()
        self._events_key: Any = None
        self._recurring = RecurringSounds(home.folder)
        self._past = PastDays(home)
        self._doubts = CurrentDoubts(home.folder, home.node)
        self._sounds = KeptSounds(home.folder, home.node)
        self._sureness = UNMEASURED
        self._measured: date | None = None  # day of the last measurement of it
        self._views: dict[str, PageView] = {}
        self._lock = threading.Lock()
        self.view(self.words("").language)
        token = page_token(settings.token_file, state)
        names = frozenset(settings.names)
        key, ingress = cookie_key(state), settings.ingress or ""
        admission = PageAdmission(settings.bind, settings.port, token, key, names, ingress)
        self._server = PageServer(admission, self, settings.frames)
        if ingress:
            report(
                f"the page of the home: port {settings.port}, for the ingress at {ingress} alone"
            )
        else:
            self._report_address(bind, token, state)

    def _report_address(self, bind: IPv4Address | IPv6Address, token: str, state: Path) -> None:
        """Keep and print the address with the token, without the token where others may read."""
        settings, report = self._settings, self._report
        loopback = "::1" if bind.version == 6 else "127.0.0.1"
        opened = loopback if bind.is_unspecified else settings.bind  # 0.0.0.0 opens nowhere
        host = f"[{opened}]" if bind.version == 6 else opened
        address = f"http://{host}:{settings.port}/"
        full = f"{address}?token={token}"
        try:
            file = keep_address(full, state)
        except BridgeError:
            self._server.end()
            raise
        # Other users may read the journal, so it must not have the token.
        if writes_to_journal():
            full = f"{address}; its full address is in {file.absolute()}"
        report(f"the page of the home: {full}")
        if not bind.is_loopback:
            report(
                f"the page listens on {settings.bind}: it crosses a network unencrypted, where "
                "others can read it and its token, unless a container or a firewall keeps the port "
                "to this machine"
            )

    def words(self, accepted: str) -> Translation:
        """Return the words of the configured language, else of one that a browser accepts."""
        return translation_for(self._settings.language or preferred_language(accepted))

    def view(self, language: str) -> PageView:
        """Return the parts of the page in a language."""
        with self._lock:
            if language not in self._views:
                self._views[language] = PageView(translation_for(language))
            return self._views[language]

    def board(self, words: Translation) -> Board:
        """Return the parts of the page in a language, for its stream."""
        return self.view(words.language).board

    def home_name(self) -> str:
        """Return the name of the home."""
        return room(self._home.node)

    def update(self, update: OutputUpdate) -> None:
        """Update the page, at most once a second."""
        with self._lock:
            views = [*self._views.values()]
        for view in views:
            view.board.keep_fresh()
        if time.monotonic() - self._made < _EVERY_SECONDS:
            return
        self._made = time.monotonic()
        self._state = update.state
        day = local_time(update.today.now, update.zone).date()
        if self._measured != day:
            self._measured = day
            threading.Thread(target=self._measure, args=(update.today.now,), daemon=True).start()
        first = evening_before(day, update.zone)
        microphones, doubts = update.state.microphones.values(), self._doubts.found
        key = _events_key(update), len(doubts)
        if key != self._events_key:
            self._events_key = key
            every = events_between(microphones, first, update.today.now + _DAY)
            self._events = {event.id: event for event in every}
            self._doubtful = doubtful(microphones, every)
            folded = bouts(
                every, events_to_review(doubts, self._doubtful, every, update.state.hidden_classes)
            )
            self._bouts = {bout.first.id: bout for bout in folded}
            self._uncounted = uncounted_ids(microphones, every)
        self._doubts.update(self._doubtful, update.today.now)
        for view in views:
            self._update_view(view, update)
        self.is_settled = self._doubts.is_up_to_date and self._doubts.found == doubts

    def _update_view(self, view: PageView, update: OutputUpdate) -> None:
        moment, words, started = Moment(update.today.now, update.zone), view.words, self._started
        view.put("now", view.now.describe(update))
        view.put("scenarios", scenario_lines(update, words))
        about = {
            "home": self.home_name(),
            "clock": clock(moment.now, update.zone),
            "sound": self._settings.sound,
            "pause": self._pause(moment.zone, words),
        }
        view.put("home", about)
        view.put("recurring", self._recurring.describe(moment, words))
        problem = self._recurring.problem
        view.put("health", health_list(update, self._home.node, started, problem, words))
        day, corrections = local_time(moment.now, update.zone).date(), update.state.corrections
        key = self._events_key, corrections.number, day, self._sureness, _classes_key(update)
        view.put_changed("events", key, lambda: self._last_bouts(update, words))
        every = [*update.state.microphones.values()]
        home = HomeDay(every, update.today, update.zone, words, False, corrections, self._sureness)
        key_of_day = _day_key(update), corrections.number, self._sureness
        view.put_changed("day", key_of_day, lambda: picture_of(home))

    def close(self) -> None:
        """Stop the server and its streams."""
        self._server.end()
        self._recurring.close()

    def boards(self) -> list[Board]:
        """Return the parts of the page in all languages."""
        with self._lock:
            return [view.board for view in self._views.values()]

    def _last_bouts(self, update: OutputUpdate, words: Translation) -> Any:
        microphones = update.state.microphones.values()
        own = {label for each in microphones for label in [*each.classes, *each.labels()]}
        missing = EXPECTED - set(map(class_name, own)) - update.state.hidden_classes
        names = ordered(own | missing)  # a model learns a class by answers, too
        shown = self._shown(
            words, update.today.now, update.state.corrections, is_alone=len(microphones) == 1
        )
        shown = shown._replace(
            common_names=update.state.common_names,
            uncounted=self._uncounted,
            hidden=update.state.hidden_classes,
        )
        every = [shown.describe(bout) for bout in self._latest()]
        hidden = ordered(update.state.hidden_classes)
        return {
            "events": every,
            "classes": [(label, words.class_words(label)) for label in names if is_sound(label)],
            "hidden": [(label, words.class_words(label)) for label in hidden],
        }

    def _latest(self) -> list[Bout]:
        """Return the newest bouts that need review, those beside a television, and the others."""
        left = {"review": _MOST_TO_REVIEW, "uncounted": _MOST_OTHERS, "others": _MOST_OTHERS}
        found = []
        for bout in self._bouts.values():
            uncounted = sum(event.id in self._uncounted for event in bout.events)
            kind = "uncounted" if uncounted == len(bout.events) else "others"
            kind = "review" if needs_review(bout, uncounted) else kind
            if left[kind]:
                left[kind] -= 1
                found.append(bout)
        return found

    def _shown(
        self, words: Translation, now: int, corrections: EventCorrections, *, is_alone: bool
    ) -> ShownBouts:
        def correction(event: SoundEvent) -> str:
            found = corrections.correction_of(event)
            if found is None:
                return ""
            is_nothing = found.label == SILENCE
            name = words.text("mark.nothing") if is_nothing else words.class_words(found.label)
            return words.text("mark.own" if found.is_own else "mark.other", **{"class": name})

        return ShownBouts(now, self._home.zone, words, correction, is_alone, self._sureness)

    def act(self, path: str, subject: str, label: str, words: Translation) -> str:
        """Carry out what a person asked for; return what was done, in words."""
        if path in _MARKS:
            return self._mark(subject, label, words, is_single=_MARKS[path])
        if path == "/group":
            return self._recurring.name(subject, label, words)
        if path == "/pause":
            return self._change_pause(subject, words)
        return self._show(subject, label, words)

    def answer(self, path: str, text: str, words: Translation) -> Any:
        """Return what a browser asks for, for JSON: days, a day, or events with kept sound."""
        if path == "/days":
            days = self._past.dates()
            return [(day.isoformat(), words.short_date(day), day.year) for day in days]
        if path == "/day":
            return self._day(text, words)
        identifiers = text.split("&")[:_MOST_IDS] if self._settings.sound else []
        found = ((each, self._find(each)) for each in identifiers)
        return [each for each, event in found if event is not None and self._sounds.has(event)]

    def sound(self, identifier: str) -> bytes:
        """Return the kept sound of an event as a WAV file, without that of hidden classes.

        Raise `BridgeError` if there is none.
        """
        event = self._find(identifier) if self._settings.sound else None
        if event is None:
            raise BridgeError("No sound was kept of this.")
        past = self._past.find_event(identifier)
        states = [self._state] if past is None else [self._state, past[0].state]
        hidden = [
            other
            for state in states
            for each in state.every()
            for label in each.all_labels()
            if label in self._state.hidden_classes
            for other in each.events(label, event.start - _DAY)
        ]
        return self._sounds.wav(event, hidden)

    def _find(self, identifier: str) -> SoundEvent | None:
        """Return the event with an id that may be shown, of today or of a day that was read."""
        event = self._events.get(identifier)
        if event is None:
            past = self._past.find_event(identifier)
            event = None if past is None else past[1]
        return None if event is None or event.label in self._state.hidden_classes else event

    def _day(self, text: str, words: Translation) -> Any:
        try:
            requested = date.fromisoformat(text)
        except ValueError as error:
            raise BridgeError("There are no logs of this day.") from error
        day = self._past.read(requested, self._state.hidden_classes)
        moment, zone = day.moment, self._home.zone
        microphones = [*day.state.microphones.values()]
        given = self._state.corrections.of_day(day.marks)
        home = HomeDay(microphones, moment, zone, words, True, given, self._sureness)
        events = events_between(microphones, moment.night, moment.now + 1)
        every = self._past_bouts(day, events)
        shown = self._shown(words, moment.now, given, is_alone=len(microphones) == 1)
        shown = shown._replace(
            common_names=day.state.common_names,
            uncounted=uncounted_ids(microphones, events),
            hidden=self._state.hidden_classes,
            is_past=True,
        )
        return picture_of(home) | {"events": [shown.describe(b) for b in every[:_MOST_OF_DAY]]}

    def _past_bouts(self, day: PastDay, events: Sequence[SoundEvent]) -> list[Bout]:
        microphones, hidden = day.state.microphones.values(), self._state.hidden_classes
        unsure = doubtful(microphones, events)
        return bouts(events, events_to_review(day.doubts, unsure, events, hidden))

    def _mark(self, identifier: str, text: str, words: Translation, *, is_single: bool) -> str:
        bout = None if is_single else self._bouts.get(identifier)
        events: Sequence[SoundEvent] = [] if bout is None else bout.events
        past = None if events else self._past.find_event(identifier)
        if past is not None:
            day, event = past
            same = events_between(day.state.microphones.values(), 0, day.moment.now + 1)
            own = [each for each in self._past_bouts(day, same) if event in each.events]
            events = own[0].events if own and not is_single else [event]
        elif not events and identifier in self._events:
            events = [self._events[identifier]]
        if not events:
            raise BridgeError("This event is too long ago for the page: `hearthlog review` has it.")
        label = class_of(text)
        try:
            for event in events:
                self._state.corrections.add(event, label)
        except BridgeError as error:
            raise user_error(error) from error
        name = words.text("mark.nothing") if label == SILENCE else words.class_words(label)
        return words.text("mark.own", **{"class": name})

    def _show(self, choice: str, label: str, words: Translation) -> str:
        """Hide a class from all outputs and reports, or show it again."""
        name = class_of(label)
        if name == SILENCE or choice not in _SHOW:
            raise BridgeError("Only a sound can be hidden.")
        if name in self._home.never_tell:
            raise BridgeError("The configuration of the box hides this sound: never_tell.")
        folder = self._home.folder
        try:
            names = read_hidden_classes(folder)
            write_hidden_classes(folder, names - {name} if _SHOW[choice] else names | {name})
        except (HearthlogError, OSError) as error:
            raise user_error(error) from error
        key = "shown again" if _SHOW[choice] else "shown nowhere"
        return words.text(key, **{"class": words.class_words(name)})

    def _change_pause(self, choice: str, words: Translation) -> str:
        """Close the microphones for a while, or open them again; return which, in words."""
        folder = self._home.folder
        if choice not in _PAUSES:
            raise BridgeError("This pause is not on the page.")
        duration = _PAUSES[choice]
        try:
            if duration is None:
                pause_schedule.resume(folder)
            else:
                pause_schedule.pause(folder, duration, "the page of the home")
        except (HearthlogError, OSError) as error:
            raise user_error(error) from error
        return self._pause(self._home.zone, words)

    def _pause(self, zone: tzinfo, words: Translation) -> str:
        """Return until when somebody has closed the microphones; empty if nobody has."""
        folder = self._home.folder
        if not pause_schedule.is_paused(folder):
            return ""
        end = pause_schedule.paused_until(folder)
        if end is None:
            return words.text("pause.open")
        return words.text("pause.until", time=clock(int(end) * NANOSECONDS, zone))

    def _measure(self, now: int) -> None:
        """Measure how sure the home can be of labels, in the checked minutes of four weeks."""
        with suppress(HearthlogError, OSError):  # not measured
            logs = find_home_logs([self._home.folder])
            self._sureness = read_sureness(logs, now - BASELINE_DAYS * _DAY, now)


def _classes_key(update: OutputUpdate) -> Any:
    """Return a key that changes whenever the shown classes change."""
    microphones = update.state.microphones.values()
    return update.state.hidden_classes, [(each.name, each.classes) for each in microphones]


def _events_key(update: OutputUpdate) -> Any:
    """Return a key that changes whenever an event begins, grows or is hidden."""
    return (
        update.today.midnight,
        update.today.night,
        update.state.hidden_classes,
        [
            (each.name, [(n, each.last_event(n), len(each.events(n, 0))) for n in each.labels()])
            for each in update.state.microphones.values()
        ],
    )


def _day_key(update: OutputUpdate) -> Any:
    """Return a key that changes whenever the picture of the day changes."""
    listening = [
        (each.name, each.is_listening(), each.since, len(each.gaps))
        for each in update.state.microphones.values()
    ]
    return update.today.now // BIN, listening, _classes_key(update), _events_key(update)
