"""`hearthlog setup`: questions that lead from an installation to a running recorder."""

import os
import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from hearthlog.schemas.errors import HearthlogError
from hearthlog.tools.cli.terminal import print_lines, print_notice, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.bridge.settings import BridgeSettings
    from hearthlog.recorder.config import Settings
    from hearthlog.recorder.sources.capture import Device
    from hearthlog.tools.service.configuration_file import Answers, Broker

_NONE = "none"
_NETWORK = "yamnet"
_ACCOUNT = "hearthlog"
_LEAST_FREE = 100_000_000  # bytes beside what the configuration keeps free: ten hours of logs
_LABEL_SECONDS = 120.0
_Value = TypeVar("_Value")


class _SetupError(HearthlogError):
    """The machine lacks something that the recorder needs."""


def setup(
    *,
    microphone: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DEVICE=ROOM",
            help="Device (see `hearthlog devices`; empty: the default) and its room; repeatable.",
        ),
    ] = None,
    node: Annotated[str | None, typer.Option(help="Name of the home.")] = None,
    timezone: Annotated[str | None, typer.Option(help="Time zone of the home.")] = None,
    keep_sound: Annotated[
        bool | None,
        typer.Option(
            "--keep-sound/--no-keep-sound", help="Keep clips of sounds that the model is unsure of."
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            metavar="yamnet|none", help="Network for better labels, downloaded if absent."
        ),
    ] = None,
    page: Annotated[
        bool | None, typer.Option("--page/--no-page", help="Serve a page of the home.")
    ] = None,
    page_port: Annotated[
        int | None, typer.Option(min=1, max=65_535, help="Port of the page.", show_default="8380")
    ] = None,
    mqtt: Annotated[
        str | None,
        typer.Option(metavar="HOST|none", help="MQTT broker, such as that of Home Assistant."),
    ] = None,
    mqtt_user: Annotated[str | None, typer.Option(help="User at the broker.")] = None,
    mqtt_password_file: Annotated[
        Path | None, typer.Option(help="File with the password of that user, which is copied.")
    ] = None,
    alerts: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|none", help="File with Apprise addresses for alerts, which is copied."
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Configuration to write or to change.",
            show_default="/etc/hearthlog.toml for root, else ./hearthlog.toml",
        ),
    ] = None,
    no_service: Annotated[
        bool, typer.Option("--no-service", help="Only write the configuration.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Take the default for whatever no option answers.")
    ] = False,
) -> None:
    """Set up a recorder: choose microphones, write the configuration, start the service.

    Asks what no option answers, shows the result, and then changes this machine: root installs
    a service of the machine, anybody else a user service that records in the current folder.
    Run again, it changes the answers in an existing configuration and keeps everything else.
    """
    if mqtt in {None, _NONE} and (mqtt_user is not None or mqtt_password_file is not None):
        wrong_use("--mqtt-user and --mqtt-password-file need --mqtt HOST")
    if page is not True and page_port is not None:
        wrong_use("--page-port needs --page")
    for name in [name for name in os.environ if name.startswith("HEARTHLOG_")]:
        del os.environ[name]  # a service does not have these variables
    asker = _Asker(yes=yes)
    try:
        place = _place(config, service=not no_service)
        present = _Present(place)
        from hearthlog.tools.service.configuration_file import Answers

        _check_disk(place, present)
        secrets: dict[Path, str] = {}
        answers = Answers(
            microphones=_microphones(asker, microphone, present, place),
            node=_node(asker, node, present),
            timezone=_timezone(asker, timezone, present),
            keep_sound=_keep_sound(asker, keep_sound, present),
            network=_network(asker, network, present),
            page=_page(asker, page, page_port, present, place),
            broker=_broker(asker, mqtt, (mqtt_user, mqtt_password_file), present, place, secrets),
            alerts=_alerts(asker, alerts, present, place, secrets),
            secrets=secrets,
        )
        text = _text(place, present, answers)
        _confirm(asker, place, present, answers, text)
    except (KeyboardInterrupt, EOFError, typer.Abort):
        print(file=sys.stderr)
        print_notice("nothing was changed")
        raise typer.Exit(130) from None
    _carry_out(place, answers, text)


