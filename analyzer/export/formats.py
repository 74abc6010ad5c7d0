"""The table of export formats, and the names of exported files.

A format is an `Exporter` in a module of this folder, and a row here.
"""

import re
from typing import NamedTuple


class ExportFormat(NamedTuple):
    """A format of exports."""

    name: str  # and the suffix of its files
    module: str
    exporter: str  # by its name in the module
    note: str = ""  # whose format it is
    by_topic: bool = True  # whether a file is for one topic
    is_folder: bool = False

    @property
    def pattern(self) -> str:
        """How its files are named, and what they are: `*.bag (ROS 1)`."""
        return f"*.{self.name} ({self.note})" if self.note else f"*.{self.name}"


FORMATS = {
    each.name: each
    for each in (
        ExportFormat("parquet", "arrow", "PARQUET"),
        ExportFormat("csv", "csvfile", "CSV"),
        ExportFormat("npz", "npz", "NPZ"),
        ExportFormat("wav", "audio", "WAV"),
        ExportFormat("txt", "audio", "LABEL_TRACK", "Audacity labels"),
        ExportFormat("bag", "bags", "BAG", "ROS 1", by_topic=False),
        ExportFormat("rosbag2", "bags", "ROSBAG2", by_topic=False, is_folder=True),
    )
}


_LENGTH = 100  # characters


def file_stem(topic: str) -> str:
    """Make a part of a file name from a topic: `mic_features` from `/mic/features`.

    Returns
    -------
    str
        At most 100 letters, digits and `_`; `topic` if nothing is left.
    """
    return re.sub(r"[^A-Za-z0-9]+", "_", topic).strip("_")[:_LENGTH] or "topic"


def unused_name(name: str, taken: dict[str, int]) -> str:
    """Return a name that is not taken, with a number before its suffix if need be.

    Parameters
    ----------
    name : str
        The name that is wanted; becomes `name-2.suffix` and so on.
    """
    stem, dot, suffix = name.rpartition(".")
    before, behind = (stem, dot + suffix) if stem else (name, "")
    unused, number = name, taken.get(name, 2)
    while unused in taken:
        unused, number = f"{before}-{number}{behind}", number + 1
    taken[name] = number
    taken[unused] = 2
    return unused
