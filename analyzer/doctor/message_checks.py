"""Checks of a recorder's messages and metadata against docs/log.md."""

import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hearthlog.analyzer.doctor import DISTRUST, Findings
from hearthlog.analyzer.doctor.column_checks import (
    DIRECTION,
    EMBEDDING,
    FEATURES,
    GAP,
    LABEL,
    LOG_NAME,
    SECONDARY_LABEL,
    SEGMENT,
    SHARED,
    STAMP,
    STATISTICS,
    TYPES,
    ColumnChecks,
    split_topic,
    topic_type,
)
from hearthlog.analyzer.doctor.frame_sequence import FrameSequence
from hearthlog.analyzer.doctor.records import MessageBatch
from hearthlog.analyzer.doctor.sections import DataSection
from hearthlog.models.classifiers.classifier import LabelTiming, label_timing
from hearthlog.models.classifiers.model import read_description
from hearthlog.models.features.installed import DEFAULT, feature_set
from hearthlog.models.modelfile import CARD, DESCRIPTION, attachment_of
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import LogError, ModelError
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.metadata import (
    HEARTHLOG_METADATA,
    THINNED,
    describes_model,
    recorded_scenarios,
    schema_version,
)
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA as ROSBAG2
from hearthlog.schemas.logs.writer import PROFILE, SCHEMA_ENCODING
from hearthlog.schemas.mcap.chunk_writer import GATHERED_SPAN
from hearthlog.schemas.messages.fields import difference, type_hash_of
from hearthlog.schemas.messages.message_types import LOG_DAMAGED, SCHEMA_VERSION
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    DIAGNOSTICS,
    EmbeddingSource,
    Topic,
    scenario_labelling,
    topics_of,
)
from hearthlog.schemas.messages.type_definitions import message_type
from hearthlog.schemas.salvage.recover import dropped_kinds

# ns; maximum delay of one microphone's messages behind those of another
ALLOWED_DELAY = 10 * NANOSECONDS
_LONGEST_WINDOW = 3600.0  # seconds; no log of ours has a longer window


def allowed_delay(data: DataSection) -> int:
    """Return the maximum delay of one microphone's messages behind those of another, in ns."""
    return ALLOWED_DELAY if len(_channels_of("info", data)) > 1 else 0


def _channels_of(kind: str, data: DataSection) -> list[int]:
    channels = data.definitions.channels.items()
    return [number for number, channel in channels if split_topic(channel.topic)[1] == kind]


