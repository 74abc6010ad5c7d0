"""Logs as a rosbag2 folder."""

import warnings
from typing import Any

from hearthlog.analyzer.export.exporter import Exporter, OutputFiles
from hearthlog.analyzer.export.merge import is_for_rosbag2, write_log
from hearthlog.analyzer.logs.selection import LogSelection
from hearthlog.schemas.errors import HearthlogWarning, LogError, Progress
from hearthlog.schemas.messages.type_definitions import defined_types

_NO_PLACE = (
    "channels of different types or qualities of service, or without ROS 2 messages, for which "
    "rosbag2 has no place"
)


def _save(selection: LogSelection, files: OutputFiles, progress: Progress) -> int:
    """Write a log and `metadata.yaml`, without topics whose channels rosbag2 cannot tell apart."""
    topics = [topic for topic, channels in selection.channels.items() if is_for_rosbag2(channels)]
    if selection.channels and not topics:
        raise LogError(_NO_PLACE)
    for topic in selection.channels.keys() - topics:
        warnings.warn(HearthlogWarning(f"{_NO_PLACE}: left out", topic, each=True), stacklevel=2)
    if len(topics) < len(selection.channels):
        selection = selection.only(topics)
    _warn_of_definitions(selection)
    log = files.path / f"{files.output.name}.mcap"
    with log.open("xb") as stream:
        record, repeated = write_log(selection, stream, log.name, progress)
    assert record is not None  # each topic has one description
    information = record["serialized_metadata"]  # JSON, which is YAML too
    text = f"rosbag2_bagfile_information: {information}\n"
    (files.path / "metadata.yaml").write_text(text, "utf-8")
    return repeated


def _warn_of_definitions(selection: LogSelection) -> None:
    """Warn of types with several definitions: readers of rosbag2 decode all by one of them."""
    known: dict[str, Any] = {}
    for topic, channels in selection.channels.items():
        for schema in [schema for _, schema in channels if schema is not None]:
            try:
                types = defined_types(schema.name, schema.encoding, schema.data)
            except LogError:
                continue  # its messages are copied all the same
            for name, (_, fields) in types.items():
                if known.setdefault(name, fields) != fields:
                    text = f"{name} is defined in two ways, of which readers of rosbag2 take one"
                    warnings.warn(HearthlogWarning(text, topic), stacklevel=2)


EXPORTER = Exporter(_save)
