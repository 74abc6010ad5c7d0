"""What a recorder needs of the machine that it is a service of."""

from dataclasses import dataclass
from pathlib import Path

STATE = Path("/var/lib/hearthlog")  # what systemd calls the state directory of the unit


@dataclass(frozen=True)
class Needs:
    """What a recorder needs by its configuration."""

    output: str
    models: list[str]
    has_network: bool
    readable_by: str
