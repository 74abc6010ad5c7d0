"""A page of this machine, shown to whoever sits before it."""

import webbrowser

import typer


def show_page(address: str) -> None:
    """Say where a page is, and open it where there is a display."""
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.review.viewer.process import check_display

    typer.echo(f"hearthlog: open {address}", err=True)
    try:
        check_display("")
    except DataError:
        return  # a browser of the terminal would take it from us
    webbrowser.open(address)
