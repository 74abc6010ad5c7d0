"""Figures for Prometheus: in a text file of node_exporter, or on a port of loopback."""

import math
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock, Thread
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.home_state import MicrophoneState
from hearthlog.analyzer.bridge.listeners import (
    is_of_scenario,
    microphone_of_listener,
    scenario_of_listener,
)
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.settings import PrometheusSettings
from hearthlog.analyzer.bridge.totals import TOTALS, Total, Totals
from hearthlog.analyzer.ports import HOST, is_asked_in_digits
from hearthlog.schemas.storage.new_files import replaced_file
from hearthlog.schemas.times import NANOSECONDS

_EVERY_SECONDS, _STALE_SECONDS = 10.0, 60.0
_LATER = 12 * 3600 * NANOSECONDS  # than its beginning an event may be known
_TEXT = "text/plain; version=0.0.4; charset=utf-8"
_TIMEOUT_SECONDS = 5.0
_LABELS = ("node", "microphone", "label")
_LABELS_OF_SCENARIOS = ("node", "microphone", "scenario", "label")


class PrometheusOutput:
    """Gives figures of a home to whoever asks, or writes them down every ten seconds.

    Parameters
    ----------
    settings : PrometheusSettings
    home : Home
    state_folder : Path
        Of what the bridge remembers.
    since : int
        From when on events count the first time, in nanoseconds of UTC.
    say : callable
        Told what is wrong, in a line.

    Attributes
    ----------
    totals : Totals

    Raises
    ------
    BridgeError
        If the port cannot be had, or what is remembered is damaged.
    """

    def __init__(
        self,
        settings: PrometheusSettings,
        home: Home,
        state_folder: Path,
        since: int,
        say: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._home = home
        self._say = say
        self.totals = Totals(state_folder / TOTALS, since)
        self._text, self._made = b"", -math.inf  # and when, by CLOCK_MONOTONIC
        self._lock = Lock()
        self._due = 0.0  # by CLOCK_MONOTONIC
        self._server = None if settings.port is None else self._listen(settings.port)

    def update(self, news: News) -> None:
        """Work the figures out anew, if they are ten seconds old."""
        if time.monotonic() < self._due:
            return
        self._due = time.monotonic() + _EVERY_SECONDS
        self.totals.keep(news.state, min(news.today.midnight, news.today.night) - _LATER)
        registry = CollectorRegistry()
        registry.register(_Figures(news, self._home, self.totals.count(news.state)))
        text = generate_latest(registry)
        with self._lock:
            self._text, self._made = text, time.monotonic()
        if self._settings.text_file is not None:
            with replaced_file(self._settings.text_file) as temporary:
                temporary.write_bytes(text)
                temporary.chmod(0o644)  # who collects it is another user

    def close(self) -> None:
        """Answer no more; the text file goes, so that nobody takes it for today's."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
        if self._settings.text_file is not None:
            self._settings.text_file.unlink(missing_ok=True)

    def _listen(self, port: int) -> WSGIServer:
        try:
            server = make_server(HOST, port, self._answer, handler_class=_Handler)
        except OSError as error:
            raise BridgeError(
                f"bridge.prometheus: cannot listen on port {port} ({error.strerror}); take another"
            ) from error
        Thread(target=server.serve_forever, daemon=True).start()
        return server

    def _answer(self, request: dict[str, Any], start_response: Callable[..., Any]) -> list[bytes]:
        """Answer one request; a page of a browser is refused, whatever name it came by."""
        is_here = is_asked_in_digits(HOST, request.get("HTTP_HOST", ""))
        if not is_here or "HTTP_ORIGIN" in request:
            start_response("403 Forbidden", [("Content-Type", _TEXT)])
            return [b"ask for an address in digits, and from no page\n"]
        if request["REQUEST_METHOD"] != "GET" or request["PATH_INFO"] != "/metrics":
            start_response("404 Not Found", [("Content-Type", _TEXT)])
            return [b"there is /metrics\n"]
        with self._lock:
            text, made = self._text, self._made
        if time.monotonic() - made > _STALE_SECONDS:
            start_response("503 Service Unavailable", [("Content-Type", _TEXT)])
            return [b"what is known is old\n"]
        start_response("200 OK", [("Content-Type", _TEXT)])
        return [text]


class _Handler(WSGIRequestHandler):
    timeout = _TIMEOUT_SECONDS

    def log_message(self, *_: Any) -> None:
        """Say nothing of those who ask."""


class _Figures(Collector):
    """The figures of one moment."""

    def __init__(self, news: News, home: Home, totals: Sequence[Total]) -> None:
        self._news = news
        self._home = home
        self._totals = totals

    def collect(self) -> Iterator[Metric]:
        """Yield each figure, by microphone and class."""
        node, state = self._home.node, self._news.state
        of_home = [total for total in self._totals if not is_of_scenario(total.microphone)]
        yield from _counters("", _LABELS, [((node, *one[:2]), one) for one in of_home])
        of_scenarios = [
            ((node, microphone_of_listener(name), scenario_of_listener(name), one.label), one)
            for one in self._totals
            if is_of_scenario(name := one.microphone)
        ]
        if of_scenarios:
            yield from _counters("scenario_", _LABELS_OF_SCENARIOS, of_scenarios)
        yield _gauge("recording", "Whether the recorder writes.", [((node,), state.is_recording())])
        yield from self._of_microphones()
        yield _gauge(
            "problem",
            "Level of what the recorder says of a thing: 0 is well, 1 a warning, 2 an error.",
            [((node, subject), health.level) for subject, health in state.health.items()],
            "subject",
        )
        with suppress(OSError):  # it is away
            free = shutil.disk_usage(self._home.folder).free
            yield _gauge("free_bytes", "Of the disk of the logs.", [((node,), free)])

    def _of_microphones(self) -> Iterator[Metric]:
        node = self._home.node
        microphones = self._news.state.microphones.values()

        def each(value: Callable[[Any], float]) -> list[tuple[tuple[str, ...], float]]:
            return [((node, microphone.name), value(microphone)) for microphone in microphones]

        def level(microphone: MicrophoneState) -> float:
            return microphone.level_dbfs if microphone.is_listening() else math.nan

        yield _gauge(
            "listening", "Whether labels come.", each(lambda m: m.is_listening()), "microphone"
        )
        yield _gauge("level_dbfs", "Mean level of ten seconds.", each(level), "microphone")
        yield _gauge(
            "last_label_timestamp_seconds",
            "When the newest label was known.",
            each(lambda m: m.heard.time / NANOSECONDS),
            "microphone",
        )


def _counters(
    of: str, labels: Sequence[str], totals: Iterable[tuple[Sequence[str], Total]]
) -> Iterator[Metric]:
    events = CounterMetricFamily(
        f"hearthlog_{of}events", "Events of a class, from the log.", labels=labels
    )
    seconds = CounterMetricFamily(
        f"hearthlog_{of}event_seconds", "Seconds that a class was heard.", labels=labels
    )
    for names, total in totals:
        events.add_metric(names, total.events)
        seconds.add_metric(names, total.seconds)
    yield from (events, seconds)


def _gauge(
    name: str, text: str, values: Iterable[tuple[tuple[str, ...], float]], *labels: str
) -> Metric:
    family = GaugeMetricFamily(f"hearthlog_{name}", text, labels=("node", *labels))
    for names, value in values:
        family.add_metric(names, float(value))
    return family
