"""Prometheus metrics: in a text file for node_exporter, or on a loopback port."""

import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from pathlib import Path
from secrets import compare_digest
from typing import Any, cast

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from hearthlog.analyzer.activity.segments import is_of_scenario, source_parts
from hearthlog.analyzer.bridge.output import OutputUpdate, Total, Totals
from hearthlog.analyzer.bridge.settings import PrometheusSettings, RecorderAddress, figures_token
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState, Report
from hearthlog.analyzer.http import HOST, HttpHandler, HttpServer, is_numeric_host
from hearthlog.analyzer.logs.spans import SEGMENT_DELAY
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import create_file, replaced_file

_EVERY_SECONDS, _STALE_SECONDS = 10.0, 60.0
_TEXT = "text/plain; version=0.0.4; charset=utf-8"
_READERS = {"owner": 0, "group": 0o040, "all": 0o044}


class PrometheusOutput:
    """Serves the metrics of a home on a port, or writes them to a text file every ten seconds.

    If no totals are saved, the count of events starts at `since`, in nanoseconds of UTC. Raise
    `BridgeError` if neither port nor text file is configured, or if the port cannot be opened or
    has no token and there is no text file.
    """

    def __init__(
        self,
        settings: PrometheusSettings,
        home: RecorderAddress,
        state: BridgeState,
        since: int,
        report: Report,
    ) -> None:
        settings.check_readers()
        self._settings = settings
        self._home = home
        self._report = report
        self.totals = Totals(state, since, report)
        self._made = b"", -math.inf  # the metrics, and their time by CLOCK_MONOTONIC
        self._due = 0.0  # by CLOCK_MONOTONIC
        for line in (settings.deprecated_readers(), settings.unread_text_file()):
            if line:
                report(line)
        self._server: _Server | None = None
        self._open_port()

    def update(self, update: OutputUpdate) -> None:
        """Compute the metrics again if they are ten seconds old."""
        if time.monotonic() < self._due:
            return
        self._due = time.monotonic() + _EVERY_SECONDS
        self._open_port()
        self.totals.keep(
            update.state, min(update.today.midnight, update.today.night) - SEGMENT_DELAY
        )
        registry = CollectorRegistry()
        totals = self.totals.count(update.state)
        shown = [total for total in totals if total.label not in update.state.hidden_classes]
        registry.register(HomeCollector(update, self._home, shown))
        text = generate_latest(registry)
        self._made = text, time.monotonic()
        if self._settings.text_file is not None:
            self._write(self._settings.text_file, text)

    def close(self) -> None:
        """Stop the server, and delete the text file, which would otherwise be read when stale."""
        if self._server is not None:
            self._server.end()
        if (file := self._settings.text_file) is not None:
            try:
                file.unlink(missing_ok=True)
            except OSError as error:
                self._report(f"bridge.prometheus: {file}: cannot be removed ({error.strerror})")

    def _write(self, file: Path, text: bytes) -> None:
        rights = _READERS[self._settings.readable_by or "all"]
        try:
            with replaced_file(file, readers=rights) as temporary, create_file(temporary) as stream:
                stream.write(text)
        except (LogError, OSError) as error:
            self._report(f"bridge.prometheus: text_file: {error}; trying again")

    def _open_port(self) -> None:
        """Open the configured port; with a text file, a failure is only reported."""
        if self._settings.port is None or self._server is not None:
            return
        port, file = self._settings.port, self._settings.text_file
        try:
            token = figures_token(port, self._settings.token_file)
            self._server = _Server(port, token, self._current)
        except (BridgeError, OSError) as error:
            text = str(error)
            if isinstance(error, OSError):
                text = f"cannot listen on port {port} ({error.strerror}); take another"
                text = f"bridge.prometheus: {text}"
            if file is None:
                raise BridgeError(text) from error
            self._report(f"{text}; {file} is written all the same")

    def _current(self) -> bytes | None:
        """Return the metrics; None if they are stale."""
        text, made = self._made
        return text if time.monotonic() - made <= _STALE_SECONDS else None


class _Server(HttpServer):
    """Server of the metrics for clients with the token."""

    def __init__(self, port: int, token: str, current: Callable[[], bytes | None]) -> None:
        super().__init__(HOST, port, _Handler)
        self.expected = f"Bearer {token}".encode()
        self.current = current
        self.start()


