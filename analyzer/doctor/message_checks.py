"""The messages of a log of hearthlog, checked against docs/log.md."""

import json
import re
from collections.abc import Mapping
from itertools import repeat
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from hearthlog.analyzer.doctor.findings import DISTRUST, Findings
from hearthlog.analyzer.doctor.frame_sequence import (
    FEATURES,
    GAP,
    LABEL,
    SEGMENT,
    STATISTICS,
    Frames,
)
from hearthlog.analyzer.doctor.mcap.batch import Batch
from hearthlog.analyzer.doctor.mcap.data_section import Data
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SECONDS
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_layout import message_type
from hearthlog.schemas.messages.fields import difference
from hearthlog.schemas.messages.topics import DIAGNOSTICS, ROSOUT

TYPES = {
    "info": message_types.STREAM_INFO,
    FEATURES: message_types.FEATURES,
    STATISTICS: message_types.STATISTICS,
    LABEL: message_types.LABEL,
    SEGMENT: message_types.SEGMENT,
    GAP: message_types.GAP,
}
ALWAYS = {"info", FEATURES, STATISTICS, GAP}  # what is a channel in every log of a recorder
NAME = re.compile(r"(?P<node>.+)_(?P<time>\d{8}T\d{6}Z)\.mcap(\.active)?")
SHARED = {DIAGNOSTICS: message_types.DIAGNOSTICS, ROSOUT: message_types.LOG}
_TOPIC = re.compile(r"/([a-z](?:_?[a-z0-9])*)/(\w+)")
_STAMP = "header.stamp"
_WIDTHS = {FEATURES: ("values",), STATISTICS: ("mean", "std"), LABEL: ("probabilities",)}
_CLOCK_SET = "the clock was set"
_LONGEST_WINDOW = 3600.0  # seconds; what claims more is no log of ours
_SUM_TOLERANCE = 1e-4
_LONGEST_LAG = 61_000_000_000  # ns; of smoothing, and what stamps may be off in that time


def place_of(topic: str) -> tuple[str, str]:
    """Split a topic into microphone and kind; the microphone is empty if it is of none."""
    found = _TOPIC.fullmatch(topic)
    return ("", topic) if found is None or found[2] not in TYPES else (found[1], found[2])


def type_of(topic: str) -> str | None:
    """Return the type that a topic must have."""
    return TYPES.get(place_of(topic)[1], SHARED.get(topic))


