"""The bridge: follows the log of a recorder and updates the configured outputs."""

import stat
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from threading import Event as Flag
from threading import Lock, Thread
from typing import Any

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.bridge.home_state import HomeState, follow_home
from hearthlog.analyzer.bridge.output import RECENT, Output, OutputUpdate, Totals
from hearthlog.analyzer.bridge.settings import (
    NO_RECIPIENT,
    BridgeSettings,
    MqttSettings,
    PageSettings,
    PingSettings,
    RecorderAddress,
    figures_token,
    page_secrets,
    read_token,
    secret_path,
)
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState, Report
from hearthlog.analyzer.errors import missing, remedy
from hearthlog.analyzer.http import has_password, ip_of, listen, ping, read_ping_address
from hearthlog.analyzer.logs.local_time import today
from hearthlog.recorder.host import give_back, keep_one_heap, notify
from hearthlog.recorder.log.folder_lock import check_writable
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.files import exposed_secret
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types

_ERROR = 2  # level of diagnostics
_SOON = 10.0  # seconds from the start to the first ping
_JUDGED_SECONDS = 60.0  # after which the last state of the recorder is too old for a ping


class PingOutput:
    """Pings a URL at intervals, or its `/fail` path while there is a problem.

    There is no problem while the recorder writes and its diagnostics have no error. A bridge that
    hangs stops pinging.

    Raise `HearthlogError` if the file with the URL cannot be used.
    """

    def __init__(self, settings: PingSettings, report: Report) -> None:
        self._settings = settings
        self._url = settings.url
        if settings.url_file is not None:
            self._url = read_ping_address(secret_path(settings.url_file))
        self._report = report
        self._is_well = False
        self._judged = 0.0  # time of `_is_well`, by CLOCK_MONOTONIC
        self._stop = Flag()
        Thread(target=self._ping, daemon=True).start()

    def update(self, update: OutputUpdate) -> None:
        """Record whether the recorder works."""
        fails = any(health.level >= _ERROR for health in update.state.health.values())
        self._is_well = update.state.is_recording() and not fails
        self._judged = time.monotonic()

    def close(self) -> None:
        """Stop pinging."""
        self._stop.set()

    def _ping(self) -> None:
        pause = min(self._settings.every_seconds, _SOON)
        while not self._stop.wait(pause):
            pause = self._settings.every_seconds
            if time.monotonic() - self._judged <= _JUDGED_SECONDS:
                problem = ping(self._url, is_well=self._is_well)
                if problem:
                    self._report(f"ping: not accepted ({problem}); trying again")


_WATCHDOG_SECONDS = 10.0
_MOST_EARLY = 1000  # events before reading has caught up; only recent ones are reported
_AHEAD = 3600 * NANOSECONDS  # from now: no event can begin later
_FORGOTTEN = 24 * 3600 * NANOSECONDS  # before the last midnight and evening


