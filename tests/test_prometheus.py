"""Figures for Prometheus, on a port of loopback and in a text file."""

import http.client
import math
import time
from contextlib import contextmanager
from datetime import UTC
from pathlib import Path

import pytest
from livehome import LiveHome, following
from prometheus_client.parser import text_string_to_metric_families

from hearthlog.analyzer.bridge import home_state, prometheus
from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.prometheus import PrometheusOutput
from hearthlog.analyzer.bridge.settings import PrometheusSettings
from hearthlog.analyzer.ports import free_port
from hearthlog.schemas.times import NANOSECONDS

pytestmark = pytest.mark.fast

HOUR = 3600 * NANOSECONDS


@pytest.fixture
def home(tmp_path):
    home = LiveHome(tmp_path / "logs")
    yield home
    home.close()


@contextmanager
def bridged(home, folder, **settings):
    """A bridge in a thread that gives figures."""
    since, said = time.time_ns() - 24 * HOUR, []
    place = Home(home.folder, "home", UTC)
    output = PrometheusOutput(PrometheusSettings(**settings), place, folder, since, said.append)
    with following(place, {"prometheus": output}, said):
        yield
    assert said == []


def ask(port, path="/metrics", **fields):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host="Host" in fields)
    for name, value in fields.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def figures(text):
    """The values of a text of figures, by name and labels but the node."""
    return {
        (sample.name, *(v for k, v in sorted(sample.labels.items()) if k != "node")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def wait_for(text_of):
    until = time.monotonic() + 30
    while time.monotonic() < until:
        if found := figures(text_of()):
            return found
        time.sleep(0.05)
    pytest.fail("no figures came")


def known(port):
    """The text of the figures; empty while there are none."""
    status, text = ask(port)
    return text if status == 200 else ""


def test_a_port_of_loopback_has_what_the_log_says(home, tmp_path):
    home.heard("coughing", 30, seconds=2)
    home.heard("coughing", 20, seconds=3)
    home.hears("silence")
    home.says("mic", 1, "the microphone clips", level_dbfs="-40.5")
    port = free_port()
    with bridged(home, tmp_path, port=port):
        found = wait_for(lambda: known(port))
    assert found["hearthlog_events_total", "coughing", "mic"] == 2
    assert found["hearthlog_event_seconds_total", "coughing", "mic"] == 5
    assert found["hearthlog_level_dbfs", "mic"] == -40.5
    assert found["hearthlog_listening", "mic"] == found["hearthlog_recording",] == 1
    assert found["hearthlog_problem", "mic"] == 1
    assert found["hearthlog_free_bytes",] > 0
    assert abs(found["hearthlog_last_label_timestamp_seconds", "mic"] - time.time()) < 60


def test_a_class_counts_from_0_so_that_its_first_event_is_an_increase(home, tmp_path):
    home.hears("silence")
    port = free_port()
    with bridged(home, tmp_path, port=port):
        found = wait_for(lambda: known(port))
    assert found["hearthlog_events_total", "coughing", "mic"] == 0
    assert ("hearthlog_events_total", "silence", "mic") not in found


def test_a_microphone_that_is_away_has_no_level(home, tmp_path, monkeypatch):
    home.hears("silence")
    home.says("mic", 0, "well", level_dbfs="-40.5")
    monkeypatch.setattr(home_state, "_AWAY_SECONDS", -1.0)
    port = free_port()
    with bridged(home, tmp_path, port=port):
        found = wait_for(lambda: known(port))
    assert math.isnan(found["hearthlog_level_dbfs", "mic"])


@pytest.mark.parametrize(
    ("path", "fields", "status"),
    [
        ("/metrics", {}, 200),
        ("/metrics", {"Host": "localhost"}, 200),
        ("/metrics", {"Host": "home.example"}, 403),  # a name that points to this machine
        ("/metrics", {"Origin": "http://127.0.0.1:8000"}, 403),  # a page in a browser
        ("/", {}, 404),
        ("/../etc/passwd", {}, 404),
    ],
)
def test_the_port_answers_who_asks_for_an_address_in_digits(home, tmp_path, path, fields, status):
    home.hears("silence")
    port = free_port()
    with bridged(home, tmp_path, port=port):
        wait_for(lambda: known(port))
        assert ask(port, path, **fields)[0] == status


def test_figures_that_are_old_are_not_given(home, tmp_path, monkeypatch):
    home.hears("silence")
    port = free_port()
    with bridged(home, tmp_path, port=port):
        wait_for(lambda: known(port))
        monkeypatch.setattr(prometheus, "_STALE_SECONDS", -1.0)
        assert ask(port)[0] == 503


def test_the_port_is_of_loopback_alone(home, tmp_path):
    port = free_port()
    with bridged(home, tmp_path, port=port):
        rows = Path("/proc/net/tcp").read_text().splitlines()
        listening = [row.split()[1] for row in rows if f":{port:04X} " in row]
    assert f"0100007F:{port:04X}" in listening
    assert not any(address.startswith("00000000") for address in listening)


def test_a_port_that_is_taken_is_named(home, tmp_path):
    port = free_port()
    with bridged(home, tmp_path, port=port), pytest.raises(BridgeError, match=f"port {port}"):
        bridged(home, tmp_path, port=port).__enter__()


def test_a_text_file_is_there_while_the_bridge_is(home, tmp_path):
    home.heard("coughing", 30)
    home.hears("silence")
    path = tmp_path / "hearthlog.prom"
    with bridged(home, tmp_path, text_file=path):
        found = wait_for(lambda: path.read_text() if path.exists() else "")
        assert path.stat().st_mode & 0o777 == 0o644  # another user collects it
    assert found["hearthlog_events_total", "coughing", "mic"] == 1
    assert not path.exists()