class Contract:
    """Follows the messages of one file.

    Attributes
    ----------
    infos : dict of str to dict
        By microphone: the `AudioStreamInfo`, field by field.
    frames : dict of str to Frames
        By microphone.
    """

    def __init__(self, data: Data, findings: Findings) -> None:
        self.infos: dict[str, dict[str, Any]] = {}
        self.frames: dict[str, Frames] = {}
        self._data = data
        self._findings = findings
        self._last: int | None = None
        self._parts: dict[str, list[int]] = {}  # where further ones begin, in a merged log
        self._named = NAME.fullmatch(findings.path.name) is not None

    def add(self, batch: Batch) -> None:
        """Take the next messages of the file."""
        self._check_times(batch)
        definitions = self._data.definitions
        by_kind: dict[str, list[Columns]] = {}
        for raw in batch.by_channel(definitions.channels, definitions.schemas):
            typename = type_of(raw.channel.topic)
            if typename is not None and self._is_ours(raw.channel, typename):
                kind = place_of(raw.channel.topic)[1]
                try:
                    by_kind.setdefault(kind, []).extend(decode([raw]))
                except LogError as error:
                    time = int(raw.log_times[0])
                    self._findings.error("cdr", str(error), DISTRUST, time=time)
        for kind in ("info", *TYPES, *SHARED):  # the rest builds on what the first says
            for columns in by_kind.pop(kind, ()):
                self._check(kind, columns)
        for microphone, frames in self.frames.items():
            for time in self._parts.pop(microphone, []):
                frames.begin_anew(time)
            frames.settle(self._last)

    def finish(self) -> None:
        """Take note that this was all."""
        for frames in self.frames.values():
            frames.finish()

    def interrupt(self) -> None:
        """Take note that messages are missing here, because the file is damaged."""
        self._last = None
        for frames in self.frames.values():
            frames.interrupt()

    def _is_ours(self, channel: Channel, typename: str) -> bool:
        """Tell whether a channel is of a type as any version has it; `About` says what is not."""
        schema = self._data.definitions.schemas.get(channel.schema_id)
        if schema is None or schema.name != typename or channel.message_encoding != "cdr":
            return False
        try:
            kind = message_type(schema.name, schema.encoding, schema.data)
            return not difference(kind, version=1)
        except LogError:
            return False

    def _check_times(self, batch: Batch) -> None:
        heads = batch.heads
        times = heads["log_time"]
        if self._last is None:
            self._check_begin(heads)
        before = np.concatenate([times[:1] if self._last is None else [self._last], times[:-1]])
        report = self._findings.rows
        report(
            "log-time",
            times < before,
            times,
            lambda i: f"log time runs backwards by {(before[i] - times[i]) / 1e9:.3f} s",
        )
        late = heads["publish_time"] - times
        late[self._may_be_older(heads["channel"])] = 0
        report(
            "publish-time",
            late != 0,
            times,
            lambda i: f"publish time is not log time, but {late[i] / 1e9:+.3f} s later",
        )
        self._last = int(times[-1])

    def _may_be_older(self, channels: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Tell which messages may be older than their log time: what `cut` puts at the beginning.

        A log that bears the name of a recorder's has none of these.
        """
        infos = [
            identity
            for identity, channel in self._data.definitions.channels.items()
            if place_of(channel.topic)[1] == "info"
        ]
        return np.isin(channels, [] if self._named else infos)

    def _check_begin(self, heads: NDArray[np.void]) -> None:
        channel = self._data.definitions.channels.get(int(heads["channel"][0]))
        if not self.infos and (channel is None or place_of(channel.topic)[1] != "info"):
            topic = "" if channel is None else f", but on {channel.topic}"
            time = int(heads["log_time"][0])
            what = f"the first message is no AudioStreamInfo{topic}"
            self._findings.error("info-first", what, DISTRUST, time=time)

    def _check(self, kind: str, columns: Columns) -> None:
        microphone = place_of(columns.topic)[0]
        self._check_stamps(kind, columns, microphone)
        if not microphone:
            return
        if kind == "info":
            self._check_infos(columns, microphone)
        info = self.infos.get(microphone)
        if microphone not in self.frames:
            every = statistics_every(self._data)
            labelled = info is not None and len(info["labels"]) > 0
            window = _window_frames(info)
            self.frames[microphone] = Frames(
                self._findings, microphone, every, window, labelled=labelled
            )
        if kind in _WIDTHS and info is not None:
            names = info["labels"] if kind == LABEL else info["feature_names"]
            for field in _WIDTHS[kind]:
                self._check_values(columns, field, len(names))
        if kind == LABEL and info is not None:
            self._check_labels(columns, list(info["labels"]))
        if kind in {SEGMENT, GAP}:
            self._check_spans(kind, columns, info)
        rows = _of_frames(kind, columns)
        if rows is not None:
            self.frames[microphone].add(kind, rows)

    def _check_infos(self, columns: Columns, microphone: str) -> None:
        """Keep what a file says of itself; where it says so again another recording begins."""
        for row, values in enumerate(_rows(columns)):
            info = dict(zip(columns.fields, values, strict=True)) | {_STAMP: 0}
            time = int(columns.log_times[row])
            if microphone not in self.infos:
                self.infos[microphone] = info
            elif self._named or info != self.infos[microphone]:
                what = f"{columns.topic}: another AudioStreamInfo in one log"
                self._findings.error("info-twice", what, DISTRUST, time=time)
            elif microphone in self.frames:
                self._parts.setdefault(microphone, []).append(time)

    def _check_stamps(self, kind: str, columns: Columns, microphone: str) -> None:
        times = columns.log_times
        stamps = columns["stamp" if kind == ROSOUT else _STAMP]
        if kind in {SEGMENT, GAP}:
            stamps = stamps + columns["duration"]
        late = times - stamps
        if kind == "info" and not self._named:
            late = np.minimum(late, 0)
        if kind == SEGMENT:  # may be decided later, but never before it is over
            late[(late >= 0) & (late <= _LONGEST_LAG)] = 0
        self._findings.rows(
            "stamp",
            late != 0,
            times,
            lambda i: (
                f"{columns.topic}: log time is {late[i] / 1e9:+.3f} s from the time of the message"
            ),
        )
        if microphone:
            names = columns["header.frame_id"]
            self._findings.rows(
                "frame-id",
                np.asarray(names != microphone, bool),
                times,
                lambda i: f"{columns.topic}: frame_id is {names[i]!r}",
            )

    def _check_values(self, columns: Columns, field: str, width: int) -> None:
        values, times = columns[field], columns.log_times
        report = self._findings.rows
        if values.ndim == 1:
            widths = np.fromiter(map(len, values), np.int64, len(values))
        else:
            widths = np.full(len(values), values.shape[1])
        report(
            "width",
            widths != width,
            times,
            lambda i: (
                f"{columns.topic}: {field} has {widths[i]} values, and there are {width} names"
            ),
        )
        if values.ndim == 1 or not len(values):
            return
        bad = ~np.isfinite(values).all(axis=1)
        report("finite", bad, times, lambda _: f"{columns.topic}: {field} is not finite")
        if field == "std":
            negative = np.asarray((values < 0).any(axis=1))
            report("negative-std", negative, times, lambda _: f"{columns.topic}: std is negative")

    def _check_labels(self, columns: Columns, classes: list[str]) -> None:
        times, report = columns.log_times, self._findings.rows
        numbers = self._check_names(columns, classes)
        probabilities = columns["probabilities"]
        if probabilities.ndim == 1 or probabilities.shape[1] != len(classes):
            return
        total = probabilities.sum(axis=1, dtype=np.float64)
        wrong = (np.abs(total - 1) > _SUM_TOLERANCE) | (probabilities < 0).any(axis=1)
        report(
            "probabilities",
            wrong,
            times,
            lambda i: (
                f"{columns.topic}: the probabilities are negative, or sum up to {total[i]:.6f}"
            ),
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

    def _check_names(self, columns: Columns, classes: list[str]) -> Int64:
        """Return the numbers of the classes, -1 where a label is none of them."""
        known = {label: number for number, label in enumerate(classes)}
        labels = columns["label"].tolist()
        numbers = np.fromiter(map(known.get, labels, repeat(-1)), np.int64, len(labels))
        self._findings.rows(
            "class",
            numbers < 0,
            columns.log_times,
            lambda i: f"{columns.topic}: {labels[i]!r} is no class of the model",
        )
        return numbers

    def _check_spans(self, kind: str, columns: Columns, info: Mapping[str, Any] | None) -> None:
        """Check segments and gaps one by one."""
        times, durations, report = columns.log_times, columns["duration"], self._findings.rows
        if kind == SEGMENT:
            report("duration", durations <= 0, times, lambda _: f"{columns.topic}: has no duration")
            confidence = columns["confidence"]
            wrong = ~((confidence >= 0) & (confidence <= 1 + _SUM_TOLERANCE))
            report(
                "confidence",
                wrong,
                times,
                lambda i: f"{columns.topic}: confidence is {confidence[i]}",
            )
            if info is not None:
                self._check_names(columns, list(info["labels"]))
            return
        lost, reasons = columns["frames_lost"], columns["reason"]
        report(
            "gap",
            np.ones(len(times), bool),
            times,
            lambda i: (
                f"{columns.topic}: {durations[i] / 1e9:.3f} s, {lost[i]} frames were not heard: "
                f"{reasons[i]}"
            ),
            level="warning",
        )
        moved = np.array([reason.startswith(_CLOCK_SET) for reason in reasons], bool)
        frames = durations.astype(np.float64) / FRAME_NANOSECONDS
        differ: NDArray[np.bool_] = np.abs(frames - lost.astype(np.float64)) > 1
        report(
            "gap-duration",
            differ & ~moved & (durations >= 0),
            times,
            lambda i: (
                f"{columns.topic}: {lost[i]} lost frames do not last {durations[i] / 1e9:.3f} s"
            ),
        )


def statistics_every(data: Data) -> int | None:
    """Read from the configuration in a file how often statistics are logged."""
    try:
        configuration = json.loads(data.attachments["configuration.json"][0])
        every = configuration["statistics_every"]
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    return every if isinstance(every, int) and every > 0 else None


def _window_frames(info: Mapping[str, Any] | None) -> int:
    """Tell how many frames end with one that has a label, by what a log says."""
    seconds = DEFAULT.window_seconds if info is None else float(info["window_seconds"])
    if not FRAME_SECONDS <= seconds <= _LONGEST_WINDOW:
        seconds = DEFAULT.window_seconds
    return round(seconds / FRAME_SECONDS)


def _rows(columns: Columns) -> Any:
    return zip(*(values.tolist() for values in columns.fields.values()), strict=True)


def _of_frames(kind: str, columns: Columns) -> Int64 | None:
    """Return what `Frames.add` wants of a kind, None if that is nothing."""
    times, stamps = columns.log_times, columns[_STAMP]
    if kind == GAP:
        parts = times, stamps, columns["frames_lost"]
    elif kind == SEGMENT:
        parts = times, stamps, stamps + columns["duration"]
    elif kind in _WIDTHS:
        parts = times, columns["frame"], stamps
    else:
        return None
    return np.stack([part.astype(np.int64) for part in parts], axis=1)
