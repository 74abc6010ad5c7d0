"""Opening a page of this machine in a browser."""

import webbrowser

from hearthlog.tools.cli.text import tell


def show_page(address: str) -> None:
    """Say where a page is, and open it where there is a display."""
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.review.viewer.process import check_display

    tell(f"open {address}")
    try:
        check_display("")
    except DataError:
        return  # a browser of the terminal would take it from us
    webbrowser.open(address)
