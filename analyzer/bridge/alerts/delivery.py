"""Delivery of notifications: the outbox on disk, targets, and repeated attempts."""

import codecs
import hashlib
import importlib
import logging
import re
import sqlite3
import time
from collections.abc import Iterable, Mapping, Sequence
from datetime import tzinfo
from difflib import SequenceMatcher
from pathlib import Path
from threading import Event as Flag
from threading import Lock, Thread, get_ident
from typing import Any, NamedTuple

from pydantic import BaseModel

from hearthlog.analyzer.bridge.alerts.rules import Notification
from hearthlog.analyzer.bridge.settings import secret_path
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState, Report, StateEntry
from hearthlog.analyzer.errors import remedy
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.schemas.files import exposed_secret, read_limited
from hearthlog.schemas.frames import NANOSECONDS

MOST = 1000
UNREAD = "?"  # stands for the target of an unreadable line, in place of a target name
_UNREAD_LONGEST = 24 * 3600 * NANOSECONDS  # how long notifications wait for a fix of such a line
_OUTBOX = "outbox/"  # begins the names of the entries


class Waiting(BaseModel):
    """A queued notification, and the names of targets that have received it."""

    rule: str
    time: int
    text: str
    is_known: bool
    due: int
    told: set[str] = set()

    @property
    def notification(self) -> Notification:
        """The notification."""
        return Notification(self.rule, self.time, self.text, self.is_known, self.due)


class Outbox:
    """Persistent queue of notifications until each target has received them; thread-safe.

    Beyond `most` notifications the oldest are dropped.
    """

    def __init__(
        self, state: BridgeState, targets: Sequence[str], report: Report, most: int = MOST
    ) -> None:
        self._state = state
        self._targets = frozenset(targets)
        self._report = report
        self._most = most
        self._lock = Lock()
        self._waiting: dict[str, Waiting] = {}
        for name in state.names(_OUTBOX):
            entry = self._entry(name.removeprefix(_OUTBOX))
            if (waiting := entry.load()) is None:
                continue
            if f"{_OUTBOX}{waiting.notification.id}" == name:
                self._waiting[waiting.notification.id] = waiting
            else:
                entry.report_damage()
        self._remove([n for n, each in self._waiting.items() if each.told >= self._targets])
        self._early = frozenset(self._waiting)  # these may be evaluated again after a restart

    def __len__(self) -> int:
        return len(self._waiting)

    def set_targets(self, targets: Iterable[str], now: int) -> None:
        """Set the names of the targets; notifications that every target has are removed.

        If `UNREAD` is among them, notifications are kept for a day for a target added later.
        """
        with self._lock:
            self._targets = frozenset(targets)
            self._remove_done(now)

    def replace_targets(self, former: Mapping[str, str]) -> None:
        """Copy the delivery state of replaced targets to the new targets (new name to former)."""
        with self._lock:
            for waiting in self._waiting.values():
                delivered = {now for now, before in former.items() if before in waiting.told}
                if delivered - waiting.told:
                    waiting.told |= delivered
                    self._write(waiting)

    def _remove_done(self, now: int) -> None:
        done = []
        for name, waiting in self._waiting.items():
            missing = self._targets - waiting.told
            is_old = now - waiting.time > _UNREAD_LONGEST
            if not missing or (is_old and missing == {UNREAD}):
                done.append(name)
        self._remove(done)

    def put(self, notifications: Iterable[Notification]) -> None:
        """Queue notifications that are not queued yet; they are on disk on return."""
        with self._lock:
            self._remove_done(time.time_ns())
            for notification in notifications:
                if notification.id not in self._waiting and notification.id not in self._early:
                    self._waiting[notification.id] = waiting = Waiting(**notification._asdict())
                    self._write(waiting)
            self._drop_oldest()

    def waiting_for(self, target: str, now: int) -> list[Notification]:
        """Return the notifications due for a target, oldest first."""
        with self._lock:
            due = [
                each.notification
                for each in self._waiting.values()
                if target not in each.told and each.due <= now
            ]
        return sorted(due, key=lambda notification: notification.time)

    def record_delivery(self, target: str, notification: Notification) -> None:
        """Record a delivery; a notification that all targets have is removed."""
        with self._lock:
            waiting = self._waiting.get(notification.id)
            if waiting is None:
                return
            waiting.told.add(target)
            if waiting.told >= self._targets:
                self._remove([notification.id])
            else:
                self._write(waiting)

    def forget_after(self, time: int) -> None:
        """Drop notifications later than a time: they were created while the clock was ahead."""
        with self._lock:
            self._remove([n for n, each in self._waiting.items() if each.time > time])

    def _drop_oldest(self) -> None:
        number = len(self._waiting) - self._most
        if number > 0:
            self._remove(sorted(self._waiting, key=lambda each: self._waiting[each].time)[:number])
            self._report(
                f"{self._most} alerts are waiting, and the oldest are dropped; see above which "
                "target fails; repair it, or remove it from urls_file"
            )

    def _remove(self, names: Sequence[str]) -> None:
        for name in names:
            del self._waiting[name]
        try:
            self._state.remove([f"{_OUTBOX}{name}" for name in names])
        except sqlite3.Error as error:
            self._report(f"{self._state.path}: cannot be written ({error}); alerts may come twice")

    def _write(self, waiting: Waiting) -> None:
        self._entry(waiting.notification.id).save(waiting)

    def _entry(self, name: str) -> StateEntry[Waiting]:
        return StateEntry(
            self._state,
            f"{_OUTBOX}{name}",
            Waiting,
            self._report,
            "cannot be read; this alert is not delivered",
            "until it can, alerts are only kept in memory",
        )


