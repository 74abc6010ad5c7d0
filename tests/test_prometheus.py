"""Figures for Prometheus, on a port of loopback and in a text file."""

import http.client
import math
import socket
import time
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC
from pathlib import Path

import pytest
from livehome import LiveHome, following
from prometheus_client.parser import text_string_to_metric_families

from hearthlog.analyzer import http as http_server
from hearthlog.analyzer.bridge import home_state, prometheus
from hearthlog.analyzer.bridge.prometheus import PrometheusOutput
from hearthlog.analyzer.bridge.settings import PrometheusSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState
from hearthlog.analyzer.http import free_port, listen
from hearthlog.schemas.frames import NANOSECONDS

pytestmark = pytest.mark.fast

HOUR = 3600 * NANOSECONDS


def state_in(folder):
    return BridgeState(folder, "home", pytest.fail)


@pytest.fixture
def home(tmp_path):
    home = LiveHome(tmp_path / "logs")
    yield home
    home.close()


TOKEN = "a-token-of-the-figures"


def place_of(home):
    return RecorderAddress(home.folder, "home", UTC)


@contextmanager
def bridged(home, folder, **settings):
    """A bridge in a thread that gives figures, with a token."""
    since, printed = time.time_ns() - 24 * HOUR, []
    token = folder / "token"
    token.write_text(f"{TOKEN}\n")
    settings = {"token_file": token, "readable_by": "all", **settings}
    place = place_of(home)
    output = PrometheusOutput(
        PrometheusSettings(**settings), place, state_in(folder), since, printed.append
    )
    with following(place, {"prometheus": output}, printed):
        yield
    assert printed == []


def query(port, path="/metrics", **fields):
    fields = {"Authorization": f"Bearer {TOKEN}", **fields}
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
    until = time.monotonic() + 120
    while time.monotonic() < until:
        if found := figures(text_of()):
            return found
        time.sleep(0.05)
    pytest.fail("no figures came")


def known(port):
    """The text of the figures; empty while there are none."""
    status, text = query(port)
    return text if status == 200 else ""


def opened(port):
    """The text of the figures; empty while there are none, or no port."""
    with suppress(ConnectionError):
        return known(port)
    return ""


def test_a_port_of_loopback_has_what_the_log_says(home, tmp_path):
    home.write_segment("coughing", 30, seconds=2)
    home.write_segment("coughing", 20, seconds=3)
    home.hears("silence")
    home.write_status("mic", 1, "the microphone clips", level_dbfs="-40.5")
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
    home.write_status("mic", 0, "well", level_dbfs="-40.5")
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
        ("/metrics", {"Authorization": f"bearer {TOKEN}"}, 401),
        ("/metrics", {"Authorization": f"Bearer {TOKEN}x"}, 401),
        ("/metrics", {"Authorization": "Bearer "}, 401),
        ("/metrics", {"Authorization": ""}, 401),
        ("/secret", {"Authorization": "x"}, 401),
        ("/", {}, 404),
        ("/../etc/passwd", {}, 404),
    ],
)
def test_the_port_answers_who_has_the_token_and_asks_for_an_address_in_digits(
    home, tmp_path, path, fields, status
):
    home.hears("silence")
    port = free_port()
    with bridged(home, tmp_path, port=port):
        wait_for(lambda: known(port))
        assert query(port, path, **fields)[0] == status


def test_figures_that_are_old_are_not_given(home, tmp_path, monkeypatch):
    home.hears("silence")
    port = free_port()
    with bridged(home, tmp_path, port=port):
        wait_for(lambda: known(port))
        monkeypatch.setattr(prometheus, "_STALE_SECONDS", -1.0)
        assert query(port)[0] == 503


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


def test_a_port_without_a_token_stays_closed(home, tmp_path):
    port = free_port()
    settings = PrometheusSettings(port=port)
    place = place_of(home)
    with pytest.raises(BridgeError, match=f"port {port} stays closed.*name a `token_file`"):
        PrometheusOutput(settings, place, state_in(tmp_path), 0, pytest.fail)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=10)


