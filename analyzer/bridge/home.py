"""Whose sounds a bridge tells of."""

from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple


class Home(NamedTuple):
    """The recorder of a home, and the home's own time."""

    folder: Path
    node: str
    zone: tzinfo
