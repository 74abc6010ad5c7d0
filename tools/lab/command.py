"""How scripts of the lab are run."""

import sys
from collections.abc import Callable

import typer

from hearthlog.schemas.errors import HearthlogError


def run(command: Callable[..., object]) -> None:
    """Run a function with the options of the command line; an error of ours is one line."""
    try:
        typer.run(command)
    except (HearthlogError, OSError) as error:
        sys.exit(f"hearthlog: {error}")