class MessageChecks:
    """Checks of the messages of one file, in file order."""

    def __init__(self, data: DataSection, findings: Findings) -> None:
        self.infos: dict[str, dict[str, Any]] = {}  # `AudioStreamInfo` of each microphone
        self.frames: dict[str, FrameSequence] = {}  # by microphone
        self._data = data
        self._findings = findings
        self._last: int | None = None  # log time of the last message
        self._last_gathered: int | None = None  # log time of the last gathered message
        self._interrupted = 0  # log time before which messages are missing
        self._parts: dict[str, list[int]] = {}  # starts of further recordings in a merged log
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
        for kind in ("info", *TYPES, *SHARED):  # `info` first: the other checks depend on it
            for columns in by_kind.pop(kind, ()):
                self._check(kind, columns)
        for microphone, frames in self.frames.items():
            for time in self._parts.pop(microphone, []):
                frames.begin_anew(time)
            frames.settle(self._settled())

    def finish(self) -> None:
        """Check the last frames at the end of the file."""
        for frames in self.frames.values():
            frames.finish()

    def interrupt(self) -> None:
        """Record that messages are missing here, because the file is damaged."""
        self._interrupted = self._last or self._interrupted
        self._last = self._last_gathered = None
        for frames in self.frames.values():
            frames.interrupt()

    def _is_ours(self, channel: Channel, typename: str) -> bool:
        """Whether a channel has any version of a type of ours."""
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
        if self._last is None or not _channels_of(EMBEDDING, self._data):
            return self._last
        return self._last - GATHERED_SPAN

    def _check_times(self, batch: MessageBatch) -> None:
        heads = batch.heads
        times = heads["log_time"]
        if self._last is None:
            self._check_begin(heads)
        # Embeddings may be in later chunks than other messages of their time.
        gathered = np.isin(heads["channel"], _channels_of(EMBEDDING, self._data))
        self._last = self._check_order(times[~gathered], self._last)
        self._last_gathered = self._check_order(times[gathered], self._last_gathered)
        late = heads["publish_time"] - times
        if not self._named:  # `cut` puts older infos at the beginning
            late[np.isin(heads["channel"], _channels_of("info", self._data))] = 0
        self._findings.rows(
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

    def _check_begin(self, heads: NDArray[np.void]) -> None:
        channel = self._data.definitions.channels.get(int(heads["channel"][0]))
        if not self.infos and (channel is None or split_topic(channel.topic)[1] != "info"):
            topic = "" if channel is None else f", but on {channel.topic}"
            time = int(heads["log_time"][0])
            what = f"the first message is no AudioStreamInfo{topic}"
            self._findings.error("info-first", what, DISTRUST, time=time)

    def _check(self, kind: str, columns: Columns) -> None:
        microphone = split_topic(columns.topic)[0]
        checks = ColumnChecks(self._findings, columns)
        checks.check_stamps(kind, microphone, named=self._named)
        if kind == DIAGNOSTICS:
            self._check_health(columns)
        if not microphone:
            return
        if kind == "info":
            self._check_infos(columns, microphone)
        info = self.infos.get(microphone)
        if microphone not in self.frames:
            self.frames[microphone] = self._frame_sequence(microphone, info)
        checks.check_content(kind, info)
        rows = _sequence_rows(kind, columns)
        if rows is not None and kind == EMBEDDING:  # gathered after the missing messages
            rows = rows[rows[:, 0] > self._interrupted]
        if rows is not None:
            self.frames[microphone].add(kind, rows)
        if kind == GAP and rows is not None:
            self.frames[microphone].add_damages(rows[columns["reason"] == LOG_DAMAGED])

    def _frame_sequence(self, microphone: str, info: Mapping[str, Any] | None) -> FrameSequence:
        every, timing = statistics_every(self._data), None
        if info is not None and len(info["labels"]):
            timing = _label_timing(self._data, microphone, info)
        thinned = _thinned_kinds(self._data)
        return FrameSequence(self._findings, microphone, every, timing, thinned)

    def _check_health(self, columns: Columns) -> None:
        """Report each problem in the recorder's diagnostics once."""
        for time, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
            for status in statuses:
                trouble = f"{status['name']}: {status['message']}"
                if status["level"] and trouble not in self._troubles:
                    self._troubles.add(trouble)
                    self._findings.warning("health", trouble, time=time)

    def _check_infos(self, columns: Columns, microphone: str) -> None:
        """Store the info of a microphone; a repeated info starts another recording."""
        for row, values in enumerate(_rows(columns)):
            info = dict(zip(columns.fields, values, strict=True)) | {STAMP: 0}
            time = int(columns.log_times[row])
            if microphone not in self.infos:
                self.infos[microphone] = info
            elif self._named or info != self.infos[microphone]:
                what = f"{columns.topic}: another AudioStreamInfo in one log"
                self._findings.error("info-twice", what, DISTRUST, time=time)
            elif microphone in self.frames:
                self._parts.setdefault(microphone, []).append(time)


def statistics_every(data: DataSection) -> int | None:
    """Read the interval of statistics, in frames, from the configuration in a file, if stated."""
    try:
        configuration = json.loads(data.attachments["configuration.json"][0])
        every = configuration["statistics_every"]
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    return every if isinstance(every, int) and every > 0 else None


def _thinned_kinds(data: DataSection) -> set[str]:
    """Return the kinds of messages that were dropped as the file aged, from its metadata."""
    steps = {record.get(THINNED) for record in data.metadata.get(HEARTHLOG_METADATA, [])}
    return {kind for step in steps for kind in dropped_kinds(step)}


def _label_timing(
    data: DataSection, microphone: str, info: Mapping[str, Any]
) -> LabelTiming | None:
    """Return the timing of the model in a file; None if its description was lost.

    The first version had no description; its labels refer to the end of a window.
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
    except (KeyError, ModelError):  # the feature set is not installed
        frames = max(round(description.window_seconds / FRAME_SECONDS), 1)
        return LabelTiming(frames, description.label_frame, needs_floor=description.gate > 0.0)


def _rows(columns: Columns) -> Any:
    return zip(*(values.tolist() for values in columns.fields.values()), strict=True)


def _sequence_rows(kind: str, columns: Columns) -> Int64 | None:
    """Return the rows of a kind for `FrameSequence.add`; None for an unsupported kind."""
    times, stamps = columns.log_times, columns[STAMP]
    if kind == GAP:
        parts = times, stamps, columns["frames_lost"]
    elif kind == SEGMENT:
        parts = times, stamps, stamps + columns["duration"]
    elif kind in {FEATURES, STATISTICS, LABEL, DIRECTION, EMBEDDING}:
        parts = times, columns["frame"], stamps
    else:
        return None
    return np.stack([part.astype(np.int64) for part in parts], axis=1)


_TIME = "%Y%m%dT%H%M%SZ"
DAY_FOLDERS = re.compile(r"\d{4}/\d{2}/\d{2}")
_KEYS = {"version", "node", "configuration_sha256", "feature_set", "model", "model_sha256"}
_CONFIGURATION, _MODEL_CARD, _MODEL = ATTACHMENTS = ("configuration.json", CARD, DESCRIPTION)


class MetadataChecks:
    """Checks of metadata and counts, after the complete file was read.

    Counts are compared only if the complete file was readable.
    """

    def __init__(
        self,
        data: DataSection,
        messages: MessageChecks,
        findings: Findings,
        *,
        finished: bool,
        is_readable: bool,
    ) -> None:
        self._data = data
        self._infos = messages.infos
        self._findings = findings
        self._finished = finished
        self._is_readable = is_readable
        self._records = data.metadata.get(HEARTHLOG_METADATA, [])
        self._channels = {c.topic: c for c in data.definitions.channels.values()}

    def check(self) -> None:
        """Check the metadata, the name, the info, the topics and the counts of the file."""
        if self._data.header is not None and self._data.header.profile != PROFILE:
            self._error("profile", f"the profile is {self._data.header.profile!r}, not {PROFILE}")
        self._check_metadata()
        self._check_name()
        if not self._data.counts:
            return
        for microphone, info in self._infos.items():
            self._check_info(microphone, info)
        self._check_topics()
        if self._finished:
            self._check_rosbag2()

    def _error(self, rule: str, what: str) -> None:
        self._findings.error(rule, what, DISTRUST)

    def _check_metadata(self) -> None:
        records = self._records
        if len(records) != 1:
            what = f"there are {len(records)} metadata records {HEARTHLOG_METADATA}, not one"
            self._error("metadata", what)
            return
        if missing := sorted(_KEYS - records[0].keys()):
            self._error("metadata", f"metadata {HEARTHLOG_METADATA} lacks {', '.join(missing)}")
        attachments = self._data.attachments
        one = 1 if records[0].get("model") else 0
        least_models = one if describes_model(records[0]) else 0
        counts = {_CONFIGURATION: (1, 1), _MODEL_CARD: (one, one), _MODEL: (least_models, one)}
        for name, (least, most) in counts.items():
            count = len(attachments.get(name, ()))
            if not least <= count <= most:
                what = f"there are {count} attachments {name}, not {most}"
                self._error("attachments", what)
        if len(attachments.get(_CONFIGURATION, ())) == 1:
            digest = hashlib.sha256(attachments[_CONFIGURATION][0]).hexdigest()
            if records[0].get("configuration_sha256") != digest:
                what = f"{_CONFIGURATION} is not the one of metadata {HEARTHLOG_METADATA}"
                self._error("attachments", what)

    def _check_name(self) -> None:
        """Compare a recorder-style file name with the contents."""
        path = self._findings.path
        named = LOG_NAME.fullmatch(path.name)
        if named is None:
            return
        node = self._records[0].get("node", named["node"]) if self._records else named["node"]
        if node != named["node"]:
            self._error("name", f"the name says node {named['node']}, the file {node}")
        if self._data.span is None:
            return
        try:
            start = datetime.fromtimestamp(self._data.span[0] // NANOSECONDS, UTC)
        except (OverflowError, ValueError, OSError):
            start = datetime.min.replace(tzinfo=UTC)
        latest = start + timedelta(seconds=allowed_delay(self._data) / NANOSECONDS)
        if not f"{start:{_TIME}}" <= named["time"] <= f"{latest:{_TIME}}":
            self._error("name", f"the name says {named['time']}, the first message {start:%c}")
        folders = "/".join(path.absolute().parts[-4:-1])
        days = {f"{start:%Y/%m/%d}", f"{latest:%Y/%m/%d}"}
        if DAY_FOLDERS.fullmatch(folders) and folders not in days:
            self._error("name", f"the folder says {folders}, the first message {start:%Y/%m/%d}")

    def _check_info(self, microphone: str, info: dict[str, Any]) -> None:
        expected: dict[str, Any] = {"sample_rate": SAMPLE_RATE, "frame_seconds": FRAME_SECONDS}
        with suppress(ModelError):  # the feature set is not installed
            features = feature_set(str(info["feature_set"]))
            expected["window_seconds"] = features.window_seconds
            expected["feature_names"] = list(features.feature_names)
        is_first = microphone == next(iter(self._infos))  # the record names its model
        for record in self._records[:is_first]:
            expected |= {k: record.get(k) for k in ("feature_set", "model", "model_sha256")}
        for name, value in expected.items():
            if _plain(info[name]) != value:
                what = f"{microphone}: info says {name} {_plain(info[name])}, not {value}"
                self._error("info", what)
        has = {bool(info["model"]), len(info["labels"]) > 0, bool(info["model_sha256"])}
        if len(has) > 1:
            what = f"{microphone}: info has only some of model, model_sha256 and labels"
            self._error("info", what)

    def _check_topics(self) -> None:
        """Compare the channels with the expected channels of a recorder."""
        expected: dict[str, Topic] = {}
        candidates = [CANDIDATE] if any(each.get("candidate") for each in self._records) else []
        scenarios = [one for record in self._records for one in recorded_scenarios(record)]
        for microphone, info in self._infos.items():
            classes = list(info["labels"]) or None
            own = [scenario_labelling(s.name) for s in scenarios if s.microphone == microphone]
            others: dict[str, list[str]] = {name: [] for name in (*candidates, *own)}
            is_array = f"/{microphone}/{DIRECTION}" in self._channels
            channel = self._channels.get(f"/{microphone}/{EMBEDDING}")
            metadata = {} if channel is None else channel.metadata
            embedding = EmbeddingSource.from_metadata(metadata)
            names = list(info["feature_names"])
            topics = topics_of(
                microphone, names, classes, others, directions=is_array, embedding=embedding
            )
            expected |= {topic.name: topic for topic in topics}
        for name, topic in expected.items():
            if name not in self._channels and split_topic(name)[0]:
                self._error("topics", f"{name} is missing")
            if name in self._channels and split_topic(name)[1] != SECONDARY_LABEL:
                self._check_arrays(self._channels[name], topic)
        counts = Counter(c.topic for c in self._data.definitions.channels.values())
        for name, channel in self._channels.items():
            if counts[name] > 1:
                self._error("topics", f"{name} has {counts[name]} channels")
            if split_topic(name)[0] and expected and name not in expected:
                self._error("topics", f"{name} should not be there")
            typename = topic_type(name)
            if typename is None:
                self._findings.warning("other-topic", f"{name} is no topic of hearthlog")
            else:
                self._check_type(channel, typename)

    def _check_type(self, channel: Channel, typename: str) -> None:
        schema = self._data.definitions.schemas.get(channel.schema_id)
        if schema is None:
            return  # already reported
        if (schema.name, schema.encoding) != (typename, SCHEMA_ENCODING):
            what = f"{channel.topic} is of type {schema.name} ({schema.encoding}), not {typename}"
            self._error("type", what)
        else:
            self._check_definition(channel, schema)
        try:
            profiles = json.loads(channel.metadata.get("offered_qos_profiles", "[{}]"))
            good = isinstance(profiles, list) and all(isinstance(p, dict) for p in profiles)
        except (ValueError, RecursionError):
            good = False
        if not good or not profiles:
            self._error("qos", f"{channel.topic}: offered_qos_profiles is no list of profiles")

    def _check_definition(self, channel: Channel, schema: Schema) -> None:
        """Compare a definition with released versions, and its hash with the channel's hash."""
        version = schema_version(self._records[0] if self._records else {})
        try:
            kind = message_type(schema.name, schema.encoding, schema.data)
            what = difference(kind, version or SCHEMA_VERSION)
            if not what and channel.metadata.get("topic_type_hash") != type_hash_of(kind):
                self._error("type", f"{channel.topic}: topic_type_hash is not that of {kind.name}")
        except LogError as error:
            what = str(error)
        if what:
            what = f"{channel.topic}: {schema.name} is defined otherwise than by hearthlog: {what}"
            self._error("type", what)

    def _check_arrays(self, channel: Channel, topic: Topic) -> None:
        for key, names in topic.array_names.items():
            if channel.metadata.get(f"{key}_names") != json.dumps(list(names)):
                self._error("array-names", f"{topic.name}: {key}_names are not those of info")

    def _check_rosbag2(self) -> None:
        records = self._data.metadata.get(ROSBAG2, [])
        if len(records) != 1:
            self._error("rosbag2", f"there are {len(records)} metadata records {ROSBAG2}, not one")
            return
        try:
            metadata = json.loads(records[0]["serialized_metadata"])
            counts = {
                topic["topic_metadata"]["name"]: topic["message_count"]
                for topic in metadata["topics_with_message_count"]
            }
            start = metadata["starting_time"]["nanoseconds_since_epoch"]
            span = start, start + metadata["duration"]["nanoseconds"]
            total = metadata["message_count"]
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            self._error("rosbag2", f"metadata {ROSBAG2} cannot be read ({error!r})")
            return
        if not self._is_readable:
            return
        actual: Counter[str] = Counter()
        for number, channel in self._data.definitions.channels.items():
            actual[channel.topic] += self._data.counts[number]
        counts |= dict.fromkeys(actual.keys() - counts.keys(), 0)
        actual.update(dict.fromkeys(counts.keys() - actual.keys(), 0))
        if counts != actual or total != sum(actual.values()):
            wrong = [topic for topic in actual if counts.get(topic) != actual[topic]]
            what = ", ".join(sorted(map(str, wrong))) or "in all"
            self._error("rosbag2", f"metadata {ROSBAG2} has other counts than the file: {what}")
        if span != self._data.span:
            self._error("rosbag2", f"metadata {ROSBAG2} has other times than the file")


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, list | tuple) else value
