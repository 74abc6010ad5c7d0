"""Checks of a recorder log's topics and columns against docs/log.md."""

import json
import re
from collections.abc import Callable, Mapping
from itertools import repeat
from typing import Any

import numpy as np

from hearthlog.analyzer.doctor import Findings, Level
from hearthlog.models.classifiers.network_names import MOST_AHEAD_FRAMES
from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import CLOCK_SET, LOG_DAMAGED, ON_PURPOSE
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    DIAGNOSTICS,
    LIVE,
    ROSOUT,
    SCENARIO,
    EmbeddingSource,
    parse_topic,
)

FEATURES, STATISTICS, LABEL, SEGMENT, GAP = "features", "statistics", "label", "segment", "gap"
DIRECTION = "direction"  # only from a microphone array
EMBEDDING = "embedding"  # only with an embedding network
_SECONDARY = "secondary"  # topics of a candidate or a scenario
SECONDARY_LABEL, SECONDARY_SEGMENT = f"{_SECONDARY}/{LABEL}", f"{_SECONDARY}/{SEGMENT}"
TYPES = {
    "info": message_types.STREAM_INFO,
    FEATURES: message_types.FEATURES,
    STATISTICS: message_types.STATISTICS,
    LABEL: message_types.LABEL,
    SEGMENT: message_types.SEGMENT,
    GAP: message_types.GAP,
    DIRECTION: message_types.DIRECTION,
    EMBEDDING: message_types.EMBEDDING,
    SECONDARY_LABEL: message_types.LABEL,
    SECONDARY_SEGMENT: message_types.SEGMENT,
}
ALWAYS = {"info", FEATURES, STATISTICS, GAP}  # channels in every log of a recorder
LOG_NAME = re.compile(r"(?P<node>.+)_(?P<time>\d{8}T\d{6}Z)(_\d+)?\.mcap(\.active)?")
SHARED = {DIAGNOSTICS: message_types.DIAGNOSTICS, ROSOUT: message_types.LOG}


def split_topic(topic: str) -> tuple[str, str]:
    """Split a topic of a recorder into microphone and kind, such as `mic` and `features`.

    The kind is `SECONDARY_LABEL` or `SECONDARY_SEGMENT` for a candidate or a scenario. For other
    topics, return an empty text and the complete topic.
    """
    name = parse_topic(topic)
    if name is None:
        return "", topic
    kind = name.kind
    if name.labelling != LIVE:
        is_other = name.labelling.partition("/")[0] in {CANDIDATE, SCENARIO}
        kind = f"{_SECONDARY if is_other else name.labelling}/{kind}"
    return (name.microphone, kind) if kind in TYPES else ("", topic)


def topic_type(topic: str) -> str | None:
    """Return the message type of a topic in docs/log.md; None for an unknown topic."""
    return TYPES.get(split_topic(topic)[1], SHARED.get(topic))


STAMP = "header.stamp"
_ARRAYS = {FEATURES: ("values",), STATISTICS: ("mean", "std")}
_SUM_TOLERANCE = 1e-4
_LABEL_LATE = MOST_AHEAD_FRAMES * FRAME_NANOSECONDS + 10_000_000  # ns; of labels by network names
_LATE = {  # ns, including the tolerance of stamps
    LABEL: _LABEL_LATE,
    SECONDARY_LABEL: _LABEL_LATE,
    SEGMENT: 75_000_000_000,
    DIRECTION: 400_000_000,
    EMBEDDING: 1_010_000_000,
    SECONDARY_SEGMENT: 75_000_000_000,
}


