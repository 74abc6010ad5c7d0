"""Questions of `hearthlog setup`: on the terminal, or answered by options."""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import typer

from hearthlog.schemas.errors import HearthlogError
from hearthlog.tools.cli.terminal import print_notice, wrong_use

if TYPE_CHECKING:
    from hearthlog.recorder.sources.capture import Device
    from hearthlog.tools.service.configuration_file import Broker

NONE = "none"
NETWORK = "yamnet"
# Questions, and the options that answer them.
_BROKER = "Publish to Home Assistant or another MQTT broker", "--mqtt HOST or --mqtt none"
_ALERTS = (
    "Send alerts, first of all when the recorder falls silent",
    "--alerts FILE or --alerts none",
)
_Value = TypeVar("_Value")


class SetupError(HearthlogError):
    """The machine lacks something that the recorder needs."""


@dataclass(frozen=True)
class Installation:
    """The place where a recorder is set up; `account` is None for a user's."""

    config: Path
    folder: Path
    account: str | None
    has_service: bool

    def unit(self, name: str) -> Path:
        """Return the path of a unit, of the distribution if nothing replaces it."""
        from hearthlog.tools.service import unit

        if self.account is None:
            return unit.user_units() / name
        return unit.system_unit_path(name)

    def is_running(self, name: str) -> bool:
        """Return whether a service runs now."""
        from hearthlog.tools.service import unit

        options = ["--user"] if self.account is None else []
        return self.has_service and self.unit(name).exists() and unit.is_active(name, *options)


