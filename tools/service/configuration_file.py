"""A configuration file made from answers, in which comments and other keys stay as they are."""

import os
import pwd
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT

from hearthlog.recorder.addresses import public_name
from hearthlog.recorder.config import load_settings
from hearthlog.schemas.errors import ConfigurationError
from hearthlog.schemas.new_files import make_folders, replaced_file

PAGE_PORT = 8380

_NEW = """\
# The configuration of hearthlog: its recorder and its bridge. All keys: docs/configuration.md.
# Check a change with `hearthlog config check FILE`, then restart the service.

# The name of this home: its logs begin with it.
node = ""
timezone = ""

# Sound that is kept as clips: "off" for none, or "unsure" for what the model is unsure of.
keep_audio = "off"

# The network that makes labels more accurate: "" for yamnet where it is installed, or "none".
embedding = ""

# A table for each microphone: its name is the room, `hearthlog devices` lists the devices.
"""
_RULE = {"name": "recorder silent", "rule": "recorder_silent", "silent_for": "30m", "urgent": True}


@dataclass(frozen=True)
class Broker:
    """An MQTT broker, and the file with the password of its user."""

    host: str
    user: str = ""
    password_file: Path | None = None


@dataclass(frozen=True)
class Answers:
    """The answers of a person from which a configuration is made."""

    microphones: list[tuple[str, str]]  # device and room
    node: str
    timezone: str
    keep_sound: bool = False
    network: str = ""  # empty for a network wherever one is installed
    page: int | None = None  # port
    broker: Broker | None = None
    alerts: Path | None = None  # file of the addresses
    secrets: dict[Path, str] = field(default_factory=dict, repr=False)  # content of secret files

    def has_bridge(self) -> bool:
        """Whether something is published."""
        return self.page is not None or self.broker is not None or self.alerts is not None


def configuration_text(text: str | None, answers: Answers) -> str:
    """Return a configuration, valid TOML or None, with the answers; everything else is kept.

    Raise `ConfigurationError` if the text has a form that cannot be changed.
    """
    try:
        content = tomlkit.parse(_NEW if text is None else text)
        _set(content, "node", answers.node)
        _set(content, "timezone", answers.timezone)
        kept = content.get("keep_audio", "off") != "off"
        if kept is not answers.keep_sound:
            content["keep_audio"] = "unsure" if answers.keep_sound else "off"
        if content.get("embedding", "") != answers.network:
            content["embedding"] = answers.network
        _set_microphones(content, answers.microphones)
        _set_bridge(content, answers)
        return tomlkit.dumps(content)
    except TOMLKitError as error:
        raise ConfigurationError(f"cannot be changed ({error}); edit it") from error


def _set(table: Any, key: str, value: Any) -> None:
    if table.get(key) != value:
        table[key] = value


def _set_microphones(content: Any, microphones: list[tuple[str, str]]) -> None:
    present = content.get("microphone")
    if present is None:
        if microphones == [("", "mic")]:
            return
        content["microphone"] = tomlkit.aot()
        present = content["microphone"]
    if not isinstance(present, AoT):
        raise ConfigurationError("microphone: is a list on a line; write [[microphone]] tables")
    devices = [device for device, _ in microphones]
    for place in reversed(range(len(present))):
        if present[place].get("device", "") not in devices:
            del present[place]
    tables = {table.get("device", ""): table for table in present}
    for device, room in microphones:
        table = tables.get(device)
        if table is None:
            table = tomlkit.table()
            table["name"] = room
            if device:
                table["device"] = device
            present.append(table)
        elif table.get("name", "mic") != room:
            table["name"] = room


def _set_bridge(content: Any, answers: Answers) -> None:
    bridge = content.get("bridge")
    if bridge is None:
        if not answers.has_bridge():
            return
        content["bridge"] = tomlkit.table(is_super_table=True)
        bridge = content["bridge"]
    _set_table(bridge, "page", None if answers.page is None else {"port": answers.page})
    mqtt, broker = None, answers.broker
    if broker is not None:
        password = None if broker.password_file is None else str(broker.password_file)
        mqtt = {"host": broker.host, "user": broker.user or None, "password_file": password}
    _set_table(bridge, "mqtt", mqtt)
    if answers.alerts is None:
        _set_table(bridge, "delivery", None)
        bridge.pop("alert", None)
    else:
        _set_table(bridge, "delivery", {"urls_file": str(answers.alerts)})
        if "alert" not in bridge:
            rule = tomlkit.table()
            rule.comment("further rules: docs/alerts.md")
            rule.update(_RULE)
            bridge["alert"] = tomlkit.aot()
            bridge["alert"].append(rule)


def _set_table(parent: Any, name: str, keys: Mapping[str, Any] | None) -> None:
    """Set the keys of a table, and remove those that are None; None removes the table."""
    if keys is None:
        parent.pop(name, None)
        return
    if name not in parent:
        parent[name] = tomlkit.table()
    for key, value in keys.items():
        if value is None:
            parent[name].pop(key, None)
        else:
            _set(parent[name], key, value)


def secret_file(config: Path, name: str) -> Path:
    """Return the path of a secret file, in a folder with the name of the configuration."""
    return config.with_suffix("") / name


@contextmanager
def written_files(
    config: Path, text: str, secrets: Mapping[Path, str], account: str | None
) -> Iterator[None]:
    """Write a configuration and its secret files; restore what was there if the block raises.

    Only `account` may read the secrets; None for this one. Raise `LogError` if a file cannot be
    written.
    """
    person = None if account is None else pwd.getpwnam(account)
    before: dict[Path, Path | None] = {}
    new = [each for each in {path.parent for path in (*secrets, config)} if not each.exists()]
    try:
        for path, content in {**secrets, config: text}.items():
            make_folders(path.parent, 0o700 if person is None else 0o755)
            before[path] = _copied(path)
            with replaced_file(path, readers=0) as temporary:
                temporary.touch(0o600)
                temporary.write_text(content, encoding="utf-8")
            if path != config and person is not None:
                os.chown(path, person.pw_uid, person.pw_gid)
        _set_readers(config, before[config], person)
        yield
    except BaseException:
        for path, copy in before.items():
            if copy is None:
                path.unlink(missing_ok=True)
            else:
                copy.replace(path)
        for folder in new:
            with suppress(OSError):
                folder.rmdir()
        raise
    for copy in before.values():
        if copy is not None:
            copy.unlink()


def _set_readers(config: Path, before: Path | None, person: pwd.struct_passwd | None) -> None:
    """Keep the readers of a configuration; a new one is for the service, and all if not secret."""
    if before is not None:
        status = before.stat()
        os.chown(config, status.st_uid, status.st_gid)
        config.chmod(status.st_mode & 0o777)
    elif person is not None:
        devices = [each.device for each in load_settings(config, {}, {}).microphone]
        is_secret = any(public_name(device) != device for device in devices)
        os.chown(config, 0, person.pw_gid)
        config.chmod(0o640 if is_secret else 0o644)


def _copied(path: Path) -> Path | None:
    """Copy a file to a private name next to it, with its owner and rights; None without one."""
    if not path.exists():
        return None
    copy = path.with_name(f".{path.name}.before")
    copy.unlink(missing_ok=True)
    try:
        copy.touch(0o600, exist_ok=False)
        shutil.copy2(path, copy)
        status = path.stat()
        os.chown(copy, status.st_uid, status.st_gid)
    except BaseException:
        copy.unlink(missing_ok=True)
        raise
    return copy
