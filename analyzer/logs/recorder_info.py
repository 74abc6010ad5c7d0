"""The recorder of a log: its configuration, feature set, models and health."""

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from mcap import records
from mcap.opcode import Opcode
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hearthlog.analyzer.logs.clips import CLIP_FIELDS
from hearthlog.analyzer.logs.selection import array_names, decode_types, is_compatible
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.installed import BUILT_IN, feature_set
from hearthlog.schemas.errors import LogError, ModelError
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.contents import Status
from hearthlog.schemas.logs.files import check_node_name
from hearthlog.schemas.logs.metadata import (
    FEATURE_SET_DIGEST,
    FEATURE_SET_DISTRIBUTION,
    FEATURE_SET_VERSION,
    features_of_microphone,
    read_provenance,
    recorded_scenarios,
)
from hearthlog.schemas.logs.writer import Attachment
from hearthlog.schemas.mcap.chunks import read_chunks
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    EmbeddingSource,
    check_microphone_name,
    parse_topic,
    topic,
)

CONFIGURATION = "configuration.json"
_INFO = ("device", "feature_set", "model", "model_sha256")
TYPES = {
    "features": (message_types.FEATURES, ("frame", "header.stamp", "values")),
    "audio": (message_types.RAW_AUDIO, CLIP_FIELDS),
    "info": (message_types.STREAM_INFO, _INFO),
}
_UNNAMED = "?"  # feature set of a log that has only the names of its features
_DIGEST = re.compile("[0-9a-f]{64}")
_FIRST: Mapping[str, Collection[str]] = {
    message_types.STREAM_INFO: _INFO,
    message_types.FEATURES: ("frame", "header.stamp"),
}


class Configuration(BaseModel):
    """Recorder settings that shape its log."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)

    max_bag_duration: int = Field(default=3600, ge=1, le=86_400)  # seconds in a file
    flush_seconds: float = Field(default=1.0, ge=1.0, le=3600)  # maximum loss of a killed process
    sync_seconds: float = Field(default=5.0, ge=1.0, le=3600)  # maximum loss by a power cut
    # frames between messages of statistics; 1 in logs without it
    statistics_every: int = Field(default=1, ge=1, le=1 << 32)


@dataclass(frozen=True, eq=False)
class RecorderInfo:
    """Recorder and microphone as described by a log."""

    path: Path
    complete: bool  # whether the log is finished
    node: str
    microphone: str
    device: str  # as in `AudioStreamInfo`; empty if not in the log
    feature_set: str
    model: str
    model_sha256: str
    configuration: Configuration
    metadata: Mapping[str, str]  # `hearthlog` record, with the model of this microphone
    attachments: Sequence[Attachment]
    # number and time of the first frame of features; None if not requested or missing
    first_frame: tuple[int, int] | None
    has_directions: bool  # whether the log has directions from a microphone array
    embedding: EmbeddingSource | None  # network and projection; None without embeddings


def read_recorder_infos(path: Path, kind: str) -> list[RecorderInfo]:
    """Read the recorder description of each microphone of a log, sorted by microphone.

    Empty if the log has no such topic, which is normal for layers. Raise `LogError` if the log is
    damaged or has invalid values.
    """
    with LogFile(path) as file:
        microphones = _described_microphones(file, kind)
        if not microphones:
            return []
        attachments = attachments_of(file)
        # A merged log is attributed to the last of its recorders.
        record = next(reversed(read_provenance(file)), {})
        return [_info_of(file, name, kind, record, attachments) for name in microphones]


def _described_microphones(file: LogFile, kind: str) -> list[str]:
    """Return the microphones with a topic of a kind, sorted."""
    if not file.channels:
        read_chunks(file, file.chunks[:1], topics=())  # a log without an index has them there
    return sorted(microphones_of(file, kind))


def _info_of(
    file: LogFile,
    microphone: str,
    kind: str,
    record: Mapping[str, str],
    attachments: Sequence[Attachment],
) -> RecorderInfo:
    path = file.path
    own = first_message(file, topic(microphone, "info"), message_types.STREAM_INFO)
    frame = first_message(file, topic(microphone, "features"), message_types.FEATURES)
    info = {**record, **own}
    digest = info.get("model_sha256", "")
    first = None
    if frame and kind == "features":
        first = int(frame["frame"]), int(frame["header.stamp"])
    try:
        node = check_node_name(record.get("node", "home"))
        check_microphone_name(microphone)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    return RecorderInfo(
        path=path,
        complete=file.complete,
        node=node,
        microphone=microphone,
        device=info.get("device", ""),
        feature_set=info.get("feature_set") or _set_of_names(file, topic(microphone, "features")),
        model=info.get("model", ""),
        model_sha256=digest if _DIGEST.fullmatch(digest) else "",
        configuration=_configuration(path, attachments),
        metadata={
            key: own.get(key, text)
            for key, text in features_of_microphone(record, microphone).items()
        },
        attachments=attachments,
        first_frame=first,
        has_directions=kind == "features" and bool(_channels(file, topic(microphone, "direction"))),
        embedding=embedding_source(file, microphone) if kind == "features" else None,
    )


def _set_of_names(file: LogFile, name: str) -> str:
    """Return the feature set with a channel's feature names; empty if it names none.

    Programs that copy topics drop metadata records, but keep the names.
    """
    names = next((array_names(one.metadata, "values") for one in _channels(file, name)), [])
    ours = {each.feature_names: each.name for each in BUILT_IN}
    return ours.get(tuple(names), _UNNAMED) if names else ""


def embedding_source(file: LogFile, microphone: str) -> EmbeddingSource | None:
    """Return network and projection of a log's embeddings; None without embeddings."""
    channels = _channels(file, topic(microphone, "embedding"))
    return next((EmbeddingSource.from_metadata(channel.metadata) for channel in channels), None)