@dataclass
class Bridge:
    """Follows one recorder and updates the outputs."""

    home: RecorderAddress
    since: int  # log time from which events are read, in nanoseconds of UTC
    outputs: dict[str, Output]
    report: Report
    _watchdog_due: float = 0.0

    def run(self, stop: Flag) -> None:
        """Update the outputs until `stop` is set."""
        keep_one_heap()
        notify(["READY=1"])
        early: deque[SoundEvent] = deque(maxlen=_MOST_EARLY)
        columns: list[Columns] = []
        had_caught_up = False
        try:
            for state, begun, read in follow_home(self.home, self.since, stop, self.report):
                self._live()
                early += begun
                columns += (part for part in read if part.type != message_types.LABEL)
                if state.caught_up:
                    self._update_outputs(state, list(early), columns, is_first=not had_caught_up)
                    early.clear()
                    columns = []
                had_caught_up = state.caught_up
        finally:
            notify(["STOPPING=1"])
            for name, output in self.outputs.items():
                self._try(name, output.close)

    def _live(self) -> None:
        """Notify the watchdog of systemd that the bridge is alive."""
        if time.monotonic() >= self._watchdog_due:
            self._watchdog_due = time.monotonic() + _WATCHDOG_SECONDS
            notify(["WATCHDOG=1"])

    def _update_outputs(
        self,
        state: HomeState,
        begun: Sequence[SoundEvent],
        columns: Sequence[Columns],
        *,
        is_first: bool,
    ) -> None:
        now = time.time_ns()
        moment = today(now, self.home.zone)
        ended = [event for each in state.every() for event in each.ended_events()]
        if is_first:
            give_back()  # memory used while reading the log
            ended = [event for event in ended if now - event.end <= RECENT]
        recent = [event for event in begun if now - event.end <= RECENT]
        update = OutputUpdate(state, recent, ended, moment, self.home.zone, columns)
        for name, output in self.outputs.items():
            self._try(name, partial(output.update, update))
        for microphone in state.every():
            microphone.forget(min(moment.midnight, moment.night) - _FORGOTTEN, now + _AHEAD)

    def _try(self, name: str, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception as error:  # noqa: BLE001  a failing output must not stop the others
            self.report(f"{name}: {type(error).__name__}: {error}")


_REPEAT_SECONDS = 3600.0
_MOST_TEXTS = 100  # remembered texts


class ProblemReporter:
    """Passes on status lines from any thread; repeats a line after an hour at the earliest."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._reported: dict[str, float] = {}  # the oldest first
        self._lock = Lock()

    def __call__(self, text: object) -> None:
        """Report a line, unless it was reported within the last hour."""
        line, now = str(text), time.monotonic()
        with self._lock:
            if now - self._reported.get(line, -_REPEAT_SECONDS) < _REPEAT_SECONDS:
                return
            self._reported.pop(line, None)  # so that it becomes the newest
            self._reported[line] = now
            if len(self._reported) > _MOST_TEXTS:
                del self._reported[next(iter(self._reported))]
        with suppress(OSError, ValueError):  # a full disk, or a closed stream
            self._report(line)


_OLDEST = 7 * 24 * 3600 * NANOSECONDS  # longest history read at a start
_EARLIER = 6 * 3600 * NANOSECONDS  # longest event: read from this much earlier for complete events
_AGAIN_SECONDS = 60.0


class ReopenedOutput:
    """An output that is retried every minute while it cannot be opened; `output` is None then."""

    def __init__(self, make: Callable[[], Output], report: Report) -> None:
        self.output: Any = None
        self._make = make
        self._report = report
        self._due = 0.0  # by CLOCK_MONOTONIC
        self._open()

    def update(self, update: OutputUpdate) -> None:
        """Update the output if it is open; retry opening it once a minute."""
        if self.output is None and time.monotonic() >= self._due:
            self._open()
        if self.output is not None:
            self.output.update(update)

    def close(self) -> None:
        """Close the output if it is open."""
        if self.output is not None:
            self.output.close()

    def _open(self) -> None:
        self._due = time.monotonic() + _AGAIN_SECONDS
        try:
            self.output = self._make()
        except ModuleNotFoundError as error:
            self._report(f"{error.name} is not installed; {remedy(error.name or '')}; trying again")
        except (HearthlogError, OSError) as error:
            self._report(f"{error}; trying again")
        except Exception as error:  # noqa: BLE001  a failing output must not stop the others
            self._report(f"{type(error).__name__}: {error}; trying again")


def open_outputs(
    settings: BridgeSettings, home: RecorderAddress, state: BridgeState, report: ProblemReporter
) -> tuple[dict[str, Output], int]:
    """Open the configured outputs; return also the log time from which they need events.

    The time is in nanoseconds of UTC.
    """
    moment = today(time.time_ns(), home.zone)
    since = min(moment.midnight, moment.night) - _EARLIER
    outputs: dict[str, Output] = {}
    # Imported here: without a broker no MQTT client need be installed.
    if (mqtt := settings.mqtt) is not None:

        def publish() -> Output:
            from hearthlog.analyzer.bridge.mqtt.publisher import MqttPublisher  # noqa: PLC0415

            return MqttPublisher(mqtt, home, state, report)

        outputs["mqtt"] = publisher = ReopenedOutput(publish, report)
    if (figures := settings.prometheus) is not None:
        first = since

        def count() -> Output:
            from hearthlog.analyzer.bridge.prometheus import PrometheusOutput  # noqa: PLC0415

            return PrometheusOutput(figures, home, state, first, report)

        outputs["prometheus"] = ReopenedOutput(count, report)
        kept = Totals(state, since, lambda _: None).time - _EARLIER
        since = min(since, max(kept, moment.now - _OLDEST))
    if (page := settings.page) is not None:
        from hearthlog.analyzer.bridge.page.home_page import HomePage  # noqa: PLC0415

        outputs["page"] = ReopenedOutput(lambda: HomePage(page, home, state.folder, report), report)
    if (watchdog := settings.ping) is not None:
        outputs["ping"] = ReopenedOutput(lambda: PingOutput(watchdog, report), report)
    if settings.alert:
        from hearthlog.analyzer.bridge.alerts.output import AlertsOutput  # noqa: PLC0415

        def publish_alert(rule: str, text: str, time: int) -> bool:
            return publisher.output is not None and publisher.output.alert(rule, text, time)

        rules, delivery = settings.alert, settings.delivery
        on_notification = None if mqtt is None else publish_alert
        outputs["alerts"] = ReopenedOutput(
            lambda: AlertsOutput(rules, delivery, home, state, report, on_notification), report
        )
    return outputs, since


def needed_modules(settings: BridgeSettings) -> dict[str, bool]:
    """Return the modules that the configured outputs need, and whether each is installed."""
    needed = {
        "paho": settings.mqtt,
        "prometheus_client": settings.prometheus,
        "apprise": settings.alert and settings.delivery.urls_file,
    }
    return {name: find_spec(name) is not None for name, table in needed.items() if table}


def output_problems(settings: BridgeSettings) -> tuple[list[str], list[str]]:
    """Return errors that the outputs would raise at their start, and warnings; open nothing.

    Warnings are of missing files that may be credentials of the service, and of a text file of
    figures that node_exporter would not read.
    """
    problems: list[str] = []
    warnings: list[str] = []
    there = needed_modules(settings) | {"apprise": True}  # its absence is reported below
    if lacking := [name for name, is_there in there.items() if not is_there]:
        problems.append(missing(*lacking))
    if (figures := settings.prometheus) is not None:
        lines = figures.deprecated_readers(), figures.unread_text_file()
        warnings += [line for line in lines if line]
    if settings.alert and settings.mqtt is None and settings.delivery.urls_file is None:
        problems.append(NO_RECIPIENT)
    for path, step in [*_secret_steps(settings, problems), *_other_steps(settings)]:
        if path is not None and not path.is_absolute() and not secret_path(path).exists():
            warnings.append(f"{path}: missing; it must be a credential of the service")
            continue
        try:
            step()
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in lacking:
                raise
        except (HearthlogError, OSError) as error:
            problems.append(str(error))
    return problems, warnings


_Step = tuple[Path | None, Callable[[], object]]  # the file of a secret, and its check


def _secret_steps(settings: BridgeSettings, problems: list[str]) -> Iterator[_Step]:
    """Yield the checks of the files of secrets."""
    mqtt, page, figures = settings.mqtt, settings.page, settings.prometheus
    if mqtt is not None:
        yield mqtt.password_file, partial(_check_connection, "read_password", mqtt)
    if page is not None and page.token_file is not None:
        yield page.token_file, partial(read_token, page.token_file)
    if figures is not None and figures.port is not None:
        yield figures.token_file, partial(figures_token, figures.port, figures.token_file)
    if settings.ping is not None and (url := settings.ping.url_file) is not None:
        yield url, lambda: read_ping_address(secret_path(url))
    if (file := settings.delivery.urls_file) is not None:
        from hearthlog.analyzer.bridge.alerts.delivery import find_targets  # noqa: PLC0415

        yield file, lambda: problems.extend(find_targets(file, lambda _: None).problems)


def _other_steps(settings: BridgeSettings) -> Iterator[_Step]:
    """Yield the checks of certificates, addresses and folders."""
    mqtt, page, figures = settings.mqtt, settings.page, settings.prometheus
    if mqtt is not None:
        yield None, mqtt.check_files
        if mqtt.tls:
            yield None, partial(_check_connection, "tls_context", mqtt)
    if page is not None:
        yield None, lambda: listen(bind=page.bind).close()
    if figures is not None:
        yield None, figures.check_readers
        if figures.text_file is not None:
            yield None, partial(_check_text_file, figures.text_file)
    if page is not None and figures is not None and figures.port == page.port:
        yield None, partial(_check_ports, page)
    if settings.state is not None:
        yield None, partial(check_writable, settings.state)


def _check_connection(check: str, settings: MqttSettings) -> None:
    from hearthlog.analyzer.bridge.mqtt import connection  # noqa: PLC0415

    getattr(connection, check)(settings)


def _check_text_file(file: Path) -> None:
    try:
        if stat.S_ISDIR(file.stat().st_mode):
            problem = "is a folder; name a file in it, as hearthlog.prom"
            raise BridgeError(f"bridge.prometheus: text_file: {file} {problem}")
    except (FileNotFoundError, NotADirectoryError):
        pass  # `check_writable` checks the folder below
    except OSError as error:
        problem = f"cannot be written ({error.strerror})"
        raise BridgeError(f"bridge.prometheus: text_file: {file} {problem}") from error
    check_writable(file.absolute().parent)


def _check_ports(page: PageSettings) -> None:
    address = ip_of(page.bind)
    if address is None or address.is_loopback or address.is_unspecified:
        raise BridgeError(
            f"bridge.prometheus: port {page.port} is that of [bridge.page]; choose another one"
        )


def exposed_files(settings: BridgeSettings, file: Path | None, state: Path | None) -> list[str]:
    """Return a line for each file of secrets that other users may read or change.

    The configuration file is a secret if it has a ping URL with a password; the state folder of the
    bridge is None if unknown.
    """
    mqtt, page, figures, ping = settings.mqtt, settings.page, settings.prometheus, settings.ping
    tables = (ping, "url_file"), (mqtt, "password_file"), (mqtt, "key_file"), (page, "token_file")
    files = [settings.delivery.urls_file]
    files += [getattr(table, key, None) for table, key in ((figures, "token_file"), *tables)]
    paths = [secret_path(each) for each in files if each is not None]
    paths += [] if page is None or state is None else page_secrets(state)
    paths += [file] if file is not None and ping is not None and has_password(ping.url) else []
    return [line for line in map(exposed_secret, paths) if line]
