"""The Home Assistant add-on: valid for the Supervisor, and what its options and broker lead to."""

import json
import os
import re
import select
import subprocess
import sys
import threading
import tomllib
import urllib.error
import urllib.request
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml
from brokers import Listener
from microphones import DIES_WITH_PARENT
from waiting import wait_for

from hearthlog import __version__
from hearthlog.analyzer.http import free_port
from hearthlog.tools.service import addon as addon_program
from hearthlog.tools.service.addon import AddonFolders, AddonOptions, MicrophoneOptions

ADDON = Path(__file__).parents[1] / "tools/home-assistant"
TOKEN = "the-token-of-the-supervisor"
# Keys of an add-on that the Supervisor of 2026.08 knows, as far as this one uses or may use them,
# after https://developers.home-assistant.io/docs/add-ons/configuration.
# It drops any other key in silence.
KEYS = {
    **dict.fromkeys(("name", "slug", "description", "panel_icon", "panel_title"), str),
    **dict.fromkeys(("url", "watchdog", "image", "ingress_entry"), str),
    **dict.fromkeys(("ingress", "audio", "init", "panel_admin", "tmpfs", "apparmor"), bool),
    **dict.fromkeys(("arch", "services", "map", "backup_exclude"), list),
    **dict.fromkeys(("options", "schema"), dict),
    **dict.fromkeys(("timeout", "ingress_port"), int),
    "version": str,
    "homeassistant": re.compile(r"20\d\d\.\d{1,2}\.\d+"),
    "startup": re.compile("initialize|system|services|application|once"),
    "stage": re.compile("stable|experimental|deprecated"),
    "backup": re.compile("hot|cold"),
    "boot": re.compile("auto|manual|manual_only"),
}
NEEDED = {"name", "version", "slug", "description", "arch"}
MAPPED = re.compile("(addon_config|share|media|ssl|backup)(:(rw|ro))?")
ELEMENT = re.compile(r"(bool|str|int|float|port|password|email|url|list\([^)]+\)|match\(.+\))\??")


def read(name):
    return yaml.safe_load((ADDON / name).read_text("utf-8"))


def elements(schema):
    """Yield the types of a schema."""
    if isinstance(schema, str):
        yield schema
    elif isinstance(schema, dict):
        for each in schema.values():
            yield from elements(each)
    else:
        assert len(schema) == 1
        yield from elements(schema[0])


def test_the_supervisor_knows_every_key_and_type():
    addon = read("config.yaml")
    assert NEEDED <= addon.keys() <= KEYS.keys()
    for key, value in addon.items():
        kind = KEYS[key]
        is_right = isinstance(value, kind) if isinstance(kind, type) else kind.fullmatch(value)
        assert is_right, key
    assert {*addon["arch"]} <= {"aarch64", "amd64"}
    assert 10 <= addon["timeout"] <= 300
    assert all(map(MAPPED.fullmatch, addon["map"]))
    assert all(re.fullmatch("(mqtt|mysql):(provide|want|need)", each) for each in addon["services"])
    assert all(map(ELEMENT.fullmatch, elements(addon["schema"])))
    assert addon["version"] == __version__
    assert [int(part) for part in addon["homeassistant"].split(".")] >= [2026, 3]  # test_ingress.py
    assert read("repository.yaml").keys() <= {"name", "url", "maintainer"}


def test_each_option_is_known_to_the_program_and_has_a_name_in_english_and_german():
    addon = read("config.yaml")
    schema, options = addon["schema"], addon["options"]
    assert schema.keys() == AddonOptions.model_fields.keys()
    (microphone,) = schema["microphones"]
    assert microphone.keys() == MicrophoneOptions.model_fields.keys()
    needed = {key for key, kind in schema.items() if not str(kind).endswith("?")}
    assert options.keys() == needed
    assert AddonOptions.model_validate(options) == AddonOptions()
    for language in ("en", "de"):
        texts = read(f"translations/{language}.yaml")["configuration"]
        assert texts.keys() == schema.keys()
        assert texts["microphones"]["fields"].keys() == microphone.keys()
        for text in [*texts.values(), *texts["microphones"]["fields"].values()]:
            assert text["name"]
            assert text["description"]