def _channels(file: LogFile, name: str) -> list[records.Channel]:
    return [channel for channel in file.channels.values() if channel.topic == name]


def first_embedding_source(path: Path) -> EmbeddingSource | None:
    """Read network and projection of a log's embeddings; None without embeddings.

    Raise `LogError` if the log is damaged.
    """
    with LogFile(path) as file:
        names = _described_microphones(file, "features")
        return next(filter(None, (embedding_source(file, name) for name in names)), None)


def attachments_of(file: LogFile) -> list[Attachment]:
    """Read the attachments of a log, in the order of its index.

    Raise `LogError` if an attachment is too large or damaged.
    """
    locations = [each for each in file.record_locations if each.opcode == Opcode.ATTACHMENT]
    attached = [r for r in map(file.record, locations) if isinstance(r, records.Attachment)]
    return [Attachment(r.name, r.media_type, r.data) for r in attached]


def models_for(features: str) -> str:
    """Return advice for an error message: which models fit a feature set."""
    method = ""
    with suppress(ModelError):  # a set that is not installed here
        method = feature_set(features).method
    how = f"; `hearthlog train --method {method}` learns one" if method else ""
    return f"take a model for {features[:64]}{how}"


def check_model(origin: RecorderInfo, model: Model) -> None:
    """Check that a model fits the features of a log.

    Raise `LogError` if the model is for another feature set, or if the log's feature set is not
    installed or has another version.
    """
    features, wanted = features_of(origin), model.description.feature_set
    if features.name != wanted:
        raise LogError(
            f"{origin.path}: has features of set {features.name}; model {model.name} is for "
            f"{wanted}: {models_for(features.name)}"
        )


def features_of(origin: RecorderInfo) -> FeatureSet:
    """Return the feature set of a log; `auros21`, once the only one, if the log names none.

    Raise `LogError` if the set is not installed, cannot be imported, or has another version.
    """
    name = origin.feature_set or AUROS21.name
    if name == _UNNAMED:
        raise LogError(f"{origin.path}: does not say of which feature set its features are")
    try:
        features = feature_set(name)
    except ModelError as error:
        source = origin.metadata.get(FEATURE_SET_DISTRIBUTION, "")
        origin_text = f" (the recorder had it from {source[:64]})" if source else ""
        raise LogError(f"{origin.path}: {error}{origin_text}") from error
    version = origin.metadata.get(FEATURE_SET_VERSION, "1")
    if version != str(features.version):
        raise LogError(
            f"{origin.path}: has features of {name}, version {version[:20]!r}; here is version "
            f"{features.version}, which gives other values"
        )
    digest = origin.metadata.get(FEATURE_SET_DIGEST, "")
    if digest != features.digest:
        raise LogError(
            f"{origin.path}: has features of the network {name} with sha256 {digest[:12]!r}; here "
            f"is {features.digest[:12]!r}, which gives other values"
        )
    return features


def microphones_of(file: LogFile, kind: str) -> set[str]:
    """Return the names of the microphones with a topic of a kind."""
    names = set()
    for channel in file.channels.values():
        schema = file.schemas.get(channel.schema_id)
        name = channel.topic.removeprefix("/").removesuffix("/" + kind)
        if channel.topic == topic(name, kind) and is_compatible(channel, schema, *TYPES[kind]):
            names.add(name)
    return names


def first_message(file: LogFile, name: str, kind: str) -> dict[str, Any]:
    """Return some fields of the first message of a topic; empty if there is no message.

    Raise `LogError` if the message is damaged.
    """
    ids = {i for i, channel in file.channels.items() if channel.topic == name}
    chunks = file.with_channels(file.chunks, ids)
    for i in range(len(chunks)):
        messages = read_chunks(file, chunks[i : i + 1], [name])
        for columns in decode_types(file.path, messages, {kind: _FIRST[kind]}):
            return {field: values[0] for field, values in columns.fields.items()}
    return {}


def _configuration(path: Path, attachments: Sequence[Attachment]) -> Configuration:
    text = next((item.data for item in attachments if item.name == CONFIGURATION), b"{}")
    try:
        return Configuration.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(["", *(str(part)[:64] for part in first["loc"])])
        raise LogError(f"{path}: {CONFIGURATION}{where}: {first['msg']}") from error


_ANY = ""  # microphone key if only the `hearthlog` record names a model


