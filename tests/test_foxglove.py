"""What is heard, and what was, reaches Foxglove as the log has it, and nobody else."""

import base64
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from xml.etree import ElementTree as ET

import psutil
import pytest
from conftest import HEARTHLOG
from foxglove import layouts
from grown_schema import GROWN, grown_definitions, write_as_later
from homelife import GENERAL as GENERAL_HOME
from livehome import LiveHome
from logreader import LogReader
from test_interoperability import plain
from test_typescript import FOLDER, like, need_node
from waiting import wait_for

from hearthlog.analyzer.foxglove.publisher import RecordedSpan
from hearthlog.analyzer.foxglove.server import Admission, RefusedError
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.logs.hidden_classes import write_hidden_classes
from hearthlog.analyzer.logs.selection import array_names
from hearthlog.models.classes import in_words, ordered
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.mcap.chunks import read_definitions
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.fields import fields_of
from hearthlog.schemas.messages.message_types import FEATURES, LABEL
from hearthlog.schemas.messages.type_definitions import message_type

SECOND = 1_000_000_000
START = 1_772_348_370 * SECOND  # half a minute before a full hour: two logs
GOLDEN = Path(__file__).parent / "golden"
SILENT_SECONDS = 1.5  # in which what must not come would have come


@pytest.fixture(scope="module")
def logs(day, model_file, tmp_path_factory):
    """Three minutes of a home in two logs."""
    folder = tmp_path_factory.mktemp("played") / "logs"
    options = ["--model", model_file, "--start", "2026-03-01T06:59:30"]
    subprocess.run([*HEARTHLOG, "record", day, "-o", folder, *options], check=True)
    assert len(find_logs(folder)) == 2
    return folder


@contextmanager
def serving(folder, *options):
    """Run `hearthlog watch --foxglove`; yield its process and the address for viewers."""
    need_node(FOLDER / "node_modules")
    command = [*HEARTHLOG, "watch", folder, "--foxglove", "--port", str(free_port()), *options]
    process = subprocess.Popen([*map(str, command)], stderr=subprocess.PIPE, text=True)
    lines = []
    reader = threading.Thread(target=lambda: lines.extend(process.stderr))
    try:
        process.lines = lines
        url = None
        while url is None:
            line = process.stderr.readline()
            assert line, (process.wait(), lines)
            lines.append(line)
            found = re.search(r"ws://\S+", line)
            url = found and found[0]
        reader.start()
        yield process, url
    finally:
        process.kill()
        process.wait()
        reader.join()
        process.stderr.close()


def ended(process, by=signal.SIGTERM):
    """Ask it to end; return its status."""
    process.send_signal(by)
    return process.wait(30)


@contextmanager
def recording(day, model_file, folder):
    """Record in real time until the end."""
    command = [*HEARTHLOG, "record", day, "--model", model_file, "-o", folder, "--realtime"]
    recorder = subprocess.Popen([*map(str, command)], stdout=subprocess.DEVNULL)
    try:
        yield recorder
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(60) == 0
    finally:
        recorder.kill()
        recorder.wait()


