"""Label file formats of other programs, one module each, read and written as marks."""

from pathlib import Path
from typing import NamedTuple

from hearthlog.schemas.errors import listed

_MEGABYTE = 1 << 20


class LabelFormat(NamedTuple):
    """A format of label files."""

    name: str  # of the program or the format
    suffix: str
    module: str
    size_limit: int = 16 * _MEGABYTE  # enough for a hundred thousand labels
    has_columns: bool = False  # whether columns can be chosen
    has_tiers: bool = False

    @property
    def pattern(self) -> str:
        """File name pattern with the program name: `*.eaf (ELAN)`."""
        named = self.suffix == f".{self.name.lower()}"
        return f"*{self.suffix}" if named else f"*{self.suffix} ({self.name})"


AUDACITY = LabelFormat("Audacity", ".txt", "tables")
RAVEN = LabelFormat("Raven", ".selections.txt", "tables", has_columns=True)
FORMATS = (
    AUDACITY,
    RAVEN,
    LabelFormat("CSV", ".csv", "tables", has_columns=True),
    # XML needs more bytes for the same number of labels.
    LabelFormat("ELAN", ".eaf", "elan", 64 * _MEGABYTE, has_tiers=True),
    LabelFormat("Label Studio", ".json", "labelstudio"),
    LabelFormat("RTTM", ".rttm", "tables"),
)
PATTERNS = listed([each.pattern for each in FORMATS])


def find_format(path: Path) -> LabelFormat | None:
    """Return the format of a file by its suffix; None if it is not in `FORMATS`."""
    fitting = [each for each in FORMATS if path.name.endswith(each.suffix)]
    return max(fitting, key=lambda each: len(each.suffix), default=None)
