"""The description of the log of a replay."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.modelfile.card import CARD, DESCRIPTION, model_attachments
from hearthlog.recorder.log.description import LogDescription
from hearthlog.recorder.stream.messages import stream_info
from hearthlog.schemas.logs.provenance import provenance
from hearthlog.schemas.messages.topics import CANDIDATE, topics_of

# How attachments begin that are about the models of microphones.
_MODELS = tuple(name.partition(".")[0] + "." for name in (CARD, DESCRIPTION))


def describe(
    recorded: RecorderInfo,
    features: FeatureSet,
    model: Model | None,
    output: Path,
    replayed: Mapping[str, str],
) -> LogDescription:
    """Describe a new log as the recorder described the old one.

    Parameters
    ----------
    recorded : RecorderInfo
        Of the old log.
    features : FeatureSet
        Of the features in the new log.
    model : Model or None
        The model that labels the new log; None if there are no labels.
    output : Path
        Folder of the new log.
    replayed : mapping of str to str
        Further entries of the `hearthlog` record; they replace those of the old log.
    """
    if model is not None and model.sha256 == recorded.model_sha256:
        model = replace(model, name=recorded.model)  # whatever its file is called here
    classes = None if model is None else list(model.classes)
    info = stream_info(recorded.microphone, recorded.device, features, model)
    attachments = [item for item in recorded.attachments if not item.name.startswith(_MODELS)]
    if model is not None:
        attachments += model_attachments(model)
    return LogDescription(
        root=output,
        node=recorded.node,
        topics=topics_of(recorded.microphone, features.feature_names, classes),
        infos=[info],
        metadata={
            **{k: v for k, v in recorded.metadata.items() if not k.startswith(CANDIDATE)},
            **provenance(recorded.node),
            "feature_set": features.name,
            "feature_set_version": str(features.version),
            "model": info.model,
            "model_sha256": info.model_sha256,
            **replayed,
        },
        attachments=attachments,
    )