class Supervisor(ThreadingHTTPServer):
    """A stand-in for the Supervisor's API that names a broker, if it has one."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Answers)
        self.broker = None
        self.paths = []

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_port}"


class _Answers(BaseHTTPRequestHandler):
    def do_GET(self):
        self.server.paths.append(self.path)
        broker, status = self.server.broker, 200
        answer = {"result": "ok", "data": broker}
        if self.headers["Authorization"] != f"Bearer {TOKEN}":
            answer, status = {"result": "error", "message": "forbidden"}, 403
        elif broker is None:
            answer, status = {"result": "error", "message": "Service not enabled"}, 400
        body = json.dumps(answer).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def supervisor():
    with Supervisor() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


class Addon:
    """The add-on's program and the folders that the Supervisor would mount."""

    def __init__(self, place, supervisor, env=None):
        self.folders = AddonFolders(place / "data", place / "config", place / "share")
        for folder in (self.folders.data, self.folders.config, self.folders.share):
            folder.mkdir()
        self.port = free_port()
        self._supervisor = supervisor
        env = {**os.environ, "TZ": "Europe/Vienna", "SUPERVISOR_TOKEN": TOKEN, **(env or {})}
        env.pop("HEARTHLOG_MODEL", None)
        self._env = env
        self._log = place / "log"

    def set(self, **options):
        content = read("config.yaml")["options"] | options
        (self.folders.data / "options.json").write_text(json.dumps(content))

    def command(self):
        code = (
            "from hearthlog.tools.service import addon\n"
            "addon._BROKER_SECONDS = 0.5\n"
            f"addon.INGRESS_PORT = {self.port}\n"
            "addon.main()\n"
        )
        return [sys.executable, "-c", code, *self.options()]

    def options(self):
        names = ("data", "config", "share")
        folders = [f"--{name}={getattr(self.folders, name)}" for name in names]
        return [*folders, f"--supervisor={self._supervisor.address}"]

    @contextmanager
    def running(self):
        with self._log.open("wb") as log:
            command = [*DIES_WITH_PARENT, *self.command()]
            self.process = subprocess.Popen(command, env=self._env, stdout=log, stderr=log)
        try:
            yield
            self.process.terminate()
            assert self.process.wait(timeout=60) == 0, self.log()
        finally:
            self.process.kill()
            self.process.wait()

    def log(self):
        return self._log.read_text()

    def wait_for_line(self, text):
        wait_for(lambda: text in self.log(), 60, self.log)

    def child(self, verb):
        """Return the process of a service, or 0."""
        found = ["pgrep", "-P", str(self.process.pid), "-f", f"main {verb} "]
        text = subprocess.run(found, capture_output=True, text=True, check=False).stdout.split()
        return int(text[0]) if text else 0

    def configuration(self):
        return tomllib.loads(self.folders.configuration.read_text("utf-8"))


@pytest.fixture
def addon(tmp_path, supervisor, labmic):
    return Addon(tmp_path, supervisor, labmic.env)


