"""Messages of logs as rows of a timeline: fields taken out, names of values checked."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hearthlog.analyzer.logs.recorder_info import MicrophoneHealth, microphone_states
from hearthlog.analyzer.logs.selection import checked_array_names
from hearthlog.analyzer.logs.sound_vectors import as_vectors
from hearthlog.analyzer.review.timeline.model import LabelledSpans, LogLines
from hearthlog.models.classes import in_words
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import TopicName, is_review, parse_topic

ENERGY = "energy"
_SEGMENT_LINE = re.compile(r"^(\w+) for(?= [\d.]+ s \(\d+ %\)$)")
FIELDS = {
    message_types.FEATURES: ("header.stamp", "values"),
    message_types.LABEL: ("header.stamp", "novelty", "probabilities"),
    message_types.SEGMENT: ("header.stamp", "duration", "label"),
    message_types.GAP: ("header.stamp", "duration", "reason"),
    message_types.DIRECTION: ("header.stamp", "azimuth", "confidence"),
    message_types.DIAGNOSTICS: ("header.stamp", "header.frame_id", "status"),
    message_types.LOG: ("stamp", "level", "msg"),
}
_KINDS = {"features", "label", "segment", "gap", "direction"}
_QUIETEST = 1e-10  # of a mean square: -100 dB


class FeatureRows(NamedTuple):
    """Features of n frames.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames, in nanoseconds of UTC.
    values : np.ndarray [shape=(n, k)], float32
    """

    microphone: str
    names: tuple[str, ...]
    times: Int64
    values: Float32


class LabelRows(NamedTuple):
    """Probabilities of k classes, and novelty, in n frames.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames, in nanoseconds of UTC.
    probabilities : np.ndarray [shape=(n, k)], float32
    novelty : np.ndarray [shape=(n,)], float32
        NaN where the model has none.
    """

    microphone: str
    labelling: str
    names: tuple[str, ...]
    times: Int64
    probabilities: Float32
    novelty: Float32


class SegmentRows(NamedTuple):
    """Segments of a labelling."""

    microphone: str
    labelling: str
    spans: LabelledSpans


class GapRows(NamedTuple):
    """Gaps of a microphone, with their reasons."""

    microphone: str
    spans: LabelledSpans


class DirectionRows(NamedTuple):
    """Whence the sound of an array came, in n blocks.

    Attributes
    ----------
    times : np.ndarray [shape=(n,)], int64
        Starts of the blocks, in nanoseconds of UTC.
    directions : np.ndarray [shape=(n, 2)], float64
        Ahead and left: of a length that is the confidence.
    """

    microphone: str
    times: Int64
    directions: Float64


class StateRows(NamedTuple):
    """How microphones were, by the diagnostics."""

    states: list[MicrophoneHealth]


Rows = FeatureRows | LabelRows | SegmentRows | GapRows | DirectionRows | StateRows | LogLines


def read_rows(path: Path, columns: Columns) -> Rows | None:
    """Take the fields out of messages of one topic.

    Parameters
    ----------
    columns : Columns
        At least one message, with the `FIELDS` of its type.

    Returns
    -------
    FeatureRows, LabelRows, SegmentRows, GapRows, DirectionRows, StateRows, LogLines or None
        None if a timeline does not show the topic.

    Raises
    ------
    LogError
        If a channel does not name its values, or names another number of them.
    """
    if columns.type == message_types.LOG:
        texts = np.array([worded(text) for text in columns["msg"]], object)
        return LogLines(columns["stamp"], columns["level"], texts)
    if columns.type == message_types.DIAGNOSTICS:
        return StateRows(list(microphone_states(columns)))
    topic = shown_topic(columns.topic)
    return topic and _microphone_rows(path, columns, topic)


def worded(line: str) -> str:
    """Return a line about a segment with the name that the lane of its class has."""
    return _SEGMENT_LINE.sub(lambda found: f"{in_words(found[1])} for", line)


def _microphone_rows(path: Path, columns: Columns, topic: TopicName) -> Rows:
    microphone, labelling = topic.microphone, topic.labelling
    times = columns["header.stamp"]
    if columns.type == message_types.FEATURES:
        names = checked_array_names(path, columns, "values")
        return FeatureRows(microphone, names, times, columns["values"])
    if columns.type == message_types.LABEL:
        names = checked_array_names(path, columns, "probabilities")
        values = columns["probabilities"], columns["novelty"]
        return LabelRows(microphone, labelling, names, times, *values)
    if columns.type == message_types.DIRECTION:
        towards = as_vectors(columns["azimuth"], columns["confidence"])
        return DirectionRows(microphone, times, towards)
    ends = times + columns["duration"]
    if columns.type == message_types.SEGMENT:
        return SegmentRows(microphone, labelling, LabelledSpans(times, ends, columns["label"]))
    return GapRows(microphone, LabelledSpans(times, ends, columns["reason"]))


def shown_topic(name: str) -> TopicName | None:
    """Return the parts of a topic that a timeline shows.

    Returns
    -------
    TopicName or None
        None for any other topic. Marks are not shown by their topic, but read from their layers.
    """
    topic = parse_topic(name)
    if topic is None or topic.kind not in _KINDS or is_review(topic.labelling):
        return None
    return topic


def decibel(energy: Any) -> Any:
    """Return the level of a mean square, in dB relative to full scale: 10 log10 of it.

    Parameters
    ----------
    energy : float or np.ndarray
        Mean square of samples from -1 to 1.

    Returns
    -------
    float or np.ndarray
        At least -100; 0 for a square wave of full scale.
    """
    return 10 * np.log10(np.maximum(energy, _QUIETEST))
