"""Names: a kind of model that has learned nothing, and labels by what a network of sounds says."""

from collections.abc import Mapping
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from hearthlog.models.classes import CLASS_NAME, SILENCE
from hearthlog.models.classifiers.classifier_kind import ClassifierKind
from hearthlog.models.classifiers.description import MOST_CLASSES, MOST_VALUES, TEXT
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.models.embedding.embeddings import HOP_FRAMES, WINDOW_FRAMES
from hearthlog.schemas.arrays import Float32, Float64

BY_NAMES: Final = "names"
MOST_WINDOWS = 4  # that must say a name: two seconds and a half
MARGIN_FRAMES = (WINDOW_FRAMES - HOP_FRAMES) // 2  # of a window before and behind its middle
_WINDOW_AHEAD = WINDOW_FRAMES - 1 - MARGIN_FRAMES  # from its middle to the frame that completes it
MOST_AHEAD_FRAMES = HOP_FRAMES * (MOST_WINDOWS - 1) + _WINDOW_AHEAD
_ClassName = Annotated[str, StringConstraints(pattern=rf"^{CLASS_NAME.pattern}$")]
_Logged = Annotated[int, Field(ge=-128, le=127)]


class NameRule(BaseModel):
    """When a logged value says a name.

    Attributes
    ----------
    seconds : float
        Expected duration without a pause; of names at once, that of the shortest sound counts.
    precision : float
        Share of such labels that were right where the threshold was measured.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    value: Annotated[int, Field(ge=0, lt=MOST_VALUES)]
    begins: _Logged
    goes_on: _Logged
    windows: Annotated[int, Field(ge=1, le=MOST_WINDOWS)]
    seconds: Annotated[float, Field(gt=0.0, le=1e6)]
    precision: Annotated[float, Field(gt=0.5, le=1.0)]


class NamesParameters(BaseModel):
    """Parameters of a model that labels by names."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    network: Annotated[str, StringConstraints(pattern=rf"^{TEXT.pattern}$")]
    projection_sha256: Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
    rules: Annotated[dict[_ClassName, NameRule], Field(max_length=MOST_CLASSES)]

    @property
    def ahead(self) -> int:
        """Frames from one to that at which its label is known.

        A frame waits for the windows after that which has it in the middle, as many as the name
        that needs most of them; and for one, by which it is known whether it is in a pause.
        """
        later = max([2, *(rule.windows for rule in self.rules.values())]) - 1
        return HOP_FRAMES * later + _WINDOW_AHEAD


class NamesKind(ClassifierKind):
    """Names of a network, and thresholds; no arrays. Without embeddings all is silence."""

    name = BY_NAMES
    parameters = NamesParameters
    arrays: Mapping[str, np.dtype[Any]] = {}

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the shapes: there are none."""
        del classes, width, arrays
        return {}

    def machine(self, model: Model) -> "_Silent":
        """Prepare a model for inference by features, which say nothing here."""
        return _Silent(model.classes)

    def summary(self, model: Model) -> str:
        """Return the size of a model in a few words."""
        parameters = names_parameters(model)
        return f"{len(parameters.rules)} names of the network {parameters.network}"


class _Silent:
    def __init__(self, classes: tuple[str, ...]) -> None:
        self._of_silence = np.where([name == SILENCE for name in classes], 0.0, -100.0)

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Say that all windows are silence."""
        return np.tile(self._of_silence, (len(inputs), 1)), np.full(len(inputs), np.nan)


def names_parameters(model: Model) -> NamesParameters:
    """Return the parameters of a model that labels by names."""
    return NamesParameters.model_validate(model.description.parameters)


NAMES = NamesKind()
