"""The messages of a recorder's log, checked against docs/log.md as the file is read."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from hearthlog.analyzer.doctor import column_checks
from hearthlog.analyzer.doctor.findings import DISTRUST, Findings
from hearthlog.analyzer.doctor.frame_sequence import FrameSequence
from hearthlog.analyzer.doctor.mcap.data_section import DataSection
from hearthlog.analyzer.doctor.mcap.message_batch import MessageBatch
from hearthlog.analyzer.doctor.topic_types import (
    BESIDE_LABEL,
    BESIDE_SEGMENT,
    DIRECTION,
    EMBEDDING,
    FEATURES,
    GAP,
    LABEL,
    LOG_NAME,
    SEGMENT,
    SHARED,
    STATISTICS,
    TYPES,
    split_topic,
    topic_type,
)
from hearthlog.models.classifiers.classifier import LabelTiming, label_timing
from hearthlog.models.classifiers.model import read_description
from hearthlog.models.errors import ModelError
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile.modelfile import DESCRIPTION, attachment_of
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.metadata import HEARTHLOG_METADATA, THINNED, describes_model
from hearthlog.schemas.mcap.chunk_writer import GATHERED_SPAN
from hearthlog.schemas.messages.fields import difference
from hearthlog.schemas.messages.message_types import LOG_DAMAGED
from hearthlog.schemas.messages.topics import DIAGNOSTICS
from hearthlog.schemas.messages.type_definitions import message_type
from hearthlog.schemas.salvage.recover import dropped_kinds

# In ns, by how much the messages of one microphone may come behind those of another.
ALLOWED_DELAY = 10 * NANOSECONDS
_WIDTHS = {FEATURES: ("values",), STATISTICS: ("mean", "std"), LABEL: ("probabilities",)}
_LONGEST_WINDOW = 3600.0  # seconds; what claims more is no log of ours


def allowed_delay(data: DataSection) -> int:
    """Return by how much messages of one microphone may come behind those of another, in ns."""
    channels = data.definitions.channels.values()
    infos = [channel for channel in channels if split_topic(channel.topic)[1] == "info"]
    return ALLOWED_DELAY if len(infos) > 1 else 0


class MessageChecks:
    """Follows the messages of one file."""

    def __init__(self, data: DataSection, findings: Findings) -> None:
        self.infos: dict[str, dict[str, Any]] = {}  # the `AudioStreamInfo` of each microphone
        self.frames: dict[str, FrameSequence] = {}  # by microphone
        self._data = data
        self._findings = findings
        self._last: int | None = None  # log time of the last message
        self._last_gathered: int | None = None  # and of the last that was gathered
        self._interrupted = 0  # log time before which messages are missing
        self._parts: dict[str, list[int]] = {}  # where further ones begin, in a merged log
        self._troubles: set[str] = set()
        self._named = LOG_NAME.fullmatch(findings.path.name) is not None

    def add(self, batch: MessageBatch) -> None:
        """Check the next messages of the file."""
        self._check_times(batch)
        definitions = self._data.definitions
        by_kind: dict[str, list[Columns]] = {}
        for raw in batch.by_channel(definitions.channels, definitions.schemas):
            typename = topic_type(raw.channel.topic)
            if typename is not None and self._is_ours(raw.channel, typename):
                kind = split_topic(raw.channel.topic)[1]
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
            frames.settle(self._settled())

    def finish(self) -> None:
        """Check the last frames: no more messages will come."""
        for frames in self.frames.values():
            frames.finish()

    def interrupt(self) -> None:
        """Note that messages are missing here, because the file is damaged."""
        self._interrupted = self._last or self._interrupted
        self._last = self._last_gathered = None
        for frames in self.frames.values():
            frames.interrupt()

    def _is_ours(self, channel: Channel, typename: str) -> bool:
        """Tell whether a channel is of a type as any version has it."""
        schema = self._data.definitions.schemas.get(channel.schema_id)
        if schema is None or schema.name != typename or channel.message_encoding != "cdr":
            return False
        try:
            kind = message_type(schema.name, schema.encoding, schema.data)
            return not difference(kind, version=1)
        except LogError:
            return False

    def _settled(self) -> int | None:
        """Return the log time before which all messages were added."""
        if self._last is None or not self._gathered_channels():
            return self._last
        return self._last - GATHERED_SPAN

    def _gathered_channels(self) -> list[int]:
        """Return the channels whose messages may stand in chunks behind those of the others."""
        channels = self._data.definitions.channels.items()
        return [i for i, one in channels if split_topic(one.topic)[1] == EMBEDDING]

    def _check_times(self, batch: MessageBatch) -> None:
        heads = batch.heads
        times = heads["log_time"]
        if self._last is None:
            self._check_begin(heads)
        gathered = np.isin(heads["channel"], self._gathered_channels())
        self._last = self._check_order(times[~gathered], self._last)
        self._last_gathered = self._check_order(times[gathered], self._last_gathered)
        report = self._findings.rows
        late = heads["publish_time"] - times
        late[self._may_be_older(heads["channel"])] = 0
        report(
            "publish-time",
            late != 0,
            times,
            lambda i: f"publish time is not log time, but {late[i] / 1e9:+.3f} s later",
        )

    def _check_order(self, times: Int64, last: int | None) -> int | None:
        """Check that log times do not run backwards; return the last one."""
        if not len(times):
            return last
        before = np.concatenate([times[:1] if last is None else [last], times[:-1]])
        self._findings.rows(
            "log-time",
            times < before - allowed_delay(self._data),
            times,
            lambda i: f"log time runs backwards by {(before[i] - times[i]) / 1e9:.3f} s",
        )
        return int(times[-1])

    def _may_be_older(self, channels: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Tell which messages may be older than their log time: what `cut` puts at the beginning.

        A log that bears the name of a recorder's has none of these.
        """
        infos = [
            identity
            for identity, channel in self._data.definitions.channels.items()
            if split_topic(channel.topic)[1] == "info"
        ]
        return np.isin(channels, [] if self._named else infos)

    def _check_begin(self, heads: NDArray[np.void]) -> None:
        channel = self._data.definitions.channels.get(int(heads["channel"][0]))
        if not self.infos and (channel is None or split_topic(channel.topic)[1] != "info"):
            topic = "" if channel is None else f", but on {channel.topic}"
            time = int(heads["log_time"][0])
            what = f"the first message is no AudioStreamInfo{topic}"
            self._findings.error("info-first", what, DISTRUST, time=time)

    def _check(self, kind: str, columns: Columns) -> None:
        microphone = split_topic(columns.topic)[0]
        column_checks.check_stamps(self._findings, kind, columns, microphone, named=self._named)
        if kind == DIAGNOSTICS:
            self._check_health(columns)
        if not microphone:
            return
        if kind == "info":
            self._check_infos(columns, microphone)
        info = self.infos.get(microphone)
        if microphone not in self.frames:
            self.frames[microphone] = self._frame_sequence(microphone, info)
        self._check_content(kind, columns, info)
        rows = _sequence_rows(kind, columns)
        if rows is not None and kind == EMBEDDING:  # gathered behind what is missing
            rows = rows[rows[:, 0] > self._interrupted]
        if rows is not None:
            self.frames[microphone].add(kind, rows)
        if kind == GAP and rows is not None:
            self.frames[microphone].add_damages(rows[columns["reason"] == LOG_DAMAGED])

    def _check_content(self, kind: str, columns: Columns, info: Mapping[str, Any] | None) -> None:
        if kind in _WIDTHS and info is not None:
            names = info["labels"] if kind == LABEL else info["feature_names"]
            for field in _WIDTHS[kind]:
                column_checks.check_values(self._findings, columns, field, len(names))
        if kind == LABEL and info is not None:
            column_checks.check_labels(self._findings, columns, list(info["labels"]))
        if kind == BESIDE_LABEL:
            names = _class_names(columns)
            column_checks.check_values(self._findings, columns, "probabilities", len(names))
            column_checks.check_labels(self._findings, columns, names)
        if kind == BESIDE_SEGMENT:
            column_checks.check_segments(self._findings, columns, None)
        if kind == SEGMENT:
            classes = None if info is None else list(info["labels"])
            column_checks.check_segments(self._findings, columns, classes)
        if kind == GAP:
            column_checks.check_gaps(self._findings, columns)
        if kind == DIRECTION:
            column_checks.check_directions(self._findings, columns)
        if kind == EMBEDDING:
            column_checks.check_embeddings(self._findings, columns)

    def _frame_sequence(self, microphone: str, info: Mapping[str, Any] | None) -> FrameSequence:
        every, timing = statistics_every(self._data), None
        if info is not None and len(info["labels"]):
            timing = _label_timing(self._data, microphone, info)
        thinned = _thinned_kinds(self._data)
        return FrameSequence(self._findings, microphone, every, timing, thinned)

    def _check_health(self, columns: Columns) -> None:
        """Say once what the recorder said of itself that was not well."""
        for time, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
            for status in statuses:
                said = f"{status['name']}: {status['message']}"
                if status["level"] and said not in self._troubles:
                    self._troubles.add(said)
                    self._findings.warning("health", said, time=time)

    def _check_infos(self, columns: Columns, microphone: str) -> None:
        """Keep what a file says of itself; where it says so again another recording begins."""
        for row, values in enumerate(_rows(columns)):
            info = dict(zip(columns.fields, values, strict=True)) | {column_checks.STAMP: 0}
            time = int(columns.log_times[row])
            if microphone not in self.infos:
                self.infos[microphone] = info
            elif self._named or info != self.infos[microphone]:
                what = f"{columns.topic}: another AudioStreamInfo in one log"
                self._findings.error("info-twice", what, DISTRUST, time=time)
            elif microphone in self.frames:
                self._parts.setdefault(microphone, []).append(time)