class Questions:
    """Questions on the terminal, for what no option answers.

    The present configuration has the defaults of the answers; `secrets` has the contents of files
    for what was answered.
    """

    def __init__(self, installation: Installation, *, yes: bool) -> None:
        from hearthlog.analyzer.bridge.settings import load_bridge_settings

        self.installation = installation
        self.secrets: dict[Path, str] = {}
        file = installation.config if installation.config.exists() else None
        self.settings, self.bridge = load_bridge_settings(file)
        self.present = None if file is None else file.read_text("utf-8-sig")
        self._yes = yes
        self._is_terminal = sys.stdin.isatty() and sys.stderr.isatty()

    def _may_prompt(self, question: str, option: str) -> bool:
        """Return whether to ask; end with a line if the question cannot be asked."""
        if not self._yes and not self._is_terminal:
            wrong_use(f"{question}: there is no terminal to ask on; give {option}, or --yes")
        return not self._yes

    def _prompt(
        self,
        question: str,
        option: str,
        default: str,
        check: Callable[[str], _Value],
        given: str | None = None,
    ) -> _Value:
        """Check the given answer, or ask until one passes a check that raises HearthlogError."""
        if given is not None or not self._may_prompt(question, option):
            return _checked(option, default if given is None else given, check)
        while True:
            answer = typer.prompt(question, default=default, err=True)
            try:
                return check(answer.strip())
            except HearthlogError as error:
                print_notice(str(error))

    def confirm(self, question: str, option: str, *, default: bool) -> bool:
        """Ask a question for yes or no."""
        if not self._may_prompt(question, option):
            return default
        return typer.confirm(question, default=default, err=True)

    def microphones(self, given: list[str] | None) -> list[tuple[str, str]]:
        """Return devices and rooms, after hearing each device."""
        from hearthlog.recorder.sources.capture import Device
        from hearthlog.recorder.sources.process import query_devices
        from hearthlog.tools.service.unit import NAME

        configured = [(each.device, each.name) for each in self.settings.microphone]
        chosen = configured if self.present is not None else []
        ours = [device for device, _ in chosen] if self.installation.is_running(NAME) else []
        if given:
            chosen = [_device_and_room(text) for text in given]
        elif self._may_prompt("the microphone", "--microphone DEVICE=ROOM"):
            devices = query_devices()
            names = {name for each in devices for name in (each.identity, each.name)}
            # PortAudio does not list a device that the recorder uses.
            devices += [
                Device(-1, name, 1, 0.0, False) for name in ours if name not in {*names, ""}
            ]
            chosen = self._choose(devices, chosen)
        elif not chosen:
            chosen = [(_found(query_devices(), "").identity, configured[0][1])]
        for device, _ in chosen:
            if device not in ours:
                _check_level(device)
        return chosen

    def _choose(
        self, devices: "list[Device]", configured: list[tuple[str, str]]
    ) -> list[tuple[str, str]]:
        from hearthlog.tools.cli.live_display import choose_by_level

        default = _found(devices, "")
        rooms = {device or default.identity: room for device, room in configured}
        before = [
            row for row, each in enumerate(devices) if rooms.keys() & {each.identity, each.name}
        ]
        chosen = choose_by_level(devices, before or [devices.index(default)])
        pairs: list[tuple[str, str]] = []
        for row in chosen:
            device = devices[row]
            room = rooms.get(device.identity, "" if len(chosen) > 1 else "mic")

            def check(text: str) -> str:
                name = _room(text)
                if name in [other for _, other in pairs]:
                    raise SetupError(
                        f"{name}: is the room of another microphone; write another name"
                    )
                return name

            question = f"Room of {device.name}, such as kitchen"
            answer = self._prompt(question, "--microphone", room or "mic", check)
            pairs.append((device.identity, answer))
        return pairs

    def node(self, given: str | None) -> str:
        """Return the name of the home."""
        from hearthlog.schemas.logs.files import check_node_name

        default = self.settings.node
        return self._prompt("Name of the home", "--node", default, check_node_name, given)

    def timezone(self, given: str | None) -> str:
        """Return the time zone of the home."""
        from hearthlog.recorder.pause_schedule import check_time_zone

        default = self.settings.timezone
        return self._prompt("Time zone of the home", "--timezone", default, check_time_zone, given)

    def keep_sound(self, given: bool | None) -> bool:
        """Return whether clips of sound are kept."""
        if given is not None:
            return given
        question = (
            "Keep sound? Without it the logs have labels and features only. With it, also clips of "
            "sounds that the model is unsure of, never of speech, for 30 days, to listen to in a "
            "review"
        )
        option = "--keep-sound or --no-keep-sound"
        return self.confirm(question, option, default=self.settings.keep_audio != "off")

    def network(self, given: str | None) -> str:
        """Return what the configuration says of the network; it is downloaded later."""
        from hearthlog.analyzer.errors import missing
        from hearthlog.models.embedding.networks import YAMNET, find_network, missing_modules

        if given not in {None, NETWORK, NONE}:
            wrong_use(f"--network {given}: is neither {NETWORK} nor {NONE}")
        absent = missing_modules(YAMNET.suffix)
        if given == NETWORK and absent:
            raise SetupError(f"--network {NETWORK}: {missing(*absent)}")
        if given is not None:
            return given if given == NETWORK or find_network(NETWORK) else ""
        now = self.settings.embedding
        if now or find_network(NETWORK):
            return now
        if not self._may_prompt("the network", f"--network {NETWORK} or --network {NONE}"):
            return now
        if absent:
            print_notice(
                f"a network would make labels more accurate; {missing(*absent)}; then setup"
            )
            return now
        file = YAMNET.files[0]
        host = file.url.split("/")[2]
        question = (
            f"Download the network {NETWORK}, {file.size / 1e6:.0f} MB from {host}? "
            "In homes unknown to the model it doubles the accuracy (macro F1 0.70, without it 0.36)"
        )
        return NETWORK if self.confirm(question, "--network", default=False) else now

    def page(self, given: bool | None, port: int | None) -> int | None:
        """Return the port of the page; None without a page."""
        from hearthlog.analyzer.errors import DataError
        from hearthlog.analyzer.http import free_port
        from hearthlog.tools.service.configuration_file import PAGE_PORT
        from hearthlog.tools.service.unit import BRIDGE_NAME

        now = self.bridge.page
        if given is None:
            given = self.confirm(
                "Serve a page of the home, for a browser on this machine",
                "--page or --no-page",
                default=now is not None,
            )
        if not given:
            return None
        before = PAGE_PORT if now is None else now.port
        bind = "127.0.0.1" if now is None else now.bind
        is_own = now is not None and self.installation.is_running(BRIDGE_NAME)

        def check(text: str) -> int:
            if not text.isdecimal() or not 0 < int(text) <= 65_535:
                raise SetupError(f"{text}: is no port; write a number such as {PAGE_PORT}")
            try:
                return int(text) if is_own and int(text) == before else free_port(int(text), bind)
            except DataError as error:
                raise SetupError(
                    f"port {text} is used by another program; choose another one for the page, "
                    "with --page-port"
                ) from error

        if port is not None:
            return _checked("--page-port", str(port), check)
        try:
            return check(str(before))
        except SetupError as error:
            if not self._may_prompt(str(error), "--page-port"):
                raise
            return self._prompt(str(error), "--page-port", str(before + 1), check)

    def broker(
        self, given: str | None, user: str | None, password_file: Path | None
    ) -> "Broker | None":
        """Return the MQTT broker; None without one."""
        from hearthlog.analyzer.errors import require
        from hearthlog.tools.service.configuration_file import Broker, secret_file

        now = self.bridge.mqtt
        if given == NONE or (given is None and not self.confirm(*_BROKER, default=now is not None)):
            return None
        require("paho")
        file = secret_file(self.installation.config, "mqtt-password")
        old = None if now is None else now.password_file
        if given is not None:
            host = _checked("--mqtt", given, _host)
            user = user if user is not None else "" if now is None else now.user
            if password_file is not None:
                self.secrets[file] = _secret(password_file)
                old = file
            return Broker(host, user, old if user else None)
        host = self._prompt(
            "Broker, such as homeassistant.local", "--mqtt", now.host if now else "", _host
        )
        user = self._prompt(
            "User at the broker, empty for none", "--mqtt-user", now.user if now else "", str
        )
        if not user:
            return Broker(host)
        if self._yes:
            return Broker(host, user, old)
        hint = "Password (not shown)" if old is None else "Password (not shown; empty: as before)"
        password = typer.prompt(hint, default="", hide_input=True, show_default=False, err=True)
        if password:
            self.secrets[file] = f"{password}\n"
            old = file
        return Broker(host, user, old)

    def alerts(self, given: str | None) -> Path | None:
        """Return the file of addresses for alerts; None without alerts."""
        from hearthlog.analyzer.errors import require
        from hearthlog.tools.service.configuration_file import secret_file

        now = self.bridge.delivery.urls_file
        file = secret_file(self.installation.config, "alert-urls")
        if given == NONE or (given is None and not self.confirm(*_ALERTS, default=now is not None)):
            return None
        require("apprise")
        if given is not None:
            self.secrets[file] = _alert_urls(_secret(Path(given)))
        elif now is not None:
            return now
        else:
            question = "Address for alerts, such as ntfy://ntfy.sh/a-topic-of-yours (Apprise)"
            self.secrets[file] = self._prompt(question, "--alerts", "", _alert_urls)
        return file