_LIMIT = 1 << 16  # bytes of the file
_HOST = re.compile(r"localhost|\[[0-9a-f:.]+\]|[\w-]+(\.[\w-]+)+", re.ASCII | re.IGNORECASE)
_FORM = "%(thread)d %(message)s"  # other threads deliver at the same time
_CODE = re.compile(r"\berror=(\d{3})\b")


class Target:
    """An address of Apprise.

    `name` is stable across restarts; neither it nor `place`, for people, reveals a secret.
    """

    def __init__(self, plugin: Any, address: str, line: int) -> None:
        self._plugin = plugin
        self.name = _name(address)
        self.place = f"line {line}, {_scheme_and_host(plugin, address)}"

    def deliver(self, title: str, text: str) -> str:
        """Deliver within the timeout of the address; return the reason of a failure."""
        import apprise  # noqa: PLC0415  takes half a second, and few need it

        with apprise.LogCapture(level=logging.WARNING, fmt=_FORM) as captured:
            done = self._plugin.notify(
                title=title, body=text, notify_type=apprise.NotifyType.WARNING
            )
            if done:
                return ""
            lines = captured.getvalue().splitlines()
        return _reason("\n".join(line for line in lines if line.startswith(f"{get_ident()} ")))


def _scheme_and_host(plugin: Any, address: str) -> str:
    scheme, host = address.partition("://")[0], plugin.host or ""
    # Many services have a token or a topic in place of the host; neither has a dot.
    is_host = "host" in (plugin.template_tokens or {}) and _HOST.fullmatch(host)
    # In an unescaped password, the text after an @ or before a / is parsed as the host.
    is_sure = "@" not in address or (address.count("@") == 1 and f"@{host}" in address)
    return f"{scheme}://{host}" if is_host and is_sure else scheme


def _reason(failure: str) -> str:
    """Summarize a failure without Apprise's own words, which contain topics and paths."""
    code = _CODE.search(failure)
    if code:
        return f"error {code[1]}"
    is_away = "connection error" in failure.lower()
    return "no connection" if is_away else "`apprise -v -b test ADDRESS` says why"


class Addresses(NamedTuple):
    """Result of reading a file of addresses."""

    targets: list[Target]
    problems: list[str]  # one line for each target that cannot be used, without its address
    names: list[str]  # identifier of the target of each line, readable or not
    lacks_package: bool = False  # whether Apprise, or a package that it needs, is not installed


def find_targets(file: Path | None, report: Report) -> Addresses:
    """Read a file of addresses, one per line, if there is one; `#` begins a comment line."""
    if file is None:
        return Addresses([], [], [])
    file = secret_path(file)
    try:
        importlib.invalidate_caches()  # Apprise may have been installed since the last call
        import apprise  # noqa: PLC0415

        text = _text(read_limited(file, "file of addresses", _LIMIT, BridgeError))
    except BridgeError as error:
        return Addresses([], [str(error)], [])
    except ModuleNotFoundError as error:
        problem = f"{error.name} is not installed; {remedy(error.name or '')}"
        return Addresses([], [problem], [], lacks_package=True)
    if line := exposed_secret(file):
        report(line)
    # Keep Apprise from loading plugins from disk and from writing to disk.
    asset = apprise.AppriseAsset(
        plugin_paths=[], storage_mode="memory", secure_logging=True, async_mode=False
    )
    asset.app_id = asset.app_desc = "hearthlog"
    targets: dict[str, Target] = {}
    problems = []
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    for number, address in lines:
        plugin = _plugin(address, asset)
        if plugin is None:
            problems.append(
                f"{file}, line {number}: no address that Apprise knows; docs/alerts.md has examples"
            )
        else:
            target = Target(plugin, address, number)
            targets.setdefault(target.name, target)
    if not targets and not problems:
        problems = [f"{file}: no address in it; write one a line, as ntfy://ntfy.sh/my-topic"]
    return Addresses([*targets.values()], problems, [_name(line) for _, line in lines])


