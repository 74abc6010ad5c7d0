"""Settings of the table `bridge`: outputs, alerts and their delivery, and files of secrets."""

import json
import os
import re
import secrets
from datetime import tzinfo
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from hearthlog.analyzer.bridge.alerts.rules import AlertRules
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.http import ip_of, is_ping_address
from hearthlog.recorder.config import (
    BRIDGE,
    MicrophoneSettings,
    PlainPath,
    Settings,
    load_settings,
)
from hearthlog.recorder.config_problems import Origins, configuration_error, key_lines
from hearthlog.schemas.errors import ConfigurationError, LogError
from hearthlog.schemas.files import read_limited, read_toml
from hearthlog.schemas.new_files import create_file, private_folder, replaced_file


class RecorderAddress(NamedTuple):
    """The recorder that a bridge follows."""

    folder: Path
    node: str
    zone: tzinfo
    never_tell: frozenset[str] = frozenset()  # classes of the configuration that no output shows


NO_RECIPIENT = (
    "bridge.alert: alerts have no target; set urls_file in [bridge.delivery], or a broker in "
    "[bridge.mqtt]"
)


def _check_secret_file(value: Any) -> Any:
    if "://" in str(value):  # a secret, which must not appear in messages
        raise ValueError("expects a file; write the address into a file, on a line of its own")
    return value


