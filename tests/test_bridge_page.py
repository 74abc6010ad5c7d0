"""The page of the home: who may read it, what it shows, and how one says what a sound was."""

import dataclasses
import json
import os
import socket
import time
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from http.client import HTTPConnection
from types import SimpleNamespace
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import GENERAL
from livehome import LiveHome
from pydantic import ValidationError
from servedhome import JSON, PALE_TEXTS, pages, proxying, serving
from viewers import address_of, patiently

from hearthlog.analyzer import http
from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.bridge.bridge import open_outputs
from hearthlog.analyzer.bridge.commands import class_of
from hearthlog.analyzer.bridge.corrections import REVIEWER, EventCorrections
from hearthlog.analyzer.bridge.home_state import Health, HomeState
from hearthlog.analyzer.bridge.output import OutputUpdate
from hearthlog.analyzer.bridge.page import ENGLISH, clock, server, translation_for
from hearthlog.analyzer.bridge.page.day import HomeDay, picture_of
from hearthlog.analyzer.bridge.page.home_page import HomePage
from hearthlog.analyzer.bridge.page.server import Board, PageAdmission
from hearthlog.analyzer.bridge.page.status import RoomStatus, health_list
from hearthlog.analyzer.bridge.settings import BridgeSettings, PageSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState
from hearthlog.analyzer.http import HttpServer, free_port
from hearthlog.analyzer.logs.local_time import today
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.models.classes import ON_TELEVISION
from hearthlog.recorder.pause_schedule import is_paused, pause, paused_until
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages import message_types

LIVED = [name for name in GENERAL if name not in {"silence", "crying"}]
HOSTILE = '<img src=x onerror="document.title=1">'


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("served")) as home:
        home.log.write_segment("silence", 300, 60)
        home.coughed = home.log.write_segment("coughing", 90, 3, 0.95)
        home.log.hears("silence")
        with home.stream() as part:
            part("events", lambda events: events["events"])
        yield home


def event_id(start, label="coughing", microphone="mic"):
    return f"{microphone}-{label}-{start}"


# Who may read


@pytest.mark.parametrize("path", ["/", "/page.js", "/page.css", "/events", "/mark", "/etc/passwd"])
def test_without_the_token_one_learns_how_to_get_the_address_and_nothing_else(served, path):
    token = served.token
    cookies = [None, "", f"hearthlog-{served.port}=", f"hearthlog-{served.port}={token}"]
    targets = [path, f"{path}?token=", f"{path}?token={token[:-1]}", f"{path}?token={token}x"]
    answers = {served.request("GET", path, cookie=cookie)[::2] for cookie in cookies}
    answers |= {served.request("GET", target, cookie=None)[::2] for target in targets}
    answers.add(served.request("POST", path, "{}", None, Origin=served.url.partition("/?")[0])[::2])
    assert {status for status, _ in answers} == {403}
    for _, text in answers:
        assert "its full address" in text
        assert "<" not in text
        assert token[:-1] not in text


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "192.168.1.5", "", "127.0.0.1.evil.example"]
)
def test_a_name_that_somebody_lets_point_here_gets_nothing(served, host):
    for target in ("/", f"/?token={served.token}", "/events"):
        assert served.request("GET", target, Host=f"{host}:{served.port}")[0] == 403
    assert served.request("GET", "/", Host="127.0.0.1:9999")[0] == 200  # the other end of a tunnel
    assert served.request("GET", "/", Host=f"localhost:{served.port}")[0] == 200


@pytest.fixture(scope="module")
def dashboard():
    """A page of another server of this machine."""
    with pages(b"<!doctype html><title>Dashboard</title>") as address:
        yield address


@pytest.fixture(scope="module")
def named(tmp_path_factory, dashboard):
    names = ["Raspberrypi.local", "home.example:8443"]
    settings = {"names": names, "frames": [dashboard.rstrip("/")]}
    with serving(tmp_path_factory.mktemp("named"), settings) as home:
        home.log.write_segment("coughing", 90, 3, 0.95)
        home.log.hears("silence")
        with home.stream() as part:
            part("events", lambda events: events["events"])
        yield home


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("raspberrypi.local:8380", 200),
        ("RaspberryPi.local", 200),
        ("raspberrypi.local.:8380", 200),  # the same name, written in full
        ("localhost.", 200),
        ("evil.example.", 403),
        ("home.example:8443", 200),
        ("home.example", 403),
        ("home.example:80", 403),
        ("raspberrypi.local.evil.example", 403),
        ("evil.example", 403),
        ("127.0.0.1", 200),
    ],
)
def test_a_name_that_the_configuration_has_opens_the_page(named, host, status):
    assert named.request("GET", "/", Host=host)[0] == status
    assert named.request("GET", "/", Host=host, cookie=None)[0] == 403


def test_who_asks_by_a_name_is_told_so_and_which_key_allows_it(served):
    full = f"/?token={served.token}"
    status, _, text = served.request("GET", full, cookie=None, Host="raspberrypi.local:8380")
    assert status == 403
    assert 'names = ["raspberrypi.local"] in [bridge.page]' in text
    assert "its full address" not in text
    for host in ("<script>", "a b", "x" * 300, '"', "[::1"):
        status, _, text = served.request("GET", full, cookie=None, Host=host)
        assert (status, host in text, "by its IP address" in text) == (403, False, True)


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("raspberrypi.local", "https://raspberrypi.local", 422),
        ("127.0.0.1:8380", "https://home.example:8443", 422),  # a proxy that asks by its own
        ("127.0.0.1:8380", "https://home.example", 403),
        ("raspberrypi.local", "http://raspberrypi.local:3000", 403),  # another server there
        ("raspberrypi.local", "ftp://raspberrypi.local", 403),
        ("127.0.0.1:8380", "http://127.0.0.1:9", 403),  # it may show a frame, and no more
    ],
)
def test_behind_a_proxy_the_page_itself_marks_and_no_other(named, host, origin, status):
    body = json.dumps({"event": "none", "label": "music"})
    answer = named.request("POST", "/mark", body, Host=host, Origin=origin, **JSON)
    assert answer[0] == status
    assert ("names" in answer[2]) == (status == 403)


