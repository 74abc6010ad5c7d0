"""Start of the Home Assistant add-on: recorder and bridge as its services.

The image runs it as root, because only root reads the options; recorder and bridge run as another
account. A service that ends, or hangs, is started again, and the other one goes on.
"""

import argparse
import json
import os
import pwd
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import tomlkit
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from tomlkit.exceptions import TOMLKitError

from hearthlog.analyzer.bridge.settings import load_bridge_settings
from hearthlog.recorder.config_problems import Origins, configuration_error
from hearthlog.recorder.host import module_command
from hearthlog.recorder.pause_schedule import machine_zone
from hearthlog.schemas.errors import ConfigurationError, HearthlogError, printable
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.logs.files import check_node_name
from hearthlog.schemas.messages.topics import check_microphone_name
from hearthlog.schemas.new_files import make_folders
from hearthlog.tools.service.configuration_file import written_files

INGRESS = "172.30.32.2"  # the only address that the Supervisor's ingress connects from
INGRESS_PORT = 8099
_SECONDS = 10.0
_MOST_BYTES = 1 << 20
_SOURCE = re.compile(r"[\w.:+-]{0,200}", re.ASCII)


def _home(name: str) -> str:
    return _raises_value_error(check_node_name, name.strip())


def _room(name: str) -> str:
    return _raises_value_error(check_microphone_name, re.sub(r"[\s-]+", "_", name.strip().lower()))


def _source(name: str) -> str:
    if not _SOURCE.fullmatch(name):
        raise ValueError("is no name of an input; `ha audio info` lists them")
    return name


def _raises_value_error(check: Any, text: str) -> str:
    try:
        return str(check(text))
    except HearthlogError as error:
        raise ValueError(str(error)) from error


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MicrophoneOptions(_Options):
    """A microphone: its room, and its name at the audio server of Home Assistant."""

    room: Annotated[str, AfterValidator(_room)]
    source: Annotated[str, AfterValidator(_source)] = ""


class AddonOptions(_Options):
    """The options of the add-on; `tools/home-assistant/config.yaml` has their defaults."""

    home: Annotated[str, AfterValidator(_home)] = "home"
    microphones: list[MicrophoneOptions] = Field(
        default=[MicrophoneOptions(room="mic")], min_length=1
    )
    keep_sound: bool = False
    play_sound: bool = False
    hidden_sounds: list[str] = []
    language: Literal["auto", "de", "en"] = "auto"
    commands: bool = False
    share_logs: bool = False
    mqtt_host: str = ""
    mqtt_port: int | None = None
    mqtt_user: str = ""
    mqtt_password: str = Field(default="", repr=False)


@dataclass(frozen=True)
class AddonFolders:
    """Folders that the Supervisor mounts."""

    data: Path  # of the add-on alone; the restoration of a backup empties it
    config: Path  # of the add-on, for files of the user
    share: Path  # of the whole home, which no backup of the add-on touches

    @property
    def configuration(self) -> Path:
        """The configuration, written at each start."""
        return self.data / "hearthlog.toml"

    @property
    def own_keys(self) -> Path:
        """The user's file of further keys, which need not exist."""
        return self.config / "hearthlog.toml"

    @property
    def state(self) -> Path:
        """The state of the bridge."""
        return self.data / "bridge"

    def logs(self, options: AddonOptions) -> Path:
        """Return the folder of the logs."""
        return (self.share / "hearthlog" if options.share_logs else self.data) / "logs"


@dataclass(frozen=True)
class AddonBroker:
    """An MQTT broker; the password is a secret."""

    host: str
    port: int
    user: str
    password: str
    tls: bool = False


class BrokerError(HearthlogError):
    """There is no broker."""


def read_options(file: Path) -> AddonOptions:
    """Read the Supervisor's options; raise `ConfigurationError` with a line for each wrong one."""
    data = read_limited(file, "file of options", _MOST_BYTES, ConfigurationError)
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{file}: is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise ConfigurationError(f"{file}: has no options; it is not a JSON object")
    given = {key: value for key, value in content.items() if value is not None}
    try:
        return AddonOptions.model_validate(given)
    except ValidationError as error:
        origins = Origins({}, given, file, {})
        raise configuration_error(error, origins, AddonOptions) from error


