"""A Home Assistant beside the tests, a broker that it listens to, and a home that is recorded."""

import asyncio
import json
import os
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import aiohttp
import numpy as np
import pytest
import soundfile
from conftest import HEARTHLOG
from microphones import DIES_WITH_PARENT
from waiting import wait_for

from hearthlog.analyzer.http import free_port

_ROOT = Path(__file__).parents[1]
_VERSIONS = _ROOT / "build" / "home-assistant"
_CLIPS = _ROOT / "tests" / "data" / "household"
_BLUEPRINTS = _ROOT / "examples" / "home-assistant"
_RATE = 16_000
_CONFIGURATION = """\
homeassistant:
  name: a home
  latitude: 48.2
  longitude: 16.37
  elevation: 170
  unit_system: metric
  time_zone: Europe/Vienna
  country: AT
http:
  server_host: 127.0.0.1
  server_port: {port}
api:
config:
onboarding:
device_automation:
persistent_notification:
recorder:
history:
automation: !include automations.yaml
"""


def versions():
    """List the versions of Home Assistant that are here; one that is not, if there is none."""
    return sorted(path.name for path in _VERSIONS.glob("2*")) or ["any"]


def hass_of(version):
    """Return the command of a Home Assistant."""
    command = _VERSIONS / version / "bin" / "hass"
    if not command.exists():
        if os.environ.get("TESTS_REQUIRE_HOME_ASSISTANT"):
            pytest.fail("no Home Assistant: run .ci/home-assistant")
        pytest.skip("needs a Home Assistant: .ci/home-assistant")
    return command


def end(process, number=signal.SIGTERM, seconds=120):
    """End a process, and return its status."""
    process.send_signal(number)
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise


