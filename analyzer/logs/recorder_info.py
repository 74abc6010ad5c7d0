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
from hearthlog.models.errors import ModelError
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.home33 import HOME33
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.errors import LogError
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
_UNNAMED = "?"  # a feature set of which a log has no more than the names of its features
_METHODS = {"auros21": "room21", "home33": "room"}  # which learns best, of the sets of ours
_DIGEST = re.compile("[0-9a-f]{64}")
_FIRST: Mapping[str, Collection[str]] = {
    message_types.STREAM_INFO: _INFO,
    message_types.FEATURES: ("frame", "header.stamp"),
}


class Configuration(BaseModel):
    """Settings of a recorder that shape its log.

    Attributes
    ----------
    max_bag_duration : int
        Seconds in a file; 1 to 86,400.
    flush_seconds, sync_seconds : float
        Seconds that a killed process, and a power cut, lose at most; 1 to 3600.
    statistics_every : int
        Frames from one message of statistics to the next; at least 1, which is that of every log
        that does not say.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)

    max_bag_duration: int = Field(default=3600, ge=1, le=86_400)
    flush_seconds: float = Field(default=1.0, ge=1.0, le=3600)
    sync_seconds: float = Field(default=5.0, ge=1.0, le=3600)
    statistics_every: int = Field(default=1, ge=1, le=1 << 32)


@dataclass(frozen=True, eq=False)
class RecorderInfo:
    """What a log says of the recorder that wrote it."""

    path: Path
    complete: bool  # whether the log is finished
    node: str
    microphone: str
    device: str  # as in `AudioStreamInfo`; empty where the log does not say
    feature_set: str
    model: str
    model_sha256: str
    configuration: Configuration
    metadata: Mapping[str, str]  # the `hearthlog` record, with the model of this microphone
    attachments: Sequence[Attachment]
    # number and time of the first frame of its features; None if they are not wanted, or it has
    # none
    first_frame: tuple[int, int] | None
    has_directions: bool  # whether those of an array are beside its features
    embedding: EmbeddingSource | None  # of the embeddings beside them; None if there are none


def read_recorder_infos(path: Path, kind: str) -> list[RecorderInfo]:
    """Read what a log says of its recorder, for each of its microphones.

    Returns
    -------
    list of RecorderInfo
        In the order of the names of the microphones; empty if the log has no such topic, as layers
        have not.

    Raises
    ------
    LogError
        If it is damaged, or says what cannot be.
    """
    with LogFile(path) as file:
        if not file.channels:
            read_chunks(file, file.chunks[:1], topics=())  # a log without an index says it there
        microphones = sorted(microphones_of(file, kind))
        if not microphones:
            return []
        attachments = attachments_of(file)
        # What was merged is of the last of its recorders.
        record = next(reversed(read_provenance(file)), {})
        return [_info_of(file, name, kind, record, attachments) for name in microphones]


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
        has_directions=kind == "features" and _has_topic(file, topic(microphone, "direction")),
        embedding=embedding_source(file, microphone) if kind == "features" else None,
    )


def _set_of_names(file: LogFile, name: str) -> str:
    """Name the feature set whose features a channel names; empty if it names none.

    Programs that copy topics leave metadata records behind, but not the names.
    """
    channels = (channel for channel in file.channels.values() if channel.topic == name)
    names = next((array_names(channel.metadata, "values") for channel in channels), [])
    ours = {each.feature_names: each.name for each in (HOME33, AUROS21)}
    return ours.get(tuple(names), _UNNAMED) if names else ""


def embedding_source(file: LogFile, microphone: str) -> EmbeddingSource | None:
    """Return of which network and projection a log has embeddings; None if it has none."""
    name = topic(microphone, "embedding")
    channels = (channel for channel in file.channels.values() if channel.topic == name)
    return next((EmbeddingSource.from_metadata(channel.metadata) for channel in channels), None)


def _has_topic(file: LogFile, name: str) -> bool:
    return any(channel.topic == name for channel in file.channels.values())


def first_embedding_source(path: Path) -> EmbeddingSource | None:
    """Read of which network and projection the embeddings of a log are; None if it has none.

    Raise `LogError` if it is damaged.
    """
    with LogFile(path) as file:
        if not file.channels:
            read_chunks(file, file.chunks[:1], topics=())  # as above
        names = (embedding_source(file, name) for name in sorted(microphones_of(file, "features")))
        return next(filter(None, names), None)


def attachments_of(file: LogFile) -> list[Attachment]:
    """Read the attachments of a log, in the order of its index.

    Raise `LogError` if one is too large, or damaged.
    """
    locations = [each for each in file.record_locations if each.opcode == Opcode.ATTACHMENT]
    attached = [r for r in map(file.record, locations) if isinstance(r, records.Attachment)]
    return [Attachment(r.name, r.media_type, r.data) for r in attached]


def models_for(features: str) -> str:
    """Say which models a feature set needs, as advice in a message."""
    method = _METHODS.get(features)
    how = f"; `hearthlog train --method {method}` learns one" if method else ""
    return f"take a model for {features[:64]}{how}"


def check_model(origin: RecorderInfo, model: Model) -> None:
    """Check that a model is for the features of a log.

    Raise `LogError` if it is for others, or the log's are not installed, or installed in
    another version.
    """
    features, wanted = features_of(origin), model.description.feature_set
    if features.name != wanted:
        raise LogError(
            f"{origin.path}: has features of set {features.name}; model {model.name} is for "
            f"{wanted}: {models_for(features.name)}"
        )


def features_of(origin: RecorderInfo) -> FeatureSet:
    """Return the feature set of a log; `auros21` where the log names none, as there was no other.

    Raise `LogError` if the set is not installed, cannot be imported, or is installed in another
    version.
    """
    name = origin.feature_set or AUROS21.name
    if name == _UNNAMED:
        raise LogError(f"{origin.path}: does not say of which feature set its features are")
    try:
        features = feature_set(name)
    except ModelError as error:
        source = origin.metadata.get(FEATURE_SET_DISTRIBUTION, "")
        known = f" (the recorder had it from {source[:64]})" if source else ""
        raise LogError(f"{origin.path}: {error}{known}") from error
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
    """Return the names of the microphones that have a topic in a log."""
    names = set()
    for channel in file.channels.values():
        schema = file.schemas.get(channel.schema_id)
        name = channel.topic.removeprefix("/").removesuffix("/" + kind)
        if channel.topic == topic(name, kind) and is_compatible(channel, schema, *TYPES[kind]):
            names.add(name)
    return names


def first_message(file: LogFile, name: str, kind: str) -> dict[str, Any]:
    """Return some fields of the first message of a topic; nothing if it has none.

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


