"""Progress on standard error: a bar on a terminal, now and then a line elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from hearthlog.schemas.errors import Progress
from hearthlog.tools.cli.text import tell

_SPEED_SECONDS = 1800.0  # over which speed is measured, for the time left: steps may be long
_LINE_SECONDS = 60.0  # between two lines


@contextmanager
def share_done(what: str, *, announce: bool = False) -> Iterator[Progress]:
    """Show the share, 0 to 1, that the block reports, and the time left.

    Where standard error is no terminal, `announce` prints what begins, and what takes longer than
    a minute prints a line a minute.
    """
    if not sys.stderr.isatty():
        if announce:
            tell(what)
        yield _lines(what)
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(
        console=Console(stderr=True), transient=True, speed_estimate_period=_SPEED_SECONDS
    ) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def _lines(what: str) -> Progress:
    last = time.monotonic()

    def report(share: float) -> None:
        nonlocal last
        if time.monotonic() - last >= _LINE_SECONDS:
            last = time.monotonic()
            tell(f"{what}: {share:.1%}")

    return report
