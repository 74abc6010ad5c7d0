"""Options of the Home Assistant add-on, and the configuration of hearthlog made from them."""

import json
import re
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import tomlkit
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from tomlkit.exceptions import TOMLKitError

from hearthlog.analyzer.bridge.settings import load_bridge_settings
from hearthlog.recorder.config_problems import Origins, configuration_error
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.pause_schedule import machine_zone
from hearthlog.schemas.errors import HearthlogError, printable
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.logs.files import check_node_name
from hearthlog.schemas.messages.topics import check_microphone_name
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
