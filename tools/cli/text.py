"""How numbers, times and lists are printed."""

import sys
from collections.abc import Iterator, Sequence

from hearthlog.schemas.text import printable

PLAIN_WIDTH = 160  # where there is no terminal to say how wide it is
_SHOWN = 10  # of a list


def tell(text: str) -> None:
    """Write a line that is no result to standard error."""
    print(f"hearthlog: {printable(text)}", file=sys.stderr)


def number(count: int, what: str) -> str:
    """Say how many there are of something."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def moment(stamp: int | None) -> str | None:
    """Write a time (ns of UTC) down to the millisecond."""
    import numpy as np

    return None if stamp is None else f"{np.datetime64(stamp, 'ns').astype('datetime64[ms]')}Z"


def first_of(what: str, lines: Sequence[str]) -> Iterator[str]:
    """Yield the first lines of a list, and how many more there are."""
    for line in lines[:_SHOWN]:
        yield f"{what}: {line}"
    if len(lines) > _SHOWN:
        yield f"{what}: and {len(lines) - _SHOWN} more (--json lists all)"
