"""A model: its description, checked when it is read, and its arrays."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    StringConstraints,
    ValidationError,
    model_serializer,
)

from hearthlog.models.classes import CLASS_NAME
from hearthlog.models.errors import ModelError
from hearthlog.schemas.arrays import Float32, Float64, Int32, Int64
from hearthlog.schemas.errors import printable
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.messages.topics import EmbeddingSpace

TEXT = re.compile(r"[^\x00-\x1f\x7f]{0,300}")  # all other strings of a description
MOST_SPANS = 1000  # forty kilobytes
MOST_CLASSES = 32  # more would let the BLAS divide the products of the pairs among threads
MOST_FEATURES = 5000  # those of a network have 4097 at most
FORMAT: Final = 5
FORMAT_OF_DIRECTIONS: Final = 6  # which a version that cannot use them refuses
FORMAT_OF_EMBEDDINGS: Final = 7  # as well
MOST_HEADS = 8
MOST_VALUES = 1024  # of a window of sound, as a network hears it
MOST_ARRAYS = 16  # of microphones, in a home
MOST_WEIGHT: Final = 10.0
SIMULATED = "hearthlog simulated home"  # the collection of the sounds of `hearthlog.tools.home`
_OLD_METHODS = {"statistics": "paper", "bands": "bands"}  # of format 2, by inputs

_ClassName = Annotated[str, StringConstraints(pattern=rf"^{CLASS_NAME.pattern}$")]
_Text = Annotated[str, StringConstraints(pattern=rf"^{TEXT.pattern}$")]
_Digest = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
_Count = Annotated[int, Field(ge=0, lt=1 << 53)]
_LONGEST_SECONDS = 1e6
_Positive = Annotated[float, Field(gt=0.0, le=_LONGEST_SECONDS)]
_Seconds = Annotated[float, Field(ge=0.0, le=1e12)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Span = Annotated[list[Annotated[int, Field(ge=0, lt=1 << 63)]], Field(min_length=2, max_length=2)]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class Amount(_Record):
    """An amount of training data; a source is a source group of the manifest."""

    sources: _Count
    segments: _Count
    seconds: _Seconds


class PublicCollection(_Record):
    """A public collection that audio came from; attribution is due wherever the model goes."""

    name: _Text
    licence: _Text
    clips: _Count


class TrainingData(_Record):
    """The training data; the digest is that of its segments, not of files.

    Attributes
    ----------
    home_spans : list of [start, end]
        Time of the home whose sound was learned from, in nanoseconds of UTC, in order; by whatever
        microphone, and with what is less than a minute between.
    base_sha256 : str
        SHA-256 of the model file that was adapted, or empty.
    """

    sha256: _Digest
    classes: dict[_ClassName, Amount]
    collections: list[PublicCollection]
    home: dict[_ClassName, Amount] = {}
    home_confirmed: dict[_ClassName, _Count] = {}
    home_frames: _Count = 0
    home_spans: Annotated[list[_Span], Field(max_length=MOST_SPANS)] = []
    base_sha256: _Text = ""

    @property
    def simulated(self) -> bool:
        """Whether all of it was simulated: the model has never learned from a real sound."""
        names = {item.name for item in self.collections}
        return names == {SIMULATED} and not any(amount.segments for amount in self.home.values())


class ClassMetrics(_Record):
    """Scores of one class, cross-validated."""

    precision: _Share
    recall: _Share
    f1: _Share


class Metrics(_Record):
    """Scores, cross-validated by source group; true classes are rows of the confusion matrix.

    Macro F1 is the mean over the classes but `unknown`, whose segments count where they are taken
    for another.
    """

    folds: _Count
    macro_f1: _Share
    expected_calibration_error: _Share
    classes: dict[_ClassName, ClassMetrics]
    confusion: list[list[_Count]]


class Elsewhere(_Record):
    """Scores in collections of which nothing was learned, which is what a new home is.

    Attributes
    ----------
    right : float
        Share of them that were recognised.
    macro_f1 : float or None
        Over the classes of these segments and `unknown`; None of models that were not told.
    macro_f1_interval : list of float, or None
        95 %, bootstrap over source groups.
    calibration_errors : dict of str to float
        Of these segments, where ten or more were labelled as a class: how far the mean probability
        of it is from the share that is right.
    """

    collections: _Count
    segments: _Count
    right: _Share
    expected_calibration_error: _Share
    macro_f1: _Share | None = None
    macro_f1_interval: Annotated[list[_Share], Field(min_length=2, max_length=2)] | None = None
    classes: dict[_ClassName, _Share] = {}
    calibration_errors: dict[_ClassName, _Share] = {}


SmoothingMethod = Literal["hmm", "merge"]


class Smoothing(_Record):
    """How labels become segments.

    Attributes
    ----------
    weight : float
        Weight of a frame's probabilities in the hidden Markov model.
    reach_seconds : float
        Time by which a border of silence is moved at most, to where the level changes.
    class_exponent : float or None
        Exponent of how likely a class other than silence is, relative to the likeliest of them;
        then the probability of silence counts by itself. None: the probabilities count as they are.
    """

    method: SmoothingMethod
    lag_seconds: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0
    weight: Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)] = 1.0
    reach_seconds: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    shortest_seconds: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    class_exponent: Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)] | None = None


class NamesHead(_Record):
    """A head that has learned nothing: what the names of a network say as they are."""

    weight: Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)]
    slope: Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)]
    classes: Annotated[
        dict[
            _ClassName,
            Annotated[
                list[Annotated[int, Field(ge=0, lt=MOST_VALUES)]],
                Field(min_length=1, max_length=MOST_VALUES),
            ],
        ],
        Field(min_length=2, max_length=MOST_CLASSES),
    ]
    bias: dict[_ClassName, Annotated[float, Field(ge=-100.0, le=100.0)]] = {}


class EmbeddingMix(_Record):
    """How a model mixes its classifier with heads on what a network hears.

    Attributes
    ----------
    inverse_temperature : float
        Of the mix, the weighted mean of the logarithms of probabilities.
    base_inverse_temperature : float or None
        That of the model before it was adapted to a home; None if it never was.
    of_home : bool
        Whether there is one linear head more, of a home: its decision values are no logarithms of
        probabilities, but added to the sum of those of the other heads.
    """

    network: _Text
    projection_sha256: _Digest
    values: Annotated[int, Field(ge=1, le=MOST_VALUES)]
    head_weights: Annotated[
        list[Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)]],
        Field(min_length=1, max_length=MOST_HEADS),
    ]
    names: Annotated[list[NamesHead], Field(max_length=MOST_HEADS)] = []
    machine_weight: Annotated[float, Field(ge=0.0, le=MOST_WEIGHT)]
    inverse_temperature: Annotated[float, Field(gt=0.0, le=200.0)]
    base_inverse_temperature: Annotated[float, Field(gt=0.0, le=200.0)] | None = None
    bias: dict[_ClassName, Annotated[float, Field(ge=-100.0, le=100.0)]] = {}
    of_home: bool = False

    @property
    def space(self) -> EmbeddingSpace:
        """Of the embeddings that the heads take."""
        return EmbeddingSpace(self.network, self.projection_sha256, self.values)


class Description(_Record):
    """Everything about a model but its arrays.

    Attributes
    ----------
    feature_set_sha256 : str
        SHA-256 of the network whose values the features are; empty for other feature sets.
    label_frame : int
        Frame of a window, from 0 on, which the label of the window speaks of.
    gate : float
        A window is silence where no band is so many dB above the floor of the room; 0 for no
        gate.
    base_inverse_temperature : float or None
        The one before the model was adapted to a home; None if it was not.
    novelty : str
        `doubt`: the probability that a label is wrong. `machine`: what the kind of classifier
        gives, as older models have it.
    elsewhere : Elsewhere or None
        Scores in collections left out, from which the temperature is; None if it is from sources
        left out, for want of collections.
    direction_microphones : list of str
        The arrays of a home whose directions the model takes, by name; with any, the format is 6.
    embedding : EmbeddingMix or None
        What it takes of a network's embeddings; with any, the format is 7.
    """

    format: Literal[5, 6, 7]
    kind: _Text
    parameters: dict[_Text, Any]
    method: _Text
    classes: Annotated[list[_ClassName], Field(min_length=2, max_length=MOST_CLASSES)]
    feature_set: _Text
    feature_set_version: Annotated[int, Field(ge=1, lt=1 << 31)]
    feature_set_sha256: _Digest | Literal[""] = ""
    feature_names: Annotated[list[_Text], Field(min_length=1, max_length=MOST_FEATURES)]
    inputs: _Text
    window_seconds: _Positive
    label_frame: Annotated[int, Field(ge=0, lt=1000)]
    gate: Annotated[float, Field(ge=0.0, le=40.0)]
    scenario_name: _Text
    scenario: dict[_ClassName, list[_Text]]
    copies: _Count = 0
    calibration: Literal["temperature"]
    inverse_temperature: _Positive
    base_inverse_temperature: _Positive | None = None
    decision_bias: dict[_ClassName, Annotated[float, Field(ge=-100.0, le=100.0)]]
    novelty: Literal["doubt", "machine"]
    elsewhere: Elsewhere | None
    smoothing: Smoothing
    training_data: TrainingData
    metrics: Metrics
    direction_microphones: Annotated[list[_Text], Field(max_length=MOST_ARRAYS)] = []
    embedding: EmbeddingMix | None = None
    seed: _Count = 0
    versions: dict[_Text, _Text]

    @property
    def embedding_space(self) -> EmbeddingSpace | None:
        """Of the embeddings that the model takes; None if it takes none."""
        return None if self.embedding is None else self.embedding.space

    @model_serializer(mode="wrap")
    def _as_older_versions_read_it(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what most models have not; older versions refuse fields they lack."""
        content: dict[str, Any] = handler(self)
        if self.embedding is None:
            content.pop("embedding", None)
        if not self.seed:
            content.pop("seed", None)
        if self.smoothing.class_exponent is None and "smoothing" in content:
            content["smoothing"].pop("class_exponent", None)
        return content


