"""Metadata records of a log: `hearthlog` with features and scenarios, and `rosbag2`; digests."""

import hashlib
import json
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Metadata

from hearthlog._version import __version__
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.message_types import SCHEMA_VERSION
from hearthlog.schemas.messages.topics import (
    SCENARIO,
    Quality,
    check_microphone_name,
    check_scenario_name,
)

HEARTHLOG_METADATA = "hearthlog"
THINNED = "thinned"  # message kinds dropped from a log
THINNED_OF = "thinned_of"  # digests of the log before each thinning
_VERSION_KEY = "schema_version"
_FIRST = "1"  # the first version did not write its number
_SCHEMA_VERSIONS = {str(number): number for number in range(1, SCHEMA_VERSION + 1)}
_LARGEST, _MOST = 1 << 20, 64 << 20  # bytes per record and in total; hearthlog's have below 1000


NEVER_TELL = "never_tell"  # key of the classes that nobody is told of, with commas between them


def provenance(node: str, **more: str) -> dict[str, str]:
    """Return the `hearthlog` record of a file written by this version."""
    return {"version": __version__, _VERSION_KEY: str(SCHEMA_VERSION), "node": node, **more}


def read_provenance(file: LogFile) -> list[Mapping[str, str]]:
    """Read the distinct `hearthlog` records of a file: one, those of all merged logs, or none.

    A record of a newer version causes a `HearthlogWarning`. Raise `LogError` if one is damaged.
    """
    records = provenance_records(file)
    for record in records:
        check_version(record, file.path)
    return records


def provenance_records(file: LogFile) -> list[Mapping[str, str]]:
    """Read records as `read_provenance`, without version check; raise `LogError` if damaged."""
    different: dict[frozenset[tuple[str, str]], Mapping[str, str]] = {}
    size = 0
    for place in file.record_locations:
        if place.opcode == Opcode.METADATA and place.length <= _LARGEST and size < _MOST:
            record = file.record(place)
            size += place.length
            if isinstance(record, Metadata) and record.name == HEARTHLOG_METADATA:
                different.setdefault(frozenset(record.metadata.items()), record.metadata)
    return list(different.values())


def version_text(record: Mapping[str, str]) -> str:
    """Return the schema version of a record as text, which may not be a number."""
    return record.get(_VERSION_KEY, _FIRST)


def schema_version(record: Mapping[str, str]) -> int | None:
    """Return the schema version of a record; None if this version does not support it."""
    return _SCHEMA_VERSIONS.get(version_text(record))


def describes_model(record: Mapping[str, str]) -> bool:
    """Return whether a log with this record has `model.json`, if it has labels."""
    version = schema_version(record)
    return version is not None and version > 1


def unknown_version(record: Mapping[str, str]) -> str:
    """Return why a schema version is not supported, to follow the file's name; else empty."""
    if schema_version(record) is not None:
        return ""
    return (
        f"is of schema version {version_text(record)[:20]!r}, and this hearthlog knows up to "
        f"{SCHEMA_VERSION}: what is newer in it is not read; {update_advice(record.get('version'))}"
    )


def check_version(record: Mapping[str, str], path: Path) -> None:
    """Warn with `HearthlogWarning` if the schema version of a file is not supported."""
    text = unknown_version(record)
    if text:
        warnings.warn(HearthlogWarning(text, path), stacklevel=2)


ROSBAG2_METADATA = "rosbag2"
_COUNTED = re.compile(
    r"^ *(?:name: *(?P<name>\S+)|message_count: *(?P<count>\d{1,18})) *$", re.MULTILINE
)
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass
class TopicCount:
    """Topic of a file with its number of messages."""

    type: str
    channel_metadata: Mapping[str, str]
    messages: int = 0


def rosbag2_channel(type_hash: str, quality: Quality) -> dict[str, str]:
    """Return the metadata required for a ROS 2 channel."""
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
    """Counts and span of one file of a bag, for rosbag2."""

    name: str  # relative to the folder of the bag
    topics: Mapping[str, TopicCount]
    span: tuple[int, int]  # first and last log time, in nanoseconds of UTC

    @property
    def times(self) -> dict[str, object]:
        """Start, duration and message count, in the format of rosbag2."""
        start, end = self.span
        return {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": end - start},
            "message_count": sum(topic.messages for topic in self.topics.values()),
        }


def rosbag2_metadata(
    name: str, topics: Mapping[str, TopicCount], span: tuple[int, int]
) -> dict[str, str]:
    """Return the `rosbag2` metadata record of a file (version 9 of its `metadata.yaml`).

    `span` has the first and last log time, in nanoseconds of UTC.
    """
    return {"serialized_metadata": json.dumps(_information([FileCounts(name, topics, span)]))}


