"""Which logs follow each other, by where they lie and what they are called."""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import find_logs, is_layer, is_log, stem
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX, time_span

_NAMED = re.compile(r"(?P<node>.+)_(?P<time>\d{8}T\d{6}Z.*)")
_DAY = re.compile(r"\d{4}/\d\d/\d\d")
_DAYS = "[0-9]*/[0-9]*/[0-9]*/*"


class Chain(NamedTuple):
    """The logs of a node of a home.

    Attributes
    ----------
    logs : list of Path
        In the order of time; the last may still be being written.
    asked : dict of int to Path
        Those that were asked for, by their places.
    """

    logs: Sequence[Path]
    asked: Mapping[int, Path]


def is_active(path: Path) -> bool:
    """Tell by its name whether a log is still being written."""
    return path.name.endswith(ACTIVE_SUFFIX)


def find_chains(paths: Iterable[Path]) -> list[Chain]:
    """Find logs, and those before and behind them.

    Parameters
    ----------
    paths : iterable of Path
        Logs, or folders of logs, of which layers are passed over.

    Raises
    ------
    LogError
        If there is no such log, or it is a layer.
    """
    asked: dict[str, Path] = {}
    for path in paths:
        if is_layer(path):
            raise LogError(f"{path}: is a layer; name the log that it speaks of")
        asked |= {str(log): log for log in find_logs(path) if not is_layer(log)}
    homes: dict[str, Path] = {}
    for log in asked.values():
        homes.setdefault(str(home(log)), home(log))
    found = []
    for root in homes.values():
        for logs in _nodes(root):
            wanted = {i: log for i, log in enumerate(logs) if str(log) in asked}
            if wanted:
                found.append(Chain(logs, wanted))
    return found


def home(log: Path) -> Path:
    """Return the folder that has the folders of years; of another layout that of the log."""
    folder = log.parent
    days = "/".join(part.name for part in (folder.parent.parent, folder.parent, folder))
    return folder.parent.parent.parent if _DAY.fullmatch(days) else folder


def _nodes(root: Path) -> list[list[Path]]:
    """List the logs of each node of a home, in the order of time."""
    nodes: dict[str, list[tuple[str, Path]]] = {}
    for log in (*root.glob("*"), *root.glob(_DAYS)):
        if home(log) == root and is_log(log) and not is_layer(log):
            node, time = _node_and_time(log)
            nodes.setdefault(node, []).append((time, log))
    return [[log for _, log in sorted(logs)] for _, logs in sorted(nodes.items())]


def _node_and_time(log: Path) -> tuple[str, str]:
    named = _NAMED.fullmatch(stem(log))
    if named is not None:
        return named["node"], named["time"]
    span = None
    with suppress(LogError):  # why it cannot be read will be said when it is labelled
        span = time_span(log)
    return "", f"{span[0] if span else 0:020}"
