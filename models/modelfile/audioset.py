"""The model `audioset`: the names of YAMNet that are events, as a model that any command takes.

It is made of the table of names and the projection, so there is no file of it to grow old.
"""

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.description import (
    FORMAT,
    Amount,
    ClassMetrics,
    Description,
    Metrics,
    Smoothing,
    TrainingData,
)
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.names import (
    BY_NAMES,
    NameRule,
    NamesParameters,
    names_parameters,
)
from hearthlog.models.embedding.embeddings import WINDOW_FRAMES
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.projection import Projection, read_projection
from hearthlog.models.embedding.sound_names import RELEASE, SoundName, audioset_names
from hearthlog.models.errors import ModelError
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import write_sealed
from hearthlog.schemas.frames import FRAME_SECONDS

AUDIOSET = "audioset"
KEY = "hearthlog"  # of the description, in a model file
_LOGGED = np.arange(-128, 128)  # all that a value can be
_HALVES = 2  # of the sources, on one of which a threshold was tried


@lru_cache(maxsize=1)
def audioset_file() -> bytes:
    """Return the model `audioset` as the bytes of a model file."""
    projection = read_projection(YAMNET.projection)
    events = [name for name in audioset_names() if name.is_event]
    rules = {name.name: rule for name in events if (rule := _rule(name, projection)) is not None}
    chosen = {name.name: name for name in events if name.name in rules}
    parameters = NamesParameters(
        network=YAMNET.name, projection_sha256=projection.sha256, rules=rules
    )
    table = json.dumps([list(name) for name in chosen.values()])
    metrics = {name: _metrics(row.precision, row.recall) for name, row in chosen.items()}
    description = Description(
        format=FORMAT,
        kind=BY_NAMES,
        parameters=parameters.model_dump(),
        method=BY_NAMES,
        classes=[SILENCE, *chosen],
        **_of_features(DEFAULT),
        window_seconds=WINDOW_FRAMES * FRAME_SECONDS,
        label_frame=0,
        gate=0.0,
        scenario_name=AUDIOSET,
        scenario={SILENCE: [], **{name: [row.group] for name, row in chosen.items()}},
        calibration="temperature",
        inverse_temperature=1.0,
        decision_bias={},
        novelty="machine",
        elsewhere=None,
        smoothing=Smoothing(method="merge"),
        training_data=TrainingData(
            sha256=hashlib.sha256(table.encode()).hexdigest(),
            classes={
                SILENCE: Amount(sources=0, segments=0, seconds=0.0),
                **{
                    name: Amount(sources=row.sources, segments=row.clips, seconds=0.0)
                    for name, row in chosen.items()
                },
            },
            collections=[],
        ),
        metrics=Metrics(
            folds=_HALVES,
            macro_f1=sum(one.f1 for one in metrics.values()) / max(len(metrics), 1),
            expected_calibration_error=0.0,
            classes={SILENCE: _metrics(0.0, 0.0), **metrics},
            confusion=[[0] * (len(chosen) + 1) for _ in range(len(chosen) + 1)],
        ),
        versions={},
    )
    return _file_of(description)


def is_by_names(model: Model) -> bool:
    """Return whether a model labels by names, which leave a class to any model that learned it."""
    return model.description.kind == BY_NAMES


def insist_taught(model: Model) -> None:
    """Refuse a model that labels by names where one is asked for that was taught.

    Raises
    ------
    ModelError
    """
    if is_by_names(model):
        raise ModelError(
            f"{model.name} labels by the names of a network and has learned nothing: clips are "
            "not needed to measure it (docs/audioset.md has its figures), nor can it be adapted"
        )


def without_classes(model: Model, names: Collection[str], features: FeatureSet) -> Model:
    """Return a model that labels by names without some of its classes."""
    before = model.description
    kept = [name for name in before.classes if name not in names]
    if kept == before.classes and before.feature_set == features.name:
        return model

    def of_kept(table: Mapping[str, Any]) -> dict[str, Any]:
        return {name: table[name] for name in kept if name in table}

    parameters = names_parameters(model)
    less = parameters.model_copy(update={"rules": of_kept(parameters.rules)})
    data, metrics = before.training_data, before.metrics
    description = before.model_copy(
        update={
            **_of_features(features),
            "classes": kept,
            "parameters": less.model_dump(),
            "scenario": of_kept(before.scenario),
            "training_data": data.model_copy(update={"classes": of_kept(data.classes)}),
            "metrics": metrics.model_copy(
                update={
                    "classes": of_kept(metrics.classes),
                    "confusion": [[0] * len(kept) for _ in kept],
                }
            ),
        }
    )
    digest = hashlib.sha256(_file_of(description)).hexdigest()
    return replace(model, description=description, sha256=digest)


def _rule(name: SoundName, projection: Projection) -> NameRule | None:
    """Return a threshold in logged integers; None for one that no integer reaches."""
    value = projection.names.index(name.group)
    every = np.zeros((len(_LOGGED), len(projection.names)), np.int8)
    every[:, value] = _LOGGED
    logits = projection.values(every)[:, value]
    above_low = float((projection.lows + projection.steps)[value])
    goes_on = max(name.threshold - RELEASE, above_low)
    if not (logits >= name.threshold).any() or not name.precision > 0.5:
        return None
    return NameRule(
        value=value,
        begins=int(_LOGGED[logits >= name.threshold][0]),
        goes_on=int(_LOGGED[logits >= min(goes_on, name.threshold)][0]),
        windows=name.windows,
        seconds=name.seconds,
        precision=name.precision,
    )


def _metrics(precision: float, recall: float) -> ClassMetrics:
    both = precision + recall
    return ClassMetrics(
        precision=precision, recall=recall, f1=2 * precision * recall / both if both else 0.0
    )


def _of_features(features: FeatureSet) -> dict[str, Any]:
    """Return what a description says of the features, which name nothing here."""
    return {
        "feature_set": features.name,
        "feature_set_version": features.version,
        "feature_set_sha256": features.digest,
        "feature_names": list(features.feature_names),
        "inputs": next(iter(features.inputs)),
    }


def _file_of(description: Description) -> bytes:
    text = json.dumps(description.model_dump(), ensure_ascii=False)
    return write_sealed({}, KEY, text)
