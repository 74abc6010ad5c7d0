"""The description of the log of a replay."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import entries_of
from hearthlog.models.modelfile.modelfile import CARD, DESCRIPTION, model_attachments
from hearthlog.recorder.log.rolling_log import LogDescription, with_scenarios
from hearthlog.recorder.stream.messages import stream_info
from hearthlog.schemas.logs.metadata import FEATURE_SET, provenance
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    SCENARIO,
    scenario_labelling,
    topics_of,
)

_OF_RECORDER = (CANDIDATE, SCENARIO, FEATURE_SET)  # entries that are not those of the new log
# How attachments begin that are about the models of microphones.
_MODELS = tuple(name.partition(".")[0] + "." for name in (CARD, DESCRIPTION))


def describe(  # noqa: PLR0913, PLR0917
    recorded: RecorderInfo,
    features: FeatureSet,
    model: Model | None,
    scenarios: Mapping[str, Model],
    output: Path,
    replayed: Mapping[str, str],
) -> LogDescription:
    """Describe a new log as the recorder described the old one.

    Parameters
    ----------
    model : Model or None
        The model that labels the new log; None if there are no labels.
    """
    if model is not None and model.sha256 == recorded.model_sha256:
        model = replace(model, name=recorded.model)  # whatever its file is called here
    classes = None if model is None else list(model.classes)
    info = stream_info(recorded.microphone, recorded.device, features, model)
    attachments = [item for item in recorded.attachments if not item.name.startswith(_MODELS)]
    if model is not None:
        attachments += model_attachments(model)
    named = {scenario_labelling(name): list(one.classes) for name, one in scenarios.items()}
    description = LogDescription(
        root=output,
        node=recorded.node,
        topics=topics_of(
            recorded.microphone,
            features.feature_names,
            classes,
            named,
            directions=recorded.has_directions,
            embedding=recorded.embedding,
        ),
        infos=[info],
        metadata={
            **{k: v for k, v in recorded.metadata.items() if not k.startswith(_OF_RECORDER)},
            **provenance(recorded.node),
            **entries_of(features),
            "model": info.model,
            "model_sha256": info.model_sha256,
            **replayed,
        },
        attachments=attachments,
    )
    return with_scenarios(description, recorded.microphone, scenarios)
