"""Logs as a rosbag2 folder."""

from pathlib import Path

from hearthlog.analyzer.export.merge import write_log
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.progress import Progress


def save_rosbag2(folder: Path, name: str, selection: Selection, progress: Progress) -> None:
    """Write a log and `metadata.yaml` to a folder, which must exist.

    Parameters
    ----------
    folder : Path
    name : str
        Of the log in it, without suffix.
    selection : Selection
    progress : callable
        Is told the share that is done.

    Raises
    ------
    LogError
        If a log is damaged, if there is no message, or if rosbag2 cannot tell its channels apart.
    """
    log = folder / f"{name}.mcap"
    with log.open("xb") as stream:
        record = write_log(selection, stream, log.name, progress)
    if record is None:
        raise LogError(
            "a topic has channels of different types or qualities of service, or no ROS 2 "
            "messages, which rosbag2 has no way to say; choose others with --topics"
        )
    information = record["serialized_metadata"]  # JSON, which is YAML too
    text = f"rosbag2_bagfile_information: {information}\n"
    (folder / "metadata.yaml").write_text(text, "utf-8")
