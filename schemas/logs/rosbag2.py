"""What rosbag2 wants to find in an MCAP file."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from hearthlog.schemas.messages.topics import Quality

METADATA = "rosbag2"
_COUNTED = re.compile(
    r"^ *(?:name: *(?P<name>\S+)|message_count: *(?P<count>\d{1,18})) *$", re.MULTILINE
)
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass
class TopicCount:
    """One topic of a file and the number of its messages."""

    type: str
    channel_metadata: Mapping[str, str]
    messages: int = 0


def channel_metadata(type_hash: str, quality: Quality) -> dict[str, str]:
    """Return the metadata that a ROS 2 channel must have."""
    seconds = quality.lifespan_seconds
    profile = {
        "history": "keep_last",
        "depth": quality.depth,
        "reliability": "reliable",
        "durability": "transient_local" if quality.transient_local else "volatile",
        "deadline": _FOREVER,
        "lifespan": _FOREVER if seconds is None else {"sec": seconds, "nsec": 0},
        "liveliness": "automatic",
        "liveliness_lease_duration": _FOREVER,
        "avoid_ros_namespace_conventions": False,
    }
    return {"offered_qos_profiles": json.dumps([profile]), "topic_type_hash": type_hash}


class FileCounts(NamedTuple):
    """What rosbag2 wants to know of one file of a bag."""

    name: str  # relative to the folder of the bag
    topics: Mapping[str, TopicCount]
    span: tuple[int, int]  # first and last log time, in nanoseconds of UTC

    @property
    def times(self) -> dict[str, object]:
        """When it begins, how long it lasts, and how many messages it has, in rosbag2's words."""
        start, end = self.span
        return {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": end - start},
            "message_count": sum(topic.messages for topic in self.topics.values()),
        }


def file_metadata(
    name: str, topics: Mapping[str, TopicCount], span: tuple[int, int]
) -> dict[str, str]:
    """Return the `rosbag2` metadata record of a file (version 9 of its `metadata.yaml`).

    Parameters
    ----------
    span : (int, int)
        First and last log time, in nanoseconds of UTC.
    """
    return {"serialized_metadata": json.dumps(_information([FileCounts(name, topics, span)]))}


def message_counts(record: Mapping[str, str]) -> dict[str, int]:
    """Read how many messages of each topic a file has by its `rosbag2` metadata record.

    Returns
    -------
    dict of str to int
        By topic; empty if the record does not say so, or says two things.
    """
    text = record.get("serialized_metadata", "")
    try:
        total, counts = _from_json(text) if text.lstrip().startswith("{") else _from_yaml(text)
    except (KeyError, TypeError, ValueError, RecursionError):
        return {}
    return counts if sum(counts.values()) == total else {}


def _from_json(text: str) -> tuple[int, dict[str, int]]:
    record = json.loads(text)
    topics = record["topics_with_message_count"]
    counts = {topic["topic_metadata"]["name"]: int(topic["message_count"]) for topic in topics}
    return int(record["message_count"]), counts


def _from_yaml(text: str) -> tuple[int, dict[str, int]]:
    before, _, topics = text.partition("topics_with_message_count:")
    totals = [int(match["count"]) for match in _COUNTED.finditer(before) if match["count"]]
    counts: dict[str, int] = {}
    name = ""
    for match in _COUNTED.finditer(topics):
        if match["name"]:
            name = match["name"]
        elif name:  # those of files, further on, have none
            counts[name], name = int(match["count"]), ""
    return totals[0] if totals else -1, counts


def metadata_yaml(files: Sequence[FileCounts]) -> str:
    """Return the `metadata.yaml` of a bag of some files.

    Parameters
    ----------
    files : sequence of FileCounts
        In the order of time, at least one; a topic is of one type and quality in all of them.
    """
    information = json.dumps(_information(files), ensure_ascii=False)  # JSON, which is YAML too
    return f"rosbag2_bagfile_information: {information}\n"


def _information(files: Sequence[FileCounts]) -> dict[str, object]:
    topics: dict[str, TopicCount] = {}
    for file in files:
        for name, topic in file.topics.items():
            earlier = topics.get(name)
            messages = topic.messages + (0 if earlier is None else earlier.messages)
            topics[name] = replace(topic, messages=messages)
    start, end = min(file.span[0] for file in files), max(file.span[1] for file in files)
    return {
        "version": 9,
        "storage_identifier": "mcap",
        **FileCounts("", topics, (start, end)).times,
        "topics_with_message_count": [
            {"topic_metadata": _topic_metadata(name, topic), "message_count": topic.messages}
            for name, topic in topics.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [{"path": file.name, **file.times} for file in files],
        "custom_data": {},
        "ros_distro": "",
    }


def _topic_metadata(name: str, topic: TopicCount) -> dict[str, object]:
    return {
        "name": name,
        "type": topic.type,
        "serialization_format": "cdr",
        "offered_qos_profiles": json.loads(topic.channel_metadata["offered_qos_profiles"]),
        "type_description_hash": topic.channel_metadata["topic_type_hash"],
    }
