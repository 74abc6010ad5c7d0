"""What a log of hearthlog says of itself, checked against docs/log.md and its messages."""

import hashlib
import json
import re
from collections import Counter
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Any

from mcap.records import Channel, Schema

from hearthlog.analyzer.doctor.findings import DISTRUST, Findings
from hearthlog.analyzer.doctor.mcap.data_section import DataSection
from hearthlog.analyzer.doctor.message_checks import MessageChecks, allowed_delay
from hearthlog.analyzer.doctor.topic_types import (
    BESIDE_LABEL,
    DIRECTION,
    EMBEDDING,
    LOG_NAME,
    split_topic,
    topic_type,
)
from hearthlog.models.errors import ModelError
from hearthlog.models.features.installed import feature_set
from hearthlog.models.modelfile.modelfile import CARD, DESCRIPTION
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.metadata import (
    HEARTHLOG_METADATA,
    describes_model,
    recorded_scenarios,
    schema_version,
)
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA as ROSBAG2
from hearthlog.schemas.logs.writer import PROFILE, SCHEMA_ENCODING
from hearthlog.schemas.messages.fields import difference, type_hash_of
from hearthlog.schemas.messages.message_types import SCHEMA_VERSION
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    EmbeddingSource,
    Topic,
    scenario_labelling,
    topics_of,
)
from hearthlog.schemas.messages.type_definitions import message_type

_TIME = "%Y%m%dT%H%M%SZ"
_FOLDERS = re.compile(r"\d{4}/\d{2}/\d{2}")
_KEYS = {"version", "node", "configuration_sha256", "feature_set", "model", "model_sha256"}
_CONFIGURATION, _MODEL_CARD, _MODEL = ATTACHMENTS = ("configuration.json", CARD, DESCRIPTION)


class MetadataChecks:
    """Checks what stands once in a file, when all of it was read.

    Parameters
    ----------
    whole : bool
        Whether all of it could be read: only then counts are compared.
    """

    def __init__(
        self,
        data: DataSection,
        messages: MessageChecks,
        findings: Findings,
        *,
        finished: bool,
        whole: bool,
    ) -> None:
        self._data = data
        self._infos = messages.infos
        self._findings = findings
        self._finished = finished
        self._whole = whole
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
        records = self._data.metadata.get(HEARTHLOG_METADATA, [])
        if len(records) != 1:
            self._error(
                "metadata",
                f"there are {len(records)} metadata records {HEARTHLOG_METADATA}, not one",
            )
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
                self._error(
                    "attachments",
                    f"{_CONFIGURATION} is not the one of metadata {HEARTHLOG_METADATA}",
                )

    def _check_name(self) -> None:
        """Compare the name, if it is one as the recorder gives it, with the contents."""
        path = self._findings.path
        named = LOG_NAME.fullmatch(path.name)
        if named is None:
            return
        records = self._data.metadata.get(HEARTHLOG_METADATA, [])
        node = records[0].get("node", named["node"]) if records else named["node"]
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
        if _FOLDERS.fullmatch(folders) and folders not in days:
            self._error("name", f"the folder says {folders}, the first message {start:%Y/%m/%d}")

    def _check_info(self, microphone: str, info: dict[str, Any]) -> None:
        expected: dict[str, Any] = {
            "sample_rate": SAMPLE_RATE,
            "frame_seconds": FRAME_SECONDS,
        }
        with suppress(ModelError):  # the set is not installed here
            features = feature_set(str(info["feature_set"]))
            expected["window_seconds"] = features.window_seconds
            expected["feature_names"] = list(features.feature_names)
        is_first = microphone == next(iter(self._infos))  # the record is about its model
        for record in self._data.metadata.get(HEARTHLOG_METADATA, [])[:is_first]:
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
        """Compare the channels with those that a recorder writes."""
        expected: dict[str, Topic] = {}
        records = self._data.metadata.get(HEARTHLOG_METADATA, [])
        candidates = [CANDIDATE] if any(record.get("candidate") for record in records) else []
        scenarios = [one for record in records for one in recorded_scenarios(record)]
        for microphone, info in self._infos.items():
            classes = list(info["labels"]) or None
            own = [scenario_labelling(s.name) for s in scenarios if s.microphone == microphone]
            beside: dict[str, list[str]] = {name: [] for name in (*candidates, *own)}
            is_array = f"/{microphone}/{DIRECTION}" in self._channels
            channel = self._channels.get(f"/{microphone}/{EMBEDDING}")
            metadata = {} if channel is None else channel.metadata
            embedding = EmbeddingSource.from_metadata(metadata)
            names = list(info["feature_names"])
            topics = topics_of(
                microphone, names, classes, beside, directions=is_array, embedding=embedding
            )
            expected |= {topic.name: topic for topic in topics}
        for name, topic in expected.items():
            if name not in self._channels and split_topic(name)[0]:
                self._error("topics", f"{name} is missing")
            if name in self._channels and split_topic(name)[1] != BESIDE_LABEL:
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
            return  # is reported already
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
        """Compare a definition with those of released versions, and its hash with the channel's."""
        records = self._data.metadata.get(HEARTHLOG_METADATA, [{}])
        try:
            kind = message_type(schema.name, schema.encoding, schema.data)
            what = difference(kind, schema_version(records[0]) or SCHEMA_VERSION)
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
        if not self._whole:
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