def refusal(addon, capfd):
    """Return the lines with which it ends before anything runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(addon_program.Addon, "run", lambda _: pytest.fail("it runs"))
        with pytest.raises(SystemExit) as end:
            addon_program.main(addon.options())
    assert end.value.code == 2
    return capfd.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"home": "My home"}, "home: .*'My home'"),
        ({"microphones": []}, "microphones: "),
        ({"microphones": [{"room": "Küche"}]}, "microphones.*room: .*cannot be a topic"),
        ({"microphones": [{"room": "a", "source": 'x" }'}]}, "source: .*ha audio info"),
        ({"microphones": [{"room": "a"}, {"room": "A"}]}, "options: two microphones have name 'a'"),
        ({"language": "xx"}, "language: "),
        ({"mqtt_host": "mqtt://a"}, "options: bridge.mqtt.host: "),
        ({"hidden_sounds": ["a", 3]}, "hidden_sounds"),
    ],
)
def test_a_wrong_option_is_one_line_and_nothing_is_written(
    tmp_path, supervisor, options, line, capfd
):
    addon = Addon(tmp_path, supervisor)
    addon.set(**options)
    lines = refusal(addon, capfd)
    assert len(lines) == 1, lines
    assert re.match(f"hearthlog: .*{line}", lines[0]), lines
    assert [path.name for path in addon.folders.data.iterdir()] == ["options.json"]


def test_options_and_a_file_of_further_keys_make_a_configuration(
    addon, supervisor, hearthlog, monkeypatch
):
    monkeypatch.delenv("HEARTHLOG_MODEL")
    supervisor.broker = {"host": "core-mosquitto", "port": 1883, "username": "addons"}
    supervisor.broker |= {"password": "secret", "ssl": False, "protocol": "3.1.1"}
    addon.set(
        home="villa",
        microphones=[{"room": "Living room"}, {"room": "bath", "source": "alsa_input.usb-a.mono"}],
        **dict.fromkeys(("keep_sound", "play_sound", "commands", "share_logs"), True),
        hidden_sounds=["music"],
        language="de",
    )
    own = 'quiet_hours = ["22:00-07:00"]\n[[bridge.alert]]\nname = "a"\nrule = "recorder_silent"\n'
    addon.folders.own_keys.write_text(own)
    with addon.running():
        wait_for((addon.folders.share / "hearthlog/logs").exists, 30, addon.log)
    found = addon.configuration()
    own = tomllib.loads(own)
    assert found["quiet_hours"] == own["quiet_hours"]
    assert found["bridge"]["alert"] == own["bridge"]["alert"]
    assert (found["node"], found["timezone"]) == ("villa", "Europe/Vienna")
    assert [each["name"] for each in found["microphone"]] == ["living_room", "bath"]
    assert (found["keep_audio"], found["never_tell"]) == ("unsure", ["music"])
    page = {"port": addon.port, "bind": "0.0.0.0", "ingress": "172.30.32.2"}
    assert found["bridge"]["page"] == page | {"sound": True, "language": "de"}
    password = addon.folders.data / "mqtt-password"
    assert (password.read_text(), password.stat().st_mode & 0o77) == ("secret\n", 0)
    assert found["bridge"]["mqtt"] == {
        "host": "core-mosquitto",
        "port": 1883,
        "user": "addons",
        "commands": True,
        "password_file": str(password),
    }
    assert 'device "alsa_input.usb-a.mono"' in (addon.folders.data / "home/.asoundrc").read_text()
    check = hearthlog("config", "check", addon.folders.configuration)
    assert check.returncode == 0, check.stderr


def test_a_wrong_key_of_the_own_file_is_named_with_its_line(tmp_path, supervisor, capfd):
    addon = Addon(tmp_path, supervisor)
    addon.set()
    addon.folders.own_keys.write_text("\nquiet_houers = []\n")
    lines = refusal(addon, capfd)
    assert len(lines) == 1, lines
    assert f"{addon.folders.own_keys}, line 2: unknown key 'quiet_houers'" in lines[0]


def test_it_records_without_a_broker_and_publishes_when_one_comes(addon, supervisor, broker):
    addon.set(microphones=[{"room": "kitchen"}])
    with addon.running(), Listener(broker.port) as listener:
        addon.wait_for_line("there is no MQTT broker; install the add-on Mosquitto broker")
        addon.wait_for_line(f"the page of the home: port {addon.port}, for the ingress")
        for fields in ({}, {"X-Forwarded-For": "172.30.32.2", "X-Ingress-Path": "/x"}):
            request = urllib.request.Request(f"http://127.0.0.1:{addon.port}/", headers=fields)
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(request, timeout=30)
        recorder = addon.child("record")
        supervisor.broker = {"host": "127.0.0.1", "port": broker.port}
        listener.wait_for("hearthlog/home/kitchen/listening", "online")
        listener.wait_for("hearthlog/home/kitchen/heard")
        assert addon.child("record") == recorder
        assert addon.log().count("there is no MQTT broker") == 1
        assert {*supervisor.paths} == {"/services/mqtt"}
        environment = Path(f"/proc/{recorder}/environ").read_bytes()
        assert TOKEN.encode() not in environment
    assert [*addon.folders.data.rglob("*.mcap")]
    assert not [*addon.folders.data.rglob("*.active")]


# Reports once that it is alive, and then does nothing, though its process is there.
HANGING = """
import os, pathlib, socket, time
with pathlib.Path("starts").open("a") as file:
    file.write("x")
connection = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
connection.sendto(b"READY=1\\nWATCHDOG=1", os.environ["NOTIFY_SOCKET"])
time.sleep(600)
"""


def test_a_service_that_hangs_or_is_killed_is_started_again(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(addon_program, "_HANG_SECONDS", 0.3)
    monkeypatch.setattr(addon_program, "_AGAIN_SECONDS", 0.0)
    folders = AddonFolders(tmp_path, tmp_path, tmp_path)
    service = addon_program.Service("recorder", [sys.executable, "-c", HANGING], folders, None)

    def starts_again(count):
        service.watch()
        if select.select([service.reports], [], [], 0)[0]:
            service.take_report()
        file = tmp_path / "starts"
        return file.exists() and len(file.read_text()) == count

    wait_for(lambda: starts_again(3), 60)
    service.end()
    service.wait(60)
    service.close()
    lines = capfd.readouterr().err.splitlines()
    assert "hearthlog: the recorder hangs; ending it" in lines
    assert "hearthlog: the recorder ended with signal 9; starting it again" in lines


def test_without_a_microphone_a_line_says_so_and_the_page_runs(tmp_path, supervisor):
    silent = tmp_path / "asound.conf"
    silent.write_text("</usr/share/alsa/alsa.conf>\n")
    addon = Addon(tmp_path, supervisor, {"ALSA_CONFIG_PATH": str(silent)})
    addon.set()
    with addon.running():
        addon.wait_for_line("no microphone found")
        addon.wait_for_line("the page of the home")
