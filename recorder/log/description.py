"""Description of a recorder's logs, written to every file."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import entries_of
from hearthlog.models.modelfile import attachment_of, model_attachments
from hearthlog.recorder.config import Settings
from hearthlog.schemas.logs.metadata import (
    NEVER_TELL,
    RecordedScenario,
    other_features,
    provenance,
    scenario_entries,
)
from hearthlog.schemas.logs.writer import Attachment
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    SCENARIO,
    EmbeddingSource,
    Topic,
    topics_of,
)


@dataclass(frozen=True)
class LogDescription:
    """Description of a recording, written to every file."""

    root: Path  # folder of the logs
    node: str  # name of the recorder
    topics: Sequence[Topic]
    infos: Sequence[Any]  # `AudioStreamInfo` of each microphone; each file sets their stamps
    metadata: Mapping[str, str]  # the `hearthlog` record
    attachments: Sequence[Attachment]
    # By microphone, additional lines of `/rosout` at the start of a file.
    lines: Mapping[str, Sequence[str]] = field(default_factory=dict)


def describe_log(  # noqa: PLR0913, PLR0917
    settings: Settings,
    info: Any,
    features: FeatureSet,
    model: Model | None,
    secondary: Mapping[str, Model] | None = None,
    embedding: EmbeddingSource | None = None,
) -> LogDescription:
    """Return the description of the logs of one microphone."""
    secondary = secondary or {}
    microphone = info.header.frame_id
    models = {"model", "scenarios"}
    # Paths of this machine.
    elsewhere: Any = dict.fromkeys(["output", *models], True)
    elsewhere["microphone"] = {"__all__": models}
    configuration = settings.model_dump_json(indent=2, exclude=elsewhere).encode()
    classes = None if model is None else list(model.classes)
    attachments = [Attachment("configuration.json", "application/json", configuration)]
    metadata = provenance(
        settings.node,
        configuration_sha256=hashlib.sha256(configuration).hexdigest(),
        **entries_of(features),
        model=info.model,
        model_sha256=info.model_sha256,
        timezone=settings.timezone,
    )
    if settings.never_tell:
        metadata[NEVER_TELL] = ",".join(settings.never_tell)
    if (candidate := secondary.get(CANDIDATE)) is not None:
        metadata |= {"candidate": candidate.name, "candidate_sha256": candidate.sha256}
    if model is not None:
        attachments += model_attachments(model)
    named = {labelling: list(one.classes) for labelling, one in secondary.items()}
    description = LogDescription(
        root=settings.output,
        node=settings.node,
        topics=topics_of(
            microphone,
            features.feature_names,
            classes,
            named,
            directions=bool(settings.settings_of(microphone).array),
            embedding=embedding,
        ),
        infos=[info],
        metadata=metadata,
        attachments=attachments,
    )
    parts = {labelling.partition("/"): one for labelling, one in secondary.items()}
    scenarios = {name: one for (kind, _, name), one in parts.items() if kind == SCENARIO}
    return with_scenarios(description, microphone, scenarios)


def with_scenarios(
    description: LogDescription, microphone: str, scenarios: Mapping[str, Model]
) -> LogDescription:
    """Add metadata, attachments and lines of a microphone's scenarios, without their topics."""
    entries = dict(description.metadata)
    attachments = list(description.attachments)
    for name, model in scenarios.items():
        entries |= scenario_entries(RecordedScenario(microphone, name, model.name, model.sha256))
        attachments += _scenario_attachments(name, model)
    lines = [
        f"scenario {name}: {len(model.classes)} labels by {model.name} ({model.sha256[:12]})"
        for name, model in scenarios.items()
    ]
    return replace(
        description,
        metadata=entries,
        attachments=attachments,
        lines={**description.lines, microphone: lines},
    )


def _scenario_attachments(scenario: str, model: Model) -> list[Attachment]:
    own = f"{SCENARIO}-{scenario}"  # not a valid microphone name
    return [replace(each, name=attachment_of(each.name, own)) for each in model_attachments(model)]


def join_descriptions(descriptions: Sequence[LogDescription]) -> LogDescription:
    """Join the descriptions of several microphones."""
    first = descriptions[0]
    attachments = {each.name: each for each in first.attachments}
    features: dict[str, str] = {}
    for other in descriptions[1:]:
        (info,) = other.infos
        for each in other.attachments:
            if each not in attachments.values():
                name = attachment_of(each.name, info.header.frame_id)
                attachments[name] = replace(each, name=name)
        features |= other_features(first.metadata, other.metadata, info.header.frame_id)
    topics = {topic.name: topic for each in descriptions for topic in each.topics}
    scenarios = {
        key: text
        for each in descriptions
        for key, text in each.metadata.items()
        if key.startswith(SCENARIO)
    }
    return replace(
        first,
        metadata={**first.metadata, **features, **scenarios},
        lines={name: lines for each in descriptions for name, lines in each.lines.items()},
        topics=list(topics.values()),
        infos=[info for each in descriptions for info in each.infos],
        attachments=list(attachments.values()),
    )