def test_the_reasons_of_a_refusal_are_told_apart(served):
    cookie = served.cookie()
    until = int(cookie.partition("=")[2].partition("-")[0])
    reported = {
        name: served.request("GET", path, cookie=given)[2].partition(".")[0]
        for name, path, given in [
            ("nothing", "/", None),
            ("wrong", f"/?token={served.token[:-1]}", None),
            ("longer", "/", cookie.replace(str(until), str(until + 9))),
            ("old", "/", cookie.replace(str(until), "1")),
            ("broken", "/", f"{cookie}x"),
        ]
    }
    assert reported.pop("nothing").startswith("This page opens only with its full address")
    assert reported.pop("wrong") == "The token in this address is wrong"
    assert {*reported.values()} == {"The cookie of this browser is no longer valid"}


def test_a_cookie_is_void_with_another_key_token_or_port_or_after_a_year(monkeypatch):
    own = PageAdmission("127.0.0.1", 8380, "x" * 20, b"key")
    given = own.new_pass()
    assert own.is_pass(given)
    others = {"key": b"other"}, {"token": "y" * 20}, {"port": 8381}
    assert not any(dataclasses.replace(own, **other).is_pass(given) for other in others)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 366 * 86400)
    assert not own.is_pass(given)
    texts = "", "-", "-x", "1-", f"{10**30}-x", "é-x", given[:-1]
    assert not any(map(own.is_pass, texts))


@pytest.mark.parametrize(
    ("table", "what"),
    [
        ({"names": ["http://raspberrypi.local"]}, "without http://"),
        ({"names": ["*"]}, "is not a host name"),
        ({"names": ["a b"]}, "is not a host name"),
        ({"frames": ["homeassistant.local"]}, "is not the origin of a web page"),
        ({"frames": ["http://x; script-src *"]}, "is not the origin of a web page"),
        ({"frames": ["http://ha.local/lovelace"]}, "without a path"),
        ({"frames": ["*"]}, "is not the origin of a web page"),
        ({"ingress": "127.0.0.1"}, "not the address of one other machine"),
        ({"ingress": "0.0.0.0"}, "not the address of one other machine"),
        ({"ingress": "172.30.32.0/24"}, "not the address of one other machine"),
        ({"ingress": "172.30.32.2", "frames": ["http://ha.local"]}, "no effect with ingress"),
    ],
)
def test_names_frames_and_an_ingress_that_are_none_are_refused(table, what):
    with pytest.raises(ValidationError, match=what):
        PageSettings.model_validate(table)


INGRESS = "127.0.0.9"


class FakeContent:
    """Content that notes what is changed."""

    actions = HomePage.actions

    def __init__(self):
        self.acts = []

    def words(self, _accepted):
        return ENGLISH

    def boards(self):
        return []

    def act(self, *arguments):
        self.acts.append(arguments[:3])
        return "done"


@pytest.fixture
def behind_ingress():
    """A page that only the address of an ingress may open, and a way to send it requests."""
    port, content = free_port(), FakeContent()
    admission = PageAdmission("0.0.0.0", port, "x" * 20, b"key", ingress=INGRESS)
    page = server.PageServer(admission, content)

    def query(client, method, path, body=None, **fields):
        connection = HTTPConnection("127.0.0.1", port, 30, source_address=(client, 0))
        named = {name.replace("_", "-"): value for name, value in fields.items()}
        connection.request(method, path, body, {"Host": "ha.example:8123"} | named)
        answer = connection.getresponse()
        found = answer.status, answer.headers, answer.read().decode()
        connection.close()
        return found

    yield SimpleNamespace(request=query, content=content, admission=admission)
    page.end()


MARK = json.dumps({"event": "x", "label": "music"})


def test_the_ingress_opens_the_page_without_a_token_and_frames_it(behind_ingress):
    status, fields, text = behind_ingress.request(INGRESS, "GET", "/", Host="any.name:1")
    assert status == 200
    assert "<html" in text
    assert "frame-ancestors 'self'" in fields["Content-Security-Policy"]
    assert fields["X-Frame-Options"] == "SAMEORIGIN"
    own = JSON | {"Origin": "https://ha.example:8123"}
    assert behind_ingress.request(INGRESS, "POST", "/mark", MARK, **own)[0] == 200
    assert behind_ingress.content.acts == [("/mark", "x", "music")]


@pytest.mark.parametrize(
    "forged",
    [
        {},
        {"Host": INGRESS},
        {"X_Ingress_Path": "/api/hassio_ingress/x"},
        {"X_Forwarded_For": INGRESS},
        {"X_Real_IP": INGRESS, "Forwarded": f"for={INGRESS}"},
        {"Via": "1.1 supervisor", "X_Remote_User_Id": "1"},
    ],
)
def test_nobody_else_passes_for_the_ingress_not_even_with_the_token(behind_ingress, forged):
    admission = behind_ingress.admission
    own = {"Cookie": admission.cookie().partition(";")[0], "Origin": "http://ha.example:8123"}
    for path in ("/", f"/?token={admission.token}", "/page.js", f"/{admission.new_pass()}/"):
        for client in ("127.0.0.1", "127.0.0.90"):
            status, fields, text = behind_ingress.request(client, "GET", path, **own, **forged)
            assert status == 403
            assert "opens only in Home Assistant" in text
            assert "Set-Cookie" not in fields
    assert (
        behind_ingress.request("127.0.0.1", "POST", "/mark", MARK, **JSON, **own, **forged)[0]
        == 403
    )
    assert behind_ingress.content.acts == []


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"Origin": "null"},
        {"Origin": "https://evil.example"},
        {"Origin": "http://", "Host": ""},
        {"Origin": "https://evil.example", "X_Forwarded_Host": "evil.example"},
    ],
)
def test_another_page_changes_nothing_through_the_ingress(behind_ingress, fields):
    assert behind_ingress.request(INGRESS, "POST", "/mark", MARK, **JSON, **fields)[0] == 403
    assert behind_ingress.content.acts == []


