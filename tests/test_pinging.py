"""Signs of life to a watchdog on the network."""

import time
from contextlib import contextmanager
from datetime import UTC
from http.client import BadStatusLine, InvalidURL
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest
from pydantic import ValidationError

from hearthlog.analyzer import http
from hearthlog.analyzer.bridge.bridge import PingOutput
from hearthlog.analyzer.bridge.home_state import Health, HomeState
from hearthlog.analyzer.bridge.output import OutputUpdate
from hearthlog.analyzer.bridge.settings import PingSettings
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.logs.local_time import today
from hearthlog.schemas.errors import HearthlogError

pytestmark = pytest.mark.fast


@contextmanager
def watchdog():
    """A watchdog that notes what it is asked for: its address, and the notes."""
    requested = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            requested.append(self.path)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/box", requested
        server.shutdown()
        thread.join()


@pytest.fixture
def often(monkeypatch):
    """A ping every twentieth of a second, and no judgement that lasts longer than half of one."""
    monkeypatch.setattr("hearthlog.analyzer.bridge.bridge._SOON", 0.05)
    monkeypatch.setattr("hearthlog.analyzer.bridge.bridge._JUDGED_SECONDS", 0.5)
    return lambda url: PingSettings(url=url).model_copy(update={"every_seconds": 0.05})


def update(*, is_recording=True, **health):
    state = HomeState()
    state._seen = time.monotonic() - (0.0 if is_recording else 60.0)
    state.health = {name: Health(level, "") for name, level in health.items()}
    return OutputUpdate(state, [], [], today(0, UTC), UTC)


def last_request(pings, requested, what):
    """Return what is asked for last while something goes on."""
    until, first = time.monotonic() + 60, len(requested)
    while len(requested) < first + 3 and time.monotonic() < until:
        pings.update(what)
        time.sleep(0.02)
    return requested[-1]


def test_a_watchdog_is_asked_while_all_is_well_and_told_of_a_failure(often):
    with watchdog() as (url, requested):
        pings = PingOutput(often(url), pytest.fail)
        assert last_request(pings, requested, update(mic=0, clock=1)) == "/box"
        assert last_request(pings, requested, update(mic=2)) == "/box/fail"
        assert last_request(pings, requested, update(is_recording=False)) == "/box/fail"
        assert last_request(pings, requested, update(mic=0)) == "/box"
        pings.close()


def test_a_bridge_that_hangs_asks_no_more(often):
    with watchdog() as (url, requested):
        pings = PingOutput(often(url), pytest.fail)
        last_request(pings, requested, update(mic=0))
        until, count = time.monotonic() + 60, -1
        while len(requested) > count:
            assert time.monotonic() < until
            count = len(requested)
            time.sleep(0.8)
        pings.close()


def test_a_watchdog_that_is_away_is_said_to_be(often):
    output = []
    pings = PingOutput(often(f"http://127.0.0.1:{free_port()}"), output.append)
    until = time.monotonic() + 60
    while not output and time.monotonic() < until:
        pings.update(update())
        time.sleep(0.02)
    pings.close()
    assert output[0] == "ping: not accepted (Connection refused); trying again"


@pytest.mark.usefixtures("often")
def test_the_address_may_be_in_a_file_and_is_in_no_line(tmp_path):
    file, output = tmp_path / "url", []
    with watchdog() as (url, requested):
        file.write_text(f"\ufeff{url}/a-secret\r\n")
        settings = PingSettings(url_file=file).model_copy(update={"every_seconds": 0.05})
        pings = PingOutput(settings, output.append)
        assert last_request(pings, requested, update(mic=0)) == "/box/a-secret"
        pings.close()
    for wrong in ("", "a-secret", "https://", "http://x/a secret", "http://x:y/", "http://[x/"):
        file.write_text(wrong)
        with pytest.raises(HearthlogError, match="has no web address") as error:
            PingOutput(settings, output.append)
        assert "secret" not in str(error.value)
    assert output == []


def test_of_a_failure_nothing_is_said_that_has_the_address(monkeypatch):
    for error in (InvalidURL("/a-secret"), ValueError("/a-secret"), BadStatusLine("/a-secret")):
        monkeypatch.setattr("urllib.request.urlopen", lambda *_, e=error, **__: raise_it(e))
        assert http.ping("http://127.0.0.1/a-secret", is_well=True) == type(error).__name__


def raise_it(error):
    raise error


@pytest.mark.parametrize("table", [{}, {"url": "http://x/", "url_file": "/x"}, {"url": "x"}])
def test_one_address_is_wanted(table):
    with pytest.raises(ValidationError):
        PingSettings.model_validate(table)