class _Asker:
    """Asks on the terminal what no option answers."""

    def __init__(self, *, yes: bool) -> None:
        self.yes = yes
        self._is_terminal = sys.stdin.isatty() and sys.stderr.isatty()

    def asks(self, question: str, option: str) -> bool:
        """Return whether to ask; end with a line if the question cannot be asked."""
        if not self.yes and not self._is_terminal:
            wrong_use(f"{question}: there is no terminal to ask on; give {option}, or --yes")
        return not self.yes

    def text(
        self, question: str, option: str, default: str, check: Callable[[str], _Value]
    ) -> _Value:
        """Ask until the answer passes a check that raises HearthlogError."""
        if not self.asks(question, option):
            return _checked(option, default, check)
        while True:
            answer = typer.prompt(question, default=default, err=True)
            try:
                return check(answer.strip())
            except HearthlogError as error:
                print_notice(str(error))

    def confirm(self, question: str, option: str, *, default: bool) -> bool:
        """Ask a question for yes or no."""
        if not self.asks(question, option):
            return default
        return typer.confirm(question, default=default, err=True)


def _checked(option: str, text: str, check: Callable[[str], _Value]) -> _Value:
    try:
        return check(text)
    except HearthlogError as error:
        wrong_use(f"{option}: {error}")


@dataclass(frozen=True)
class _Place:
    """Where a recorder is set up; `account` is None for a user's."""

    config: Path
    folder: Path
    account: str | None
    has_service: bool

    def unit(self, name: str) -> Path:
        """Return the path of a unit, of the distribution if nothing replaces it."""
        from hearthlog.tools.service import unit

        if self.account is None:
            return unit.user_units() / name
        return unit.packaged_unit(name) if unit.is_packaged(name) else unit.SYSTEM_UNITS / name

    def is_running(self, name: str) -> bool:
        """Return whether a service runs now."""
        import subprocess

        manager = ["systemctl", *(["--user"] if self.account is None else [])]
        try:
            done = subprocess.run([*manager, "is-active", "--quiet", name], check=False)  # noqa: S603
        except OSError:
            return False
        return self.has_service and self.unit(name).exists() and done.returncode == 0


def _place(config: Path | None, *, service: bool) -> _Place:
    """Return where to set up, after checking that a service can be installed there."""
    from hearthlog.tools.service import unit

    is_system = os.geteuid() == 0
    config = config or Path("/etc/hearthlog.toml" if is_system else "hearthlog.toml")
    folder = unit.STATE if is_system and service else Path.cwd()
    account = _ACCOUNT if is_system and service else None
    place = _Place(config.absolute(), folder, account, service)
    if service:
        for name, verb in ((unit.NAME, "record"), (unit.BRIDGE_NAME, "bridge")):
            there = place.unit(name)
            if not (is_system and unit.is_packaged(name)):
                unit.place_of(there.parent, name)
            own = None if is_system or verb == "bridge" else folder
            unit.check_unit(there, verb, place.config, own)
        if is_system:
            unit.check_program_seen()
            unit.check_seen("the configuration", place.config)
    return place


class _Present:
    """The present configuration, of which the answers are the defaults."""

    def __init__(self, place: _Place) -> None:
        from hearthlog.analyzer.bridge.settings import load_bridge_settings

        self.file = place.config if place.config.exists() else None
        self.settings: Settings
        self.bridge: BridgeSettings
        self.settings, self.bridge = load_bridge_settings(self.file)
        self.text = None if self.file is None else self.file.read_text("utf-8-sig")


def _check_disk(place: _Place, present: _Present) -> None:
    from hearthlog.recorder.host import disk_of
    from hearthlog.recorder.retention import size_text

    logs = place.folder / present.settings.output
    least = int(present.settings.min_free_space) + _LEAST_FREE
    free = disk_of(logs).free
    if free < least:
        raise _SetupError(
            f"{logs}: {size_text(free)} of the disk are free, and the recorder keeps "
            f"{size_text(int(present.settings.min_free_space))} free: make room, {size_text(least)}"
        )