def test_two_hosts_get_nothing(served):
    with served.connect() as connection:
        head = f"GET /?token={served.token} HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n"
        connection.sendall(f"{head}\r\n".encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 403")


@pytest.mark.parametrize(
    "origin", [None, "null", "https://evil.example", "http://127.0.0.1:1", "http://localhost"]
)
def test_another_page_marks_nothing_though_the_browser_sends_the_cookie(served, origin):
    before = served.marks()
    own = {} if origin is None else {"Origin": origin}
    body = json.dumps({"event": "x", "label": "music"})
    assert served.request("POST", "/mark", body, **JSON, **own)[0] == 403
    if origin is not None:
        assert served.request("GET", "/events", Origin=origin)[0] == 403
    assert served.marks() == before


def test_the_address_gives_a_cookie_that_no_script_reads_and_that_has_no_token(served):
    status, fields, text = served.request("GET", f"/?token={served.token}", cookie=None)
    assert status == 200
    assert 'url=./"' in text
    rules = {rule.strip() for rule in fields["Set-Cookie"].split(";")[1:]}
    assert {"HttpOnly", "SameSite=Strict"} <= rules
    assert not any(rule.startswith("Path") for rule in rules)  # below a path of a proxy it is that
    assert served.token not in f"{fields}{text}"
    assert served.request("GET", "/")[0] == 200


@pytest.mark.parametrize("path", ["/", "/page.js", "/page.css", "/none"])
def test_no_answer_is_kept_framed_guessed_at_or_handed_on(served, path):
    for cookie in ("own", None):
        _, fields, _ = served.request("GET", path, cookie=cookie)
        policy = fields["Content-Security-Policy"].split("; ")
        assert {"default-src 'none'", "script-src 'self'", "frame-ancestors 'none'"} <= {*policy}
        assert "unsafe" not in fields["Content-Security-Policy"]
        assert fields["Cache-Control"] == "no-store"
        assert fields["Referrer-Policy"] == "no-referrer"
        assert fields["X-Content-Type-Options"] == "nosniff"
        assert fields["Server"] == "hearthlog"


@pytest.mark.parametrize(
    "path", ["/../server.py", "/server.py", "/%2e%2e/page.css", "/page.html", "/x"]
)
def test_only_the_files_of_the_page_are_served(served, path):
    assert served.request("GET", path)[::2] == (404, "Not Found\n")


@pytest.mark.parametrize(
    ("body", "fields", "status"),
    [
        ("x" * 5000, JSON, 413),
        ("{}", {**JSON, "Content-Length": "9" * 30}, 413),
        ("{}", {**JSON, "Content-Length": "-1"}, 411),
        ("{}", {"Content-Type": "text/plain"}, 415),
        ("{", JSON, 400),
        ("[1]", JSON, 400),
        ("[" * 4000, JSON, 400),
        ('{"event": 1, "label": "music"}', JSON, 400),
        ('{"event": "none", "label": "music"}', JSON, 422),
    ],
)
def test_what_is_no_mark_is_refused(served, body, fields, status):
    origin = f"http://127.0.0.1:{served.port}"
    assert served.request("POST", "/mark", body, Origin=origin, **fields)[0] == status


def test_a_head_that_is_too_long_is_not_read(served):
    with served.connect() as connection:
        head = f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {served.cookie()}\r\n"
        with suppress(ConnectionError):
            connection.sendall(head.encode() + b"X: %b\r\n" % (b"y" * 1000) * 50 + b"\r\n")
        answer = b""
        with suppress(ConnectionError):
            answer = connection.recv(1000)
    assert not answer.startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize("so_far", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: "])
def test_strangers_who_hold_connections_do_not_keep_out_who_has_the_token(served, so_far):
    cookie = served.cookie()
    with ExitStack() as held:
        for _ in range(3):
            for _ in range(http.MOST_ASKING):
                own = held.enter_context(served.connect())
                with suppress(ConnectionError):
                    own.sendall(so_far)
            assert served.request("GET", "/", cookie=cookie)[0] == 200
        with patiently(served.open_stream, bool):
            assert served.request("GET", "/", cookie=cookie)[0] == 200
        assert len(served.threads()) <= http.MOST_ASKING + http.MOST_ADMITTED


def test_one_address_of_the_network_takes_no_place_of_another(monkeypatch):
    monkeypatch.setattr(http, "MOST_ASKING", 4)
    with ExitStack() as stack:
        own = HttpServer("127.0.0.1", 0, http.HttpHandler)
        stack.callback(own.end)
        own.start()
        first = stack.enter_context(socket.socket())
        first.bind(("127.0.0.9", 0))
        first.connect(own.server_address)
        for _ in range(9):
            stack.enter_context(socket.create_connection(own.server_address))
        first.settimeout(0.5)
        with pytest.raises(TimeoutError):  # it is not ended
            first.recv(1)


def test_too_many_open_pages_leave_room_for_the_page_itself(served):
    streams = [patiently(served.open_stream, bool) for _ in range(server._MOST_STREAMS)]
    assert served.request("GET", "/events")[0] == 503
    assert served.request("GET", "/")[0] == 200
    for each in streams:
        each.close()
    assert patiently(served.open_stream, bool).close() is None


def test_who_sends_a_request_for_ever_is_cut_off(served, monkeypatch):
    monkeypatch.setattr(http, "SECONDS", 0.2)
    with served.connect() as connection, suppress(ConnectionError):
        connection.sendall(b"GET / HTTP/1.1\r\n")
        while True:  # until the other side ends: by reset, or by an end
            connection.sendall(b"X: y\r\n")
            connection.settimeout(0.05)
            with suppress(TimeoutError):
                assert connection.recv(1) == b""
                break


def test_a_reader_who_is_slow_gets_the_newest_and_nobody_waits_for_him():
    board = Board()
    for number in range(1000):
        board.put("now", b"%d" % number)
    (part,) = board.wait({}, 60).values()
    assert part.content == b"999"
    assert board.wait({"now": part.number}, 0) == {}
    board.put("now", b"999")
    assert board.wait({"now": part.number}, 0) == {}


def test_a_browser_that_reads_nothing_does_not_hold_up_the_others(served):
    with patiently(served.open_stream, bool), served.stream() as part:
        start = served.log.write_segment("laughing", 5)
        part("events", lambda it: event_id(start, "laughing") in {e["id"] for e in it["events"]})


# Ports and tokens


@pytest.fixture
def place(tmp_path):
    return RecorderAddress(tmp_path, "home", UTC)


def test_nothing_listens_unless_the_page_is_configured(place, tmp_path):
    outputs, _ = open_outputs(BridgeSettings(), place, BridgeState(tmp_path, "home", print), print)
    assert outputs == {}


def test_the_page_listens_on_loopback_by_default(place, tmp_path):
    output, port = [], free_port()
    settings = BridgeSettings(page=PageSettings(port=port))
    outputs, _ = open_outputs(
        settings, place, BridgeState(tmp_path, "home", pytest.fail), output.append
    )
    assert address_of(port) == "127.0.0.1"
    outputs["page"].close()
    assert address_of(port) is None
    assert len(output) == 1


def test_an_address_of_the_network_comes_with_a_warning(place, tmp_path):
    output = []
    settings = PageSettings(port=free_port(), bind="0.0.0.0")
    HomePage(settings, place, tmp_path, output.append).close()
    assert f" http://127.0.0.1:{settings.port}/?token=" in output[0]  # which a browser can open
    assert "unencrypted" in output[1]


@pytest.mark.parametrize("bind", ["localhost", "box.example", ""])
def test_an_address_that_is_a_name_is_refused(bind):
    with pytest.raises(ValidationError, match="not an IP address"):
        PageSettings(bind=bind)


def test_a_port_that_is_taken_is_named(served, tmp_path):
    with pytest.raises(BridgeError, match=rf"port {served.port} .*choose another"):
        HomePage(PageSettings(port=served.port), served.home, tmp_path, print)


def test_a_token_is_made_once_and_only_its_owner_reads_it(place, tmp_path, monkeypatch):
    journal = os.fstat(2)
    monkeypatch.setenv("JOURNAL_STREAM", f"{journal.st_dev}:{journal.st_ino}")
    output = []
    for _ in range(2):
        HomePage(PageSettings(port=free_port()), place, tmp_path / "state", output.append).close()
    secrets = {path.name: path for path in (tmp_path / "state").iterdir()}
    assert {*secrets} == {"page-token", "page-cookies", "page-address"}
    assert {path.stat().st_mode & 0o777 for path in secrets.values()} == {0o600}
    token = secrets["page-token"].read_text().strip()
    assert secrets["page-address"].read_text().strip().endswith(f"/?token={token}")
    assert not any(path.read_text().strip() in line for path in secrets.values() for line in output)
    assert all(str(secrets["page-address"]) in line for line in output)


def test_who_starts_the_bridge_is_shown_the_whole_address(place, tmp_path):
    output = []
    HomePage(PageSettings(port=free_port()), place, tmp_path, output.append).close()
    assert output[0].endswith(f"/?token={(tmp_path / 'page-token').read_text().strip()}")


@pytest.mark.parametrize(
    "text", ["", "short", "a b c d e f g h i j", "x" * 16 + "\nsecond", "é" * 20]
)
def test_a_file_that_has_no_token_is_refused(place, tmp_path, text):
    file = tmp_path / "token"
    file.write_text(text)
    with pytest.raises(BridgeError, match="has no token"):
        HomePage(PageSettings(token_file=file), place, tmp_path, print)


def test_a_token_of_ones_own_opens_the_page(place, tmp_path):
    file, output, port = tmp_path / "token", [], free_port()
    file.write_text("Correct.Horse_Battery~1\n")
    settings = PageSettings(port=port, token_file=file)
    page = HomePage(settings, place, tmp_path, output.append)
    connection = HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("GET", "/?token=Correct.Horse_Battery~1")
    assert connection.getresponse().status == 200
    connection.close()
    page.close()


# What it shows


def segments(name, *spans):
    starts = np.array([start for start, _, _ in spans])
    ends = np.array([end for _, end, _ in spans])
    fields = {
        "header.stamp": starts,
        "duration": ends - starts,
        "label": np.array([label for _, _, label in spans], object),
        "confidence": np.ones(len(spans), np.float32),
    }
    return Columns(f"/{name}/segment", message_types.SEGMENT, {}, ends, ends, ends, fields)


def at(zone, *moment):
    return int(datetime(*moment, tzinfo=zone).timestamp()) * NANOSECONDS


@pytest.mark.parametrize(("day", "hours"), [((2026, 3, 29), 23), ((2026, 10, 25), 25)])
def test_a_day_on_which_the_clock_is_changed_has_the_hours_of_the_clock(day, hours):
    zone = ZoneInfo("Europe/Vienna")
    noon = at(zone, *day, 12)
    state = HomeState()
    state.push([segments("mic", (noon, noon + 120 * NANOSECONDS, "speech"))])
    picture = picture_of(HomeDay([*state.microphones.values()], today(noon + 60, zone), zone))
    clock = [hour for _, hour in picture["hours"]]
    assert clock[:2] == [22, 23]
    assert len(clock) == hours
    assert sorted({*clock}) == sorted({*range(24)} - ({2} if hours == 23 else set()))
    noons = [place for place, hour in picture["hours"] if hour == 12]
    (lane,) = picture["rooms"][0]["lanes"]
    assert len(lane["bars"]) == hours * 30
    assert lane["bars"].index("1") / len(lane["bars"]) == pytest.approx(noons[0], abs=1e-4)
    places = {hour: place for place, hour in picture["hours"]}
    assert picture["nights"] == [(0, places[7])]


def test_an_event_from_before_midnight_is_of_the_night_and_counts_once():
    begin = at(UTC, 2026, 5, 5)
    minute = 60 * NANOSECONDS
    state = HomeState()
    state.push([segments("mic", (begin - 60 * minute, begin + 60 * minute, "shower"))])
    now = today(begin + 600 * minute, UTC)
    (lane,) = picture_of(HomeDay([*state.microphones.values()], now, UTC))["rooms"][0]["lanes"]
    assert lane["bars"] == "0" * 30 + "1" * 60 + "0" * 630
    assert (lane["counts"], lane["told"]) == (
        [1, None],
        "Shower: once since yesterday evening, by the sound of it, last at 01:00",
    )


@pytest.mark.parametrize(
    ("first", "gap", "today_known", "night_known"),
    [
        (-12, None, True, True),
        (-1, None, True, True),  # 7 of the 9 hours of the night
        (1, None, True, False),
        (9, None, True, False),  # a recorder that was started this morning
        (-12, (-2, 1), True, False),
        (-12, (-2, 10), False, False),
    ],
)
def test_a_0_is_said_only_where_it_was_listened_for(first, gap, today_known, night_known):
    begin, hour = at(UTC, 2026, 5, 5), 3600 * NANOSECONDS
    state = HomeState()
    state.push([segments("mic", (begin + first * hour, begin + first * hour + 9, "music"))])
    if gap:
        start, end = (begin + edge * hour for edge in gap)
        times = np.array([end])
        fields = {"header.stamp": np.array([start]), "duration": np.array([end - start])}
        state.push([Columns("/mic/gap", message_types.GAP, {}, times, times, times, fields)])
    (microphone,) = state.microphones.values()
    microphone.names, microphone.seen = ["silence", "coughing"], time.monotonic()
    now = today(begin + 10 * hour, UTC)
    lanes = {
        each["words"]: each
        for each in picture_of(HomeDay([microphone], now, UTC))["rooms"][0]["lanes"]
    }
    cough = lanes["Coughing"]
    night, day = cough["counts"]
    assert day == (0 if today_known else None)
    assert night == (0 if night_known else None)
    assert ("not known" in cough["told"]) == (not (today_known and night_known))
    assert lanes["Music"]["counts"][0] == (1 if -2 <= first < 7 else night)


def test_what_was_not_heard_is_marked_as_such():
    begin = at(UTC, 2026, 5, 5)
    hour = 3600 * NANOSECONDS
    state = HomeState()
    state.push([segments("mic", (begin + 6 * hour, begin + 7 * hour, "silence"))])
    times = np.array([begin + 14 * hour])
    fields = {"header.stamp": np.array([begin + 12 * hour]), "duration": np.array([2 * hour])}
    state.push([Columns("/mic/gap", message_types.GAP, {}, times, times, times, fields)])
    (microphone,) = state.microphones.values()
    microphone.active.time, microphone.seen = begin + 18 * hour, time.monotonic() - 60
    now = today(begin + 20 * hour, UTC)
    gaps = picture_of(HomeDay([microphone], now, UTC))["rooms"][0]["gaps"]
    assert gaps == [(0, 0.3333), (0.5833, 0.6667), (0.8333, 0.9167)]


@pytest.mark.parametrize(
    ("output", "why"), [("listening", ""), ("reading", ""), ("paused by Anna", "paused by Anna")]
)
def test_a_microphone_that_is_away_is_not_said_to_listen(output, why):
    state, now = HomeState(), time.time_ns()
    state.push([segments("mic", (now - 60 * NANOSECONDS, now - 30 * NANOSECONDS, "silence"))])
    state.health["mic"] = Health(0, output)
    update = OutputUpdate(state, [], [], today(now, UTC), UTC)
    (recorded,) = RoomStatus().describe(update)["rooms"]
    assert (recorded["words"], recorded["why"]) == ("Not listening", why)
    health = health_list(update, "home", now)[0]
    assert health["text"] == (f"not listening: {why}" if why else "not listening")
    assert health["level"] == (0 if why else 2), "a pause needs no look"


@pytest.mark.parametrize(
    ("minutes", "words"), [(60, "Something like a television"), (2, "A sound")]
)
def test_a_ring_of_a_television_is_not_called_a_telephone_that_rings_now(tmp_path, minutes, words):
    with serving(tmp_path) as home:
        for ago in range(minutes, 0, -1):
            home.log.write_segment("speech", ago, 3)
        home.log.hears("phone_ring")
        with home.stream() as part:
            part("now", lambda now: now["rooms"] and now["rooms"][0]["words"] == words)


def test_times_and_lengths_are_said_in_words():
    now = at(UTC, 2026, 5, 5, 12)
    hour = 3600 * NANOSECONDS
    assert [ENGLISH.when(now - hours * hour, now, UTC) for hours in (1, 13, 60)] == [
        "11:00",
        "yesterday 23:00",
        "3 May 00:00",
    ]
    output = [ENGLISH.length(seconds) for seconds in (0.4, 1, 59.6, 84, 200, 320, 5040, 7260)]
    expected = (
        "less than a second,1 second,1 minute,1½ minutes,3½ minutes,5 minutes,1 hour 24 minutes,"
        "2 hours 1 minute"
    )
    assert output == expected.split(",")
    assert translation_for("de").length(84) == "1½ Minuten"


def test_a_day_of_thousands_of_sounds_is_small():
    begin, step = at(UTC, 2026, 5, 5), 15 * NANOSECONDS
    state = HomeState()
    starts = [begin + number * step for number in range(5000)]
    labels = [name for name in GENERAL if name != "silence"]
    state.push(
        [
            segments("mic", *((s, s + NANOSECONDS, labels[i % 8]) for i, s in enumerate(starts))),
        ]
    )
    picture = picture_of(
        HomeDay([*state.microphones.values()], today(begin + 5000 * step, UTC), UTC)
    )
    lanes = picture["rooms"][0]["lanes"]
    assert {lane["label"]: lane["count"] or 0 for lane in lanes} == {
        name: 0 if name in ON_TELEVISION else 625 for name in labels
    }, "like a television"
    assert len(json.dumps(picture)) < 40_000


# What people say


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("music", "music"),
        ("Water tap", "tap_water"),
        (" Kettle ", "kettle"),
        ("My old, dear fridge", "my_old_dear_fridge"),
        ("Talking", "speech"),
    ],
)
def test_a_class_is_meant_by_its_words(text, name):
    assert class_of(text) == name


