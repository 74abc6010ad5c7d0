"""What is in a log, or in a folder of logs."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from schemas import messages
from schemas.messages import NANOSECONDS, nanoseconds
from schemas.reader import LogMessage, LogReader


@dataclass
class TopicSummary:
    """One topic: its messages, the bytes of their payloads before compression, its log times."""

    type: str
    messages: int = 0
    bytes: int = 0
    first: int = 0
    last: int = 0

    @property
    def rate(self) -> float:
        """Messages a second between its first and its last one."""
        span = (self.last - self.first) / NANOSECONDS
        return (self.messages - 1) / span if span > 0 else 0.0


@dataclass(frozen=True)
class GapSummary:
    """Audio that was not heard: when (ns of UTC), for how long (s), and why."""

    microphone: str
    start: int
    seconds: float
    reason: str
    frames_lost: int


@dataclass
class Summary:
    """What was found in some logs.

    Attributes
    ----------
    files : list of Path
    unfinished : list of Path
        Those of them that are still being written, or were cut short.
    size : int
        Bytes on disk.
    topics : dict of str to TopicSummary
    label_seconds : dict of str to dict of str to float
        By microphone and label.
    gaps : list of GapSummary
    streams : list of dict
        What the files say of themselves: microphone, device, feature set, model.
    """

    files: list[Path] = field(default_factory=list)
    unfinished: list[Path] = field(default_factory=list)
    size: int = 0
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    label_seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    gaps: list[GapSummary] = field(default_factory=list)
    streams: list[dict[str, str]] = field(default_factory=list)

    @property
    def start(self) -> int:
        """Log time of the first message, in nanoseconds of UTC."""
        return min((topic.first for topic in self.topics.values()), default=0)

    @property
    def end(self) -> int:
        """Log time of the last message."""
        return max((topic.last for topic in self.topics.values()), default=0)

    @property
    def seconds(self) -> float:
        """Time from the first message to the last."""
        return (self.end - self.start) / NANOSECONDS


def summarise(paths: Iterable[Path]) -> Summary:
    """Read logs from beginning to end and count.

    Raises
    ------
    LogError
        If one of them is no log, or is damaged.
    """
    summary = Summary()
    frames = Counter[tuple[str, str]]()
    frame_seconds: dict[str, float] = {}
    for path in paths:
        log = LogReader(path)
        for item in log.messages():
            _count(summary, item)
            if item.type == messages.LABEL:
                content = item.decode()
                frames[content.header.frame_id, content.label] += 1
            elif item.type == messages.STREAM_INFO:
                content = item.decode()
                frame_seconds[content.header.frame_id] = float(content.frame_seconds)
        summary.files.append(path)
        summary.size += path.stat().st_size
        if not log.complete:
            summary.unfinished.append(path)
    for (microphone, label), count in frames.most_common():
        seconds = count * frame_seconds.get(microphone, 0.0)
        summary.label_seconds.setdefault(microphone, {})[label] = round(seconds, 3)
    return summary


def _count(summary: Summary, item: LogMessage) -> None:
    topic = summary.topics.setdefault(item.topic, TopicSummary(item.type))
    topic.messages += 1
    topic.bytes += len(item.data)
    topic.first = min(topic.first or item.log_time, item.log_time)
    topic.last = max(topic.last, item.log_time)
    if item.type == messages.GAP:
        content = item.decode()
        seconds = nanoseconds(content.duration) / NANOSECONDS
        start = nanoseconds(content.header.stamp)
        microphone = content.header.frame_id
        lost = int(content.frames_lost)
        summary.gaps.append(GapSummary(microphone, start, seconds, content.reason, lost))
    elif item.type == messages.STREAM_INFO:
        content = item.decode()
        stream = {
            "microphone": content.header.frame_id,
            "device": content.device,
            "feature_set": content.feature_set,
            "model": content.model,
            "model_sha256": content.model_sha256,
        }
        if stream not in summary.streams:
            summary.streams.append(stream)