def read_description(text: str) -> Description:
    """Read a description, of this format or an older one.

    Raise `ModelError` if the description is of a newer format, is no JSON, or is invalid.
    """
    try:
        content = json.loads(text)
        if isinstance(content, dict):
            content = _in_this_format(content)
        return Description.model_validate(content)
    except ValidationError as error:
        raise ModelError(first_problem(error)) from error
    except (ValueError, RecursionError) as error:
        raise ModelError(f"its description is no JSON ({one_line(error)})") from error


def _in_this_format(content: dict[str, Any]) -> dict[str, Any]:
    number = content.get("format")
    if isinstance(number, int) and number > FORMAT_OF_EMBEDDINGS:
        raise ModelError(f"is of format {number}, newer than this version of hearthlog: update it")
    if number == 2:
        inputs = content.get("inputs", "statistics")
        parameters = {key: content[key] for key in ("cost", "gamma") if key in content}
        content = {
            **{key: value for key, value in content.items() if key not in parameters},
            "parameters": parameters,
            "feature_set_version": 1,
            "inputs": inputs,
            "method": _OLD_METHODS.get(inputs, "") if isinstance(inputs, str) else "",
        }
    if number in (2, 3):
        # A label spoke of the second that ended with its frame.
        seconds, frames = content.get("window_seconds"), 1
        if isinstance(seconds, int | float) and 0 < seconds <= _LONGEST_SECONDS:
            frames = max(round(seconds / FRAME_SECONDS), 1)
        content = {**content, "label_frame": frames - 1, "gate": 0.0}
        content |= {"decision_bias": {}, "novelty": "machine", "elsewhere": None}
    return {**content, "format": FORMAT} if number in (2, 3, 4) else content


