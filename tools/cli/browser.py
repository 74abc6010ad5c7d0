"""How what was drawn is looked at: a recording in Rerun, a page in a browser."""

import shlex
import webbrowser
from pathlib import Path

from hearthlog.tools.cli.text import tell


def print_recording(path: Path) -> None:
    """Print the name of a Rerun recording, and how to look at it."""
    from hearthlog.analyzer.review.viewer.process import hidden_options

    print(path)
    print(f"open it with: rerun {hidden_options()} {shlex.quote(str(path))}")
    tell("by --bind and --port no web page finds what Rerun shows")


def show_page(address: str) -> None:
    """Say where a page is, and open it where there is a display; without an address nothing."""
    if not address:
        return
    from hearthlog.analyzer.review.viewer.process import has_display

    tell(f"open {address}")
    if has_display():  # else a browser of the terminal would take it from us
        webbrowser.open(address)