SecretFile = Annotated[PlainPath, BeforeValidator(_check_secret_file)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class DeliverySettings(_Table):
    """Where alerts go, besides the broker of MQTT."""

    urls_file: SecretFile | None = Field(
        default=None,
        examples=["/etc/hearthlog/alert-urls"],
        description="File of Apprise addresses, one a line; keep it secret.",
    )


_MOST_OF_TOPIC = 200  # characters
_COLLECTED = ".prom"  # suffix of the files that the textfile collector of node_exporter reads


def _check_topic(topic: str) -> str:
    if not 0 < len(topic) <= _MOST_OF_TOPIC or set(topic) & set("+#\0") or not topic.isprintable():
        raise ValueError(
            f"{topic[:64]!r} cannot begin topics; write 1 to {_MOST_OF_TOPIC} characters without "
            "+ and #, such as hearthlog"
        )
    return topic


_Topic = Annotated[str, AfterValidator(_check_topic)]
_Port = Annotated[int, Field(ge=1, le=65535, examples=[8883])]


def _check_ping_address(url: str) -> str:
    if url and not (is_ping_address(url) and url.isprintable() and " " not in url):
        raise ValueError("is not a web address; write one such as https://hc-ping.com/your-uuid")
    return url


def _check_host(name: str) -> str:
    if "/" in name or "@" in name:  # the text may contain a password
        raise ValueError("is an address; write only the host name, such as broker.lan")
    try:
        encoded = name.encode("idna")
    except UnicodeError:
        encoded = b""
    if not encoded:
        raise ValueError(f"{name[:64]!r} cannot be the name of a host")
    return name


_PLACE = r"[a-z0-9]([a-z0-9.-]{0,251}[a-z0-9])?(:[0-9]{1,5})?"


def _check_name(name: str) -> str:
    if not re.fullmatch(_PLACE, name.lower()):
        raise ValueError(
            f"{name[:64]!r} is not a host name; write one such as raspberrypi.local, without "
            "http://"
        )
    return name.lower()


def _check_origin(origin: str) -> str:
    if not re.fullmatch(f"https?://{_PLACE}", origin.lower()):
        raise ValueError(
            f"{origin[:64]!r} is not the origin of a web page; write one such as "
            "http://homeassistant.local:8123, without a path"
        )
    return origin.lower()


def _check_bind(address: str) -> str:
    found = ip_of(address)
    if found is None or found.is_multicast:
        raise ValueError(
            f"{address[:64]!r} is not an IP address; write one of this machine, such as 127.0.0.1"
        )
    return address


def _check_ingress(address: str) -> str:
    found = ip_of(address)
    if found is None or found.is_multicast or found.is_unspecified or found.is_loopback:
        raise ValueError(
            f"{address[:64]!r} is not the address of one other machine or container; write one "
            "such as 172.30.32.2"
        )
    return str(found)


class MqttSettings(_Table):
    """An MQTT broker and its connection."""

    host: Annotated[str, AfterValidator(_check_host)] = Field(
        examples=["broker.lan"], description="Name or address of the broker."
    )
    port: _Port | None = Field(default=None, description="Port; by default 1883, with TLS 8883.")
    user: str = Field(default="", examples=["hearthlog"], description="User name; empty: none.")
    password_file: SecretFile | None = Field(
        default=None, examples=["/etc/hearthlog/mqtt-password"], description="Of one line."
    )
    tls: bool = Field(default=False, description="Whether the connection is encrypted.")
    ca_file: PlainPath | None = Field(
        default=None, description="CA certificates for the broker; none: the machine's."
    )
    certificate_file: PlainPath | None = Field(default=None, description="Of this client.")
    key_file: PlainPath | None = Field(default=None, description="Of this client.")
    client_id: str = Field(
        default="", description="MQTT client id; empty: hearthlog- and the recorder's name."
    )
    topic: _Topic = Field(default="hearthlog", description="Begins all topics.")
    home_assistant: bool = Field(
        default=True, description="Publish discovery messages for Home Assistant."
    )
    discovery_topic: _Topic = Field(
        default="homeassistant", description="Discovery topic of Home Assistant."
    )
    commands: bool = Field(
        default=False, description="Accept corrections and pauses from the broker."
    )

    def check_files(self) -> None:
        """Check that the files fit the other settings, before any connection.

        This is no validator, which would reject the other outputs, too.

        Raise `BridgeError` if the files do not fit.
        """
        files = ("ca_file", "certificate_file", "key_file")
        if not self.tls and (name := next((name for name in files if getattr(self, name)), "")):
            problem = f"{name} is for an encrypted connection; write tls = true, or leave it out"
        elif self.key_file and not self.certificate_file:
            problem = "key_file needs a certificate; set certificate_file"
        elif self.password_file and not self.user:
            problem = "password_file needs a user name; set user"
        else:
            return
        raise BridgeError(f"bridge.mqtt: {problem}")


class PrometheusSettings(_Table):
    """Where Prometheus reads the metrics."""

    text_file: PlainPath | None = Field(
        default=None,
        examples=["/var/lib/node_exporter/hearthlog.prom"],
        description="File for the textfile collector of node_exporter; ends in .prom.",
    )
    port: _Port | None = Field(
        default=None, description="Port on loopback; needs `token_file`; none: no port."
    )
    token_file: SecretFile | None = Field(
        default=None,
        description="File with the token for the port: the `credentials_file` of Prometheus.",
    )
    readable_by: Literal["owner", "group", "all"] | None = Field(
        default=None, description="Accounts of this machine that may read `text_file`."
    )

    def check_readers(self) -> None:
        """Check that a text file or port is configured; no validator, see `check_files` of MQTT.

        Raise `BridgeError` if both are missing.
        """
        if self.text_file is None and self.port is None:
            raise BridgeError("bridge.prometheus: has no output; set text_file or port")

    def deprecated_readers(self) -> str:
        """Return a warning if the readers of the text file are left to the default."""
        if self.text_file is None or self.readable_by is not None:
            return ""
        return (
            f"bridge.prometheus: every account of this machine may read {self.text_file}; "
            'write readable_by = "all" if that is meant, else "owner" or "group": hearthlog 0.4.0 '
            'will use "owner" by default'
        )

    def unread_text_file(self) -> str:
        """Return a warning if the name of the text file keeps node_exporter from reading it."""
        file = self.text_file
        if file is None or file.suffix == _COLLECTED or os.path.isdir(file):  # noqa: PTH112  raises nothing
            return ""
        return (
            f"bridge.prometheus: text_file: {file} does not end in {_COLLECTED}, so that "
            f"node_exporter does not read it; write {json.dumps(str(file.with_suffix(_COLLECTED)))}"
        )


class PageSettings(_Table):
    """A page of the home, for a browser."""

    port: _Port = Field(default=8380, description="TCP port of the page.")
    bind: Annotated[str, AfterValidator(_check_bind)] = Field(
        default="127.0.0.1",
        description="Address of this machine to listen on; may be other than loopback.",
    )
    token_file: SecretFile | None = Field(
        default=None,
        description="File with the token of the page; by default one is created in the state "
        "folder.",
    )
    names: list[Annotated[str, AfterValidator(_check_name)]] = Field(
        default=[],
        description="Host names that may open the page, such as "
        '["raspberrypi.local"]; with a port if the name of a proxy has one.',
    )
    frames: list[Annotated[str, AfterValidator(_check_origin)]] = Field(
        default=[],
        description='Origins that may embed the page, such as ["http://homeassistant.local:8123"].',
    )
    ingress: Annotated[str, AfterValidator(_check_ingress)] | None = Field(
        default=None,
        examples=["172.30.32.2"],
        description="Address of a proxy that logs its users in, such as the ingress of Home "
        "Assistant; then nobody else may open the page, and it needs no token.",
    )
    sound: bool = Field(
        default=False, description="Play kept sound of events to those who may open the page."
    )
    language: str = Field(
        default="",
        pattern=r"^([a-z]{2,3})?$",
        examples=["de"],
        description="Language of the page; empty: that of the browser, else English.",
    )

    @model_validator(mode="after")
    def _check_ingress_alone(self) -> Self:
        if self.ingress and (self.token_file or self.frames):
            raise ValueError("token_file and frames have no effect with ingress; leave them out")
        return self


class PingSettings(_Table):
    """A watchdog on the network that raises the alarm when it hears nothing."""

    url: Annotated[str, AfterValidator(_check_ping_address)] = Field(
        default="",
        examples=["https://hc-ping.com/your-uuid"],
        description="As of healthchecks.io.",
    )
    url_file: SecretFile | None = Field(
        default=None, description="File with that address, which is a secret."
    )
    every_seconds: float = Field(default=60.0, ge=5.0, le=86_400, description="Between pings.")

    @model_validator(mode="after")
    def _check_address(self) -> Self:
        if bool(self.url) == (self.url_file is not None):
            raise ValueError("give either url or url_file")
        return self


class BridgeSettings(_Table):
    """Everything that can be configured; the field names are the keys of the table `bridge`."""

    state: PlainPath | None = Field(
        default=None,
        description="State folder of the bridge; by default systemd's, or `bridge` in the "
        "folder of logs.",
    )
    mqtt: MqttSettings | None = None
    prometheus: PrometheusSettings | None = None
    page: PageSettings | None = None
    ping: PingSettings | None = None
    alert: AlertRules = Field(default=[], description="One table for each rule.")
    delivery: DeliverySettings = DeliverySettings()

    def has_outputs(self) -> bool:
        """Whether any output is configured."""
        outputs = self.mqtt, self.prometheus, self.page, self.ping
        return any(output is not None for output in outputs) or bool(self.alert)


_OTHERS: dict[str, type[BaseModel]] = {  # other tables in which a misplaced key may be valid
    "above the first table": Settings,
    "below [[microphone]]": MicrophoneSettings,
    "below [bridge.mqtt]": MqttSettings,
    "below [bridge.page]": PageSettings,
    "below [bridge.ping]": PingSettings,
    "below [bridge.delivery]": DeliverySettings,
}


def load_bridge_settings(file: Path | None) -> tuple[Settings, BridgeSettings]:
    """Load the configuration of a recorder and of its bridge from TOML; None for the defaults.

    Raise `ConfigurationError` as `load_settings`, also for the table `bridge`.
    """
    problems: list[str] = []
    settings = Settings.model_construct()
    try:
        settings = load_settings(file, {}, {})
    except ConfigurationError as error:
        problems += error.lines
    content = {} if file is None else read_toml(file, "configuration", ConfigurationError)
    table = content.get(BRIDGE, {})
    lines = {} if file is None else key_lines(file.read_text("utf-8-sig"))
    bridge = BridgeSettings()
    try:
        bridge = BridgeSettings.model_validate(table)
    except ValidationError as error:
        origins = Origins({}, content, file, lines)
        refused = configuration_error(error, origins, BridgeSettings, (BRIDGE,), _OTHERS)
        problems += refused.lines
    if problems:
        raise ConfigurationError(*problems)
    return settings, bridge


def configured_microphones(settings: Settings) -> list[str]:
    """Return the names of the configured microphones; none if only the default is in force.

    Without a table `microphone`, the recorder may have another configuration.
    """
    is_given = "microphone" in settings.model_fields_set
    return [each.name for each in settings.microphone] if is_given else []


def file_schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file, for recorder and bridge."""
    schema = Settings.model_json_schema()
    bridge = BridgeSettings.model_json_schema()
    schema["$defs"] |= bridge.pop("$defs", {})
    schema["properties"][BRIDGE] = bridge | {
        "description": "A key of the bridge, not of the recorder."
    }
    return schema


_CREDENTIALS = "CREDENTIALS_DIRECTORY"  # of systemd


def secret_path(path: Path) -> Path:
    """Return the path of a secret, relative to the systemd credentials folder if there is one."""
    return Path(os.environ.get(_CREDENTIALS, "")) / path


_TOKEN, _COOKIES, _ADDRESS = "page-token", "page-cookies", "page-address"
_FORM = re.compile(r"[A-Za-z0-9._~-]{16,200}")  # characters that URLs need not escape


def page_token(file: Path | None, state: Path) -> str:
    """Return the token of the page from a one-line file, resolved by `secret_path`.

    Without a file a token is created in the state folder and kept. Raise `BridgeError` if the file
    cannot be used or created.
    """
    return read_token(file) if file is not None else _kept(state / _TOKEN)


def cookie_key(state: Path) -> bytes:
    """Return the key that signs the page's cookies; a new key is created if its file is missing.

    Raise `BridgeError` if the key cannot be read or created.
    """
    return _kept(state / _COOKIES).encode()


def page_secrets(state: Path) -> list[Path]:
    """Return the paths of the page's secrets in the state folder."""
    return [state / name for name in (_TOKEN, _COOKIES, _ADDRESS)]


def keep_address(address: str, state: Path) -> Path:
    """Write the page's address with its token to a file that only the owner may read.

    Raise `BridgeError` if the file cannot be written.
    """
    path = state / _ADDRESS
    _write(path, address)
    return path


def read_token(file: Path) -> str:
    """Read a token file, resolved by `secret_path`.

    Raise `BridgeError` if the file cannot be used.
    """
    file = secret_path(file)
    data = read_limited(file, "file of a token", 1 << 12, BridgeError)
    token = data.decode("utf-8", errors="replace").strip()
    if not _FORM.fullmatch(token):
        raise BridgeError(
            f"{file}: has no token: one line of 16 to 200 letters, digits, '.', '_', '~' and '-'"
        )
    return token


def figures_token(port: int, file: Path | None) -> str:
    """Return the token of the port for Prometheus.

    Raise `BridgeError` if no token is configured: every account of the machine can reach a loopback
    port.
    """
    if file is None:
        raise BridgeError(
            f"bridge.prometheus: port {port} stays closed, as every account of this machine could "
            "read it: name a `token_file`, and the same file as `credentials_file` in Prometheus"
        )
    return read_token(file)


def _kept(path: Path) -> str:
    if not path.exists():
        _write(path, secrets.token_urlsafe(16))
    return read_token(path.absolute())


def _write(path: Path, line: str) -> None:
    try:
        private_folder(path.parent)
        with replaced_file(path, readers=0) as temporary, create_file(temporary) as stream:
            stream.write(f"{line}\n".encode())
    except (LogError, OSError) as error:
        text = (
            f"{path}: cannot be written ({error.strerror})" if isinstance(error, OSError) else error
        )
        raise BridgeError(f"{text}; name another folder with `state` in [bridge]") from error
