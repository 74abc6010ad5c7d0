"""What the log of a replay says of itself."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.modelfile.card import CARD, DESCRIPTION, model_attachments
from hearthlog.recorder.log import LogDescription
from hearthlog.recorder.pipeline import stream_info
from hearthlog.schemas.logs.provenance import provenance
from hearthlog.schemas.messages.topics import topics_of


def describe(
    origin: RecorderInfo,
    features: FeatureSet,
    model: Model | None,
    output: Path,
    replayed: Mapping[str, str],
) -> LogDescription:
    """Say of a new log what the recorder said of the old one.

    Parameters
    ----------
    origin : RecorderInfo
        Of the old one.
    features : FeatureSet
    model : Model or None
        Which gives the labels now.
    output : Path
        Folder of the new one.
    replayed : mapping of str to str
        What the `hearthlog` record says besides.
    """
    if model is not None and model.sha256 == origin.model_sha256:
        model = replace(model, name=origin.model)  # whatever its file is called here
    classes = None if model is None else list(model.classes)
    info = stream_info(origin.microphone, origin.device, features, model)
    attachments = [item for item in origin.attachments if item.name not in {CARD, DESCRIPTION}]
    if model is not None:
        attachments += model_attachments(model)
    return LogDescription(
        root=output,
        node=origin.node,
        topics=topics_of(origin.microphone, features.feature_names, classes),
        infos=[info],
        metadata={
            **origin.metadata,
            **provenance(origin.node),
            "feature_set": features.name,
            "feature_set_version": str(features.version),
            "model": info.model,
            "model_sha256": info.model_sha256,
            **replayed,
        },
        attachments=attachments,
    )
