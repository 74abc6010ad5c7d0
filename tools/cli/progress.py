"""Progress on standard error, when that is a terminal."""

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from hearthlog.schemas.progress import Progress, ignore_progress

_SPEED_SECONDS = 1800.0  # over which speed is measured, for the time left: steps may be long

Item = TypeVar("Item")


def track(items: Sequence[Item], what: str) -> Iterable[Item]:
    """Show how many of the items have been worked through."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track as track_with_bar

    return track_with_bar(items, what, console=Console(stderr=True), transient=True)


@contextmanager
def share_done(what: str, *, announce: bool = False) -> Iterator[Progress]:
    """Show the share, 0 to 1, that the block reports, and the time left.

    Parameters
    ----------
    what : str
    announce : bool
        Print what begins where standard error is no terminal.
    """
    if not sys.stderr.isatty():
        if announce:
            print(f"hearthlog: {what}", file=sys.stderr)
        yield ignore_progress
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(
        console=Console(stderr=True), transient=True, speed_estimate_period=_SPEED_SECONDS
    ) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)
