"""A home whose log is written as a test goes on, without sound."""

import time
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta, timezone
from threading import Event, Lock, Thread

import numpy as np
from homelife import GENERAL, frames_of
from pydantic import TypeAdapter

from hearthlog.analyzer.bridge.alerts.rules import AlertRule
from hearthlog.analyzer.bridge.bridge import Bridge
from hearthlog.models.features.auros21 import FEATURE_NAMES
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import log_path
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, header, message
from hearthlog.schemas.messages.topics import DIAGNOSTICS, scenario_labelling, topics_of

FRAME = NANOSECONDS // 20
MINUTE = 60 * NANOSECONDS


def midday_zone():
    """A time zone in which it is about noon, so that what was an hour ago was today."""
    return timezone(timedelta(hours=12 - datetime.now(UTC).hour))


def rule(kind, name="it", **keys):
    """A rule of an alert."""
    return TypeAdapter(AlertRule).validate_python({"name": name, "rule": kind, **keys})


class LiveHome:
    """A log that is being written, by its name from six hours ago on.

    Attributes
    ----------
    start : int
        Of the log, in nanoseconds of UTC.
    """

    def __init__(
        self,
        folder,
        microphones=("mic",),
        classes=GENERAL,
        scenarios=None,
        minutes_ago=360,
        **metadata,
    ):
        self.folder, self.classes = folder, list(classes)
        self.start = time.time_ns() - minutes_ago * MINUTE
        neighbour = {scenario_labelling(name): own for name, own in (scenarios or {}).items()}
        topics = {
            topic.name: topic
            for microphone in microphones
            for topic in topics_of(microphone, FEATURE_NAMES, self.classes, neighbour)
        }
        self._lock = Lock()
        path = log_path(folder, metadata.get("node", "home"), self.start)
        self._writer = LogWriter(
            path, list(topics.values()), {"version": "0", "node": "home"} | metadata
        )

    def write_segment(self, label, minutes_ago, seconds=4.0, confidence=0.93, microphone="mic"):
        """Write a segment that began so many minutes ago; return when that was."""
        start = time.time_ns() - round(minutes_ago * 60 * 1000) * 1_000_000
        length = round(seconds * 1000) * 1_000_000
        fields = {
            "header.stamp": np.array([start]),
            "header.frame_id": microphone,
            "duration": np.array([length]),
            "label": [label],
            "confidence": np.array([confidence], np.float32),
        }
        self._write(f"/{microphone}/segment", start + length, fields)
        return start

    def doubts(self, minutes_ago, *doubt, microphone="mic"):
        """Write a segment, and its frames with those around it; return when it began.

        Parameters
        ----------
        *doubt
            Seconds, label, confidence, other probabilities, dB above the quiet around.
        """
        start = self.write_segment(doubt[1], minutes_ago, doubt[0], doubt[2], microphone)
        self._writer.write_columns(frames_of(microphone, self.classes, start, *doubt))
        self._writer.flush()
        return start

    def hears(self, label, microphone="mic"):
        """Write two seconds of labels that are of now."""
        count, now = 40, time.time_ns()
        stamps = now - FRAME * np.arange(count)[::-1]
        fields = {
            "header.stamp": stamps,
            "header.frame_id": microphone,
            "frame": np.arange(count),
            "label": [label] * count,
            "confidence": np.full(count, 0.9, np.float32),
            "novelty": np.zeros(count, np.float32),
            "probabilities": np.zeros((count, len(self.classes)), np.float32),
        }
        self._write(f"/{microphone}/label", stamps, fields)

    @contextmanager
    def listening(self, label, microphone="mic"):
        """Write labels of now every few seconds: without them, a microphone is away after 15 s."""
        ended = Event()

        def write():
            while not ended.wait(3):
                self.hears(label, microphone)

        thread = Thread(target=write, daemon=True)
        self.hears(label, microphone)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def not_heard(self, minutes_ago, minutes, microphone="mic"):
        """Write a gap."""
        start = time.time_ns() - minutes_ago * MINUTE
        fields = {
            "header.stamp": np.array([start]),
            "header.frame_id": microphone,
            "duration": np.array([minutes * MINUTE]),
            "reason": ["the microphone was away"],
            "frames_lost": np.array([minutes * 1200]),
        }
        self._write(f"/{microphone}/gap", start + minutes * MINUTE, fields)

    def write_status(self, subject, level, text, **values):
        """Write what the recorder says of something."""
        now = time.time_ns()
        pair = "diagnostic_msgs/msg/KeyValue"
        status = message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=f"hearthlog: {subject}",
            message=text,
            hardware_id=subject.partition(" ")[0],
            values=[message(pair, key=key, value=value) for key, value in values.items()],
        )
        output = message(message_types.DIAGNOSTICS, header=header(now, ""), status=[status])
        self._writer.write(DIAGNOSTICS, now, encode(output))
        self._writer.flush()

    def close(self):
        self._writer.finish()

    def _write(self, topic, times, fields):
        with self._lock:
            self._writer.write_columns([TopicBatch(topic, np.atleast_1d(times), fields)])
            self._writer.flush()


@contextmanager
def following(place, outputs, output):
    """A bridge in a thread, which knows the events of the last day."""
    stop = Event()
    bridge = Bridge(place, time.time_ns() - 24 * 60 * MINUTE, dict(outputs), output.append)
    thread = Thread(target=bridge.run, args=[stop], daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