_ANY = ""  # microphone, where the record alone names a model


class LabelledBy(NamedTuple):
    """A model; both texts are empty for none."""

    model: str
    model_sha256: str


NO_MODEL = LabelledBy("", "")


def models_of(log: Path) -> Mapping[str, LabelledBy]:
    """Read which models labelled the microphones of a log.

    Returns
    -------
    mapping of str to LabelledBy
        By the names of the microphones, in their order. Of a file in which none of them says it,
        that of its `hearthlog` record, by an empty name. Empty if it says nothing, is damaged, or
        has no message of several microphones yet.
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
    """Read which model labelled a microphone of a log, or of a layer; as `models_of`.

    Parameters
    ----------
    scenario : str, optional
        For which it labelled; empty for the sounds of the home.
    """
    if scenario:
        return scenario_models(log).get((microphone, scenario), NO_MODEL)
    models = models_of(log)
    return models.get(microphone, models.get(_ANY, NO_MODEL))


def scenario_models(log: Path) -> Mapping[tuple[str, str], LabelledBy]:
    """Read which models labelled for the scenarios of a log.

    Returns
    -------
    mapping of (str, str) to LabelledBy
        By microphone and scenario; empty if there is none, or the log is damaged.
    """
    of_scenarios: dict[tuple[str, str], LabelledBy] = {}
    with suppress(LogError), LogFile(log) as file:
        for record in read_provenance(file):
            for one in recorded_scenarios(record):
                of_scenarios[one.microphone, one.name] = LabelledBy(one.model, one.sha256)
    return of_scenarios


_LONGEST = 200  # characters


class Trouble(NamedTuple):
    """What was not well, from when to when (ns of UTC): a gap, or what diagnostics say."""

    source: str
    text: str
    start: int
    end: int


class MicrophoneHealth(NamedTuple):
    """How a microphone was at a time (ns of UTC): the worst level, and all that was not well.

    `floor_dbfs` is the level of the floor of the room, NaN where it is not known.
    """

    microphone: str
    time: int
    level: int
    text: str
    floor_dbfs: float


def gaps_of(node: str, columns: Columns) -> Iterator[Trouble]:
    """Yield the gaps of messages, without those of no length.

    Raise `LogError` if one of these fields is missing.
    """
    starts, durations = columns["header.stamp"], columns["duration"]
    rows = zip(starts.tolist(), durations.tolist(), columns["reason"].tolist(), strict=True)
    for start, nanoseconds, reason in rows:
        if nanoseconds > 0:
            yield Trouble(f"{node}/{columns.topic}", reason, start, start + nanoseconds)


def microphone_states(columns: Columns) -> Iterator[MicrophoneHealth]:
    """Yield the state of a microphone for each diagnostic message that is about one.

    Raise `LogError` if one of these fields is missing.
    """
    times, names = columns["header.stamp"].tolist(), columns["header.frame_id"].tolist()
    for time, name, statuses in zip(times, names, columns["status"], strict=True):
        topic = parse_topic(f"/{name}/info")
        if topic is not None and topic.labelling == LIVE:
            level = max((status["level"] for status in statuses), default=0)
            bad = [status["message"] for status in statuses if status["level"]]
            yield MicrophoneHealth(name, time, level, "; ".join(bad)[:_LONGEST], _floor(statuses))


def _floor(statuses: Sequence[Any]) -> float:
    for status in statuses:
        for pair in status["values"]:
            if pair["key"] == "floor_dbfs":
                with suppress(ValueError):
                    value = float(pair["value"])
                    return value if math.isfinite(value) else math.nan
    return math.nan


def troubles_of(statuses: Iterable[Status], end: int) -> Iterator[Trouble]:
    """Yield what was not well, from when it was said until something else was said.

    Parameters
    ----------
    end : int
        Nanoseconds of UTC. The last trouble of a name ends with the last status of that name, or
        here if that is earlier.
    """
    for name, same in groupby(sorted(statuses), lambda status: status.name):
        own = list(same)
        texts = [(status.time, status.message if status.level else None) for status in own]
        for start, stop, text in lasting(texts, min(own[-1].time, end)):
            yield Trouble(name, text, start, stop)


def lasting(texts: Sequence[tuple[int, str | None]], end: int) -> Iterator[tuple[int, int, str]]:
    """Let each text last until the next one that differs, and the last one until `end`.

    Parameters
    ----------
    texts : sequence of (int, str or None)
        When something was said (nanoseconds of UTC), in the order of time; None where there is
        nothing to say.
    """
    changes = [(next(same)[0], text) for text, same in groupby(texts, lambda pair: pair[1])]
    ends = [*(time for time, _ in changes[1:]), end]
    for (start, text), stop in zip(changes, ends, strict=False):
        if text is not None:
            yield start, stop, text
