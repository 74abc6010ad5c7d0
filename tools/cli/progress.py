"""A progress bar on standard error, when that is a terminal."""

import sys
from collections.abc import Iterable, Sequence
from typing import TypeVar

Item = TypeVar("Item")


def track(items: Sequence[Item], what: str) -> Iterable[Item]:
    """Show how many of the items have been worked through."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track as track_with_bar

    return track_with_bar(items, what, console=Console(stderr=True), transient=True)
