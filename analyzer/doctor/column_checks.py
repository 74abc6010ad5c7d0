"""Checks of a recorder log's topics and columns against docs/log.md."""

import re
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.doctor.findings import Findings
from hearthlog.models.classifiers.names import MOST_AHEAD_FRAMES
from hearthlog.models.embedding.projection import HOP_FRAMES, WINDOW_FRAMES
from hearthlog.schemas.arrays import Int64
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
_BESIDE = "beside"  # topics of a candidate or a scenario
BESIDE_LABEL, BESIDE_SEGMENT = f"{_BESIDE}/{LABEL}", f"{_BESIDE}/{SEGMENT}"
TYPES = {
    "info": message_types.STREAM_INFO,
    FEATURES: message_types.FEATURES,
    STATISTICS: message_types.STATISTICS,
    LABEL: message_types.LABEL,
    SEGMENT: message_types.SEGMENT,
    GAP: message_types.GAP,
    DIRECTION: message_types.DIRECTION,
    EMBEDDING: message_types.EMBEDDING,
    BESIDE_LABEL: message_types.LABEL,
    BESIDE_SEGMENT: message_types.SEGMENT,
}
ALWAYS = {"info", FEATURES, STATISTICS, GAP}  # channels in every log of a recorder
LOG_NAME = re.compile(r"(?P<node>.+)_(?P<time>\d{8}T\d{6}Z)(_\d+)?\.mcap(\.active)?")
SHARED = {DIAGNOSTICS: message_types.DIAGNOSTICS, ROSOUT: message_types.LOG}


def split_topic(topic: str) -> tuple[str, str]:
    """Split a topic of a recorder into microphone and kind.

    Returns
    -------
    microphone, kind : str
        Such as `mic` and `features`; `BESIDE_LABEL` or `BESIDE_SEGMENT` for a candidate or a
        scenario; an empty text and the complete topic for other topics.
    """
    name = parse_topic(topic)
    if name is None:
        return "", topic
    kind = name.kind
    if name.labelling != LIVE:
        is_beside = name.labelling.partition("/")[0] in {CANDIDATE, SCENARIO}
        kind = f"{_BESIDE if is_beside else name.labelling}/{kind}"
    return (name.microphone, kind) if kind in TYPES else ("", topic)


def topic_type(topic: str) -> str | None:
    """Return the message type of a topic in docs/log.md; None for an unknown topic."""
    return TYPES.get(split_topic(topic)[1], SHARED.get(topic))


STAMP = "header.stamp"
_SUM_TOLERANCE = 1e-4
_LABEL_LATE = MOST_AHEAD_FRAMES * FRAME_NANOSECONDS + 10_000_000  # ns; of labels by network names
_LATE = {  # ns, including the tolerance of stamps
    LABEL: _LABEL_LATE,
    BESIDE_LABEL: _LABEL_LATE,
    SEGMENT: 75_000_000_000,
    DIRECTION: 400_000_000,
    EMBEDDING: 1_010_000_000,
    BESIDE_SEGMENT: 75_000_000_000,
}


def check_stamps(
    findings: Findings, kind: str, columns: Columns, microphone: str, *, named: bool
) -> None:
    """Compare log times with stamps, and `frame_id` with the microphone.

    Parameters
    ----------
    microphone : str
        Name; empty for a topic without a microphone.

    Raises
    ------
    LogError
        If a field of the type is missing.
    """
    times = columns.log_times
    stamps = columns["stamp" if kind == ROSOUT else STAMP]
    if kind in {SEGMENT, BESIDE_SEGMENT, GAP}:
        stamps = stamps + columns["duration"]
    late = times - stamps
    if kind == "info" and not named:
        late = np.minimum(late, 0)
    if kind in _LATE:  # may be logged later, but never before its end
        late[(late >= 0) & (late <= _LATE[kind])] = 0
    findings.rows(
        "stamp",
        late != 0,
        times,
        lambda i: (
            f"{columns.topic}: log time is {late[i] / 1e9:+.3f} s from the time of the message"
        ),
    )
    if microphone:
        names = columns["header.frame_id"]
        findings.rows(
            "frame-id",
            np.asarray(names != microphone, bool),
            times,
            lambda i: f"{columns.topic}: frame_id is {names[i]!r}",
        )


def check_values(findings: Findings, columns: Columns, field: str, width: int) -> None:
    """Check that an array has one finite value per name.

    Parameters
    ----------
    field : str
        Path of the array; values of `std` must not be negative, either.

    Raises
    ------
    LogError
        If the messages have no such field.
    """
    values, times = columns[field], columns.log_times
    report = findings.rows
    if values.ndim == 1:
        widths = np.fromiter(map(len, values), np.int64, len(values))
    else:
        widths = np.full(len(values), values.shape[1])
    report(
        "width",
        widths != width,
        times,
        lambda i: f"{columns.topic}: {field} has {widths[i]} values, and there are {width} names",
    )
    if values.ndim == 1 or not len(values):
        return
    bad = ~np.isfinite(values).all(axis=1)
    report("finite", bad, times, lambda _: f"{columns.topic}: {field} is not finite")
    if field == "std":
        negative = np.asarray((values < 0).any(axis=1))
        report("negative-std", negative, times, lambda _: f"{columns.topic}: std is negative")