class LabelledBy(NamedTuple):
    """Name and digest of the labelling model; both empty for none."""

    model: str
    model_sha256: str


NO_MODEL = LabelledBy("", "")


def models_of(log: Path) -> Mapping[str, LabelledBy]:
    """Read which models labelled the microphones of a log, sorted by microphone.

    If no microphone names a model, the model of the `hearthlog` record has an empty name. Empty if
    there is no model, if the log is damaged, or if it has several microphones and no message of
    them yet.
    """
    models: dict[str, LabelledBy] = {}
    with suppress(LogError), LogFile(log) as file:
        names = sorted(microphones_of(file, "info"))
        for name in names:
            info = first_message(file, topic(name, "info"), message_types.STREAM_INFO)
            if info:
                models[name] = LabelledBy(info["model"], info["model_sha256"])
        if not models and len(names) <= 1:
            for record in read_provenance(file)[-1:]:
                models[_ANY] = LabelledBy(record.get("model", ""), record.get("model_sha256", ""))
    return models


def model_of(log: Path, microphone: str, scenario: str = "") -> LabelledBy:
    """Read which model labelled a microphone of a log or layer, as `models_of`.

    The scenario is empty for the sounds of the home.
    """
    if scenario:
        return scenario_models(log).get((microphone, scenario), NO_MODEL)
    models = models_of(log)
    return models.get(microphone, models.get(_ANY, NO_MODEL))


def scenario_models(log: Path) -> Mapping[tuple[str, str], LabelledBy]:
    """Read which models labelled the scenarios of a log, by microphone and scenario.

    Empty if there is none, or the log is damaged.
    """
    of_scenarios: dict[tuple[str, str], LabelledBy] = {}
    with suppress(LogError), LogFile(log) as file:
        for record in read_provenance(file):
            for one in recorded_scenarios(record):
                of_scenarios[one.microphone, one.name] = LabelledBy(one.model, one.sha256)
    return of_scenarios


_LONGEST = 200  # characters


class Trouble(NamedTuple):
    """A problem and its span (ns of UTC): a gap, or a diagnostic status that is not OK."""

    source: str
    text: str
    start: int
    end: int


class MicrophoneHealth(NamedTuple):
    """Health of a microphone at a time: the worst level and all problems."""

    microphone: str
    time: int  # in nanoseconds of UTC
    level: int
    text: str
    floor_dbfs: float  # noise floor of the room, NaN if unknown


def gaps_of(node: str, columns: Columns) -> Iterator[Trouble]:
    """Yield the gaps of positive duration.

    Raise `LogError` if a field is missing.
    """
    starts, durations = columns["header.stamp"], columns["duration"]
    rows = zip(starts.tolist(), durations.tolist(), columns["reason"].tolist(), strict=True)
    for start, nanoseconds, reason in rows:
        if nanoseconds > 0:
            yield Trouble(f"{node}/{columns.topic}", reason, start, start + nanoseconds)


def microphone_states(columns: Columns) -> Iterator[MicrophoneHealth]:
    """Yield the health of a microphone for each of its diagnostic messages.

    Raise `LogError` if a field is missing.
    """
    times, names = columns["header.stamp"].tolist(), columns["header.frame_id"].tolist()
    for time, name, statuses in zip(times, names, columns["status"], strict=True):
        topic = parse_topic(f"/{name}/info")
        if topic is not None and topic.labelling == LIVE:
            level = max((status["level"] for status in statuses), default=0)
            bad = [status["message"] for status in statuses if status["level"]]
            floors = (status_value(status, "floor_dbfs") for status in statuses)
            floor = next(filter(math.isfinite, floors), math.nan)
            yield MicrophoneHealth(name, time, level, "; ".join(bad)[:_LONGEST], floor)


def status_value(status: Any, key: str) -> float:
    """Return a number among the values of a diagnostic status; NaN if there is none."""
    for pair in status["values"]:
        if pair["key"] == key:
            with suppress(ValueError):
                return float(pair["value"])
    return math.nan


def troubles_of(statuses: Iterable[Status], end: int) -> Iterator[Trouble]:
    """Yield the problems of diagnostic statuses, each until its status changes.

    The last problem of a name ends with the last status of that name, or at `end` (nanoseconds of
    UTC) if that is earlier.
    """
    for name, same in groupby(sorted(statuses), lambda status: status.name):
        own = list(same)
        texts = [(status.time, status.message if status.level else None) for status in own]
        for start, stop, text in lasting(texts, min(own[-1].time, end)):
            yield Trouble(name, text, start, stop)


def lasting(texts: Sequence[tuple[int, str | None]], end: int) -> Iterator[tuple[int, int, str]]:
    """Yield each text with its span: until the next different text, the last until `end`.

    Times are nanoseconds of UTC, in order; the text None is no text.
    """
    changes = [(next(same)[0], text) for text, same in groupby(texts, lambda pair: pair[1])]
    ends = [*(time for time, _ in changes[1:]), end]
    for (start, text), stop in zip(changes, ends, strict=False):
        if text is not None:
            yield start, stop, text
