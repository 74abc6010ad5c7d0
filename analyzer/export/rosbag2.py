"""Logs as a rosbag2 folder."""

from hearthlog.analyzer.export.exporter import Exporter, OutputFiles
from hearthlog.analyzer.export.merge import write_log
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.progress import Progress


def _save(selection: Selection, files: OutputFiles, progress: Progress) -> int:
    """Write a log and `metadata.yaml`; raise LogError if rosbag2 cannot tell its channels apart."""
    log = files.path / f"{files.output.name}.mcap"
    with log.open("xb") as stream:
        record, repeated = write_log(selection, stream, log.name, progress)
    if record is None:
        raise LogError(
            "a topic has channels of different types or qualities of service, or no ROS 2 "
            "messages, which rosbag2 has no way to say; choose others with --topics"
        )
    information = record["serialized_metadata"]  # JSON, which is YAML too
    text = f"rosbag2_bagfile_information: {information}\n"
    (files.path / "metadata.yaml").write_text(text, "utf-8")
    return repeated


EXPORTER = Exporter(_save)
