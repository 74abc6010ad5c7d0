"""Outputs of the bridge are opened one by one, and again where that failed."""

import json
import subprocess
import sys
import threading
import time
from datetime import UTC

import pytest

from hearthlog.analyzer.bridge.bridge import ProblemReporter, open_outputs, output_problems
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.output import OutputUpdate
from hearthlog.analyzer.bridge.settings import BridgeSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.analyzer.http import free_port, listen
from hearthlog.analyzer.logs.local_time import today
from hearthlog.schemas.frames import NANOSECONDS

pytestmark = pytest.mark.fast

UPDATE = OutputUpdate(HomeState(), [], [], today(0, UTC), UTC)


@pytest.fixture
def home(tmp_path):
    return RecorderAddress(tmp_path, "home", UTC)


def test_an_output_that_cannot_be_opened_is_tried_again_and_stops_no_other(
    home, tmp_path, monkeypatch
):
    monkeypatch.setattr("hearthlog.analyzer.bridge.bridge._AGAIN_SECONDS", 0.0)
    printed = []
    token = tmp_path / "token"
    token.write_text("a-token-of-the-figures\n")
    with listen() as other:
        port = other.getsockname()[1]
        tables = {
            "prometheus": {"port": port, "token_file": token},
            "ping": {"url": "http://127.0.0.1:9"},
        }
        opened, _ = open_outputs(
            BridgeSettings.model_validate(tables),
            home,
            BridgeState(tmp_path, "home", pytest.fail),
            ProblemReporter(printed.append),
        )
        opened["prometheus"].update(UPDATE)
        assert list(opened) == ["prometheus", "ping"]
        (line,) = printed
        assert line.startswith(f"bridge.prometheus: cannot listen on port {port} (")
        assert line.endswith("; take another; trying again")
    opened["prometheus"].update(UPDATE)
    assert opened["prometheus"].output is not None
    for output in opened.values():
        output.close()


CONTRADICTIONS = [
    ({"mqtt": {"host": "127.0.0.1"} | more}, f"bridge.mqtt: {problem}")
    for more, problem in [
        ({"ca_file": "ca.pem"}, "ca_file is for an encrypted connection; write tls = true, or"),
        ({"key_file": "key.pem"}, "key_file is for an encrypted connection; write tls = true"),
        ({"certificate_file": "a.pem"}, "certificate_file is for an encrypted connection; write"),
        (
            {"tls": True, "key_file": "key.pem"},
            "key_file needs a certificate; set certificate_file",
        ),
        ({"password_file": "/etc/hostname"}, "password_file needs a user name; set user"),
    ]
] + [({"prometheus": {}}, "bridge.prometheus: has no output; set text_file or")]


@pytest.mark.parametrize(
    ("tables", "line"), CONTRADICTIONS, ids=[str(t) for t, _ in CONTRADICTIONS]
)
def test_a_table_that_contradicts_itself_closes_its_own_output_alone(home, tmp_path, tables, line):
    printed = []
    with listen() as broker:
        port = {"port": broker.getsockname()[1]} if "mqtt" in tables else {}
        tables = {name: table | port for name, table in tables.items()}
        settings = BridgeSettings.model_validate(tables | {"page": {"port": free_port()}})
        opened, _ = open_outputs(
            settings,
            home,
            BridgeState(tmp_path, "home", pytest.fail),
            ProblemReporter(printed.append),
        )
        assert [name for name, output in opened.items() if output.output] == ["page"]
        opened["page"].close()
        broker.setblocking(False)
        with pytest.raises(BlockingIOError):  # nobody came, with a password or without
            broker.accept()
    assert printed[0].startswith(line)
    assert printed[0].endswith("; trying again")
    problems, _ = output_problems(settings)
    assert any(each.startswith(line) for each in problems)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("", "bridge.prometheus: text_file: {} is a folder; name a file in it, as hearthlog.prom"),
        (
            f"{'x' * 300}.prom",
            "bridge.prometheus: text_file: {} cannot be written (File name too long)",
        ),
        (f"{'x' * 300}/home.prom", "text_file: {} cannot be written (File name too long)"),
        ("loop/home.prom", "text_file: {} cannot be written (Too many levels of symbolic links)"),
        ("file/home.prom", "/file: cannot be written ("),
    ],
)
def test_a_text_file_that_cannot_be_looked_at_is_no_reason_to_refuse_the_configuration(
    home, tmp_path, name, problem
):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").touch()
    file = tmp_path / name
    settings = BridgeSettings.model_validate({"prometheus": {"text_file": file}})
    (line,), _ = output_problems(settings)
    assert problem.format(file) in line
    printed = []
    with_readers = settings.prometheus.model_copy(update={"readable_by": "all"})
    outputs_of = settings.model_copy(update={"prometheus": with_readers})
    opened, _ = open_outputs(
        outputs_of,
        home,
        BridgeState(tmp_path, "home", pytest.fail),
        ProblemReporter(printed.append),
    )
    opened["prometheus"].update(UPDATE)
    opened["prometheus"].close()
    assert printed[0].startswith("bridge.prometheus: text_file: ")
    assert printed[0].endswith("; trying again")
    assert all("cannot be removed" in line for line in printed[1:])