@pytest.mark.parametrize("lacking", ["no token_file", "no file", "no token", "no port"])
def test_a_port_that_stays_closed_takes_no_text_file_with_it(home, tmp_path, monkeypatch, lacking):
    monkeypatch.setattr(prometheus, "_EVERY_SECONDS", 0.0)
    home.hears("silence")
    token, text, printed = tmp_path / "token", tmp_path / "home.prom", []
    place, port = place_of(home), free_port()
    if lacking == "no token":
        token.touch()
    settings = PrometheusSettings(
        port=port,
        text_file=text,
        token_file=None if lacking == "no token_file" else token,
        readable_by="all",
    )
    with ExitStack() as held:
        if lacking == "no port":
            token.write_text(f"{TOKEN}\n")
            held.enter_context(listen(port=port))
        output = PrometheusOutput(
            settings, place, state_in(tmp_path), time.time_ns(), printed.append
        )
        with following(place, {"prometheus": output}, printed):
            wait_for(lambda: text.read_text() if text.exists() else "")
            held.close()
            token.write_text(f"{TOKEN}\n")
            if lacking != "no token_file":
                assert wait_for(lambda: opened(port))
    assert all(line.endswith(f"; {text} is written all the same") for line in printed)
    assert printed


def test_a_text_file_that_node_exporter_does_not_read_is_said_to_be_none(home, tmp_path):
    printed = []
    path = tmp_path / "hearthlog.txt"
    settings = PrometheusSettings(text_file=path, readable_by="owner")
    PrometheusOutput(settings, place_of(home), state_in(tmp_path), 0, printed.append).close()
    (line,) = printed
    assert line.startswith(f"bridge.prometheus: text_file: {path} does not end in .prom")
    assert line.endswith(f'write "{tmp_path}/hearthlog.prom"')


def test_a_text_file_that_everybody_may_read_is_said_to_be(home, tmp_path):
    printed = []
    path = tmp_path / "hearthlog.prom"
    settings = PrometheusSettings(text_file=path)
    PrometheusOutput(settings, place_of(home), state_in(tmp_path), 0, printed.append).close()
    (line,) = printed
    assert line.startswith(
        f"bridge.prometheus: every account of this machine may read {path}; write readable_by"
    )


@pytest.mark.parametrize("request_so_far", [b"", b"GET /metrics HTTP/1.1\r\nX: "])
def test_who_asks_slowly_holds_up_neither_the_others_nor_the_end(home, tmp_path, request_so_far):
    home.hears("silence")
    port = free_port()
    with ExitStack() as slow:
        with bridged(home, tmp_path, port=port):
            wait_for(lambda: known(port))
            for _ in range(2 * http_server.MOST_ASKING):
                own = slow.enter_context(socket.create_connection(("127.0.0.1", port)))
                own.sendall(request_so_far)
            for _ in range(3):
                assert query(port)[0] == 200
            ending = time.monotonic()
        assert time.monotonic() - ending < 5  # though they are still there


def test_a_request_that_does_not_end_is_ended(home, tmp_path, monkeypatch):
    monkeypatch.setattr(http_server, "SECONDS", 0.5)
    home.hears("silence")
    port = free_port()
    with (
        bridged(home, tmp_path, port=port),
        socket.create_connection(("127.0.0.1", port), timeout=10) as own,
    ):
        own.sendall(b"GET /metrics HTTP/1.1\r\n")
        ended = time.monotonic() + 10
        with suppress(OSError):
            while time.monotonic() < ended:
                own.sendall(b"X: y\r\n")  # each read is in time
                time.sleep(0.1)
        assert time.monotonic() < ended


@pytest.mark.parametrize(("who", "mode"), [("owner", 0o600), ("group", 0o640), ("all", 0o644)])
def test_a_text_file_is_for_whom_the_configuration_says(home, tmp_path, who, mode):
    home.hears("silence")
    path = tmp_path / "hearthlog.prom"
    with bridged(home, tmp_path, text_file=path, readable_by=who):
        wait_for(lambda: path.read_text() if path.exists() else "")
        assert path.stat().st_mode & 0o777 == mode


def test_a_text_file_is_there_while_the_bridge_is(home, tmp_path):
    home.write_segment("coughing", 30)
    home.hears("silence")
    path = tmp_path / "hearthlog.prom"
    with bridged(home, tmp_path, text_file=path):
        found = wait_for(lambda: path.read_text() if path.exists() else "")
    assert found["hearthlog_events_total", "coughing", "mic"] == 1
    assert not path.exists()
