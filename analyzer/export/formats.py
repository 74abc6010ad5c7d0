"""The formats of exports: the one table that `save` and the command line use.

A format is a module of this folder that has an `EXPORTER`, and a row here.
"""

from typing import NamedTuple


class ExportFormat(NamedTuple):
    """A format of exports."""

    name: str  # and the suffix of its files
    module: str
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
        ExportFormat("parquet", "parquet"),
        ExportFormat("csv", "csvfile"),
        ExportFormat("npz", "npz"),
        ExportFormat("wav", "wav"),
        ExportFormat("txt", "audacity", "Audacity labels"),
        ExportFormat("bag", "rosbag1", "ROS 1", by_topic=False),
        ExportFormat("rosbag2", "rosbag2", by_topic=False, is_folder=True),
    )
}