def _checked(option: str, text: str, check: Callable[[str], _Value]) -> _Value:
    try:
        return check(text)
    except HearthlogError as error:
        wrong_use(f"{option}: {error}")


def _found(devices: "list[Device]", name: str) -> "Device":
    """Find a device; the error for a missing one names what uses the microphones."""
    from hearthlog.recorder.sources.capture import closed_card, find_device
    from hearthlog.schemas.errors import DeviceError
    from hearthlog.tools.cli.live_display import users_of_microphones

    try:
        return find_device(devices, name)
    except DeviceError as error:
        users = users_of_microphones()
        if not users and not closed_card():
            users = ["one that another program uses is not listed"]
        hints = "".join(f"; {each}, end that program" for each in users)
        raise DeviceError(f"{error}{hints}") from error


def _device_and_room(text: str) -> tuple[str, str]:
    device, equals, room = text.rpartition("=")
    if not equals:
        wrong_use(
            f"--microphone {text}: is not DEVICE=ROOM, such as 'USB PnP Sound Device=kitchen'"
        )
    return device, _checked("--microphone", room, _room)


def _room(text: str) -> str:
    from hearthlog.schemas.messages.topics import check_microphone_name

    return check_microphone_name(re.sub(r"[\s-]+", "_", text.strip().lower()))


def _check_level(device: str) -> None:
    from hearthlog.recorder.addresses import is_address
    from hearthlog.recorder.sources.process import query_devices
    from hearthlog.tools.cli.live_display import show_level

    if not is_address(device):
        _found(query_devices(), device)
        show_level(device)


def _host(text: str) -> str:
    from pydantic import ValidationError

    from hearthlog.analyzer.bridge.settings import MqttSettings

    try:
        return MqttSettings(host=text).host
    except ValidationError as error:
        raise SetupError(error.errors()[0]["msg"].removeprefix("Value error, ")) from error


def _secret(file: Path) -> str:
    try:
        text = file.read_text("utf-8")
    except UnicodeDecodeError as error:
        raise SetupError(f"{file}: is not text") from error
    if not text.strip():
        raise SetupError(f"{file}: is empty")
    return text


def _alert_urls(text: str) -> str:
    from apprise import Apprise

    for line in filter(None, map(str.strip, text.splitlines())):
        if not line.startswith("#") and not Apprise().add(line):
            raise SetupError("an address for alerts is none of Apprise's; see docs/alerts.md")
    return f"{text.strip()}\n"