class _Handler(HttpHandler):
    """Handler of one request; requests from web pages are refused, whatever the host name."""

    def do_GET(self) -> None:
        """Send the metrics."""
        server = cast(_Server, self.server)
        shown = self.headers.get("Authorization", "").encode("utf-8", "replace")
        if not is_numeric_host(HOST, self.host) or "Origin" in self.headers:
            self.send_text(
                HTTPStatus.FORBIDDEN, "request it by IP address, and not from a web page"
            )
        elif not compare_digest(shown, server.expected):
            self.send_text(
                HTTPStatus.UNAUTHORIZED,
                "send the token of token_file in [bridge.prometheus], as `authorization: "
                "credentials_file` of Prometheus does",
                {"WWW-Authenticate": "Bearer"},
            )
        elif self.path.partition("?")[0] != "/metrics":
            self.send_text(HTTPStatus.NOT_FOUND, "only /metrics exists")
        elif self.has_place():
            if (text := server.current()) is None:
                self.send_text(HTTPStatus.SERVICE_UNAVAILABLE, "the metrics are stale")
            else:
                self.send(HTTPStatus.OK, text, _TEXT)


class HomeCollector(Collector):
    """The metrics of a home at one moment."""

    def __init__(
        self, update: OutputUpdate, home: RecorderAddress, totals: Sequence[Total]
    ) -> None:
        self._update = update
        self._home = home
        self._totals = totals

    def collect(self) -> Iterator[Metric]:
        """Yield each metric, by microphone and class."""
        node, state = self._home.node, self._update.state
        for of, labels in ("", ("microphone",)), ("scenario_", ("microphone", "scenario")):
            own = {
                (node, *source_parts(one.microphone)[: len(labels)], one.label): one
                for one in self._totals
                if is_of_scenario(one.microphone) == bool(of)
            }
            if own or not of:
                counter = partial(_metric, CounterMetricFamily, labels=("node", *labels, "label"))
                events = {names: one.events for names, one in own.items()}
                yield counter(f"{of}events", "Events of a class, from the log.", events)
                seconds = {names: one.seconds for names, one in own.items()}
                yield counter(f"{of}event_seconds", "Seconds of a class, from the log.", seconds)
                gauge = partial(_metric, GaugeMetricFamily, labels=("node", *labels, "label"))
                for part, name in enumerate(("today", "night")):
                    counts = self._counts(labels, part, is_scenario=bool(of))
                    yield gauge(f"{of}events_{name}", "Events, counted as in the report.", counts)
        of_home = partial(_metric, GaugeMetricFamily, labels=("node",))
        of_microphone = partial(_metric, GaugeMetricFamily, labels=("node", "microphone"))
        present = {(node, each.name): each for each in state.present()}
        listening = {names: each.is_listening() for names, each in present.items()}
        levels = {n: each.level_dbfs if listening[n] else math.nan for n, each in present.items()}
        newest = {names: each.active.time / NANOSECONDS for names, each in present.items()}
        problems = {(node, subject): health.level for subject, health in state.health.items()}
        yield of_home("recording", "Whether the recorder writes.", {(node,): state.is_recording()})
        yield of_microphone("listening", "Whether labels come.", listening)
        yield of_microphone("level_dbfs", "Mean level of ten seconds.", levels)
        yield of_microphone("last_label_timestamp_seconds", "Time of the newest label.", newest)
        yield _metric(
            GaugeMetricFamily,
            "problem",
            "Health level reported by the recorder: 0 ok, 1 warning, 2 error.",
            problems,
            labels=("node", "subject"),
        )
        with suppress(OSError):  # the disk is missing
            free = shutil.disk_usage(self._home.folder).free
            yield of_home("free_bytes", "Free bytes on the disk of the logs.", {(node,): free})

    def _counts(
        self, labels: tuple[str, ...], part: int, *, is_scenario: bool
    ) -> dict[tuple[str, ...], int]:
        """Return the counts of the day (part 0) or night (part 1) that are known."""
        update = self._update
        return {
            (self._home.node, *source_parts(each.name)[: len(labels)], label): count
            for each in update.state.every()
            if is_of_scenario(each.name) == is_scenario
            for label, counts in each.counts(update.today, update.state.corrections).items()
            if (count := counts[part]) is not None
        }


def _metric(
    kind: type[CounterMetricFamily | GaugeMetricFamily],
    name: str,
    text: str,
    values: Mapping[Any, float],
    *,
    labels: tuple[str, ...],
) -> Metric:
    family = kind(f"hearthlog_{name}", text, labels=labels)
    for names, value in values.items():
        family.add_metric(names, float(value))
    return family
