"""The output of the bridge that evaluates rules, and tells of what rings."""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event as Flag
from threading import Thread

from hearthlog.analyzer.bridge.alerts.delivery import Delivery, message
from hearthlog.analyzer.bridge.alerts.gathering import Gathered
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.live_home import FIELDS, LiveHome, is_of_alerts
from hearthlog.analyzer.bridge.alerts.memory import KnownLines, Memory
from hearthlog.analyzer.bridge.alerts.open_run import Label
from hearthlog.analyzer.bridge.alerts.outbox import UNREAD, Outbox
from hearthlog.analyzer.bridge.alerts.read_logs import read_heard
from hearthlog.analyzer.bridge.alerts.ring import Ring
from hearthlog.analyzer.bridge.alerts.rules import AlertRule, unknown_class
from hearthlog.analyzer.bridge.alerts.settings import NO_LISTENER, DeliverySettings
from hearthlog.analyzer.bridge.alerts.targets import Addresses, find_targets, replaced_names
from hearthlog.analyzer.bridge.alerts.watch import AHEAD, RuleWatch
from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.secret_files import secret_path
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.files import log_name
from hearthlog.schemas.logs.follow import follow_messages
from hearthlog.schemas.mcap.raw_messages import RawMessages

# Told the name of a rule, a text, and when it rang; returns whether somebody has taken it.
OnRing = Callable[[str, str, int], bool]
BROKER = "mqtt"  # in the place of the name of a target
_PATIENCE = 30 * NANOSECONDS
_TO_COME = 60 * NANOSECONDS  # from now: what is later was written while a clock was ahead
_LOOK_SECONDS = 1.0
_FORGET_SECONDS = 300.0
_CLOSE_SECONDS = 2.0
_LABELS = 10_000
_LOOK_AT_FILE_SECONDS = 5.0
_WAIT_SECONDS = 60.0  # for news, where there is no recorder