class Viewer:
    """The client of Foxglove, which subscribes to all, and what came to it."""

    def __init__(self, url, **headers):
        command = ["node", FOLDER / "connect.mjs", url, json.dumps(headers)]
        self.events = []
        self._process = subprocess.Popen(
            [*map(str, command)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _read(self):
        for line in self._process.stdout:
            if line.endswith("\n"):  # or it ended in the middle of one
                self.events.append(json.loads(line))

    def close(self):
        self._process.stdin.close()
        self._process.wait(30)
        self._reader.join()
        self._process.stdout.close()

    def send(self, request):
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()

    def stand(self):
        self._process.send_signal(signal.SIGSTOP)

    def go_on(self):
        self._process.send_signal(signal.SIGCONT)

    def request(self, *, play, speed=1.0, seek=None):
        """Ask for playback; wait for the answer and return it."""
        before = len(self.of("state"))
        request = {"play": play, "speed": speed} | ({} if seek is None else {"seek": str(seek)})
        self.send(request)
        return self.wait(lambda: self.of("state")[before:])[0]

    def of(self, kind, topic=None):
        found = [event for event in list(self.events) if event["event"] == kind]
        return found if topic is None else [event for event in found if event["topic"] == topic]

    def wait(self, condition):
        return wait_for(condition, 60, lambda: self.events[-3:])

    def wait_for(self, kind, topic=None, count=1):
        return self.wait(lambda: len(self.of(kind, topic)) >= count and self.of(kind, topic))

    def messages(self):
        """What came: topic, log time and bytes of each."""
        return [
            (event["topic"], int(event["logTime"]), base64.b64decode(event["bytes"]))
            for event in self.of("message")
        ]


def logged(folder):
    """What the logs of a folder, or a log, have, in the order of time."""
    found = [
        (item.topic, item.log_time, item.data, item)
        for log in find_logs(folder)
        for item in LogReader(log).messages()
    ]
    return sorted(found, key=lambda each: (each[1], each[0]))


def by_time(messages):
    """Messages that came in the order of time, those of one time by their topics."""
    assert [stamp for _, stamp, _ in messages] == sorted(stamp for _, stamp, _ in messages)
    return sorted(messages, key=lambda each: (each[1], each[0]))


def turned_away(url, **headers):
    """What one gets that may not look."""
    with Viewer(url, **headers) as viewer:
        (event,) = viewer.wait(lambda: list(viewer.events))
    return event


def connected(url):
    host, port = re.search(r"//(.*):(\d+)/", url).groups()
    return socket.create_connection((host, int(port)), timeout=60)


def exchange(url, request):
    """Send bytes and return all that comes until the other side ends."""
    with connected(url) as connection:
        connection.sendall(request)
        answer = b""
        with suppress(ConnectionError):
            while block := connection.recv(65536):
                answer += block
        return answer


def head(url, **fields):
    """The request of a browser; None leaves a field out."""
    target = "/?" + url.partition("/?")[2]
    named = {
        "Host": re.search(r"//(.*)/", url)[1],
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Protocol": "foxglove.sdk.v1",
    } | {name.replace("_", "-"): value for name, value in fields.items()}
    lines = [f"{name}: {value}" for name, value in named.items() if value is not None]
    return "\r\n".join([f"GET {target} HTTP/1.1", *lines, "", ""]).encode()


def test_every_channel_is_decoded_live_and_has_the_bytes_of_the_log(day, model_file, tmp_path):
    with serving(tmp_path) as (watcher, url), Viewer(url) as viewer:
        with recording(day, model_file, tmp_path):
            for kind in ("label", "features", "statistics", "segment"):
                viewer.wait_for("message", f"/mic/{kind}", 2)
            for topic in ("/mic/info", "/diagnostics", "/rosout"):
                viewer.wait_for("message", topic)
        first = int(viewer.of("message", "/mic/features")[0]["logTime"])
        own = [each for each in logged(tmp_path) if each[1] >= first or each[0] == "/mic/info"]
        viewer.wait(lambda: {each[:3] for each in own} <= {*viewer.messages()})
        assert ended(watcher) == 0
    advertised = {event["topic"]: event for event in viewer.of("advertise")}
    assert set(advertised) == {topic for topic, *_ in own} | {"/mic/gap"}
    assert {event["schemaEncoding"] for event in advertised.values()} == {"ros2msg"}
    expected = {(topic, stamp, data): item for topic, stamp, data, item in logged(tmp_path)}
    assert len(viewer.messages()) == len({*viewer.messages()})
    for key, event in zip(viewer.messages(), viewer.of("message"), strict=True):
        fields = plain(expected[key].decode())
        assert like(event["fields"], fields) == fields
    assert viewer.of("error") == []


def test_a_journal_has_no_token_but_the_name_of_a_file_that_only_we_read(tmp_path):
    reading, writing = os.pipe()
    journal = os.fstat(writing)
    environment = os.environ | {"JOURNAL_STREAM": f"{journal.st_dev}:{journal.st_ino}"}
    command = [*HEARTHLOG, "watch", str(tmp_path), "--foxglove", "--port", str(free_port())]
    with subprocess.Popen(command, stderr=writing, env=environment) as process:
        os.close(writing)
        with os.fdopen(reading) as lines:
            line = next(each for each in lines if "Lichtblick" in each)
            file = Path(re.search(r"full address is in (\S+)", line)[1])
            url = file.read_text().strip()
            assert file.parent.stat().st_mode & 0o777 == 0o700
            assert "token" not in line
            with connected(url) as viewer:
                viewer.sendall(head(url))
                assert b" 101 " in viewer.recv(100)
            process.send_signal(signal.SIGTERM)
            assert "token" not in lines.read()
        assert process.wait(timeout=60) == 0
    assert not file.exists()


def test_one_who_comes_late_is_told_of_the_stream(day, model_file, tmp_path):
    with (
        serving(tmp_path) as (_, url),
        Viewer(url) as first,
        recording(day, model_file, tmp_path),
    ):
        first.wait_for("message", "/mic/features", 40)
        earlier = first.wait_for("message", "/mic/info")[0]
        with Viewer(url) as late:
            late.wait_for("message", "/mic/features")
            info = late.wait_for("message", "/mic/info")[0]
    assert info["fields"]["labels"] == list(load_model(model_file).classes)
    assert info["bytes"] == earlier["bytes"]


def test_one_who_serves_late_tells_of_the_stream_too(day, model_file, tmp_path):
    with recording(day, model_file, tmp_path):
        wait_for(lambda: list(tmp_path.rglob("*.active")))
        time.sleep(3)
        with serving(tmp_path) as (_, url), Viewer(url) as viewer:
            viewer.wait_for("message", "/mic/info")
            viewer.wait_for("message", "/mic/features")


def test_a_foreign_page_a_wrong_token_and_another_name_get_nothing(logs):
    with serving(logs) as (watcher, url):
        nothing = {"content-length": "0", "connection": "close"}
        without = url.partition("?")[0]
        for event in (
            turned_away(url, Origin="https://evil.example"),
            turned_away(url, Origin="null"),
            turned_away(url, Origin="http://localhost.evil.example"),
            turned_away(url, Origin="https://app.foxglove.dev.evil.example"),
            turned_away(url, Host="evil.example:8765"),
            turned_away(url, Host="localhost.evil.example:8765"),
            turned_away(without),
            turned_away(without, Origin="https://app.foxglove.dev"),
            turned_away(without + "?token="),
            turned_away(url[:-1]),
            turned_away(url + "x"),
        ):
            assert (event["event"], event["status"], event["body"]) == ("refused", 403, "")
            assert event["headers"] == nothing
        assert ended(watcher) == 0
    output = "".join(watcher.lines)
    assert (
        output.count("a page of https://evil.example; if it is yours, allow it with --origin") == 1
    )
    assert output.count("the token is missing or wrong") == 1
    assert output.count("the request used a host name") == 1


def test_pages_of_foxglove_and_of_this_machine_may_look(logs):
    with serving(logs, "--origin", "https://lichtblick.home/") as (_, url):
        for origin in (
            "https://app.foxglove.dev",
            "file://",
            "http://localhost:8080",
            "http://127.0.0.1",
            "https://lichtblick.home",
        ):
            with Viewer(url, Origin=origin) as viewer:
                viewer.wait_for("serverInfo")
        with Viewer(url.replace("127.0.0.1", "localhost")) as viewer:
            viewer.wait_for("serverInfo")


@pytest.mark.parametrize(
    ("bind", "host", "admitted"),
    [
        ("127.0.0.1", "127.0.0.1:8765", True),
        ("127.0.0.1", "127.9.9.9:9000", True),  # the other end of a tunnel
        ("127.0.0.1", "LOCALHOST:8765", True),
        ("127.0.0.1", "192.168.1.5:8765", False),
        ("127.0.0.1", "home.example:8765", False),
        ("127.0.0.1", "", False),
        ("127.0.0.1", "[::1", False),
        ("::1", "[::1]:8765", True),
        ("192.168.1.5", "192.168.1.5:8765", True),
        ("192.168.1.5", "192.168.1.6:8765", False),
        ("192.168.1.5", "localhost:8765", False),
        ("0.0.0.0", "192.168.1.5:8765", True),
        ("0.0.0.0", "home.example:8765", False),
    ],
)
def test_a_name_that_somebody_lets_point_here_is_refused(bind, host, admitted):
    def check():
        request = head("ws://x:1/?token=t", Host=host)
        return Admission(bind, "t").check(request)

    if admitted:
        assert b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==" in check()
    else:
        with pytest.raises(RefusedError, match="host name"):
            check()


@pytest.mark.parametrize(
    "change",
    [
        (b"GET ", b"POST "),
        (b"HTTP/1.1", b"HTTP/1.0"),
        (b"Host:", b"Host : "),
        (
            b"Upgrade: websocket",
            b"Origin: https://app.foxglove.dev\r\nOrigin: https://evil.example",
        ),
        (b"Upgrade: websocket", b"Origin: https://app.foxglove.dev\r\n https://evil.example"),
        (b"Upgrade: websocket", b"Origin: \xe9"),
    ],
)
def test_what_can_be_read_in_two_ways_is_refused(change):
    request = head("ws://127.0.0.1:1/?token=t")
    assert Admission("127.0.0.1", "t").check(request)
    with pytest.raises(RefusedError):
        Admission("127.0.0.1", "t").check(request.replace(*change))


def test_one_who_does_not_ask_as_a_viewer_gets_nothing(logs):
    with serving(logs) as (watcher, url):
        requested = head(url)
        for request in (requested[:-2], b"x" * 100_000, requested[:-2] + b"A: " + b"x" * 40_000):
            assert exchange(url, request) == b""
        assert exchange(url, requested[:-2] + b"Ok\r\n\r\n").startswith(b"HTTP/1.1 403 ")
        assert ended(watcher) == 0


def test_many_who_only_connect_keep_out_nobody_who_has_the_token(logs):
    with serving(logs) as (_, url), ExitStack() as opened:
        idle = [opened.enter_context(closing(connected(url))) for _ in range(100)]
        with Viewer(url) as viewer:  # while they are there
            viewer.wait_for("serverInfo")
        over = 0
        for each in idle:
            each.settimeout(0.02)
            with suppress(TimeoutError):
                try:
                    over += each.recv(1) == b""
                except ConnectionResetError:
                    over += 1
        assert over >= 60


def test_a_ninth_viewer_is_refused_until_one_goes(logs):
    with serving(logs) as (_, url), ExitStack() as opened:
        looking = [opened.enter_context(closing(connected(url))) for _ in range(8)]
        for each in looking:
            each.sendall(head(url))
            assert each.recv(65536).startswith(b"HTTP/1.1 101 ")
        assert turned_away(url)["status"] == 403
        looking[0].close()
        with Viewer(url) as viewer:
            viewer.wait(lambda: viewer.events)
            assert viewer.events[0]["event"] == "serverInfo"


def test_a_viewer_cannot_publish(logs):
    with serving(logs) as (_, url), Viewer(url) as viewer:
        (info,) = viewer.wait_for("serverInfo")
        assert info["capabilities"] == []
        channel = {"id": 1, "topic": "/mic/label", "encoding": "cdr", "schemaName": LABEL}
        viewer.send({"op": "advertise", "channels": [channel]})
        (status,) = viewer.wait_for("status")
        assert "does not support clientPublish" in status["message"]


def put(log, folder, name):
    """Let a whole log appear in a folder at once."""
    shutil.copy(log, folder / "half")
    (folder / "half").rename(folder / name)


def subscribe(log, folder, *viewers):
    """Let viewers know all topics, by a log that appears, and wait until nothing more comes."""
    for viewer in viewers:
        viewer.wait_for("serverInfo")
    put(log, folder, "home_00.mcap")
    for viewer in viewers:
        viewer.wait_for("advertise", count=8)
    time.sleep(SILENT_SECONDS)


def test_a_viewer_that_stands_still_keeps_nobody_waiting_and_takes_little_memory(logs, tmp_path):
    log = max(find_logs(logs))
    newest = logged(log)[-1][1]
    memory = []
    with serving(tmp_path) as (watcher, url), Viewer(url) as still, Viewer(url) as other:

        def times_seen():
            return sum(event.get("logTime") == str(newest) for event in list(other.events))

        subscribe(log, tmp_path, still, other)
        still.stand()
        for number in range(1, 21):
            before = times_seen()
            put(log, tmp_path, f"home_{number:02}.mcap")
            other.wait(lambda before=before: times_seen() > before)
            memory.append(psutil.Process(watcher.pid).memory_info().rss)
        still.go_on()
        assert ended(watcher) == 0
    assert memory[-1] - memory[4] < 10_000_000


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("options", [(), ("--start", "2026-03-01")])
def test_it_ends_in_order_while_somebody_looks(logs, by, options):
    with serving(logs, *options) as (watcher, url), Viewer(url) as viewer:
        viewer.wait_for("serverInfo")
        assert ended(watcher, by) == 0
        viewer.wait_for("close")
    assert [line for line in watcher.lines if not line.startswith("hearthlog: ")] == []


def test_a_recording_is_played_whole_and_in_order(logs):
    own = [each[:3] for each in logged(logs)]
    with serving(logs, "--start", "2026-03-01") as (watcher, url), Viewer(url) as viewer:
        (info,) = viewer.wait_for("serverInfo")
        assert info["capabilities"] == ["time", "playbackControl"]
        begin, end = (info[f"data{name}Time"] for name in ("Start", "End"))
        assert begin["sec"] * SECOND + begin["nsec"] == own[0][1]
        assert end["sec"] * SECOND + end["nsec"] == own[-1][1] + 1
        topics = {topic for topic, *_ in own} | {"/mic/gap"}
        viewer.wait(lambda: {event["topic"] for event in viewer.of("advertise")} == topics)
        state = viewer.request(play=True, speed=1000)
        assert (state["status"], state["speed"], state["sought"]) == ("playing", 100, False)
        state = viewer.wait_for("state", count=2)[1]
        assert (state["status"], int(state["time"])) == ("ended", own[-1][1] + 1)
        viewer.wait(lambda: len(viewer.of("message")) >= len(own))
        assert viewer.request(play=True)["status"] == "ended"
        assert ended(watcher) == 0
    assert by_time(viewer.messages()) == own
    times = [int(event["timestamp"]) for event in viewer.of("time")]
    assert times == sorted(times)
    assert own[0][1] <= times[0]
    assert times[-1] <= own[-1][1] + 1


@pytest.mark.parametrize("second", [10.02, 45.0, 150.0])
def test_after_a_seek_one_sees_what_held_then_and_what_follows(logs, second):
    moment = START + round(second * SECOND)
    own = [each[:3] for each in logged(logs)]
    infos = [each for each in own if each[0] == "/mic/info" and each[1] < moment]
    held = {each[0]: each for each in own if moment - SECOND <= each[1] < moment}
    held["/mic/info"] = infos[-1]
    following = [each for each in own if each[1] >= moment]
    with serving(logs, "--start", "2026-03-01") as (_, url), Viewer(url) as viewer:
        viewer.wait_for("advertise", count=8)
        state = viewer.request(play=False, seek=moment)
        assert (state["status"], state["sought"], int(state["time"])) == ("paused", True, moment)
        viewer.wait(lambda: len(viewer.of("message")) >= len(held))
        assert sorted(viewer.messages()) == sorted(held.values())
        with Viewer(url) as late:
            late.wait_for("message", "/mic/info")
            assert late.messages() == infos[-1:]
        repeated = len(viewer.of("message"))  # it was told again, too
        viewer.request(play=True, speed=100)
        viewer.wait(lambda: viewer.of("state")[-1]["status"] == "ended")
        viewer.wait(lambda: len(viewer.of("message")) >= repeated + len(following))
        assert by_time(viewer.messages()[repeated:]) == following
        viewer.request(play=True, speed=100, seek=0)
        viewer.wait(lambda: len(viewer.of("message")) >= repeated + len(following) + len(own))
        assert by_time(viewer.messages()[repeated + len(following) :]) == own


def test_what_is_paused_stands_still_and_goes_on(logs):
    own = [each[:3] for each in logged(logs)]
    with serving(logs, "--start", "2026-03-01") as (_, url), Viewer(url) as viewer:
        viewer.wait_for("advertise", count=8)
        viewer.request(play=True, speed=20)
        viewer.wait(lambda: len(viewer.of("message")) >= 200)
        state = viewer.request(play=False, speed=20)
        time.sleep(SILENT_SECONDS)
        came = viewer.messages()
        assert by_time(came) == [each for each in own if each[1] < int(state["time"])]
        assert len(came) < len(own)
        time.sleep(SILENT_SECONDS)
        assert viewer.messages() == came
        assert viewer.request(play=False, speed=0)["speed"] == pytest.approx(0.01)
        viewer.request(play=True, speed=100)
        viewer.wait(lambda: len(viewer.of("message")) >= len(own))
        assert by_time(viewer.messages()) == own


def test_only_what_was_asked_for_is_played(logs):
    span = "--start", "2026-03-01T06:59:50", "--end", "2026-03-01T07:00:05"
    first, last = START + 20 * SECOND, START + 35 * SECOND
    own = [each[:3] for each in logged(logs) if first <= each[1] < last]
    with serving(logs, *span) as (_, url), Viewer(url) as viewer:
        viewer.wait_for("message", "/mic/info")  # of before, as one comes in the middle
        viewer.request(play=True, speed=100, seek=0)
        viewer.wait(lambda: viewer.of("state")[-1]["status"] == "ended")
        viewer.wait(lambda: {*own} <= {*viewer.messages()})
    extra = [each for each in viewer.messages() if each not in own]
    assert all(first - SECOND <= stamp < first for topic, stamp, _ in extra if topic != "/mic/info")


def test_years_without_a_log_are_passed_over(logs, day, tmp_path):
    shutil.copy(max(find_logs(logs)), tmp_path / "home_2.mcap")
    command = [*HEARTHLOG, "record", day, "-o", tmp_path, "--start", "1970-01-01T00:01"]
    subprocess.run(command, check=True)
    recording = RecordedSpan(find_logs(tmp_path), None, None, pytest.fail)
    read = []
    recording._between = lambda *span: read.append(span) or iter(())
    assert list(recording.messages(recording.start)) == []
    assert len(read) == 2
    for start, end in read:
        assert any(start <= stamp < end for _, stamp, *_ in logged(tmp_path))


def test_nothing_to_play_is_told(refused, logs):
    for span in (("--start", "2027-01-01"), ("--end", "2020-01-01")):
        line = refused("watch", logs, "--foxglove", *span)
        assert line == "nothing was recorded in this time; `hearthlog info` lists what was"


def test_what_a_later_version_wrote_passes_as_it_is(tmp_path):
    golden = max(GOLDEN.iterdir()) / "logs"
    with grown_definitions(tmp_path):
        write_as_later(golden, tmp_path / "later")
    with serving(tmp_path / "later", "--start", "2000-01-01") as (_, url), Viewer(url) as viewer:
        viewer.wait_for("advertise", count=6)
        viewer.request(play=True, speed=100)
        features = viewer.wait_for("message", "/hall/features")
    grown = GROWN[FEATURES]
    assert features[0]["fields"][grown.name] == grown.value


def write_damaged(log, path):
    """Write a log with noise in the middle of it."""
    data = bytearray(log.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2_000] = os.urandom(2_000)
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["home_1.mcap", "home_1.mcap.active"])
def test_a_damaged_log_is_told_once_and_the_others_are_played(logs, tmp_path, name):
    options = ("--start", "2026-03-01")
    first, second = find_logs(logs)
    write_damaged(second, tmp_path / name)
    shutil.copy(first, tmp_path / "home_0.mcap")
    with serving(tmp_path, *options) as (watcher, url), Viewer(url) as viewer:
        viewer.wait_for("serverInfo")
        viewer.request(play=True, speed=100)
        viewer.wait(lambda: viewer.of("state")[-1]["status"] == "ended")
        assert {each[:3] for each in logged(first)} <= {*viewer.messages()}
        assert ended(watcher) == 3
    assert "".join(watcher.lines).count(name) == 1


def test_a_damaged_log_is_told_and_the_next_one_is_shown_live(logs, tmp_path):
    first, second = find_logs(logs)
    write_damaged(first, tmp_path / "damaged")
    with serving(tmp_path) as (watcher, url), Viewer(url) as viewer:
        subscribe(first, tmp_path, viewer)
        put(tmp_path / "damaged", tmp_path, "home_1.mcap")
        put(second, tmp_path, "home_2.mcap")
        own = [each[:3] for each in logged(second)]
        viewer.wait(lambda: own[-1] in viewer.messages())
        assert ended(watcher) == 3
    assert "".join(watcher.lines).count("home_1.mcap") == 1


def test_what_is_wrong_is_told_in_a_line(refused, logs, tmp_path):
    watch = ("watch", logs, "--foxglove")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        line = refused(*watch, "--port", port)
    assert line == (
        f"port {port} is in use, perhaps by another viewer or watcher; choose another one with "
        "--port"
    )
    assert "no such folder" in refused("watch", tmp_path / "gone", "--foxglove")
    assert "cannot listen on 192.0.2.1" in refused(*watch, "--bind", "192.0.2.1")
    for options, line in {
        ("--bind", "home.example"): "--bind home.example: not an address in digits",
        ("--origin", "lichtblick.home"): "--origin lichtblick.home: not the address of a page",
        ("--origin", "https://a.b/c"): "--origin https://a.b/c: not the address of a page",
        ("--web",): "--web does not go with --foxglove",
        ("--serve",): "--serve does not go with --foxglove",
        ("--minutes", 3): "--minutes does not go with --foxglove",
        ("--start", "noon"): "--start noon: not a time",
    }.items():
        assert refused(*watch, *options, status=2).startswith(line)
    for options in (("--start", "2026-03-01"), ("--end", "2026-03-01"), ("--origin", "http://a")):
        line = refused("watch", logs, *options, status=2)
        assert line == f"{options[0]} goes with --foxglove"


def test_without_the_sdk_it_is_said_what_to_install(logs):
    code = "import sys; sys.modules['foxglove'] = None; from hearthlog.tools.cli import main"
    command = [sys.executable, "-c", f"{code}; main.main()", "watch", str(logs), "--foxglove"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert result.stderr.startswith("hearthlog: foxglove is not installed; try: ")
    assert "[foxglove]" in result.stderr
    assert result.stderr.count("\n") == 1


def test_it_listens_by_ipv6_too(logs):
    with serving(logs, "--bind", "::1") as (watcher, url):
        assert url.startswith("ws://[::1]:")
        with Viewer(url) as viewer:
            viewer.wait_for("serverInfo")
        assert ended(watcher) == 0
    assert "ssh -L [::1]:" in "".join(watcher.lines)


def test_who_listens_to_the_network_is_warned(logs):
    with serving(logs, "--bind", "0.0.0.0") as (watcher, url):
        with Viewer(url.replace("0.0.0.0", "127.0.0.1")) as viewer:
            viewer.wait_for("serverInfo")
        assert ended(watcher) == 0
    assert "crosses the network unencrypted" in "".join(watcher.lines)


def panels_of(tree):
    """The panels of a layout."""
    if isinstance(tree, str):
        return [tree]
    assert tree.keys() == {"direction", "first", "second", "splitPercentage"}
    return panels_of(tree["first"]) + panels_of(tree["second"])


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """A home with two microphones, of which one class is hidden, and the columns of its log."""
    folder = tmp_path_factory.mktemp("rooms")
    names = ["living_room", "bath"]
    write_hidden_classes(folder, ["music"])
    home = LiveHome(folder, names, minutes_ago=0)
    home.write_status("recorder", 0, "listening")
    for name in names:
        home.hears("coughing", name)
        home.write_segment("coughing", 0, microphone=name)
    home.close()
    return folder


def layout_of(folder, file):
    """Write a layout with the command; return its text."""
    command = [*map(str, [*HEARTHLOG, "watch", folder, "--layout", file])]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout == f"{file}\n"
    assert "open it in " in result.stderr
    return file.read_text()


def check_path(folder, path, separator):
    """Whether the log has what a path of a layout names, with so many elements."""
    pattern = rf"(/\w+/\w+){re.escape(separator)}(\w+)(?:\[(\d+)\])?(?:\.@log10)?"
    topic, field, index = re.fullmatch(pattern, path).groups()
    for log in find_logs(folder):
        with LogFile(log) as file:
            read_definitions(file)
            (channel,) = (each for each in file.channels.values() if each.topic == topic)
            schema = file.schemas[channel.schema_id]
            types = fields_of(message_type(schema.name, schema.encoding, schema.data))
            assert field in types
            names = array_names(channel.metadata, field)
            assert index is None or int(index) < len(names)
            name = None if index is None else names[int(index)]
    return topic.split("/")[1], name


def panels_in(layout, configs):
    """The panels of a layout, with those in tabs."""
    for panel in panels_of(layout):
        yield panel
        for tab in configs[panel].get("tabs", ()):
            yield from panels_in(tab["layout"], configs)


def test_a_layout_for_foxglove_has_the_microphones_and_classes_of_the_home(rooms, tmp_path):
    layout = json.loads(layout_of(rooms, tmp_path / "home.json"))
    configs = layout["configById"]
    assert sorted(panels_in(layout["layout"], configs)) == sorted(configs)
    kinds = {
        "Plot": (layouts.PlotConfig, layouts.PlotSeries),
        "StateTransitions": (layouts.StateTransitionsConfig, layouts.StateTransitionsSeries),
        "RosOut": (layouts.LogConfig, None),
        "DiagnosticSummary": (layouts.DiagnosticsSummaryConfig, None),
    }
    series = []
    for panel, config in configs.items():
        if panel == "Tab!microphones":
            assert [tab["title"] for tab in config["tabs"]] == ["Bath", "Living room"]
            continue
        of_panel, of_series = kinds[panel.partition("!")[0]]
        titles = {"foxglovePanelTitle", "lichtblickPanelTitle"}
        assert config.keys() - titles <= of_panel()._to_dict().keys()
        for path in config.get("paths", ()):
            assert path.keys() <= of_series()._to_dict().keys()
            series.append((*check_path(rooms, path["value"], "."), path["label"]))
        assert config.get("topicToRender", "/rosout") in {"/rosout", "/diagnostics"}
    shown = [(name, label) for one, name, label in series if one == "bath" and name in GENERAL_HOME]
    own = [name for name in ordered(GENERAL_HOME) if name != "music"]
    assert shown == [(name, in_words(name)) for name in own]
    assert {name for one, name, label in series if label == "level"} == {"energy"}


def test_a_layout_for_plotjuggler_has_series_by_the_names_of_classes(rooms, tmp_path):
    root = ET.fromstring(layout_of(rooms, tmp_path / "home.xml"))
    assert [tab.get("tab_name") for tab in root.iter("Tab")] == ["Bath", "Living room"]
    made = {snippet.get("name"): snippet for snippet in root.iter("snippet")}
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert made.keys() <= set(curves)
    for name in set(curves) - made.keys():
        check_path(rooms, name, "/")
    named = {
        name: check_path(rooms, snippet.findtext("linked_source"), "/")
        for name, snippet in made.items()
    }
    assert named.pop("Bath: level in dBFS") == ("bath", "energy")
    assert named["Living room: Coughing"] == ("living_room", "coughing")
    own = [name for name in ordered(GENERAL_HOME) if name != "music"]
    of_bath = [curve for curve in curves if curve.startswith("Bath: ")][:-1]
    assert of_bath == [f"Bath: {in_words(name)}" for name in own]


def test_a_layout_of_one_microphone_has_no_tab_and_names_what_it_cannot_be(logs, refused, tmp_path):
    layout = json.loads(layout_of(logs, tmp_path / "home.json"))
    assert not any(panel.startswith("Tab") for panel in layout["configById"])
    line = refused("watch", logs, "--layout", tmp_path / "home.json")
    assert line.endswith("home.json: exists already; choose another name, or delete it first")
    line = refused("watch", logs, "--layout", tmp_path / "home.txt", status=2)
    assert line.endswith("must end in .json for Foxglove, or in .xml for PlotJuggler")
    line = refused("watch", logs, "--layout", tmp_path / "a.json", "--web", status=2)
    assert line == "--web does not go with --layout"
    (tmp_path / "empty").mkdir()
    assert "no log" in refused("watch", tmp_path / "empty", "--layout", tmp_path / "a.json")