def _microphones(
    asker: _Asker, given: list[str] | None, present: _Present, place: _Place
) -> list[tuple[str, str]]:
    """Return devices and rooms, after hearing each device."""
    from hearthlog.recorder.sources.capture import Device
    from hearthlog.recorder.sources.process import query_devices
    from hearthlog.tools.service.unit import NAME

    configured = [(each.device, each.name) for each in present.settings.microphone]
    chosen = configured if present.file is not None else []
    ours = [device for device, _ in chosen] if place.is_running(NAME) else []
    if given:
        chosen = [_device_and_room(text) for text in given]
    elif asker.asks("the microphone", "--microphone DEVICE=ROOM"):
        devices = query_devices()
        names = {name for each in devices for name in (each.identity, each.name)}
        # PortAudio does not list a device that the recorder uses.
        devices += [Device(-1, name, 1, 0.0, False) for name in ours if name not in {*names, ""}]
        chosen = _chosen_on_terminal(asker, devices, chosen)
    elif not chosen:
        chosen = [(_found(query_devices(), "").identity, configured[0][1])]
    for device, _ in chosen:
        if device not in ours:
            _check_heard(device)
    return chosen


def _found(devices: "list[Device]", name: str) -> "Device":
    """Find a device; the error for a missing one names what uses the microphones."""
    from hearthlog.recorder.errors import DeviceError
    from hearthlog.recorder.sources.capture import find_device
    from hearthlog.tools.cli.level_meter import users_of_microphones

    try:
        return find_device(devices, name)
    except DeviceError as error:
        users = "".join(f"; {each}, end that program" for each in users_of_microphones())
        raise DeviceError(f"{error}{users}") from error


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


def _chosen_on_terminal(
    asker: _Asker, devices: "list[Device]", configured: list[tuple[str, str]]
) -> list[tuple[str, str]]:
    from hearthlog.tools.cli.level_meter import choose_by_level

    default = _found(devices, "")
    rooms = {device or default.identity: room for device, room in configured}
    before = [
        place for place, each in enumerate(devices) if rooms.keys() & {each.identity, each.name}
    ]
    chosen = choose_by_level(devices, before or [devices.index(default)])
    pairs: list[tuple[str, str]] = []
    for place in chosen:
        device = devices[place]
        room = rooms.get(device.identity, "" if len(chosen) > 1 else "mic")

        def check(text: str) -> str:
            name = _room(text)
            if name in [other for _, other in pairs]:
                raise _SetupError(f"{name}: is the room of another microphone; write another name")
            return name

        question = f"Room of {device.name}, such as kitchen"
        pairs.append((device.identity, asker.text(question, "--microphone", room or "mic", check)))
    return pairs


def _check_heard(device: str) -> None:
    from hearthlog.recorder.addresses import is_address
    from hearthlog.recorder.sources.process import query_devices
    from hearthlog.tools.cli.level_meter import hear

    if not is_address(device):
        _found(query_devices(), device)
        hear(device)


def _node(asker: _Asker, given: str | None, present: _Present) -> str:
    from hearthlog.schemas.logs.files import check_node_name

    if given is not None:
        return _checked("--node", given, check_node_name)
    return asker.text("Name of the home", "--node", present.settings.node, check_node_name)


def _timezone(asker: _Asker, given: str | None, present: _Present) -> str:
    from hearthlog.recorder.pause_schedule import check_time_zone

    if given is not None:
        return _checked("--timezone", given, check_time_zone)
    default = present.settings.timezone
    return asker.text("Time zone of the home", "--timezone", default, check_time_zone)


def _keep_sound(asker: _Asker, given: bool | None, present: _Present) -> bool:
    if given is not None:
        return given
    question = (
        "Keep sound? Without it the logs have labels and features only. With it, also clips of "
        "sounds that the model is unsure of, never of speech, for 30 days, to listen to in a review"
    )
    option = "--keep-sound or --no-keep-sound"
    return asker.confirm(question, option, default=present.settings.keep_audio != "off")


def _network(asker: _Asker, given: str | None, present: _Present) -> str:
    """Return what the configuration says of the network; it is downloaded later."""
    from hearthlog.analyzer.extras import missing
    from hearthlog.models.embedding.networks import YAMNET, find_network, missing_modules

    if given not in {None, _NETWORK, _NONE}:
        wrong_use(f"--network {given}: is neither {_NETWORK} nor {_NONE}")
    absent = missing_modules(YAMNET.suffix)
    if given == _NETWORK and absent:
        raise _SetupError(f"--network {_NETWORK}: {missing(*absent)}")
    if given is not None:
        return given if given == _NETWORK or find_network(_NETWORK) else ""
    now = present.settings.embedding
    if now or find_network(_NETWORK):
        return now
    if not asker.asks("the network", f"--network {_NETWORK} or --network {_NONE}"):
        return now
    if absent:
        print_notice(f"a network would make labels more accurate; {missing(*absent)}; then setup")
        return now
    size = YAMNET.files[0].size / 1e6
    question = (
        f"Download the network {_NETWORK}, {size:.0f} MB from {YAMNET.files[0].url.split('/')[2]}? "
        "In homes unknown to the model it doubles the accuracy (macro F1 0.70, without it 0.36)"
    )
    return _NETWORK if asker.confirm(question, "--network", default=False) else now


