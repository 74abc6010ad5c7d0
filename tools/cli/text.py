"""How results, numbers, times and lists are printed, and what goes to standard error."""

import json
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import typer

from hearthlog.schemas.errors import printable
from hearthlog.schemas.frames import millisecond_text

JUDGED_BY = "leave it recording, for ten minutes that it has not learned from judge it"
_SHOWN = 10  # of a list
_MOST_TOLD = 100  # that are remembered


def print_lines(lines: Iterable[str]) -> None:
    """Print lines whose texts may come from any file."""
    for line in lines:
        print(printable(line))


def print_json(result: dict[str, Any]) -> None:
    """Print a result for a program."""
    print(json.dumps(result, allow_nan=False))


def tell(text: str) -> None:
    """Write a line that is no result to standard error."""
    print(f"hearthlog: {printable(text)}", file=sys.stderr)


class TellOnce:
    """Tells what may come again and again, each text once."""

    def __init__(self) -> None:
        self._told: deque[str] = deque(maxlen=_MOST_TOLD)

    def __call__(self, what: object) -> None:
        """Tell it, unless it was told of late."""
        if str(what) not in self._told:
            self._told.append(str(what))
            tell(str(what))

    def __bool__(self) -> bool:
        return bool(self._told)


def wrong_use(message: str) -> NoReturn:
    """End with one line, and the exit status of wrong use."""
    tell(message)
    raise typer.Exit(2)


def unfinished_lines(paths: Sequence[Path]) -> list[str]:
    """Say in a line which logs were not completed, if any."""
    names = ", ".join(map(str, paths))
    return [f"unfinished, read up to the last whole chunk: {names}"] if names else []


def end_with_warnings(lines: Sequence[str]) -> None:
    """Tell each line; end with exit status 3 if there is one."""
    for line in lines:
        tell(line)
    if lines:
        raise typer.Exit(3)


def number(count: int, what: str) -> str:
    """Say how many there are of something."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def moment(stamp: int | None) -> str | None:
    """Write a time (ns of UTC) down to the millisecond; None stays None."""
    return None if stamp is None else millisecond_text(stamp)


def first_of(what: str, lines: Sequence[str], hint: str = " (--json lists all)") -> Iterator[str]:
    """Yield the first lines of a list, and how many more there are."""
    for line in lines[:_SHOWN]:
        yield f"{what}: {line}"
    if len(lines) > _SHOWN:
        yield f"{what}: and {len(lines) - _SHOWN} more{hint}"
