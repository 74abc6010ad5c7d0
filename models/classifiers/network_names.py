"""Labels by the names of a network, without training: the kind of model, and `audioset`."""

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from hearthlog.models.classes import CLASS_NAME, SILENCE
from hearthlog.models.classifiers import ClassifierKind
from hearthlog.models.classifiers.model import (
    FORMAT,
    MOST_CLASSES,
    MOST_VALUES,
    TEXT,
    Amount,
    Array,
    ClassMetrics,
    Description,
    Metrics,
    Model,
    Smoothing,
    TrainingData,
)
from hearthlog.models.embedding import (
    HOP_FRAMES,
    WINDOW_FRAMES,
    Projection,
    read_projection,
)
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.sound_names import RELEASE, SoundName, audioset_names
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Float32, Float64, write_sealed
from hearthlog.schemas.errors import ModelError
from hearthlog.schemas.frames import FRAME_SECONDS

BY_NAMES: Final = "names"
MOST_WINDOWS = 4  # consecutive windows required for a name: two and a half seconds
MARGIN_FRAMES = (WINDOW_FRAMES - HOP_FRAMES) // 2  # of a window, before and after its middle
_WINDOW_AHEAD = WINDOW_FRAMES - 1 - MARGIN_FRAMES  # from its middle to the frame that completes it
MOST_AHEAD_FRAMES = HOP_FRAMES * (MOST_WINDOWS - 1) + _WINDOW_AHEAD
_ClassName = Annotated[str, StringConstraints(pattern=rf"^{CLASS_NAME.pattern}$")]
_Logged = Annotated[int, Field(ge=-128, le=127)]


class NameRule(BaseModel):
    """Decision rule of a name on its logged value."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    value: Annotated[int, Field(ge=0, lt=MOST_VALUES)]
    begins: _Logged
    goes_on: _Logged
    windows: Annotated[int, Field(ge=1, le=MOST_WINDOWS)]
    # expected duration without a pause; of simultaneous names, the one with the shortest wins
    seconds: Annotated[float, Field(gt=0.0, le=1e6)]
    # share of correct labels where the threshold was measured
    precision: Annotated[float, Field(gt=0.5, le=1.0)]


class NamesParameters(BaseModel):
    """Parameters of a model that labels by names."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    network: Annotated[str, StringConstraints(pattern=rf"^{TEXT.pattern}$")]
    projection_sha256: Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
    rules: Annotated[dict[_ClassName, NameRule], Field(max_length=MOST_CLASSES)]

    @property
    def ahead(self) -> int:
        """Number of frames from a frame to the frame that completes its label.

        A frame waits for the windows after the window centred on it, as many as the most demanding
        name needs, and for one more, which decides whether the frame is in a pause.
        """
        later = max([2, *(rule.windows for rule in self.rules.values())]) - 1
        return HOP_FRAMES * later + _WINDOW_AHEAD


class NamesKind(ClassifierKind):
    """Names of a network and thresholds; no arrays. Without embeddings all frames are silence."""

    name = BY_NAMES
    parameters = NamesParameters
    arrays: Mapping[str, np.dtype[Any]] = {}

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return no shapes."""
        del classes, width, arrays
        return {}

    def machine(self, model: Model) -> "_Silent":
        """Prepare a model for inference by features, which have no effect here."""
        return _Silent(model.classes)

    def summary(self, model: Model) -> str:
        """Return the size of a model in a few words."""
        parameters = names_parameters(model)
        return f"{len(parameters.rules)} names of the network {parameters.network}"


class _Silent:
    def __init__(self, classes: tuple[str, ...]) -> None:
        self._of_silence = np.where([name == SILENCE for name in classes], 0.0, -100.0)

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Decide silence for all windows."""
        return np.tile(self._of_silence, (len(inputs), 1)), np.full(len(inputs), np.nan)


def names_parameters(model: Model) -> NamesParameters:
    """Return the parameters of a model that labels by names."""
    return NamesParameters.model_validate(model.description.parameters)


NAMES = NamesKind()


AUDIOSET = "audioset"
KEY = "hearthlog"  # key of the description in a model file
_LOGGED = np.arange(-128, 128)  # all possible values
_HALVES = 2  # of the sources; thresholds are tried on one half


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
    """Return whether a model labels by names; such labels yield to a model trained on the class."""
    return model.description.kind == BY_NAMES


def require_trained(model: Model) -> None:
    """Raise `ModelError` if a model labels by names, where a trained model is required."""
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
    """Return the rule of a name in logged integers; None if no integer reaches the threshold."""
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
    """Return the description fields of the feature set, which do not affect the names."""
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