class HomeAssistant:
    """A Home Assistant on loopback, with an owner, and the blueprints of the examples."""

    def __init__(self, hass, folder):
        self.folder, self._hass, self.version = folder, hass, hass.parents[1].name
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._me = self.url + "/"
        self._refresh, self._token, self._until = "", "", 0.0
        self._process = None
        blueprints = folder / "blueprints" / "automation" / "hearthlog"
        blueprints.mkdir(parents=True)
        for path in _BLUEPRINTS.glob("*.yaml"):
            shutil.copy(path, blueprints)
        (folder / "configuration.yaml").write_text(_CONFIGURATION.format(port=self.port))
        (folder / "automations.yaml").write_text("[]\n")
        self._fix_address()

    def _fix_address(self):
        """Say the address where 2026.11 looks for it: that of YAML it only tries.

        After five minutes in which nobody confirms it, it would listen on all addresses.
        """
        address = {
            "server_host": ["127.0.0.1"],
            "server_port": self.port,
            "cors_allowed_origins": [],
            "login_attempts_threshold": -1,
            "ip_ban_enabled": True,
            "ssl_profile": "modern_v6",
            "use_x_frame_options": True,
            "created_at": "2026-01-01T00:00:00+00:00",
            "error": None,
            "error_message": None,
        }
        data = {"stable": address, "pending": None, "yaml_migration_done": True}
        stored = {"version": 3, "minor_version": 1, "key": "http", "data": data}
        place = self.folder / ".storage"
        place.mkdir()
        (place / "http").write_text(json.dumps(stored))

    @property
    def log(self):
        """What it has said."""
        return (self.folder / "said").read_text(errors="replace")

    def start(self):
        """Start it, and wait until it answers."""
        with (self.folder / "said").open("a") as output:
            self._process = subprocess.Popen(
                [*DIES_WITH_PARENT, self._hass, "-c", self.folder, "--skip-pip"],
                stdout=output,
                stderr=output,
            )
        wait_for(self._answers, 120)
        if not self._refresh:
            self._make_owner()
        wait_for(lambda: self.call("/api/config")["state"] == "RUNNING", 120)
        assert self.addresses() == {"127.0.0.1"}

    def stop(self):
        """End it, if it runs."""
        if self._process is not None and self._process.poll() is None:
            end(self._process, seconds=60)

    def addresses(self):
        """Return the addresses of this machine at which it waits for connections."""
        sockets = set()
        for path in Path(f"/proc/{self._process.pid}/fd").iterdir():
            with suppress(OSError):
                sockets.add(path.readlink().name.removeprefix("socket:[").removesuffix("]"))
        found = set()
        for table in ("tcp", "tcp6"):
            for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
                words = line.split()
                if words[3] == "0A" and words[9] in sockets:
                    place = bytes.fromhex(words[1].split(":")[0])
                    is_v4 = len(place) == 4
                    found.add(".".join(map(str, place[::-1])) if is_v4 else words[1])
        return found

    def connect(self, port):
        """Set up MQTT, as a person does in the settings."""
        flows = "/api/config/config_entries/flow"
        flow = self.call(flows, {"handler": "mqtt"})
        if flow.get("menu_options"):
            flow = self.call(f"{flows}/{flow['flow_id']}", {"next_step_id": "broker"})
        answer = {"broker": "127.0.0.1", "port": port}
        if any(field["name"] == "other_settings" for field in flow["data_schema"]):
            answer["other_settings"] = {"set_client_cert": False, "set_ca_cert": "off"}
        done = self.call(f"{flows}/{flow['flow_id']}", answer)
        assert done["type"] == "create_entry", done

    def states(self):
        """Return the entities of hearthlog: their state and attributes, by name."""
        return {
            each["entity_id"]: each
            for each in self.call("/api/states")
            if "hearthlog_home_mic" in each["entity_id"]
        }

    def state(self, entity):
        """Return the state of an entity; None if there is none."""
        found = self.states().get(entity)
        return None if found is None else found["state"]

    def any_state(self, entity):
        """Return the state of an entity of any device; None if there is none."""
        states = {each["entity_id"]: each["state"] for each in self.call("/api/states")}
        return states.get(entity)

    def act(self, domain, action, entity):
        """Call an action on an entity, as a button on a dashboard does."""
        self.call(f"/api/services/{domain}/{action}", {"entity_id": entity})

    def automate(self, name, **content):
        """Add an automation, as the editor does, and wait until it waits for its triggers."""
        content = {"alias": name, "id": name, "mode": "queued", **content}
        self.call(f"/api/config/automation/config/{name}", content)
        wait_for(lambda: self._automation_state(name) == "on", 10)

    def forget(self, name):
        """Remove an automation."""
        self.call(f"/api/config/automation/config/{name}", method="DELETE")

    def _automation_state(self, name):
        for each in self.call("/api/states"):
            if each["attributes"].get("id") == name:
                return each["state"]
        return None

    def query(self, **command):
        """Give a command of the WebSocket API, and return its result."""
        return asyncio.run(self._query(command))

    async def _query(self, command):
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{self.url}/api/websocket", max_msg_size=0) as socket_,
        ):
            await socket_.receive_json()
            await socket_.send_json({"type": "auth", "access_token": self._access()})
            assert (await socket_.receive_json())["type"] == "auth_ok"
            await socket_.send_json({"id": 1, **command})
            answer = await socket_.receive_json()
        assert answer["success"], answer
        return answer["result"]

    def call(self, path, data=None, *, method=None):
        """Call the REST API."""
        return self._request(path, data, self._access(), method)

    def _request(self, path, data=None, token="", method=None, *, form=False):
        head = {"Authorization": f"Bearer {token}"} if token else {}
        body = None
        if form:
            body = urllib.parse.urlencode(data).encode()
        elif data is not None:
            body = json.dumps(data).encode()
            head["Content-Type"] = "application/json"
        request = urllib.request.Request(self.url + path, body, head, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.loads(answer.read())
        except urllib.error.HTTPError as error:
            text = error.read().decode()
            error.close()
            raise AssertionError(f"{path}: {error.code} {text}") from None

    def _answers(self):
        assert self._process.poll() is None, self.log
        try:
            return self._request("/api/onboarding")
        except (OSError, AssertionError):
            return None

    def _make_owner(self):
        person = {"name": "lab", "username": "lab", "password": "lab-lab-lab", "language": "en"}
        made = self._request("/api/onboarding/users", {"client_id": self._me, **person})
        wanted = {"grant_type": "authorization_code", "code": made["auth_code"]}
        tokens = self._request("/auth/token", {"client_id": self._me, **wanted}, form=True)
        self._refresh = tokens["refresh_token"]

    def _access(self):
        if time.monotonic() > self._until:
            wanted = {"grant_type": "refresh_token", "refresh_token": self._refresh}
            tokens = self._request("/auth/token", {"client_id": self._me, **wanted}, form=True)
            self._token, self._until = tokens["access_token"], time.monotonic() + 600
        return self._token


class Household:
    """A home that is recorded, and a bridge that tells a broker of it."""

    def __init__(self, folder, port):
        self.folder = folder
        folder.mkdir()
        self._write_sound()
        self.recorder = self.bridge = None
        self.configuration = folder / "home.toml"
        self.configuration.write_text(
            f'node = "home"\noutput = "{folder / "logs"}"\ntimezone = "Europe/Vienna"\n'
            f'[bridge.mqtt]\nhost = "127.0.0.1"\nport = {port}\n'
            "commands = true\n"
        )

    def _write_sound(self):
        """Write an hour in which somebody coughs every half minute."""
        noise = np.random.default_rng(1).normal(0, 1e-4, 30 * _RATE).astype(np.float32)
        clips = [f"coughing/coughing_{number}.flac" for number in ("006", "017", "059")]
        at = 5 * _RATE
        for clip in clips:
            samples, rate = soundfile.read(_CLIPS / clip, dtype="float32")
            assert rate == _RATE
            noise[at : at + len(samples)] += samples
            at += len(samples)
        soundfile.write(self.folder / "home.flac", np.tile(noise, 120), _RATE)

    def record(self, model="general"):
        """Start the recorder: it hears the hour, from now on."""
        start = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        sound = self.folder / "home.flac"
        self.recorder = self._start(
            "record", sound, "--realtime", "--start", start, "--model", model
        )

    def listen(self, microphone):
        """Start the recorder: it hears a virtual microphone."""
        samples, _ = soundfile.read(self.folder / "home.flac", 60 * _RATE, dtype="int16")
        microphone.configure(data=samples)
        arguments = "--device", microphone.device, "--model", "general"
        self.recorder = self._start("record", *arguments, env=microphone.env)

    def start_bridge(self):
        """Start the bridge."""
        self.bridge = self._start("bridge")

    def _start(self, verb, *arguments, **options):
        command = [*DIES_WITH_PARENT, *HEARTHLOG, verb, *arguments, "--config", self.configuration]
        with (self.folder / f"said-{verb}").open("a") as output:
            return subprocess.Popen(
                list(map(str, command)), stdout=output, stderr=output, **options
            )

    def close(self):
        """End both, if they run."""
        for process in (self.bridge, self.recorder):
            if process is not None and process.poll() is None:
                end(process)
