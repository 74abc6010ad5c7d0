"""Export, merging and cutting of logs: the table of formats, and names of files.

A format is an `Exporter` in a module of this folder, and a row here.
"""

import re
from typing import NamedTuple


class ExportFormat(NamedTuple):
    """An export format."""

    name: str  # also the file suffix
    module: str
    exporter: str  # name of the `Exporter` in the module
    note: str = ""  # origin of the format
    by_topic: bool = True  # whether each file holds one topic
    is_folder: bool = False

    @property
    def pattern(self) -> str:
        """Pattern and description of the files: `*.bag (ROS 1)`."""
        return f"*.{self.name} ({self.note})" if self.note else f"*.{self.name}"


FORMATS = {
    each.name: each
    for each in (
        ExportFormat("parquet", "arrow", "PARQUET"),
        ExportFormat("csv", "arrow", "CSV"),
        ExportFormat("npz", "npz", "NPZ"),
        ExportFormat("wav", "audio", "WAV"),
        ExportFormat("txt", "audio", "LABEL_TRACK", "Audacity labels"),
        ExportFormat("bag", "bags", "BAG", "ROS 1", by_topic=False),
        ExportFormat("rosbag2", "bags", "ROSBAG2", by_topic=False, is_folder=True),
    )
}


_LENGTH = 100  # characters


def file_stem(topic: str) -> str:
    """Return a file name part for a topic: `mic_features` for `/mic/features`.

    It has at most 100 letters, digits and `_`, and is `topic` if none remain.
    """
    return re.sub(r"[^A-Za-z0-9]+", "_", topic).strip("_")[:_LENGTH] or "topic"


def unused_name(name: str, taken: dict[str, int]) -> str:
    """Return an unused name: the preferred one, or `name-2.suffix` and so on."""
    stem, dot, suffix = name.rpartition(".")
    before, behind = (stem, dot + suffix) if stem else (name, "")
    unused, number = name, taken.get(name, 2)
    while unused in taken:
        unused, number = f"{before}-{number}{behind}", number + 1
    taken[name] = number
    taken[unused] = 2
    return unused