def first_problem(error: ValidationError) -> str:
    """Return the first problem of a description on one line."""
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part)[:64] for part in first["loc"]) or "description"
    return f"{one_line(where)}: {one_line(first['msg'])}"


def one_line(text: object) -> str:
    """Return a text from any file as a part of a message: printable, 200 characters at most."""
    return printable(text)[:200]


Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Model:
    """A model.

    Attributes
    ----------
    description : Description
    arrays : mapping of str to np.ndarray
        Those of its kind of classifier.
    transitions : np.ndarray [shape=(C, C)], float64
        Probability that a frame of the row's class is followed by one of the column's class; empty
        where segments are merged.
    training_digests : np.ndarray [shape=(k,)], int64
        Digests of the segments that it was learned from.
    training_windows : np.ndarray [shape=(m, window_frames, d)], float32
        Features that it was learned from, of some models of earlier versions; else empty.
    training_floor : np.ndarray [shape=(m, b)], float64
        Floor of the room in each training window; empty for a feature set without bands.
    training_target, training_group : np.ndarray [shape=(m,)], int64
        Classes of the training windows, and numbers of their source groups.
    direction_weights : np.ndarray [shape=(M, C, S)], float64
        For each array of the description, logarithms of how much likelier each class is with each
        sector of the circle; empty without arrays.
    embedding_weights : np.ndarray [shape=(H, W, C)], int32
        Of H linear heads on the W values that are logged of a window of sound, in units of
        `hearthlog.models.classifiers.evidence.UNIT`; empty without heads.
    embedding_bias : np.ndarray [shape=(H, C)], int32
        In the same units.
    embedding_scaler : np.ndarray [shape=(2, W)], float64
        Mean and standard deviation of these values, of what the heads were learned from.
    name : str
        Stem of the model file.
    sha256 : str
        SHA-256 of the model file.
    """

    description: Description
    arrays: Mapping[str, Array]
    transitions: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    training_digests: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    training_windows: Float32 = field(default_factory=lambda: np.empty((0, 0, 0), np.float32))
    training_floor: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    training_target: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    training_group: Int64 = field(default_factory=lambda: np.empty(0, np.int64))
    direction_weights: Float64 = field(default_factory=lambda: np.empty((0, 0, 0)))
    embedding_weights: Int32 = field(default_factory=lambda: np.empty((0, 0, 0), np.int32))
    embedding_bias: Int32 = field(default_factory=lambda: np.empty((0, 0), np.int32))
    embedding_scaler: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    name: str = ""
    sha256: str = ""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the probabilities."""
        return tuple(self.description.classes)


_ALLOWED = re.compile(
    r"(cc0|public domain|cc[ -]by([ -]sa)?\b(?![ -](nc|nd))|odbl|apache[ -]2)", re.IGNORECASE
)
_FORBIDDEN = re.compile(
    r"\b(nc|nd|non-?commercial|commercial|no[ -]?deriv\w*|personal|unstated|unknown)\b",
    re.IGNORECASE,
)


def may_be_shipped(licence: str) -> bool:
    """Tell whether a model learned from a recording may be shipped, with attribution.

    Parameters
    ----------
    licence : str
        As a manifest states it: it must begin with CC0, public domain, CC BY, CC BY-SA, ODbL or
        Apache-2.0, and name nothing that forbids or doubts it.
    """
    return bool(_ALLOWED.match(licence.strip())) and not _FORBIDDEN.search(licence)