def rosbag2_counts(record: Mapping[str, str]) -> dict[str, int]:
    """Read message counts by topic from a `rosbag2` record; empty if absent or contradictory."""
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
        elif name:  # entries of files, further on, have no name
            counts[name], name = int(match["count"]), ""
    return totals[0] if totals else -1, counts


def rosbag2_yaml(files: Sequence[FileCounts]) -> str:
    """Return the `metadata.yaml` of a bag of at least one file, in order of time.

    Type and quality of a topic are equal in all of them.
    """
    information = json.dumps(_information(files), ensure_ascii=False)  # JSON is valid YAML
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


FEATURE_SET = "feature_set"
FEATURE_SET_VERSION = "feature_set_version"
FEATURE_SET_DIGEST = "feature_set_sha256"
FEATURE_SET_DISTRIBUTION = "feature_set_distribution"
_DETAILS = (FEATURE_SET_VERSION, FEATURE_SET_DIGEST, FEATURE_SET_DISTRIBUTION)


def feature_entries(name: str, version: int, digest: str, distribution: str) -> dict[str, str]:
    """Return the record entries of a feature set: network's SHA-256, or empty, and distribution.

    The distribution has a version; it is empty for hearthlog itself.
    """
    entries = {FEATURE_SET: name, FEATURE_SET_VERSION: str(version)}
    origin = {FEATURE_SET_DIGEST: digest, FEATURE_SET_DISTRIBUTION: distribution}
    return entries | {key: text for key, text in origin.items() if text}


def other_features(
    first: Mapping[str, str], other: Mapping[str, str], microphone: str
) -> dict[str, str]:
    """Return the record entries for features of further microphones."""
    return {
        f"/{microphone}/{key}": other.get(key, "")
        for key in _DETAILS
        if other.get(key, "") != first.get(key, "")
    }


def features_of_microphone(record: Mapping[str, str], microphone: str) -> dict[str, str]:
    """Return a record with the feature entries of one microphone."""
    own = {key: record.get(f"/{microphone}/{key}", record.get(key, "")) for key in _DETAILS}
    others = {key: text for key, text in record.items() if key not in own}
    return others | {key: text for key, text in own.items() if text}


_SCENARIO_KEY = re.compile(f"{SCENARIO}/([^/]+)/([^/]+)")


class RecordedScenario(NamedTuple):
    """Scenario that ran for a microphone, and its model."""

    microphone: str
    name: str
    model: str
    sha256: str


def scenario_entries(scenario: RecordedScenario) -> dict[str, str]:
    """Return the record entries of a scenario."""
    key = f"{SCENARIO}/{scenario.microphone}/{scenario.name}"
    return {key: scenario.model, f"{key}/sha256": scenario.sha256}


def recorded_scenarios(record: Mapping[str, str]) -> Iterator[RecordedScenario]:
    """Yield the scenarios of a record, in order."""
    for key, model in record.items():
        names = _SCENARIO_KEY.fullmatch(key)
        if names is None:
            continue
        try:
            microphone, name = check_microphone_name(names[1]), check_scenario_name(names[2])
        except LogError:
            continue
        yield RecordedScenario(microphone, name, model, record.get(f"{key}/sha256", ""))


_TAIL = 1 << 16  # bytes


def log_digest(log: Path) -> str:
    """Return the SHA-256, 64 hexadecimal digits, of a log's size and last 64 KiB, as its identity.

    The end of a log contains its index, or the end of it, and the checksum of the index. It
    identifies the log without reading all of it. Raise `LogError` if the log cannot be read, or is
    not an MCAP file.
    """
    with LogFile(log, indexed=False) as file:
        size = file.size
        tail = file.read(max(size - _TAIL, 0), _TAIL)
    return hashlib.sha256(str(size).encode() + b"\0" + tail).hexdigest()


def earlier_digests(log: Path) -> list[str]:
    """Return the digests before each thinning; raise `LogError` if the log is damaged."""
    with LogFile(log) as file:
        records = provenance_records(file)
    return [digest for record in records for digest in record.get(THINNED_OF, "").split()]


_RELEASE = re.compile(r"(\d{1,4})\.(\d{1,4})\.(\d{1,4})")


def update_advice(written_by: object) -> str:
    """Return the advice for a file that only a later release reads in full.

    `written_by` is the release that wrote the file, such as `0.4.0`; anything else, as a file may
    contain, gives the advice without a release.
    """
    release, own = _numbers(written_by), _numbers(__version__)
    if release is None or own is None or release <= own:
        return "update hearthlog"
    return f"update hearthlog to {written_by} or later"


def _numbers(text: object) -> tuple[int, ...] | None:
    found = _RELEASE.fullmatch(text) if isinstance(text, str) else None
    return None if found is None else tuple(int(number) for number in found.groups())