@pytest.mark.parametrize("text", ["", "   ", "7 dwarfs", "Türglocke", HOSTILE, "x" * 65, "a\nb"])
def test_what_cannot_be_a_class_is_explained(served, text):
    status, answer = served.mark(event_id(served.coughed), text)
    assert status == 422
    assert "letters a to z" in json.loads(answer)["error"]


def test_what_somebody_says_is_a_mark_of_the_log_also_after_a_restart(tmp_path):
    with serving(tmp_path) as home:
        start = home.log.write_segment("coughing", 10, 3)
        home.log.hears("silence")
        with home.stream() as part:
            part("events", lambda it: it["events"])
            status, answer = home.mark(event_id(start), "Kettle boiling")
            assert (status, json.loads(answer)) == (200, {"said": "You said: Kettle boiling"})
            reported = part("events", lambda it: it["events"][0]["said"])
        assert reported["events"][0]["said"] == "You said: Kettle boiling"
        (mark,) = home.marks()
        assert mark[:5] == ("mic", start, start + 3 * NANOSECONDS, "kettle_boiling", REVIEWER)
        home.restart()
        with home.stream() as part:
            reported = part("events", lambda it: it["events"] and it["events"][0]["said"])
        assert reported["events"][0]["said"] == "You said: Kettle boiling"


