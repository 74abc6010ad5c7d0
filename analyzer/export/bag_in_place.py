"""A folder of logs as one bag of rosbag2: what its `metadata.yaml` says, and no copy."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.export.merge import bag_metadata
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.files import is_local
from hearthlog.schemas.logs.files import find_logs, is_active, is_layer
from hearthlog.schemas.logs.metadata import FileCounts, TopicCount, rosbag2_yaml
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.new_files import replaced_file

METADATA = "metadata.yaml"
_DESCRIPTION = {"offered_qos_profiles", "topic_type_hash"}


class BagInPlace(NamedTuple):
    """What was made of a folder of logs."""

    metadata: Path  # the file
    unfinished: list[Path]  # logs that were not completed, or have no messages; not in the bag
    overlapping: list[Path]  # logs that begin before an earlier one of the bag ends


def describe_as_bag(folder: Path, progress: Progress = ignore_progress) -> BagInPlace:
    """Write a `metadata.yaml` that makes one bag of all finished logs of a folder, or replace it.

    Layers are left out: rosbag2 reads one file after the other.

    Parameters
    ----------
    progress : callable
        Is told the share that is done, 0 to 1.

    Raises
    ------
    LogError
        If there is no folder or no finished log in it, if a log is damaged, if a topic is of
        different types or qualities of service, or if the file cannot be written.
    """
    if not (is_local(folder) and folder.is_dir()):
        raise LogError(f"{folder}: is no folder of this machine; name that of the logs")
    logs = [log for log in find_logs(folder) if not is_layer(log)]
    counts, unfinished = [], []
    for number, log in enumerate(logs):
        progress(number / len(logs))
        counted = None if is_active(log) else _count(log, folder)
        if counted is None:
            unfinished.append(log)
        else:
            counts.append(counted)
    if not counts:
        raise LogError(f"{folder}: no finished log is in this folder")
    _check_topics(counts)
    counts.sort(key=lambda file: file.span)
    path = folder / METADATA
    with replaced_file(path) as temporary:
        temporary.write_text(rosbag2_yaml(counts), "utf-8")
    return BagInPlace(path, unfinished, [folder / name for name in _overlapping(counts)])


def _overlapping(files: Sequence[FileCounts]) -> Iterator[str]:
    """Give the names of files that begin before an earlier one ends; rosbag2 merges nothing."""
    latest = 0
    for file in files:
        start, end = file.span
        if start < latest:
            yield file.name
        latest = max(latest, end)


def _count(log: Path, folder: Path) -> FileCounts | None:
    """Count the messages of a log by its index; None if it was not completed, or has none."""
    with LogFile(log) as file:
        statistics = file.statistics
        if not file.complete or statistics is None or not statistics.message_count:
            return None
        topics: dict[str, TopicCount] = {}
        for number, channel in file.channels.items():
            schema = file.schemas.get(channel.schema_id)
            if schema is None or not channel.metadata.keys() >= _DESCRIPTION:
                raise LogError(f"{log}: topic {channel.topic} is not described as rosbag2 needs it")
            described = TopicCount(schema.name, bag_metadata(channel))
            topic = topics.setdefault(channel.topic, described)
            topic.messages += statistics.channel_message_counts.get(number, 0)
        span = statistics.message_start_time, statistics.message_end_time
        return FileCounts(log.relative_to(folder).as_posix(), topics, span)


def _check_topics(files: Sequence[FileCounts]) -> None:
    """Check that every topic is the same in all files."""
    known: dict[str, tuple[object, str]] = {}
    for file in files:
        for name, identity in _identities(file):
            other, where = known.setdefault(name, (identity, file.name))
            if other != identity:
                raise LogError(
                    f"{name} is of different types or qualities of service in {where} and "
                    f"{file.name}, which rosbag2 has no way to say; export with --format rosbag2 "
                    "and --output a part that is of one"
                )


def _identities(file: FileCounts) -> Iterator[tuple[str, object]]:
    for name, topic in file.topics.items():
        about = topic.channel_metadata
        yield name, (topic.type, about["offered_qos_profiles"], about["topic_type_hash"])