def replaced_names(before: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the edited lines of a file of addresses, as new name to former name."""
    matcher = SequenceMatcher(None, before, names, autojunk=False)
    edited = [
        pair
        for kind, i, i_end, j, j_end in matcher.get_opcodes()
        if kind == "replace"
        for pair in zip(names[j:j_end], before[i:i_end], strict=False)
    ]
    return {now: former for now, former in edited if now not in before and former not in names}


def _name(address: str) -> str:
    return hashlib.sha256(address.encode()).hexdigest()[:16]


def _plugin(address: str, asset: Any) -> Any:
    """Parse an address with Apprise; None if Apprise does not accept the address."""
    import apprise  # noqa: PLC0415

    try:
        return apprise.Apprise.instantiate(address, asset=asset, suppress_exceptions=True)
    except Exception:  # noqa: BLE001  hundreds of services, each with its own errors
        return None


def _text(data: bytes) -> str:
    """Decode text as editors write it: UTF-8 with or without a BOM, or UTF-16 with one."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    return data.decode("utf-8-sig", "replace")


_LOOK_SECONDS = 0.5
_LONGEST_PAUSE = 900.0  # seconds
_CLOSE_SECONDS = 2.0
_LATE = 5 * 60 * NANOSECONDS


class Delivery:
    """Delivers queued notifications, with one thread per target.

    After a failure it waits for the first pause, in seconds, doubled after each further one.
    """

    def __init__(  # noqa: PLR0913
        self,
        outbox: Outbox,
        targets: Sequence[Target],
        node: str,
        zone: tzinfo,
        report: Report,
        *,
        first_pause: float = 5.0,
    ) -> None:
        self._outbox = outbox
        self._node = node
        self._zone = zone
        self._report = report
        self._first_pause = first_pause
        self._threads: dict[str, tuple[Thread, Flag]] = {}  # by name of the target
        self.set_targets(targets)

    def set_targets(self, targets: Sequence[Target]) -> None:
        """Replace the targets; threads of targets that stay are not interrupted."""
        names = {target.name for target in targets}
        for name in self._threads.keys() - names:
            self._threads.pop(name)[1].set()
        for target in targets:
            if target.name not in self._threads:
                stop = Flag()
                thread = Thread(
                    target=self._run, args=(target, stop), daemon=True, name="alerts, to a target"
                )
                self._threads[target.name] = thread, stop
                thread.start()

    def close(self) -> None:
        """Stop within seconds, whatever a target does; the rest is delivered after a restart."""
        until = time.monotonic() + _CLOSE_SECONDS
        for _, stop in self._threads.values():
            stop.set()
        for thread, _ in self._threads.values():
            thread.join(max(until - time.monotonic(), 0.0))

    def _run(self, target: Target, stop: Flag) -> None:
        pause = self._first_pause
        while not stop.wait(_LOOK_SECONDS):
            delivered, failed = self._deliver(target, stop)
            if delivered:
                pause = self._first_pause
            if failed:
                stop.wait(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)

    def _deliver(self, target: Target, stop: Flag) -> tuple[int, bool]:
        """Deliver all due notifications to a target; return their number and whether one failed."""
        delivered = 0
        for notification in self._outbox.waiting_for(target.name, time.time_ns()):
            if stop.is_set():
                break
            try:
                reason = target.deliver(
                    f"{self._node}: {notification.rule}", message(notification, self._zone)
                )
            except Exception as error:  # noqa: BLE001  many services, each with its own errors
                reason = type(error).__name__
            if reason:
                self._report(
                    f"{target.place}: an alert could not be delivered ({reason}); it is kept and "
                    "retried at least every quarter of an hour"
                )
                return delivered, True
            self._outbox.record_delivery(target.name, notification)
            delivered += 1
        return delivered, False


def message(notification: Notification, zone: tzinfo, now: int | None = None) -> str:
    """Format a notification: local time, text, and a remark if late by `now` (nanoseconds of UTC).

    By default `now` is the current time.
    """
    late = (time.time_ns() if now is None else now) - notification.due > _LATE
    moment = f"{local_time(notification.time, zone):%Y-%m-%d %H:%M}"
    return f"{moment}: {notification.text}{' (delivered late)' if late else ''}"