def test_an_output_that_is_tried_again_leaves_no_thread(home, tmp_path, monkeypatch):
    monkeypatch.setattr("hearthlog.analyzer.bridge.bridge._AGAIN_SECONDS", 0.0)
    mqtt = {"host": "127.0.0.1", "user": "x", "password_file": tmp_path / "none", "commands": True}
    settings = BridgeSettings.model_validate({"mqtt": mqtt})
    opened, _ = open_outputs(
        settings, home, BridgeState(tmp_path, "home", pytest.fail), ProblemReporter(lambda _: None)
    )
    count = threading.active_count()
    for _ in range(5):
        opened["mqtt"].update(UPDATE)
    assert threading.active_count() == count


def test_what_was_heard_while_there_was_no_bridge_is_read(home, tmp_path):
    now = time.time_ns()
    day = 24 * 3600 * NANOSECONDS
    (tmp_path / "totals.json").write_text(json.dumps({"time": now - 3 * day, "totals": []}))
    with listen() as other:  # also while the port is taken
        figures = {"port": other.getsockname()[1]}
        settings = BridgeSettings.model_validate({"prometheus": figures})
        _, since = open_outputs(
            settings,
            home,
            BridgeState(tmp_path, "home", pytest.fail),
            ProblemReporter(lambda _: None),
        )
    assert since <= now - 3 * day


def test_without_a_table_nothing_is_opened(home, tmp_path):
    opened, since = open_outputs(
        BridgeSettings(),
        home,
        BridgeState(tmp_path, "home", pytest.fail),
        ProblemReporter(pytest.fail),
    )
    assert opened == {}
    assert since > 0


def test_a_package_that_is_missing_stops_no_other_output(home, tmp_path, monkeypatch):
    printed = []
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    monkeypatch.delitem(sys.modules, "hearthlog.analyzer.bridge.mqtt.publisher", raising=False)
    monkeypatch.delitem(sys.modules, "hearthlog.analyzer.bridge.mqtt.connection", raising=False)
    tables = {"mqtt": {"host": "127.0.0.1"}, "ping": {"url_file": str(tmp_path / "none")}}
    settings = BridgeSettings.model_validate(tables | {"page": {"port": free_port()}})
    opened, _ = open_outputs(
        settings, home, BridgeState(tmp_path, "home", pytest.fail), ProblemReporter(printed.append)
    )
    assert [name for name, output in opened.items() if output.output] == ["page"]
    assert printed[0].startswith("paho.mqtt.client is not installed; try: ")
    assert "no such file of a ping address; trying again" in printed[-1]
    for output in opened.values():
        output.close()


def test_a_bridge_loads_nothing_that_records_trains_or_draws_random_numbers():
    modules = ("bridge", "page.home_page", "mqtt.publisher", "alerts.output")
    code = "import sys\n" + "".join(f"import hearthlog.analyzer.bridge.{m}\n" for m in modules)
    run = subprocess.run(
        [sys.executable, "-c", code + "print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(run.stdout.split())
    ours = {name.removeprefix("hearthlog.") for name in loaded if name.startswith("hearthlog.")}
    assert not {"numpy.random", "scipy", "soundfile", "soxr", "sklearn"} & loaded
    assert not {"recorder.recording", "recorder.sources", "analyzer.training"} & ours
