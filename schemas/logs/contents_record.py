"""The metadata record `hearthlog_contents`: what a finished log says of its messages."""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Metadata

from hearthlog.schemas.logs.contents import STREAM, Contents, Gap, TopicContents
from hearthlog.schemas.logs.statuses import Status
from hearthlog.schemas.mcap.logfile import LogFile

METADATA = "hearthlog_contents"
_VERSION = "1"  # another one is not read
_LARGEST = 1 << 16  # bytes of the text
_ROOM = 1 << 10  # bytes of the rest of the record, at most
_MOST = 1 << 63


def as_metadata(contents: Contents) -> dict[str, str] | None:
    """Make the record; None if it would be large."""
    text = json.dumps(
        {
            "topics": contents.topics,
            "frames": contents.frames,
            "segments": contents.segments,
            "seconds": contents.seconds,
            "unsure": contents.unsure,
            "gaps": contents.gaps,
            "streams": contents.streams,
            "health": contents.health,
        }
    )
    if len(text) > _LARGEST:
        return None
    return {"version": _VERSION, "contents": text, "sha256": _digest(text)}


def stated_contents(file: LogFile) -> Contents | None:
    """Read what a finished log says of its messages.

    Returns
    -------
    Contents or None
        None if it says nothing, or what does not fit its statistics: its messages tell it then.

    Raises
    ------
    LogError
        If the file cannot be read, or its last metadata record is damaged.
    """
    places = [place for place in file.record_locations if place.opcode == Opcode.METADATA]
    if file.statistics is None or not places or places[-1].length > _LARGEST + _ROOM:
        return None
    record = file.record(places[-1])  # the writer has put it there
    if not isinstance(record, Metadata) or record.name != METADATA:
        return None
    contents = from_metadata(record.metadata)
    return contents if contents is not None and _fits(file, contents) else None


def from_metadata(record: Mapping[str, str]) -> Contents | None:
    """Read the record; None if it is damaged, or of another version.

    Parameters
    ----------
    record : mapping of str to str
        From any file: what it holds is checked for its form, not for its truth.
    """
    text = record.get("contents", "")
    if record.get("version") != _VERSION or record.get("sha256") != _digest(text):
        return None
    try:
        return _contents(json.loads(text))
    except (ValueError, TypeError, KeyError, AttributeError, ArithmeticError, RecursionError):
        return None


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="replace")).hexdigest()


def _contents(values: Any) -> Contents:
    health = values["health"]
    return Contents(
        topics={name: TopicContents(*map(_count, row)) for name, row in values["topics"].items()},
        frames=_counters(values["frames"], _count),
        segments=_counters(values["segments"], _count),
        seconds=_counters(values["seconds"], _amount),
        unsure=_counters(values["unsure"], _amount),
        gaps=[
            Gap(_text(mic), _count(start), _amount(seconds), _text(reason), _count(lost))
            for mic, start, seconds, reason, lost in values["gaps"]
        ],
        streams=[_stream(stream) for stream in values["streams"]],
        health=None if health is None else _health(*health),
    )


def _health(name: Any, time: Any, level: Any, message: Any) -> Status:
    return Status(_text(name), _count(time), _count(level), _text(message))


def _stream(values: Any) -> dict[str, Any]:
    return {name: (_amount if name == "frame_seconds" else _text)(values[name]) for name in STREAM}


def _counters(values: Any, number: Any) -> dict[str, Counter[str]]:
    return {
        name: Counter({label: number(value) for label, value in row.items()})
        for name, row in values.items()
    }


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def _count(value: Any) -> int:
    if type(value) is not int or not -_MOST <= value < _MOST:
        raise ValueError(value)
    return value


def _amount(value: Any) -> float:
    if type(value) not in {int, float} or not math.isfinite(value) or abs(value) >= _MOST:
        raise ValueError(value)
    number: float = value  # a sum of nothing is the integer 0
    return number


def _fits(file: LogFile, contents: Contents) -> bool:
    """Compare what a file says of its messages with its statistics."""
    statistics = file.statistics
    assert statistics is not None
    counts: Counter[str] = Counter()
    for number, count in statistics.channel_message_counts.items():
        if count and number not in file.channels:
            return False
        if count:
            counts[file.channels[number].topic] += count
    topics = contents.topics
    if counts != {name: topic.messages for name, topic in topics.items()}:
        return False
    if not topics:
        return True
    span = min(t.start for t in topics.values()), max(t.end for t in topics.values())
    return span == (statistics.message_start_time, statistics.message_end_time)
