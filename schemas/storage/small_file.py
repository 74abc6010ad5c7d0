"""Files that people write or pass on: read whole within limits, or refused with one line."""

import os
import re
import tomllib
from pathlib import Path
from typing import IO, Any

from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.storage.byte_ranges import is_local
from hearthlog.schemas.storage.regular_file import open_regular

_TOML_LIMIT = 1 << 20
_LINE = re.compile(r"at line (\d+)")
_HINTS = (  # by what the parser says, and the line it stopped at
    (
        re.compile(r"overwrite|twice|redefine|mutate|duplicate", re.IGNORECASE),
        "; a key or table is given twice",
    ),
    (
        re.compile(r"\n.*\"[^\"]*\\"),
        "; a text with a backslash stands in single quotes: 'C:\\logs'",
    ),
    (
        re.compile(r"Invalid value"),
        '; a text stands in quotes, as node = "home"; else true, false, a number',
    ),
    (
        re.compile(
            r"Expected '='|Invalid (initial )?(character|statement)|after (a )?(key|statement)"
        ),
        "; each line is KEY = VALUE, [TABLE] or # COMMENT",
    ),
    (
        re.compile(r"Unclosed|Unterminated|newline|Illegal character '\\n'", re.IGNORECASE),
        "; a quote or a bracket is not closed, or a comma is missing",
    ),
)
_UTF_16 = {b"\xff\xfe", b"\xfe\xff"}
_IS_UTF_16 = "no UTF-8: it is UTF-16"
_DEEPEST = 100  # parts of a dotted key, for which the parser takes the cube of their number


def read_whole(path: Path, what: str, limit: int, error: type[HearthlogError]) -> bytes:
    """Read a regular file of this machine, or a file of a store.

    Parameters
    ----------
    limit : int
        Bytes, at most.

    Raises
    ------
    HearthlogError
        Of the type `error`, if there is no such file, it is larger than the limit, cannot be read,
        or is no regular file.
    """
    try:
        if not path.exists():
            raise error(f"{path}: no such {what}")
        with _opened(path) as stream:
            data = stream.read(limit + 1)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})") from reason
    if len(data) > limit:
        most = f"{limit >> 20} MB" if limit >= 1 << 20 else f"{limit / 1000:.3g} kB"
        raise error(f"{path}: larger than {most}; this is no {what}")
    return data


def _opened(path: Path) -> IO[bytes]:
    """Open a file, which in a store is a regular one."""
    return os.fdopen(open_regular(path), "rb") if is_local(path) else path.open("rb")


def read_toml(path: Path, what: str, error: type[HearthlogError]) -> dict[str, Any]:
    """Read a TOML file of at most 1 MB.

    Raises
    ------
    HearthlogError
        Of the type `error`, if there is no such file, it is larger than 1 MB, cannot be read, is
        nested too deeply, or is no TOML in UTF-8.
    """
    data = read_whole(path, what, _TOML_LIMIT, error)
    content: dict[str, Any] = {}
    try:
        text = data.decode("utf-8-sig")  # editors of Windows begin a file with a mark
        keys = (line for line in text.split("\n") if not line.lstrip().startswith("#"))
        if "\0" in text:
            raise error(f"{path}: cannot be read as TOML ({_IS_UTF_16}); save it as UTF-8")
        deep = any(line.count(".") > _DEEPEST for line in keys)
        if not deep:
            content = tomllib.loads(text)
    except UnicodeDecodeError as reason:
        line = data.count(b"\n", 0, reason.start) + 1
        problem = _IS_UTF_16 if data[:2] in _UTF_16 else f"no UTF-8: at line {line}"
        raise error(f"{path}: cannot be read as TOML ({problem}); save it as UTF-8") from reason
    except ValueError as reason:
        raise error(f"{path}: cannot be read as TOML ({_toml_problem(text, reason)})") from reason
    except RecursionError:
        deep = True
    if deep:
        raise error(f"{path}: cannot be read as TOML (it is nested too deeply)")
    return content


def _toml_problem(text: str, reason: ValueError) -> str:
    """Say what the parser refuses, where, and what to write."""
    last = f"at line {text.rstrip().count(chr(10)) + 1}, the last one"
    problem = str(reason).replace("at end of document", last)[:200]
    found = _LINE.search(problem)
    lines = text.split("\n")
    line = lines[int(found[1]) - 1] if found and int(found[1]) <= len(lines) else ""
    return problem + next(
        (hint for words, hint in _HINTS if words.search(f"{problem}\n{line}")), ""
    )