class ColumnChecks:
    """Checks of the messages of one topic, each on its own.

    Raise `LogError` if a field of the type is missing.
    """

    def __init__(self, findings: Findings, columns: Columns) -> None:
        self._findings = findings
        self._columns = columns
        self._topic = columns.topic

    def check_stamps(self, kind: str, microphone: str, *, named: bool) -> None:
        """Compare log times with stamps, and `frame_id` with the microphone, if any."""
        columns = self._columns
        stamps = columns["stamp" if kind == ROSOUT else STAMP]
        if kind in {SEGMENT, SECONDARY_SEGMENT, GAP}:
            stamps = stamps + columns["duration"]
        late = columns.log_times - stamps
        if kind == "info" and not named:
            late = np.minimum(late, 0)
        if kind in _LATE:  # may be logged later, but never before its end
            late[(late >= 0) & (late <= _LATE[kind])] = 0
        self._report(
            "stamp",
            late != 0,
            lambda i: f"log time is {late[i] / 1e9:+.3f} s from the time of the message",
        )
        if microphone:
            names = columns["header.frame_id"]
            wrong = np.asarray(names != microphone, bool)
            self._report("frame-id", wrong, lambda i: f"frame_id is {names[i]!r}")

    def check_content(self, kind: str, info: Mapping[str, Any] | None) -> None:
        """Check the values of the messages of a kind.

        `info` is the `AudioStreamInfo` of the microphone, with the classes and the names of the
        features.
        """
        classes = None if info is None else list(info["labels"])
        if kind in _ARRAYS and info is not None:
            for field in _ARRAYS[kind]:
                self._check_array(field, len(info["feature_names"]))
        elif kind == SECONDARY_LABEL:
            self._check_labels(_class_names(self._columns))
        elif kind == LABEL and classes is not None:
            self._check_labels(classes)
        elif kind in {SEGMENT, SECONDARY_SEGMENT}:
            self._check_segments(classes if kind == SEGMENT else None)
        elif kind == GAP:
            self._check_gaps()
        elif kind == DIRECTION:
            azimuths = self._columns["azimuth"]
            wrong = ~(np.abs(azimuths) <= np.float32(np.pi))
            self._report("azimuth", wrong, lambda i: f"azimuth is {azimuths[i]}")
            self._check_confidence(1)
        elif kind == EMBEDDING:
            self._check_embeddings()

    def _report(
        self,
        rule: str,
        wrong: Bool,
        what: Callable[[int], str],
        level: Level = "error",
    ) -> None:
        times = self._columns.log_times
        self._findings.rows(rule, wrong, times, lambda i: f"{self._topic}: {what(i)}", level)

    def _check_array(self, field: str, width: int) -> None:
        """Check that an array has one finite value per name; `std` must not be negative."""
        values = self._columns[field]
        if values.ndim == 1:
            widths = np.fromiter(map(len, values), np.int64, len(values))
        else:
            widths = np.full(len(values), values.shape[1])
        self._report(
            "width",
            widths != width,
            lambda i: f"{field} has {widths[i]} values, and there are {width} names",
        )
        if values.ndim == 1 or not len(values):
            return
        bad = ~np.isfinite(values).all(axis=1)
        self._report("finite", bad, lambda _: f"{field} is not finite")
        if field == "std":
            negative = np.asarray((values < 0).any(axis=1))
            self._report("negative-std", negative, lambda _: "std is negative")

    def _check_labels(self, classes: list[str]) -> None:
        """Check frame labels of a model with these classes, in the order of the probabilities."""
        columns = self._columns
        self._check_array("probabilities", len(classes))
        numbers = self._check_names(classes)
        probabilities = columns["probabilities"]
        if probabilities.ndim == 1 or probabilities.shape[1] != len(classes):
            return
        total = probabilities.sum(axis=1, dtype=np.float64)
        wrong = (np.abs(total - 1) > _SUM_TOLERANCE) | (probabilities < 0).any(axis=1)
        self._report(
            "probabilities",
            wrong,
            lambda i: f"the probabilities are negative, or sum up to {total[i]:.6f}",
        )
        given = probabilities[np.arange(len(numbers)), np.maximum(numbers, 0)]
        confidence = columns["confidence"]
        self._report(
            "confidence",
            (numbers >= 0) & (confidence != given),
            lambda i: (
                f"confidence is {confidence[i]:.6f}, and the probability of the "
                f"label {given[i]:.6f}"
            ),
        )

    def _check_names(self, classes: list[str]) -> Int64:
        """Return the class numbers of labels, -1 for unknown labels, which are reported."""
        numbers_of = {label: number for number, label in enumerate(classes)}
        labels = self._columns["label"].tolist()
        numbers = np.fromiter(map(numbers_of.get, labels, repeat(-1)), np.int64, len(labels))
        self._report("class", numbers < 0, lambda i: f"{labels[i]!r} is no class of the model")
        return numbers

    def _check_segments(self, classes: list[str] | None) -> None:
        """Check segments; None allows any class."""
        self._report("duration", self._columns["duration"] <= 0, lambda _: "has no duration")
        self._check_confidence(1 + _SUM_TOLERANCE)
        if classes is not None:
            self._check_names(classes)

    def _check_confidence(self, most: float) -> None:
        confidence = self._columns["confidence"]
        wrong = ~((confidence >= 0) & (confidence <= most))
        self._report("confidence", wrong, lambda i: f"confidence is {confidence[i]}")

    def _check_embeddings(self) -> None:
        """Check that embeddings cover complete windows, and have one value per name."""
        columns = self._columns
        frames, lengths = columns["frame"], columns["frames"]
        wrong = (lengths != WINDOW_FRAMES) | (frames % HOP_FRAMES != 0)
        self._report(
            "embedding-window",
            wrong,
            lambda i: f"is of {lengths[i]} frames from frame {frames[i]} on",
        )
        error = self._findings.error
        source = EmbeddingSource.from_metadata(columns.metadata)
        if source is None:
            error("embedding-source", f"{self._topic}: does not say of which network it is")
        elif columns["values"].shape[1:] != (len(source.names),):
            what = f"{self._topic}: some messages are not of {len(source.names)} values"
            error("width", what)

    def _check_gaps(self) -> None:
        """Report every gap, and check its duration against its lost frames.

        Losses of a damaged log are exempt: they may include gaps in which the clock was set.
        """
        columns = self._columns
        durations, lost, reasons = columns["duration"], columns["frames_lost"], columns["reason"]
        on_purpose = np.array([each.split("; ")[0] in ON_PURPOSE for each in reasons], bool)
        self._report(
            "gap",
            ~on_purpose,
            lambda i: f"{durations[i] / 1e9:.3f} s, {lost[i]} frames were not heard: {reasons[i]}",
            level="warning",
        )
        free = [CLOCK_SET in each or each.startswith(LOG_DAMAGED) for each in reasons]
        frames = durations.astype(np.float64) / FRAME_NANOSECONDS
        differ: Bool = np.abs(frames - lost.astype(np.float64)) > 1
        self._report(
            "gap-duration",
            differ & ~np.array(free, bool) & (durations >= 0),
            lambda i: f"{lost[i]} lost frames do not last {durations[i] / 1e9:.3f} s",
        )


def _class_names(columns: Columns) -> list[str]:
    """Return the class names of a label channel's probabilities; empty if there are none."""
    try:
        names = json.loads(columns.metadata["probabilities_names"])
    except (KeyError, ValueError, RecursionError):
        return []
    is_list = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return names if is_list else []