def test_a_bridge_that_may_only_read_says_so(served, monkeypatch):
    def refuse(log, _):
        raise LogError(f"{log}: cannot be written") from PermissionError(13, "Permission denied")

    monkeypatch.setattr("hearthlog.analyzer.bridge.corrections.write_marks", refuse)
    start = served.log.write_segment("music", 30)
    with served.stream() as part:
        part("events", lambda it: event_id(start, "music") in {e["id"] for e in it["events"]})
    status, answer = served.mark(event_id(start, "music"), "speech")
    assert status == 422
    assert "may only read the folder of logs" in json.loads(answer)["error"]


def test_a_mark_made_elsewhere_is_shown_as_that(tmp_path):
    home = LiveHome(tmp_path)
    start = home.write_segment("music", 40)
    home.close()
    (log,) = find_logs(tmp_path)
    event = SoundEvent("mic", "music", start, start + 4 * NANOSECONDS, 1.0, 4.0)
    write_marks(log, [Mark("mic", start, event.end, "phone_ring", "Ann")])
    corrections = EventCorrections(tmp_path, "home")
    corrections.read_back()
    assert corrections.correction_of(event) == ("phone_ring", False)
    later = event._replace(start=event.end, end=event.end + NANOSECONDS)
    assert corrections.correction_of(later) is None


