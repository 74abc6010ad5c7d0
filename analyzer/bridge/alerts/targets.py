"""Those who are told of alerts by Apprise: a phone, a chat, an address."""

import codecs
import hashlib
import importlib
import logging
import re
from collections.abc import Callable, Sequence
from difflib import SequenceMatcher
from pathlib import Path
from threading import get_ident
from typing import Any, NamedTuple, Protocol

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.secret_files import secret_path
from hearthlog.analyzer.extras import remedy
from hearthlog.schemas.files import exposed_secret, read_whole

_LIMIT = 1 << 16  # bytes of the file
_HOST = re.compile(r"localhost|\[[0-9a-f:.]+\]|[\w-]+(\.[\w-]+)+", re.ASCII | re.IGNORECASE)
_FORM = "%(thread)d %(message)s"  # other targets are told at the same time
_CODE = re.compile(r"\berror=(\d{3})\b")


class Target(Protocol):
    """Somebody who is told."""

    @property
    def name(self) -> str:
        """What names the target from one start to the next, and gives nothing away."""

    @property
    def place(self) -> str:
        """What people call the target; it gives nothing away either."""

    def deliver(self, title: str, text: str) -> str:
        """Tell; return why it could not be told, or an empty text.

        Parameters
        ----------
        title, text : str
        """


class AppriseTarget:
    """An address of Apprise."""

    def __init__(self, plugin: Any, address: str, line: int) -> None:
        self._plugin = plugin
        self.name = _name(address)
        self.place = f"line {line}, {_scheme_and_host(plugin, address)}"

    def deliver(self, title: str, text: str) -> str:
        """Tell, within the seconds that the address allows; return why it could not be told."""
        import apprise  # noqa: PLC0415  takes half a second, and few need it

        with apprise.LogCapture(level=logging.WARNING, fmt=_FORM) as said:
            done = self._plugin.notify(
                title=title, body=text, notify_type=apprise.NotifyType.WARNING
            )
            if done:
                return ""
            lines = said.getvalue().splitlines()
        return _reason("\n".join(line for line in lines if line.startswith(f"{get_ident()} ")))


def _scheme_and_host(plugin: Any, address: str) -> str:
    scheme, host = address.partition("://")[0], plugin.host or ""
    # Many services have a token in the place of the host, or a topic, in which there is no dot.
    is_host = "host" in (plugin.template_tokens or {}) and _HOST.fullmatch(host)
    # In a password that is not escaped, what follows an @ or precedes a / is taken for a host.
    is_sure = "@" not in address or (address.count("@") == 1 and f"@{host}" in address)
    return f"{scheme}://{host}" if is_host and is_sure else scheme


def _reason(said: str) -> str:
    """Say what is known of a failure, without what Apprise says: it has topics and paths in it."""
    code = _CODE.search(said)
    if code:
        return f"error {code[1]}"
    is_away = "connection error" in said.lower()
    return "no connection" if is_away else "`apprise -v -b test ADDRESS` says why"


class Addresses(NamedTuple):
    """Addresses of a file, and its problems.

    Attributes
    ----------
    problems : list of str
        Why somebody who was meant cannot be told, a line each, without any address.
    names : list of str
        What names the target of each line, whether it can be read or not.
    """

    targets: list[AppriseTarget]
    problems: list[str]
    names: list[str]
    lacks_package: bool = False


def read_targets(file: Path, say: Callable[[str], None]) -> list[AppriseTarget]:
    """Read a file of addresses, one a line; `#` begins a line that is none.

    Raise `BridgeError` if the file cannot be read, a line is no address that Apprise knows, or
    none is there.
    """
    found = find_targets(file, say)
    if found.problems:
        raise BridgeError("; ".join(found.problems))
    return found.targets


def find_targets(file: Path, say: Callable[[str], None]) -> Addresses:
    """Read a file of addresses as `read_targets` does, as far as it can be read."""
    file = secret_path(file)
    try:
        importlib.invalidate_caches()  # it may have been installed since the last time
        import apprise  # noqa: PLC0415

        text = _text(read_whole(file, "file of addresses", _LIMIT, BridgeError))
    except BridgeError as error:
        return Addresses([], [str(error)], [])
    except ModuleNotFoundError as error:
        problem = f"{error.name} is not installed; {remedy(error.name or '')}"
        return Addresses([], [problem], [], lacks_package=True)
    if line := exposed_secret(file):
        say(line)
    # Nothing is loaded from the disk, and nothing written there.
    asset = apprise.AppriseAsset(
        plugin_paths=[], storage_mode="memory", secure_logging=True, async_mode=False
    )
    asset.app_id = asset.app_desc = "hearthlog"
    targets: dict[str, AppriseTarget] = {}
    problems = []
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    for number, address in lines:
        plugin = _plugin(address, asset)
        if plugin is None:
            problems.append(
                f"{file}, line {number}: no address that Apprise knows; docs/alerts.md has examples"
            )
        else:
            target = AppriseTarget(plugin, address, number)
            targets.setdefault(target.name, target)
    if not targets and not problems:
        problems = [f"{file}: no address in it; write one a line, as ntfy://ntfy.sh/my-topic"]
    return Addresses([*targets.values()], problems, [_name(line) for _, line in lines])


def replaced_names(before: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return which lines of a file of addresses were edited: the name of each now, and before."""
    matcher = SequenceMatcher(None, before, names, autojunk=False)
    edited = [
        pair
        for kind, i, i_end, j, j_end in matcher.get_opcodes()
        if kind == "replace"
        for pair in zip(names[j:j_end], before[i:i_end], strict=False)
    ]
    return {now: former for now, former in edited if now not in before and former not in names}


def _name(address: str) -> str:
    return hashlib.sha256(address.encode()).hexdigest()[:16]


def _plugin(address: str, asset: Any) -> Any:
    """Return an address as Apprise reads it; None if it cannot."""
    import apprise  # noqa: PLC0415

    try:
        return apprise.Apprise.instantiate(address, asset=asset, suppress_exceptions=True)
    except Exception:  # noqa: BLE001  hundreds of services, each with its own
        return None


def _text(data: bytes) -> str:
    """Decode a file as editors write it: UTF-8, or what begins with a mark."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    return data.decode("utf-8-sig", "replace")
