"""Progress on standard error, when that is a terminal."""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

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
def share_done(what: str) -> Iterator[Callable[[float], None]]:
    """Show the share, 0 to 1, that the block reports, and the time left."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(
        console=Console(stderr=True), transient=True, speed_estimate_period=_SPEED_SECONDS
    ) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)


@contextmanager
def steps_done(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show how many of how many steps are done, and the time left; or, elsewhere, what begins."""
    if not sys.stderr.isatty():
        print(f"hearthlog: {what}", file=sys.stderr)
    with share_done(what) as share:
        yield lambda done, total: share(done / max(total, 1))