# In a browser


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    """A home with two rooms, and something of everything that a page can show."""
    names = ("living_room", "bathroom")
    water = {"water": ["silence", "tap_water", "other"]}
    folder = tmp_path_factory.mktemp("lived")
    with serving(folder, microphones=names, scenarios=water) as home:
        for name in names:
            home.log.write_segment("silence", 350, 60, microphone=name)
            home.log.not_heard(200, 40, microphone=name)
        for number, label in enumerate(LIVED):
            home.log.write_segment(label, 120 - 5 * number, 30, 0.55 + 0.05 * number, "living_room")
        home.log.write_segment("tap_water", 30, 20, microphone="bathroom/scenario/water")
        home.log.write_status("living_room", 0, "listening", level_dbfs="-43.2")
        home.log.write_status("bathroom", 2, "no device of this name")
        home.log.write_status("home disk", 1, "2 days left")
        home.log.hears("speech", "living_room")
        yield home


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(390, 844), (1366, 768)], ids=str)
def test_the_page_fits_the_screen_and_can_be_read(phone, lived, size, scheme, tmp_path):
    lived.log.hears("speech", "living_room")
    phone.open(lived, *size, scheme)
    phone.shows("#heard", "Talking")
    phone.of('document.querySelector("#look summary").click()')
    phone.until('document.querySelector("#look fieldset")')
    phone.of("document.querySelector('.lane').dispatchEvent(new MouseEvent('click'))")
    phone.of("document.getElementById('show-week').click()")
    phone.of("document.getElementById('working').open = true")
    phone.shows("#week", "Today")
    phone.picture(tmp_path / "seen.png")
    assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
    assert phone.of("location.href") == lived.url.partition("?")[0]
    assert phone.of(PALE_TEXTS) == []
    dark = phone.of("getComputedStyle(document.body).backgroundColor") == "rgb(15, 20, 24)"
    assert dark == (scheme == "dark")
    assert phone.of("seen") == []


def test_the_page_says_what_is_heard_now_as_the_log_does(phone, lived):
    phone.open(lived)
    for label, words in (("coughing", "Coughing"), ("music", "Music")):
        lived.log.hears(label, "living_room")
        phone.shows("#heard", words)
    recorded = phone.text("#heard")
    assert "Living room" in recorded
    assert " ".join(recorded.split()).endswith("Bathroom: not listening (no device of this name).")
    phone.shows("#scenarios", "Water · Bathroom")
    phone.shows("#scenarios", "Now not listening. Today water tap once (20 seconds).")
    live = phone.of('[...document.querySelectorAll("[aria-live]:not(.said)")].map((e) => e.id)')
    assert live == ["paused", "heard", "day-status"], "all else that changes is not read out"