def _page(
    asker: _Asker, given: bool | None, port: int | None, present: _Present, place: _Place
) -> int | None:
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.http import free_port
    from hearthlog.tools.service.configuration_file import PAGE_PORT
    from hearthlog.tools.service.unit import BRIDGE_NAME

    now = present.bridge.page
    if given is None:
        given = asker.confirm(
            "Serve a page of the home, for a browser on this machine",
            "--page or --no-page",
            default=now is not None,
        )
    if not given:
        return None
    before = PAGE_PORT if now is None else now.port
    bind = "127.0.0.1" if now is None else now.bind
    is_own = now is not None and place.is_running(BRIDGE_NAME)

    def check(text: str) -> int:
        if not text.isdecimal() or not 0 < int(text) <= 65_535:
            raise _SetupError(f"{text}: is no port; write a number such as {PAGE_PORT}")
        try:
            return int(text) if is_own and int(text) == before else free_port(int(text), bind)
        except DataError as error:
            raise _SetupError(
                f"port {text} is used by another program; choose another one for the page, "
                "with --page-port"
            ) from error

    if port is not None:
        return _checked("--page-port", str(port), check)
    try:
        return check(str(before))
    except _SetupError as error:
        if not asker.asks(str(error), "--page-port"):
            raise
        return asker.text(str(error), "--page-port", str(before + 1), check)


def _broker(
    asker: _Asker,
    given: str | None,
    login: tuple[str | None, Path | None],
    present: _Present,
    place: _Place,
    secrets: dict[Path, str],
) -> "Broker | None":
    from hearthlog.analyzer.bridge.settings import MqttSettings
    from hearthlog.analyzer.extras import require
    from hearthlog.tools.service.configuration_file import Broker, secret_file

    now: MqttSettings | None = present.bridge.mqtt
    if given == _NONE or (given is None and not _wanted(asker, "mqtt", now is not None)):
        return None
    require("paho")
    user, password_file = login
    file = secret_file(place.config, "mqtt-password")
    old = None if now is None else now.password_file
    if given is not None:
        host = _checked("--mqtt", given, _host)
        user = user if user is not None else "" if now is None else now.user
        if password_file is not None:
            secrets[file] = _secret(password_file)
            old = file
        return Broker(host, user, old if user else None)
    host = asker.text(
        "Broker, such as homeassistant.local", "--mqtt", now.host if now else "", _host
    )
    user = asker.text(
        "User at the broker, empty for none", "--mqtt-user", now.user if now else "", str
    )
    if not user:
        return Broker(host)
    if asker.yes:
        return Broker(host, user, old)
    hint = "Password (not shown)" if old is None else "Password (not shown; empty: as before)"
    password = typer.prompt(hint, default="", hide_input=True, show_default=False, err=True)
    if password:
        secrets[file] = f"{password}\n"
        old = file
    return Broker(host, user, old)


def _wanted(asker: _Asker, option: str, default: bool) -> bool:
    questions = {
        "mqtt": ("Publish to Home Assistant or another MQTT broker", "--mqtt HOST or --mqtt none"),
        "alerts": (
            "Send alerts, first of all when the recorder falls silent",
            "--alerts FILE or --alerts none",
        ),
    }
    return asker.confirm(*questions[option], default=default)


def _host(text: str) -> str:
    from pydantic import ValidationError

    from hearthlog.analyzer.bridge.settings import MqttSettings

    try:
        return MqttSettings(host=text).host
    except ValidationError as error:
        raise _SetupError(error.errors()[0]["msg"].removeprefix("Value error, ")) from error