def statistics_every(data: DataSection) -> int | None:
    """Read from the configuration in a file how often statistics are logged.

    Returns
    -------
    int or None
        Frames from one message of statistics to the next; None if the file does not say.
    """
    try:
        configuration = json.loads(data.attachments["configuration.json"][0])
        every = configuration["statistics_every"]
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    return every if isinstance(every, int) and every > 0 else None


def _class_names(columns: Columns) -> list[str]:
    """Return the names behind probabilities that the channel of labels has; none if it has none."""
    try:
        names = json.loads(columns.metadata["probabilities_names"])
    except (KeyError, ValueError, RecursionError):
        return []
    is_list = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return names if is_list else []


def _thinned_kinds(data: DataSection) -> set[str]:
    """Return which kinds of messages a file says were dropped when it grew old."""
    steps = {record.get(THINNED) for record in data.metadata.get(HEARTHLOG_METADATA, [])}
    return {kind for step in steps for kind in dropped_kinds(step)}


def _label_timing(
    data: DataSection, microphone: str, info: Mapping[str, Any]
) -> LabelTiming | None:
    """Return the timing of the model in a file; None if what says it was lost.

    In the first version nothing says it, and labels speak of the end of a window.
    """
    records = data.metadata.get(HEARTHLOG_METADATA, [])
    if DESCRIPTION not in data.attachments and all(map(describes_model, records)):
        return None
    try:
        own = attachment_of(DESCRIPTION, microphone)
        name = own if own in data.attachments else DESCRIPTION
        content = json.loads(data.attachments[name][0])
        named = {key: value for key, value in content.items() if key not in {"name", "sha256"}}
        description = read_description(json.dumps(named))
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError, ModelError):
        seconds = float(info["window_seconds"])
        if not FRAME_SECONDS <= seconds <= _LONGEST_WINDOW:
            seconds = DEFAULT.window_seconds
        frames = round(seconds / FRAME_SECONDS)
        return LabelTiming(frames, frames - 1, needs_floor=False)
    try:
        return label_timing(description)
    except (KeyError, ModelError):  # its feature set is not installed
        frames = max(round(description.window_seconds / FRAME_SECONDS), 1)
        return LabelTiming(frames, description.label_frame, needs_floor=description.gate > 0.0)


def _rows(columns: Columns) -> Any:
    return zip(*(values.tolist() for values in columns.fields.values()), strict=True)


def _sequence_rows(kind: str, columns: Columns) -> Int64 | None:
    """Return the rows of a kind for `FrameSequence.add`; None for a kind that it does not take."""
    times, stamps = columns.log_times, columns[column_checks.STAMP]
    if kind == GAP:
        parts = times, stamps, columns["frames_lost"]
    elif kind == SEGMENT:
        parts = times, stamps, stamps + columns["duration"]
    elif kind in {*_WIDTHS, DIRECTION, EMBEDDING}:
        parts = times, columns["frame"], stamps
    else:
        return None
    return np.stack([part.astype(np.int64) for part in parts], axis=1)