class AlertsOutput:
    """Evaluates rules in a thread of its own, and has everybody told of what rings.

    Parameters
    ----------
    on_ring : callable, optional
        Told the name of the rule, the text and the time (nanoseconds of UTC) of each ring, in the
        thread of `update`; told the same at each update, and nothing else, until it returns that
        somebody has taken it.

    Raises
    ------
    BridgeError
        If nobody would be told, or the folder of the state cannot be written.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        rules: Sequence[AlertRule],
        delivery: DeliverySettings,
        home: Home,
        state_folder: Path,
        say: Callable[[str], None],
        on_ring: OnRing | None = None,
    ) -> None:
        self._file = delivery.urls_file
        if self._file is None and on_ring is None:
            raise BridgeError(NO_LISTENER)
        self._rules = rules
        self._followed = home
        self._say = say
        self._on_ring = on_ring
        folder = state_folder / "alerts"
        self._has_problems = False
        self._read_file, self._looked_at_file = object(), -math.inf  # and when, CLOCK_MONOTONIC
        try:
            self._outbox = Outbox(folder / "outbox", [BROKER, UNREAD], say)
        except OSError as error:
            raise BridgeError(f"{folder}: cannot be used ({error.strerror})") from error
        self._lines = KnownLines(folder / "lines.json", say)
        memory = Memory(folder / "rules.json", say)
        now = self._latest = time.time_ns()
        self._watch = RuleWatch(rules, home.zone, self._outbox, memory, say, now)
        self._heard = LiveHome(self._watch.start, _PATIENCE)
        self._began = time.monotonic()
        self._has_news = Flag()  # what is heard now is known
        self._labels: deque[tuple[str, Label, Sequence[str]]] = deque(maxlen=_LABELS)
        self._told_now: tuple[Ring, str] | None = None  # of which the broker is told
        self._stop = Flag()
        self._delivery = Delivery(self._outbox, [], home.node, home.zone, say)
        self._find_targets()
        self._thread = Thread(target=self._run, daemon=True, name="alerts")
        self._thread.start()

    def update(self, news: News) -> None:
        """Note what is heard now, and tell the broker of what rang."""
        for microphone in news.state.every():
            if microphone.label:
                label = Label(microphone.heard.time, microphone.label, microphone.confidence)
                self._labels.append((microphone.name, label, microphone.classes))
        self._has_news.set()
        if self._on_ring is not None:
            while self._tell_broker(self._on_ring):
                pass

    def close(self) -> None:
        """End within seconds; what was not told waits for the next start."""
        self._stop.set()
        self._thread.join(_CLOSE_SECONDS)
        self._delivery.close()

    def _tell_broker(self, on_ring: OnRing) -> bool:
        """Tell of one ring, the same one until it is taken; return whether it was."""
        if self._told_now is None:
            waiting = self._outbox.waiting_for(BROKER, time.time_ns())
            if not waiting:
                return False
            # Written once: minutes later it would say that it is late, and be another message.
            self._told_now = waiting[0], message(waiting[0], self._followed.zone)
        ring, text = self._told_now
        is_taken = on_ring(ring.rule, text, ring.time)
        if is_taken:
            self._outbox.note_told(BROKER, ring)
            self._told_now = None
        return is_taken

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._follow()
            except Exception as error:  # noqa: BLE001  alerts must go on
                self._say(f"alerts: {type(error).__name__}: {error}; they go on from there")
                self._stop.wait(_LOOK_SECONDS)
        self._watch.save(time.time_ns())

    def _find_targets(self) -> None:
        """Find out who is to be told, if the file of addresses is another one than before.

        Who cannot be read in it does not keep the others from being told; what rings waits for
        the line to be mended.
        """
        if time.monotonic() - self._looked_at_file < _LOOK_AT_FILE_SECONDS:
            return
        self._looked_at_file = time.monotonic()
        state = None if self._file is None else _state_of(self._file)
        if state == self._read_file:
            return
        targets, problems, names, lacks_package = (
            Addresses([], [], []) if self._file is None else find_targets(self._file, self._say)
        )
        self._read_file = object() if lacks_package else state
        for problem in problems:
            self._say(f"alerts: {problem}; the others are told, and who is meant when it is mended")
        if self._has_problems and not problems:
            self._say(f"alerts: {self._file}: every line of it can be read now")
        self._has_problems = bool(problems)
        if names:
            self._outbox.replace_targets(replaced_names(self._lines.names, names))
            self._lines.keep(names)
        told = [target.name for target in targets] + [UNREAD] * bool(problems)
        told += [BROKER] * (self._on_ring is not None)
        self._outbox.set_targets(told, time.time_ns())
        self._delivery.set_targets(targets)

    def _follow(self) -> None:
        """Read what is written, and evaluate the rules whenever all of it has been read.

        Ends when the clock is set back: what was read may be of a time to come.
        """
        logs, looked, forgot = self._followed.folder, 0.0, time.monotonic()
        now = self._latest = time.time_ns()
        self._watch.set_right(now)
        start = self._watch.needed_from(now)
        self._heard = LiveHome(start, _PATIENCE)
        while not logs.is_dir():
            self._find_targets()
            self._look()
            if self._stop.wait(_LOOK_SECONDS):
                return
        batches = follow_messages(logs, is_of_alerts, start, self._stop, self._damaged, ticks=True)
        caught_up = False
        for path, batch in batches:
            if self._now() < self._latest - AHEAD:
                return
            self._find_targets()
            if path == logs:
                caught_up = True
            elif log_name(path).node == self._followed.node:
                self._push(path, batch)
            if caught_up and time.monotonic() - looked >= _LOOK_SECONDS:
                self._look()
                looked = time.monotonic()
            if time.monotonic() - forgot >= _FORGET_SECONDS:
                self._heard.forget_before(self._watch.needed_from(time.time_ns()))
                forgot = time.monotonic()

    def _push(self, path: Path, batch: Sequence[RawMessages]) -> None:
        try:
            end = self._now() + _TO_COME
            known = [raw.between(None, end) for raw in batch]
            if sum(map(len, known)) < sum(map(len, batch)):
                self._say(
                    f"alerts: {path}: was the clock ahead? what is of a time to come is left out"
                )
            self._heard.push(_decoded(known))
        except LogError as error:
            self._damaged(LogError(f"{path}: {error}"))

    def _look(self) -> None:
        if not self._has_news.is_set() and time.monotonic() - self._began < _WAIT_SECONDS:
            return
        now = self._now()
        while self._labels:
            name, label, classes = self._labels.popleft()
            if label.time < now + _TO_COME:
                self._heard.add_label(name, label, classes)
        self._watch.evaluate(self._heard.heard, self._weeks, self._heard.known_until(now), now)
        if time.monotonic() - self._began >= _WAIT_SECONDS:
            self._say_unknown_classes()

    def _say_unknown_classes(self) -> None:
        for rule in self._rules:
            if text := unknown_class(rule, self._heard.classes):
                self._say(f"alerts: {text}")

    def _now(self) -> int:
        now = time.time_ns()
        self._latest = max(self._latest, now)
        return now

    def _weeks(self, start: int, end: int) -> HomeHeard:
        """Read weeks from the logs, once a day; what cannot be read was not heard.

        A night that is still quiet in the morning has no segment yet.
        """
        home = self._followed
        try:
            logs = find_home_logs([home.folder])
        except LogError:  # there is none yet
            return Gathered().heard()
        open_segments = self._heard.open_segments()
        return read_heard(logs, home.node, start, end, lambda _: None, others=open_segments)

    def _damaged(self, error: LogError) -> None:
        self._say(f"alerts: {error}")


def _state_of(file: Path) -> tuple[int, ...] | None:
    """Return what changes whenever a file does; None if it cannot be looked at."""
    with suppress(OSError):
        state = secret_path(file).stat()
        return state.st_mtime_ns, state.st_size, state.st_ino, state.st_mode, state.st_ctime_ns
    return None


def _decoded(batch: Sequence[RawMessages]) -> list[Columns]:
    columns: list[Columns] = []
    for raw in batch:
        if raw.schema is not None and raw.schema.name in FIELDS and len(raw):
            columns += decode([raw], FIELDS[raw.schema.name])
    return columns