def _secret(file: Path) -> str:
    try:
        text = file.read_text("utf-8")
    except UnicodeDecodeError as error:
        raise _SetupError(f"{file}: is not text") from error
    if not text.strip():
        raise _SetupError(f"{file}: is empty")
    return text


def _alerts(
    asker: _Asker, given: str | None, present: _Present, place: _Place, secrets: dict[Path, str]
) -> Path | None:
    from hearthlog.analyzer.extras import require
    from hearthlog.tools.service.configuration_file import secret_file

    now = present.bridge.delivery.urls_file
    file = secret_file(place.config, "alert-urls")
    if given == _NONE or (given is None and not _wanted(asker, "alerts", now is not None)):
        return None
    require("apprise")
    if given is not None:
        secrets[file] = _alert_urls(_secret(Path(given)))
    elif now is not None:
        return now
    else:
        question = "Address for alerts, such as ntfy://ntfy.sh/a-topic-of-yours (Apprise)"
        secrets[file] = asker.text(question, "--alerts", "", _alert_urls)
    return file


def _alert_urls(text: str) -> str:
    from apprise import Apprise

    for line in filter(None, map(str.strip, text.splitlines())):
        if not line.startswith("#") and not Apprise().add(line):
            raise _SetupError("an address for alerts is none of Apprise's; see docs/alerts.md")
    return f"{text.strip()}\n"


def _text(place: _Place, present: _Present, answers: "Answers") -> str:
    from hearthlog.recorder.errors import ConfigurationError
    from hearthlog.tools.service.configuration_file import configuration_text

    try:
        return configuration_text(present.text, answers)
    except ConfigurationError as error:
        raise ConfigurationError(f"{place.config}: {error}") from error


def _confirm(
    asker: _Asker, place: _Place, present: _Present, answers: "Answers", text: str
) -> None:
    """Show what will be changed, and ask for it."""
    import difflib

    from hearthlog.recorder.addresses import public_name

    broker = answers.broker
    what = "is unchanged" if present.text == text else "is changed" if present.text else "is new"
    who = "a user service" if place.account is None else f"of the machine, by {place.account}"
    parts = [] if answers.page is None else [f"a page at port {answers.page}"]
    parts += [] if broker is None else [f"MQTT at {broker.host}"]
    parts += [] if answers.alerts is None else ["alerts"]
    devices = [
        f"{room}: {public_name(name) or 'the default'}" for name, room in answers.microphones
    ]
    rows = {
        "Microphone": "; ".join(devices),
        "Home": f"{answers.node}, {answers.timezone}",
        "Sound": "clips are kept" if answers.keep_sound else "none is kept",
        "Network": answers.network or "yamnet where it is installed",
        "Bridge": ", ".join(parts) or "none",
        "Configuration": f"{place.config} {what}",
        "Secrets": ", ".join(map(str, answers.secrets)),
        "Logs": str(place.folder / present.settings.output),
        "Service": who if place.has_service else "none",
    }
    print(file=sys.stderr)
    for name, value in rows.items():
        if value:
            print(f"{name:<15}{value}", file=sys.stderr)
    if present.text is not None and present.text != text:
        old, new = (each.splitlines() for each in (present.text, text))
        changes = difflib.unified_diff(old, new, "before", "after", n=0, lineterm="")
        print(*list(changes)[2:], sep="\n", file=sys.stderr)
    if not asker.confirm("Do this", "--yes", default=True):
        raise typer.Abort


def _carry_out(place: _Place, answers: "Answers", text: str) -> None:
    """Change this machine; after a failure before the start of the service it is as before."""
    from hearthlog.models.embedding.networks import find_network
    from hearthlog.tools.cli.models import fetch
    from hearthlog.tools.service import unit
    from hearthlog.tools.service.configuration_file import written_files

    if answers.network == _NETWORK and find_network(_NETWORK) is None:
        fetch(_NETWORK, None)
    is_new = place.account is not None and unit.make_account(place.account)
    failure: unit.StartError | None = None
    is_recording = False
    try:
        with written_files(place.config, text, answers.secrets, place.account):
            _check_configuration(place)
            try:
                is_recording = place.has_service and _install(place, answers)
            except unit.StartError as error:  # its needs are met: the journal says more
                failure = error
    except BaseException:
        if is_new:
            unit.remove_account(_ACCOUNT)
        raise
    if failure is not None:
        raise failure
    if is_recording:
        _wait_for_labels(place, answers)
    _print_next(place, answers)