def test_a_tap_on_a_count_shows_when_and_hides_a_sound_everywhere(phone, lived):
    lived.log.hears("speech", "living_room")
    phone.open(lived)
    row = "[...document.querySelectorAll('tbody tr')].find((e) => e.innerText.startsWith('Music'))"
    phone.until(row)
    start = next(e for e in lived.events() if e["label"] == "music")["time"]
    phone.of(f"{row}.querySelectorAll('button')[1].click()")
    phone.until(f"{row}.nextSibling.innerText.includes({start!r})")
    phone.shows(".panel", "Music · Since 07:00")
    assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
    phone.of(f"{row}.nextSibling.querySelector('.back').click()")
    phone.shows("#hidden-said", "Music is now hidden everywhere.")
    phone.until(f"!{row}")
    phone.shows("#hidden-classes", "Show music again")
    assert phone.of(PALE_TEXTS) == []
    phone.of("document.querySelector('#hidden-classes button').click()")
    phone.until(row)
    phone.until("document.querySelector('#hidden-sounds').hidden")


def test_what_is_wrong_is_said_at_the_top_and_opens_to_the_list(phone, lived):
    phone.open(lived)
    lived.log.hears("speech", "living_room")
    phone.shows("#attention", "Needs a look: Microphone, Bathroom, Disk")
    assert phone.of('document.getElementById("working").className') == "wrong"
    assert phone.of('document.querySelector("#working .dot").getBoundingClientRect().top') < 100
    phone.of('document.querySelector("#working summary").click()')
    assert "Disk: Needs a look (2 days left)" in phone.text("#health")
    assert "Bathroom: Not working (not listening: no device of this name)" in phone.text("#health")


def test_a_tap_stops_the_listening_for_an_hour_and_a_second_one_begins_it_again(phone, lived):
    folder, button = lived.log.folder, "document.getElementById('pause')"
    phone.open(lived)
    lived.log.hears("speech", "living_room")
    phone.shows("#attention", "Needs a look")
    phone.of('document.querySelector("#working summary").click()')
    assert phone.text("#pause") == "Stop listening for an hour"
    phone.of(f"{button}.click()")
    phone.shows("#pause", "Listen again")
    assert 3500 < paused_until(folder) - time.time() <= 3600
    until = clock(round(paused_until(folder)) * NANOSECONDS, lived.home.zone)
    assert phone.text("#paused") == f"Not listening until {until}."
    pause(folder, None)
    phone.shows("#paused", "Not listening, until somebody taps “Listen again”.")
    phone.of(f"{button}.click()")
    phone.shows("#pause", "Stop listening for an hour")
    assert not is_paused(folder)
    assert lived.post("/pause", {"pause": "ever", "label": ""})[0] == 422
    assert not is_paused(folder)


def test_a_screen_reader_is_told_what_everything_is(phone, lived):
    lived.log.hears("speech", "living_room")
    phone.open(lived)
    phone.shows("#heard", "Talking")
    phone.of('document.querySelector("#events summary").click()')
    phone.until('document.querySelector("#events fieldset")')
    tree = phone.tree()
    named = {"button", "DisclosureTriangle", "image", "link", "meter", "radio", "region", "textbox"}
    assert [node for node in tree if node[0] in named | {"table"} and not node[1]] == []
    headings = [name for role, name in tree if role == "heading"]
    assert {*headings} >= {"Home", "Now", "Today", "Is this right?", "How often", "Other sounds"}
    assert {"main", "banner", "contentinfo", "list", "columnheader", "rowheader"} <= {
        role for role, _ in tree
    }
    regions = ["Now", "Today", "Is this right?", "How often", "Other sounds", "Also listened for"]
    assert [name for role, name in tree if role == "region"] == regions
    lanes = [
        name
        for role, name in tree
        if role == "button" and " since yesterday evening, by the sound of it, last at " in name
    ]
    cells = [name for role, name in tree if role in {"cell", "gridcell"}]
    # Nothing was recorded before the last night.
    assert "Coughing, Living room, Night 22\N{EN DASH}07: not known" in cells
    assert any(
        name.startswith("Coughing: perhaps once since yesterday evening, by the sound of it, last")
        for name in lanes
    )
    assert "Crying, Living room, Since 07:00: 0" in cells
    buttons = [name for role, name in tree if role == "DisclosureTriangle"]
    assert len({*buttons}) == len(buttons) == len(LIVED) + 2
    assert ("meter", "Loudness, Living room") in tree


def test_one_says_by_keyboard_what_a_sound_was(phone, lived):
    phone.open(lived)
    phone.of('document.querySelector("#events summary").focus()')
    phone.press("Enter", "\r")
    phone.until('document.querySelector("#events fieldset")')
    phone.press("Tab")
    phone.until('document.activeElement.type === "radio"')
    phone.press(" ", " ")
    phone.press("Tab")
    phone.until('document.activeElement.type === "text"')
    phone.write("Türglocke")
    phone.press("Enter", "\r")
    phone.shows("#events .problem", "letters a to z")
    phone.of("document.activeElement.value = ''")
    phone.of('document.querySelector("#events input[type=text]").select()')
    phone.write("Door bell")
    phone.press("Enter", "\r")
    phone.shows("#events .said", "You said: Door bell")
    phone.until('document.activeElement.tagName === "SUMMARY"')
    assert phone.of("seen") == []
    assert [mark.label for mark in lived.marks()] == ["door_bell"]


def test_a_form_has_what_people_ask_about_though_no_model_knows_it(phone, lived):
    phone.open(lived)
    phone.of('document.querySelector("#events summary").click()')
    phone.until('document.querySelector("#events fieldset")')
    texts = phone.of('[...document.querySelectorAll("#events label")].map((e) => e.innerText)')
    assert {"Coughing", "Crying", "Toilet flush", "Shower", "Water tap"} <= {*texts}
    assert len({*texts}) == len(texts)


def test_cancel_closes_a_form_and_keeps_nothing(phone, lived):
    phone.open(lived)
    answers = '[...document.querySelectorAll("#events .said")].map((e) => e.innerText)'
    before, marks = phone.of(answers), lived.marks()
    phone.of('document.querySelector("#events summary").click()')
    phone.until('document.querySelector("#events fieldset")')
    phone.of('document.querySelector("#events input[type=radio]").click()')
    phone.of('document.querySelector("#events .save .quiet").click()')
    phone.until('!document.querySelector("#events details").open')
    assert phone.of("document.activeElement.tagName") == "SUMMARY"
    assert phone.of(answers) == before
    assert lived.marks() == marks


