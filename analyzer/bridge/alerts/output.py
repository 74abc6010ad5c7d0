"""Alerts output: live evaluation of rules, with progress kept across restarts."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import tzinfo
from functools import cache
from pathlib import Path
from threading import Event as Flag
from threading import Thread

from hearthlog.analyzer.activity.live import LiveActivity, LiveLabel
from hearthlog.analyzer.activity.segments import HomeActivity, SegmentCollector, read_activity
from hearthlog.analyzer.bridge.alerts.delivery import (
    UNREAD,
    Delivery,
    Outbox,
    find_targets,
    message,
    replaced_names,
)
from hearthlog.analyzer.bridge.alerts.evaluation import judged_days, notifications
from hearthlog.analyzer.bridge.alerts.rule_checks import unknown_class
from hearthlog.analyzer.bridge.alerts.rules import (
    DAY,
    MINUTE,
    SECOND,
    AlertRule,
    DailyRule,
    Notification,
    RuleState,
    history,
    is_hidden,
    live_history,
)
from hearthlog.analyzer.bridge.output import OutputUpdate
from hearthlog.analyzer.bridge.settings import (
    NO_RECIPIENT,
    DeliverySettings,
    RecorderAddress,
    secret_path,
)
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState, Report, StateEntry
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns


class RuleProgressStore:
    """Persistent evaluation progress of each rule; a changed rule starts over."""

    def __init__(self, state: BridgeState, report: Report) -> None:
        damaged = "cannot be read; all rules start over"
        unsaved = "alerts may come twice after the next start"
        self._entry = StateEntry(state, "rules", dict[str, RuleState], report, damaged, unsaved)

    def load(self, rules: Sequence[AlertRule]) -> dict[str, RuleState]:
        """Return the states of rules by name."""
        saved = self._entry.load() or {}
        return {rule.name: saved.get(rule.fingerprint, RuleState()) for rule in rules}

    def save(self, rules: Sequence[AlertRule], states: Mapping[str, RuleState]) -> None:
        """Save the states of rules; they are on disk on return."""
        self._entry.save({rule.fingerprint: states[rule.name] for rule in rules})


_OLDEST = DAY  # notifications older than this are not delivered
_EVERY = SECOND  # of the log
_SAVE_EVERY = 5 * MINUTE
AHEAD = 5 * SECOND  # jump from which the clock counts as set back


class RuleWatch:
    """Evaluates rules, queues their notifications, and saves the progress."""

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        rules: Sequence[AlertRule],
        zone: tzinfo,
        outbox: Outbox,
        memory: RuleProgressStore,
        report: Report,
        now: int,
    ) -> None:
        self._rules = rules
        self._zone = zone
        self._outbox = outbox
        self._memory = memory
        self._report = report
        self._progress = memory.load(rules)
        self._saved = now
        self.hidden_classes: frozenset[str] = frozenset()  # classes whose rules never notify
        self.reset_stale_progress(now)

    def reset_stale_progress(self, now: int) -> None:
        """Restart rules whose progress is in the future, or more than a day old."""
        is_ahead = any(own.until > now + AHEAD for own in self._progress.values())
        self._progress = {name: _as_of(own, now) for name, own in self._progress.items()}
        if is_ahead:
            self._report("alerts: the clock was set back; the rules start over")
            self._outbox.forget_after(now + AHEAD)
            self.save(now)

    def needed_from(self, now: int) -> int:
        """Return the start of the activity that the rules need, in nanoseconds of UTC."""
        return min(
            (self._progress[rule.name].until - live_history(rule) for rule in self._rules),
            default=now,
        )

    def evaluate(
        self,
        activity: Callable[[], HomeActivity],
        weeks: Callable[[int, int], HomeActivity],
        until: int,
        now: int,
    ) -> list[Notification]:
        """Evaluate the rules up to a time; their notifications are on disk on return.

        `activity` returns the live activity, complete up to `until` (nanoseconds of UTC), if a rule
        needs it; `weeks` that between two times, read from the logs.
        """
        self.reset_stale_progress(now)
        found: list[Notification] = []
        activity_once = cache(activity)
        for rule in self._rules:
            own = self._progress[rule.name]
            if until - own.until < _EVERY:
                continue
            if is_hidden(rule, self.hidden_classes):
                self._progress[rule.name] = replace(own, until=until, has_rung=False)
                continue
            if isinstance(rule, DailyRule):
                if not judged_days(rule, own.until, until, self._zone):
                    self._progress[rule.name] = replace(own, until=until)
                    continue
                what = weeks(until - history(rule), until)
            else:
                what = activity_once()
            new, state = notifications(rule, what, own.until, until, self._zone, own)
            self._progress[rule.name] = state
            found += new
        self._outbox.put(found)
        if found or now - self._saved >= _SAVE_EVERY:
            self.save(now)
        return found

    def save(self, now: int) -> None:
        """Save the progress of the rules."""
        self._memory.save(self._rules, self._progress)
        self._saved = now


def _as_of(own: RuleState, now: int) -> RuleState:
    if own.until > now + AHEAD or not own.until:
        return RuleState(since=now, until=now)
    if own.until < now - _OLDEST:
        return replace(own, until=now - _OLDEST, has_rung=False)
    return own


# Takes the name of a rule, a text and a time; returns whether they were delivered.
OnNotification = Callable[[str, str, int], bool]
BROKER = "mqtt"  # in place of a target name
_PATIENCE = 30 * NANOSECONDS
_TO_COME = 60 * NANOSECONDS  # from now: later messages were written while a clock was ahead
_LOOK_SECONDS, _NEWS_SECONDS = 1.0, 0.2
_FORGET_SECONDS = 300.0
_CLOSE_SECONDS = 2.0
_LABELS, _COLUMNS = 10_000, 100_000
_LOOK_AT_FILE_SECONDS = 5.0
_WAIT_SECONDS = 60.0  # for news, without a recorder


class AlertsOutput:
    """Evaluates rules in a separate thread, and delivers their notifications.

    `on_notification` is called with rule, text and time (nanoseconds of UTC) of a notification, in
    the thread of `update`; repeated at each update until it returns True. Raise `BridgeError` if
    there is no recipient.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        rules: Sequence[AlertRule],
        delivery: DeliverySettings,
        home: RecorderAddress,
        state: BridgeState,
        report: Report,
        on_notification: OnNotification | None = None,
    ) -> None:
        self._file = delivery.urls_file
        if self._file is None and on_notification is None:
            raise BridgeError(NO_RECIPIENT)
        self._rules = rules
        self._followed = home
        self._report = report
        self._on_notification = on_notification
        self._has_problems = False
        self._read_file, self._file_checked = object(), -math.inf  # the second: CLOCK_MONOTONIC
        self._outbox = Outbox(state, [BROKER, UNREAD], report)
        twice = "targets on edited lines may be notified twice"
        self._lines_entry = StateEntry(
            state, "addresses", list[str], report, f"cannot be read; {twice}", twice
        )
        self._lines = self._lines_entry.load() or []  # target names of the file of addresses
        memory = RuleProgressStore(state, report)
        now = self._latest = time.time_ns()
        self._watch = RuleWatch(rules, home.zone, self._outbox, memory, report, now)
        self._activity = LiveActivity(now, _PATIENCE)
        self._began = time.monotonic()
        self._has_news = Flag()  # set by the first update
        self._labels: deque[tuple[str, LiveLabel, Sequence[str]]] = deque(maxlen=_LABELS)
        self._columns: deque[Columns] = deque(maxlen=_COLUMNS)
        self._in_delivery: tuple[Notification, str] | None = None  # being delivered to the broker
        self._stop = Flag()
        self._delivery = Delivery(self._outbox, [], home.node, home.zone, report)
        self._find_targets()
        self._thread = Thread(target=self._run, daemon=True, name="alerts")
        self._thread.start()

    def update(self, update: OutputUpdate) -> None:
        """Queue the current labels, and deliver notifications to the broker."""
        for microphone in update.state.every():
            if microphone.label:
                label = LiveLabel(microphone.active.time, microphone.label, microphone.confidence)
                self._labels.append((microphone.name, label, microphone.classes))
        self._watch.hidden_classes = update.state.hidden_classes
        self._columns += update.columns
        self._has_news.set()
        if self._on_notification is not None:
            while self._offer(self._on_notification):
                pass

    def close(self) -> None:
        """Stop within seconds; undelivered notifications wait for the next start."""
        self._stop.set()
        self._thread.join(_CLOSE_SECONDS)
        self._delivery.close()

    def _offer(self, on_notification: OnNotification) -> bool:
        """Offer one notification to the broker, repeatedly; return whether it was taken."""
        if self._in_delivery is None:
            waiting = self._outbox.waiting_for(BROKER, time.time_ns())
            if not waiting:
                return False
            # Formatted once: minutes later the text would say "late" and be a different message.
            self._in_delivery = waiting[0], message(waiting[0], self._followed.zone)
        notification, text = self._in_delivery
        is_taken = on_notification(notification.rule, text, notification.time)
        if is_taken:
            self._outbox.record_delivery(BROKER, notification)
            self._in_delivery = None
        return is_taken

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._follow()
            except Exception as error:  # noqa: BLE001  alerts must go on
                self._report(f"alerts: {type(error).__name__}: {error}; they go on from there")
                self._stop.wait(_LOOK_SECONDS)
        self._watch.save(time.time_ns())

    def _find_targets(self) -> None:
        """Reread the file of addresses if it has changed.

        An unreadable line does not stop delivery to the others; notifications for its target wait
        until the line is fixed.
        """
        if time.monotonic() - self._file_checked < _LOOK_AT_FILE_SECONDS:
            return
        self._file_checked = time.monotonic()
        current = None if self._file is None else _state_of(self._file)
        if current == self._read_file:
            return
        targets, problems, names, lacks_package = find_targets(self._file, self._report)
        self._read_file = object() if lacks_package else current
        for problem in problems:
            self._report(
                f"alerts: {problem}; other targets are notified, this one once it is corrected"
            )
        if self._has_problems and not problems:
            self._report(f"alerts: {self._file}: every line of it can be read now")
        self._has_problems = bool(problems)
        if names:
            self._outbox.replace_targets(replaced_names(self._lines, names))
            if names != self._lines:
                self._lines = names
                self._lines_entry.save(names)
        recipients = [target.name for target in targets] + [UNREAD] * bool(problems)
        recipients += [BROKER] * (self._on_notification is not None)
        self._outbox.set_targets(recipients, time.time_ns())
        self._delivery.set_targets(targets)

    def _follow(self) -> None:
        """Read what the rules need of the past, and evaluate the rules at each update.

        Returns when the clock is set back: messages so far may be from the future.
        """
        home, checked, forgot = self._followed, -math.inf, time.monotonic()
        now = self._latest = time.time_ns()
        self._watch.reset_stale_progress(now)
        self._activity = LiveActivity(self._watch.needed_from(now), _PATIENCE)
        with suppress(LogError):  # no log yet
            logs = find_home_logs([home.folder])
            self._activity.read(
                logs, home.node, now + _TO_COME, lambda text: self._report(f"alerts: {text}")
            )
        while not self._stop.wait(_NEWS_SECONDS):
            if self._now() < self._latest - AHEAD:
                return
            self._find_targets()
            while self._columns:
                self._push(self._columns.popleft())
            if time.monotonic() - checked >= _LOOK_SECONDS:
                self._look()
                checked = time.monotonic()
            if time.monotonic() - forgot >= _FORGET_SECONDS:
                self._activity.forget_before(self._watch.needed_from(time.time_ns()))
                forgot = time.monotonic()

    def _push(self, columns: Columns) -> None:
        past = columns.between(None, self._now() + _TO_COME)
        if len(past) < len(columns):
            self._report("alerts: was the clock ahead? segments in the future are left out")
        self._activity.push([past])

    def _look(self) -> None:
        if not self._has_news.is_set() and time.monotonic() - self._began < _WAIT_SECONDS:
            return
        now = self._now()
        while self._labels:
            name, label, classes = self._labels.popleft()
            if label.time < now + _TO_COME:
                self._activity.add_label(name, label, classes)
        self._watch.evaluate(
            self._activity.activity, self._weeks, self._activity.complete_until(now), now
        )
        if time.monotonic() - self._began >= _WAIT_SECONDS:
            unknown = (unknown_class(rule, self._activity.classes) for rule in self._rules)
            for text in filter(None, unknown):
                self._report(f"alerts: {text}")

    def _now(self) -> int:
        now = time.time_ns()
        self._latest = max(self._latest, now)
        return now

    def _weeks(self, start: int, end: int) -> HomeActivity:
        """Read weeks from the logs, once a day; unreadable logs are skipped.

        Open segments are added: a silence since the night may have no segment in the log yet.
        """
        home = self._followed
        try:
            logs = find_home_logs([home.folder])
        except LogError:  # no log yet
            return SegmentCollector().activity()
        open_segments = self._activity.open_segments()
        return read_activity(logs, home.node, start, end, lambda _: None, others=open_segments)


def _state_of(file: Path) -> tuple[int, ...] | None:
    """Return a fingerprint of the state of a file; None if `stat` fails."""
    with suppress(OSError):
        state = secret_path(file).stat()
        return state.st_mtime_ns, state.st_size, state.st_ino, state.st_mode, state.st_ctime_ns
    return None