def _check_configuration(place: _Place) -> None:
    from hearthlog.recorder.errors import ConfigurationError
    from hearthlog.tools.cli.recorder import findings

    if place.folder.is_dir():
        os.chdir(place.folder)
    errors, problems, warnings = findings(place.config)
    if errors or problems:
        raise ConfigurationError(*map(str, errors), *problems)
    for line in warnings:
        print_notice(line)


def _install(place: _Place, answers: "Answers") -> bool:
    """Install the services, and start or restart them; return whether they run."""
    from hearthlog.tools.cli.recorder import install_service
    from hearthlog.tools.service import unit

    is_user = place.account is None
    is_running = unit.is_user_manager_running() if is_user else unit.is_systemd_running()
    for name in (unit.NAME, unit.BRIDGE_NAME):
        is_bridge = name == unit.BRIDGE_NAME
        if is_bridge and (is_user or not answers.has_bridge()):
            if place.is_running(name):
                unit.stop_unit(name)
        elif place.account is not None and unit.is_packaged(name):
            unit.start_unit(name, is_running=is_running)
        else:
            account = place.account if is_bridge else None
            install_service(user=is_user, config=place.config, account=account, bridge=is_bridge)
    return is_running


def _wait_for_labels(place: _Place, answers: "Answers") -> None:
    """Wait until each microphone has a label in the log that is being written."""
    from threading import Event

    from hearthlog.recorder.config import load_settings
    from hearthlog.schemas.logs.follow import follow_messages
    from hearthlog.tools.cli.terminal import share_done

    logs = place.folder / load_settings(place.config, {}, {}).output
    end = time.monotonic() + _LABEL_SECONDS
    missing = {f"/{room}/label" for _, room in answers.microphones}
    start = time.time_ns()
    stop = Event()
    with share_done("waiting for the first label", announce=True) as report:
        while not logs.is_dir() and time.monotonic() < end:
            time.sleep(0.2)
        if logs.is_dir():
            ignored = lambda _error: None  # noqa: E731  the doctor reports damaged logs
            for _, batch in follow_messages(logs, None, start, stop, ignored, ticks=True):
                missing -= {messages.channel.topic for messages in batch if len(messages)}
                left = end - time.monotonic()
                report(1 - max(left, 0.0) / _LABEL_SECONDS)
                if not missing or left < 0:
                    break
    if missing:
        raise _SetupError(
            f"no label in {logs} of {', '.join(sorted(missing))} in {_LABEL_SECONDS:.0f} s; the "
            f"recorder runs: {_command(place, 'doctor --live', logs)} says what it waits for"
        )
    print_lines([f"{logs}: the labels of {', '.join(r for _, r in answers.microphones)} arrive"])


def _command(place: _Place, verb: str, *arguments: object) -> str:
    """Return a command in backticks, of the user who may read the logs."""
    who = "" if place.account is None else f"sudo -u {place.account} "
    return f"`{' '.join([f'{who}hearthlog {verb}', *map(str, arguments)])}`"


def _print_next(place: _Place, answers: "Answers") -> None:
    """Print what to do next."""
    from hearthlog.recorder.config import load_settings

    logs = place.folder / load_settings(place.config, {}, {}).output
    lines = []
    if not place.has_service:
        lines.append(f"to record: {_command(place, 'record --config', place.config)}")
    if answers.has_bridge() and place.account is None:
        bridge = _command(place, "bridge --config", place.config)
        lines.append(f"to publish: {bridge}, which prints the address of the page")
    elif answers.page is not None:
        lines.append(f"the page: {_page_address(answers.page)}")
    lines.append(f"after an hour, what was heard: {_command(place, 'info', logs)}")
    print_lines(lines)


_PAGE_ADDRESS = Path("/var/lib/hearthlog-bridge/page-address")
_ADDRESS_SECONDS = 10.0


def _page_address(port: int) -> str:
    """Return the address of the page, which the bridge writes at its start."""
    end = time.monotonic() + _ADDRESS_SECONDS
    while time.monotonic() < end:
        try:
            if f":{port}/" in (address := _PAGE_ADDRESS.read_text("utf-8").strip()):
                return address
        except OSError:
            pass
        time.sleep(0.2)
    return f"`sudo cat {_PAGE_ADDRESS}` shows its address"