def test_a_form_that_somebody_fills_in_stays_when_sounds_come(phone, lived):
    phone.open(lived)
    phone.of('document.querySelectorAll("#events summary")[1].click()')
    phone.until('document.querySelector("#events input[type=text]")')
    phone.of('document.querySelector("#events input[type=text]").focus()')
    phone.write("Kettle")
    texts = '[...document.querySelectorAll("#sounds .what")].map((e) => e.innerText).join()'
    before = phone.of(texts)
    lived.log.write_segment("laughing", 1, 2, microphone="bathroom")
    phone.shows("#new-sounds", "1 new sound")
    assert phone.of(texts) == before
    assert phone.focus() == "Kettle"
    phone.of('document.querySelector("#new-sounds").click()')
    assert phone.focus() == "Kettle"
    assert phone.text("#events li:first-child .what") == "Laughing"
    assert phone.of('document.querySelector("#new-sounds").hidden')


def test_texts_of_a_log_are_texts_of_the_page_whatever_they_are(phone, tmp_path):
    long = "w" * 64
    with serving(tmp_path, classes=["silence", HOSTILE, long]) as home:
        home.log.write_segment(HOSTILE, 10)
        home.log.write_segment(long, 5)
        home.log.write_status("home disk", 1, HOSTILE)
        home.log.write_status(HOSTILE, 1, "x" * 5000)
        home.log.hears(HOSTILE)
        phone.open(home)
        phone.of('document.querySelectorAll("#events summary").forEach((e) => e.click())')
        phone.of('document.querySelector("#working").open = true')
        phone.shows("#heard", HOSTILE.capitalize())
        phone.shows("#health", HOSTILE)
        for selector in ("#rooms", "#events", "#events fieldset"):
            assert HOSTILE.capitalize() in phone.text(selector)
        assert HOSTILE.capitalize() in phone.of('document.querySelector(".lane").textContent')
        assert phone.of('document.querySelectorAll("img").length') == 0
        assert phone.of("document.title") == "Home"
        assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
        assert phone.of("seen") == []


def test_a_script_that_got_into_the_page_would_not_run(phone, lived):
    phone.open(lived)
    phone.of(
        'document.body.append(Object.assign(document.createElement("script"), '
        '{ type: "text/javascript" }))'
    )
    phone.of("document.querySelector('body > script').append('window.ran = 1')")
    phone.of("try { document.body.innerHTML = '<img src=x onerror=window.ran=1>' } catch {}")
    phone.of("fetch('http://127.0.0.1:1/').catch(() => {})")
    phone.until("seen.length >= 3")
    assert phone.of("window.ran") is None
    assert phone.of('document.querySelectorAll("img").length') == 0


def test_the_page_says_when_the_box_is_gone_and_goes_on_when_it_is_back(phone, tmp_path):
    with serving(tmp_path) as home:
        home.log.write_segment("coughing", 10)
        home.log.hears("coughing")
        phone.open(home)
        home.end()
        phone.shows("#trouble", "There is no connection to the box. What you see is as of 12:")
        home.restart()
        phone.until('document.getElementById("trouble").hidden')


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_a_page_that_is_allowed_shows_it_in_a_frame_also_of_another_site(
    phone, named, dashboard, host
):
    phone._browser.call("Network.clearBrowserCookies")
    phone._browser.open(dashboard)
    patiently(named.open_pages, lambda number: number == 0)
    # By the name that is another site, no browser keeps the cookie.
    phone.of(
        "document.body.append(Object.assign(document.createElement('iframe'), "
        f"{{src: {named.url.replace('127.0.0.1', host)!r}}}))"
    )
    patiently(named.open_pages, lambda number: number == 1)


def test_a_page_that_is_not_allowed_shows_it_in_no_frame(phone, served, dashboard):
    phone._browser.open(dashboard)
    phone.of(
        "document.body.append(Object.assign(document.createElement('iframe'), "
        f"{{src: {served.url!r}}}))"
    )
    patiently(phone.framed, bool)
    patiently(served.open_pages, lambda number: number == 0)  # that of the fixture ends soon


def test_the_page_works_below_a_path_of_a_proxy_and_leaves_its_cookie_there(phone, named):
    with proxying(named.port, "/sounds/hearth") as address:
        phone.open(SimpleNamespace(url=f"{address}?token={named.token}"))
        assert phone.of("location.href").startswith(address)
        phone.of('document.querySelector("#look summary").click()')
        phone.until('document.querySelector("#look fieldset")')
        phone.of('document.querySelector("#look input[value=silence]").click()')
        phone.of('document.querySelector("#look form").requestSubmit()')
        phone.shows("#look", "You said: Nothing")
        name = f"hearthlog-{named.port}"  # another test may have left one for the whole host
        paths = {each["path"] for each in phone.cookies(address) if each["name"] == name}
        assert "/sounds/hearth" in paths
        assert phone.of("seen") == []


def test_a_page_elsewhere_can_neither_read_nor_frame_nor_mark(phone, served):
    phone.open(served)
    before = served.marks()
    address = served.url.partition("?")[0]
    phone._browser.open_as("http://127.0.0.1:9/other", "<!doctype html><title>other</title>")
    got = phone._browser.wait_for(
        f"Promise.all([fetch('{address}events', {{credentials: 'include'}}), "
        f"fetch('{address}mark', {{method: 'POST', credentials: 'include', mode: 'no-cors', "
        "body: '{}'})].map((each) => each.then((a) => a.type + a.status, (e) => 'refused')))"
    )
    assert got == ["refused", "refused"]
    phone.of(
        "document.body.append(Object.assign(document.createElement('iframe'), "
        f"{{src: '{address}'}}))"
    )
    assert patiently(phone.framed, bool) == [address]
    assert served.marks() == before