def check_labels(findings: Findings, columns: Columns, classes: list[str]) -> None:
    """Check the classes, probabilities and confidence of frame labels.

    Parameters
    ----------
    classes : list of str
        Classes of the model, in the order of the probabilities.

    Raises
    ------
    LogError
        If a field of the type is missing.
    """
    times, report = columns.log_times, findings.rows
    numbers = _check_names(findings, columns, classes)
    probabilities = columns["probabilities"]
    if probabilities.ndim == 1 or probabilities.shape[1] != len(classes):
        return
    total = probabilities.sum(axis=1, dtype=np.float64)
    wrong = (np.abs(total - 1) > _SUM_TOLERANCE) | (probabilities < 0).any(axis=1)
    report(
        "probabilities",
        wrong,
        times,
        lambda i: f"{columns.topic}: the probabilities are negative, or sum up to {total[i]:.6f}",
    )
    given = probabilities[np.arange(len(times)), np.maximum(numbers, 0)]
    confidence = columns["confidence"]
    report(
        "confidence",
        (numbers >= 0) & (confidence != given),
        times,
        lambda i: (
            f"{columns.topic}: confidence is {confidence[i]:.6f}, and the probability of the "
            f"label {given[i]:.6f}"
        ),
    )


def _check_names(findings: Findings, columns: Columns, classes: list[str]) -> Int64:
    """Return the class numbers of labels, -1 for unknown labels, which are reported."""
    numbers_of = {label: number for number, label in enumerate(classes)}
    labels = columns["label"].tolist()
    numbers = np.fromiter(map(numbers_of.get, labels, repeat(-1)), np.int64, len(labels))
    findings.rows(
        "class",
        numbers < 0,
        columns.log_times,
        lambda i: f"{columns.topic}: {labels[i]!r} is no class of the model",
    )
    return numbers


def check_segments(findings: Findings, columns: Columns, classes: list[str] | None) -> None:
    """Check the durations, confidence and classes of segments.

    Parameters
    ----------
    classes : list of str or None
        Classes of the model; None allows any.

    Raises
    ------
    LogError
        If a field of the type is missing.
    """
    times, confidence = columns.log_times, columns["confidence"]
    no_duration = columns["duration"] <= 0
    findings.rows("duration", no_duration, times, lambda _: f"{columns.topic}: has no duration")
    findings.rows(
        "confidence",
        ~((confidence >= 0) & (confidence <= 1 + _SUM_TOLERANCE)),
        times,
        lambda i: f"{columns.topic}: confidence is {confidence[i]}",
    )
    if classes is not None:
        _check_names(findings, columns, classes)


def check_directions(findings: Findings, columns: Columns) -> None:
    """Check that azimuths are within ±π, and confidences within 0 to 1.

    Raise `LogError` if a field of the type is missing.
    """
    times, azimuths, confidence = columns.log_times, columns["azimuth"], columns["confidence"]
    findings.rows(
        "azimuth",
        ~(np.abs(azimuths) <= np.float32(np.pi)),
        times,
        lambda i: f"{columns.topic}: azimuth is {azimuths[i]}",
    )
    findings.rows(
        "confidence",
        ~((confidence >= 0) & (confidence <= 1)),
        times,
        lambda i: f"{columns.topic}: confidence is {confidence[i]}",
    )


def check_embeddings(findings: Findings, columns: Columns) -> None:
    """Check that embeddings cover complete windows, and have one value per name.

    Raise `LogError` if a field of the type is missing.
    """
    times, frames, lengths = columns.log_times, columns["frame"], columns["frames"]
    findings.rows(
        "embedding-window",
        (lengths != WINDOW_FRAMES) | (frames % HOP_FRAMES != 0),
        times,
        lambda i: f"{columns.topic}: is of {lengths[i]} frames from frame {frames[i]} on",
    )
    source = EmbeddingSource.from_metadata(columns.metadata)
    if source is None:
        findings.error("embedding-source", f"{columns.topic}: does not say of which network it is")
        return
    values, width = columns["values"], len(source.names)
    if values.shape[1:] != (width,):
        findings.error("values", f"{columns.topic}: some messages are not of {width} values")


def check_gaps(findings: Findings, columns: Columns) -> None:
    """Report every gap, and check its duration against its lost frames.

    Losses of a damaged log are exempt: they may include gaps in which the clock was set.

    Raise `LogError` if a field of the type is missing.
    """
    times, durations = columns.log_times, columns["duration"]
    lost, reasons = columns["frames_lost"], columns["reason"]
    on_purpose = np.array([each.split("; ")[0] in ON_PURPOSE for each in reasons], bool)
    findings.rows(
        "gap",
        ~on_purpose,
        times,
        lambda i: (
            f"{columns.topic}: {durations[i] / 1e9:.3f} s, {lost[i]} frames were not heard: "
            f"{reasons[i]}"
        ),
        level="warning",
    )
    free = np.array([CLOCK_SET in each or each.startswith(LOG_DAMAGED) for each in reasons], bool)
    frames = durations.astype(np.float64) / FRAME_NANOSECONDS
    differ: NDArray[np.bool_] = np.abs(frames - lost.astype(np.float64)) > 1
    findings.rows(
        "gap-duration",
        differ & ~free & (durations >= 0),
        times,
        lambda i: f"{columns.topic}: {lost[i]} lost frames do not last {durations[i] / 1e9:.3f} s",
    )
