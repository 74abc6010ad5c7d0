"""Where the values of a configuration come from: which line of which file, or what else."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

ENVIRONMENT = "HEARTHLOG_"
DEFAULT = "default"
_PART = r"""(?:[\w-]+|"[^"\\]*"|'[^']*')"""
_NAME = rf"{_PART}(?:\s*\.\s*{_PART})*"
_TABLE = re.compile(rf"\s*(\[\[?)\s*({_NAME})\s*\]\]?")
_KEY = re.compile(rf"\s*({_NAME})\s*=")
_PARTS = re.compile(_PART)

Key = tuple[str | int, ...]  # such as ("microphone", 1, "device")


class Origins(NamedTuple):
    """What values were given, and where."""

    command_line: Mapping[str, Any]
    file: Mapping[str, Any]
    path: Path | None
    lines: Mapping[Key, int]

    def origin(self, key: Key) -> str:
        """Say where the value of a key comes from."""
        first = str(key[0]) if key else ""
        if first in self.command_line:
            return "command line"
        if (variable := _variable(first)) is not None:
            return f"environment, {variable}"
        if first not in self.file or not self._is_given(key):
            return DEFAULT
        line = next((self.lines[up] for up in _upwards(key) if up in self.lines), None)
        return f"{self.path}" if line is None else f"{self.path}, line {line}"

    def place(self, key: Key) -> str:
        """Say where something is wrong: a line of the file, or what else the value comes from."""
        every = (self.origin(key[:end]) for end in range(len(key), 0, -1))  # of what it is in
        return next((origin for origin in every if origin != DEFAULT), "configuration")

    def _is_given(self, key: Key) -> bool:
        value: Any = self.file
        for part in key:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return False
        return True


def key_lines(text: str) -> dict[Key, int]:
    """Return on which line each key, and each table, of a TOML file begins.

    Parameters
    ----------
    text : str
        Its content. Keys in tables within a line are not looked for.

    Returns
    -------
    dict of Key to int
        Counted from 1.
    """
    lines: dict[Key, int] = {}
    table: Key = ()
    counts: dict[Key, int] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if head := _TABLE.match(line):
            table = _parts(head[2])
            lines.setdefault(table, number)
            if head[1] == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
                lines.setdefault(table, number)
        elif key := _KEY.match(line):
            lines.setdefault((*table, *_parts(key[1])), number)
    return lines


def _parts(name: str) -> Key:
    return tuple(part.strip("\"'") for part in _PARTS.findall(name))


def _variable(name: str) -> str | None:
    wanted = f"{ENVIRONMENT}{name}".upper()
    is_a_key = name and name == name.lower()  # NODE in a file is none
    return next((each for each in os.environ if each.upper() == wanted), None) if is_a_key else None


def _upwards(key: Key) -> list[Key]:
    """Return a key, and what it is in."""
    return [key[:end] for end in range(len(key), 0, -1)]
