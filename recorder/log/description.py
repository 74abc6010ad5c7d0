"""What every file of a recording says of itself."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.modelfile.card import attachment_of, model_attachments
from hearthlog.recorder.config import Settings
from hearthlog.schemas.logs.log_stream import Attachment
from hearthlog.schemas.logs.provenance import provenance
from hearthlog.schemas.messages.topics import Topic, topics_of


@dataclass(frozen=True)
class LogDescription:
    """What every file of a recording says of itself."""

    root: Path  # folder of the logs
    node: str  # name of the recorder
    topics: Sequence[Topic]
    infos: Sequence[Any]  # `AudioStreamInfo` of each microphone; each file sets their stamps
    metadata: Mapping[str, str]  # the `hearthlog` record
    attachments: Sequence[Attachment]


def describe_log(
    settings: Settings,
    info: Any,
    features: FeatureSet,
    model: Model | None,
    candidate: Model | None = None,
) -> LogDescription:
    """Return the description of the logs of one microphone.

    Parameters
    ----------
    settings : Settings
    info : message
        `AudioStreamInfo` of the logs.
    features : FeatureSet
    model : Model or None
        The model that labels the sound; None for no labels.
    candidate : Model or None
        A model on trial that labels beside it.
    """
    configuration = settings.model_dump_json(indent=2, exclude={"output", "model"}).encode()
    classes = None if model is None else list(model.classes)
    attachments = [Attachment("configuration.json", "application/json", configuration)]
    metadata = provenance(
        settings.node,
        configuration_sha256=hashlib.sha256(configuration).hexdigest(),
        feature_set=features.name,
        feature_set_version=str(features.version),
        model=info.model,
        model_sha256=info.model_sha256,
        timezone=settings.timezone,
    )
    if candidate is not None:
        metadata |= {"candidate": candidate.name, "candidate_sha256": candidate.sha256}
    return LogDescription(
        root=settings.output,
        node=settings.node,
        topics=topics_of(
            info.header.frame_id,
            features.feature_names,
            classes,
            None if candidate is None else list(candidate.classes),
        ),
        infos=[info],
        metadata=metadata,
        attachments=attachments if model is None else [*attachments, *model_attachments(model)],
    )


def join_descriptions(descriptions: Sequence[LogDescription]) -> LogDescription:
    """Return the description of the logs of several microphones.

    Parameters
    ----------
    descriptions : sequence of LogDescription
        One for each microphone. The metadata are those of the first; attachments of another one
        are named after it where they differ.
    """
    first = descriptions[0]
    attachments = {each.name: each for each in first.attachments}
    for other in descriptions[1:]:
        (info,) = other.infos
        for each in other.attachments:
            if each not in attachments.values():
                name = attachment_of(each.name, info.header.frame_id)
                attachments[name] = replace(each, name=name)
    topics = {topic.name: topic for each in descriptions for topic in each.topics}
    return replace(
        first,
        topics=list(topics.values()),
        infos=[info for each in descriptions for info in each.infos],
        attachments=list(attachments.values()),
    )