def find_broker(options: AddonOptions, supervisor: str, token: str) -> AddonBroker:
    """Return the broker of the options, or else the one that the Supervisor knows.

    `supervisor` is the address of its API. Raise `BrokerError` if there is none, with the reason.
    """
    if options.mqtt_host:
        port = options.mqtt_port or 1883
        return AddonBroker(options.mqtt_host, port, options.mqtt_user, options.mqtt_password)
    request = Request(  # noqa: S310  the address is our own
        f"{supervisor}/services/mqtt", headers={"Authorization": f"Bearer {token}"}
    )
    try:
        with urlopen(request, timeout=_SECONDS) as answer:  # noqa: S310
            found = json.loads(answer.read(_MOST_BYTES))["data"]
        return AddonBroker(
            str(found["host"]),
            int(found["port"]),
            str(found.get("username") or ""),
            str(found.get("password") or ""),
            bool(found.get("ssl")),
        )
    except HTTPError as error:
        if error.code == 400:  # the answer where no add-on provides a broker
            raise BrokerError("there is no MQTT broker; install the add-on Mosquitto broker") from (
                error
            )
        raise BrokerError(
            f"the Supervisor does not name its MQTT broker (status {error.code})"
        ) from error
    except (OSError, HTTPException, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = printable(str(getattr(error, "reason", None) or error))
        raise BrokerError(f"the Supervisor does not name its MQTT broker ({reason})") from error


def write_configuration(
    options: AddonOptions, broker: AddonBroker | None, folders: AddonFolders, account: str | None
) -> None:
    """Write the configuration, the broker's password, and the definitions of the inputs.

    `account` runs the services; None for this one. Raise `ConfigurationError` if the user's file or
    a value is wrong; the files are then as before.
    """
    own = folders.own_keys
    text = ""
    if own.exists():
        load_bridge_settings(own)  # names the lines of that file
        text = own.read_text("utf-8-sig")
    try:
        content = tomlkit.parse(text)
        password = folders.data / "mqtt-password"
        _fill(content, options, broker, password, folders)
        new = tomlkit.dumps(content)
    except (TOMLKitError, TypeError, AttributeError) as error:
        raise ConfigurationError(f"{own}: cannot be combined with the options ({error})") from error
    secrets = {folders.data / "home" / ".asoundrc": _inputs(options)}
    if broker is not None and broker.password:
        secrets[password] = f"{broker.password}\n"
    with written_files(folders.configuration, new, secrets, account):
        try:
            load_bridge_settings(folders.configuration)
        except ConfigurationError as error:  # the user's file was right by itself
            place = re.compile(rf"{re.escape(str(folders.configuration))}(, line \d+)?: ")
            raise ConfigurationError(*(place.sub("options: ", each) for each in error.lines)) from (
                error
            )


def _fill(
    content: Any,
    options: AddonOptions,
    broker: AddonBroker | None,
    password: Path,
    folders: AddonFolders,
) -> None:
    """Set the keys of a configuration; those that the options say nothing of stay."""
    content["node"] = options.home
    content["output"] = str(folders.logs(options))
    content.setdefault("timezone", machine_zone())
    if options.keep_sound:
        content["keep_audio"] = "unsure"
    if options.hidden_sounds:
        content["never_tell"] = options.hidden_sounds
    microphones = tomlkit.aot()
    for each in options.microphones:
        table = tomlkit.table()
        table["name"] = each.room
        if each.source:
            table["device"] = _input_name(each.room)
        microphones.append(table)
    content["microphone"] = microphones
    bridge = content.setdefault("bridge", tomlkit.table())
    bridge["state"] = str(folders.state)
    page = bridge.setdefault("page", tomlkit.table())
    page |= {"port": INGRESS_PORT, "bind": "0.0.0.0", "ingress": INGRESS}  # noqa: S104
    if options.play_sound:
        page["sound"] = True
    if options.language != "auto":
        page["language"] = options.language
    if broker is not None:
        bridge.setdefault("mqtt", tomlkit.table()).update(_mqtt(options, broker, password))


def _mqtt(options: AddonOptions, broker: AddonBroker, password: Path) -> dict[str, Any]:
    keys: dict[str, Any] = {
        "host": broker.host,
        "port": broker.port,
        "commands": options.commands,
    }
    if broker.user:
        keys["user"] = broker.user
        if broker.password:
            keys["password_file"] = str(password)
    if broker.tls:
        keys["tls"] = True
    return keys


def _inputs(options: AddonOptions) -> str:
    """Return ALSA's definitions of inputs of the audio server other than its default."""
    return "".join(
        f"pcm.{_input_name(each.room)} {{\n"
        f'    type pulse\n    device "{each.source}"\n'
        f'    hint {{ show on description "{each.room}" }}\n}}\n'
        for each in options.microphones
        if each.source
    )


def _input_name(room: str) -> str:
    return f"hearthlog_{room}"


_AGAIN_SECONDS = 5.0
_BROKER_SECONDS = 60.0
_HANG_SECONDS = 120.0  # as WatchdogSec of the unit of systemd
_END_SECONDS = 80.0  # less than `timeout` of the add-on
_GAPS = 3  # status of a recorder that ended well, with gaps in its log


class Service:
    """A process that is started again when it ends, or when it has stopped reporting.

    Without `account`, this account runs it.
    """

    def __init__(
        self, name: str, command: Sequence[str], folders: AddonFolders, account: str | None
    ) -> None:
        self._name, self._command, self._account = name, command, account
        self._folder = folders.data
        address = folders.data / f".{name}.notify"
        address.unlink(missing_ok=True)
        self.reports = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self.reports.bind(str(address))
        address.chmod(0o600)
        if account is not None:
            shutil.chown(address, account, account)
        self._environment = os.environ | {
            "HOME": str(folders.data / "home"),
            "NOTIFY_SOCKET": str(address),
            "WATCHDOG_USEC": str(int(_HANG_SECONDS * 1e6)),
        }
        self._environment.pop("SUPERVISOR_TOKEN", None)  # it opens the Supervisor's API
        self._environment.pop("HASSIO_TOKEN", None)
        self._process: subprocess.Popen[bytes] | None = None
        self._due = 0.0  # of the next start, by CLOCK_MONOTONIC
        self._reported: float | None = None

    def watch(self) -> None:
        """Start the process if it is due, and end it if it hangs."""
        now = time.monotonic()
        if self._process is None:
            if now >= self._due:
                self._start()
            return
        status = self._process.poll()
        if status is not None:
            self._process = None
            self._due = now + _AGAIN_SECONDS
            if status not in {0, _GAPS}:
                how = f"signal {-status}" if status < 0 else f"status {status}"
                _announce(f"the {self._name} ended with {how}; starting it again")
        elif self._reported is not None and now - self._reported > _HANG_SECONDS:
            _announce(f"the {self._name} hangs; ending it")
            self._process.kill()

    def take_report(self) -> None:
        """Note that the process is alive, if it says so."""
        if b"WATCHDOG=1" in self.reports.recv(1 << 14).split(b"\n"):
            self._reported = time.monotonic()

    def restart(self) -> None:
        """End the process, which is then started again without a pause."""
        self.end()
        self.wait(_END_SECONDS)
        self._process, self._due = None, 0.0

    def end(self) -> None:
        """Ask the process to end."""
        if self._process is not None:
            self._process.terminate()

    def wait(self, seconds: float) -> None:
        """Wait for the end of the process, and force it if that takes too long."""
        if self._process is None:
            return
        try:
            self._process.wait(max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def close(self) -> None:
        """Stop listening to the process."""
        self.reports.close()

    def _start(self) -> None:
        self._reported = None
        person = None if self._account is None else pwd.getpwnam(self._account)
        groups = None if person is None else os.getgrouplist(person.pw_name, person.pw_gid)
        self._process = subprocess.Popen(  # noqa: S603
            self._command,
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            user=None if person is None else person.pw_uid,
            group=None if person is None else person.pw_gid,
            extra_groups=groups,
            umask=0o077,
        )


class Addon:
    """The add-on while it runs: its services, and the broker, which may come later."""

    def __init__(
        self, options: AddonOptions, folders: AddonFolders, account: str | None, supervisor: str
    ) -> None:
        self._options, self._folders, self._account = options, folders, account
        self._supervisor = supervisor
        self._token = os.environ.get("SUPERVISOR_TOKEN", "")
        self._broker_problem = ""
        self._broker_due = 0.0
        self._is_ended = False
        self._broker, problem = self._found_broker()
        write_configuration(options, self._broker, folders, account)
        self._report(problem)
        _make_folders(options, folders, account)
        config = ["--config", str(folders.configuration)]
        program = module_command("hearthlog.tools.cli.main")
        self._recorder = Service("recorder", [*program, "record", *config], folders, account)
        self._bridge = Service("bridge", [*program, "bridge", *config], folders, account)

    def run(self) -> None:
        """Run the services until SIGTERM or SIGINT."""
        services = self._recorder, self._bridge
        by_socket = {each.reports: each for each in services}
        for each in (signal.SIGTERM, signal.SIGINT):
            signal.signal(each, self._end)
        while not self._is_ended:
            for service in services:
                service.watch()
            if self._broker is None and time.monotonic() >= self._broker_due:
                self._take_broker()
            for ready in select.select([*by_socket], [], [], 0.5)[0]:
                by_socket[ready].take_report()
        until = time.monotonic() + _END_SECONDS
        for service in services:
            service.end()
        for service in services:
            service.wait(until - time.monotonic())
            service.close()

    def _end(self, _number: int, _frame: FrameType | None) -> None:
        self._is_ended = True

    def _found_broker(self) -> tuple[AddonBroker | None, str]:
        """Return the broker, or None and the reason."""
        self._broker_due = time.monotonic() + _BROKER_SECONDS
        try:
            return find_broker(self._options, self._supervisor, self._token), ""
        except BrokerError as error:
            return None, str(error)

    def _report(self, problem: str) -> None:
        """Print a problem of the broker when it is new."""
        if problem and problem != self._broker_problem:
            _announce(f"{problem}; the recorder and the page run without it")
        self._broker_problem = problem

    def _take_broker(self) -> None:
        """Restart the bridge with a broker that has been installed meanwhile."""
        broker, problem = self._found_broker()
        self._report(problem)
        if broker is None:
            return
        try:
            write_configuration(self._options, broker, self._folders, self._account)
        except HearthlogError as error:
            self._report(str(error))
            return
        self._broker = broker
        _announce(f"the MQTT broker is {broker.host}")
        self._bridge.restart()


def _make_folders(options: AddonOptions, folders: AddonFolders, account: str | None) -> None:
    """Make the folders that the services write to, also where a backup changed their owner."""
    for folder in (folders.logs(options), folders.state, folders.data / "home"):
        make_folders(folder, 0o755 if folder.is_relative_to(folders.share) else 0o700)
        if account is None:
            continue
        owner = pwd.getpwnam(account)
        if folder.stat().st_uid != owner.pw_uid:
            for path in (folder, *folder.rglob("*")):
                os.chown(path, owner.pw_uid, owner.pw_gid, follow_symlinks=False)


def _announce(text: str) -> None:
    print(f"hearthlog: {text}", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the add-on; end with status 2 and a line for each wrong option."""
    parser = argparse.ArgumentParser("hearthlog.tools.service.addon", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("/data"))
    parser.add_argument("--config", type=Path, default=Path("/config"))
    parser.add_argument("--share", type=Path, default=Path("/share"))
    parser.add_argument("--supervisor", default="http://supervisor")
    parser.add_argument("--account", help="account of the recorder and the bridge")
    given = parser.parse_args(arguments)
    try:
        options = read_options(given.data / "options.json")
        folders = AddonFolders(given.data, given.config, given.share)
        Addon(options, folders, given.account, given.supervisor).run()
    except ConfigurationError as error:
        for line in error.lines:
            _announce(line)
        sys.exit(error.status)
    except (HearthlogError, OSError) as error:
        _announce(str(error))
        sys.exit(1)


if __name__ == "__main__":
    main()
