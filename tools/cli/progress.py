"""Progress on standard error, when that is a terminal."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hearthlog.schemas.progress import Progress, ignore_progress

_SPEED_SECONDS = 1800.0  # over which speed is measured, for the time left: steps may be long


@contextmanager
def share_done(what: str, *, announce: bool = False) -> Iterator[Progress]:
    """Show the share, 0 to 1, that the block reports, and the time left.

    Where standard error is no terminal, `announce` prints what begins.
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
