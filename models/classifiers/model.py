"""A model: its description, validated when read, and its arrays."""

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
from hearthlog.schemas.arrays import Float32, Float64, Int32, Int64
from hearthlog.schemas.errors import ModelError, printable
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.logs.metadata import update_advice
from hearthlog.schemas.messages.topics import EmbeddingSpace

TEXT = re.compile(r"[^\x00-\x1f\x7f]{0,300}")  # limit of all other strings in a description
MOST_SPANS = 1000  # forty kilobytes
MOST_CLASSES = 32  # with more, the BLAS would split the products of the pairs among threads
MOST_FEATURES = 5000  # networks have at most 4097
FORMAT: Final = 5
FORMAT_OF_DIRECTIONS: Final = 6  # versions without directions refuse this format
FORMAT_OF_EMBEDDINGS: Final = 7  # likewise, for embeddings
MOST_HEADS = 8
MOST_VALUES = 1024  # values per window of embeddings
MOST_ARRAYS = 16  # microphone arrays in a home
MOST_WEIGHT: Final = 10.0
SIMULATED = "hearthlog simulated home"  # dataset name of the sounds of `hearthlog.tools.home`
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
    """A public dataset used for training; the model must carry its attribution."""

    name: _Text
    licence: _Text
    clips: _Count


class TrainingData(_Record):
    """The training data; the digest covers segments, not files."""

    sha256: _Digest
    classes: dict[_ClassName, Amount]
    collections: list[PublicCollection]
    home: dict[_ClassName, Amount] = {}
    home_confirmed: dict[_ClassName, _Count] = {}
    home_frames: _Count = 0
    # time spans of the home's sound used for training, in nanoseconds of UTC, in order; over all
    # microphones, with gaps of less than a minute closed
    home_spans: Annotated[list[_Span], Field(max_length=MOST_SPANS)] = []
    base_sha256: _Text = ""  # SHA-256 of the model file before adaptation, or empty

    @property
    def simulated(self) -> bool:
        """Whether all training data was simulated."""
        names = {item.name for item in self.collections}
        return names == {SIMULATED} and not any(amount.segments for amount in self.home.values())


class ClassMetrics(_Record):
    """Cross-validated scores of one class."""

    precision: _Share
    recall: _Share
    f1: _Share


class Metrics(_Record):
    """Scores, cross-validated by source group; rows of the confusion matrix are true classes.

    Macro F1 is the mean over the classes except `unknown`, whose segments count where they are
    mistaken for another class.
    """

    folds: _Count
    macro_f1: _Share
    expected_calibration_error: _Share
    classes: dict[_ClassName, ClassMetrics]
    confusion: list[list[_Count]]


class Elsewhere(_Record):
    """Scores on datasets outside the training data, which represent a new home."""

    collections: _Count
    segments: _Count
    right: _Share  # share of correctly recognised segments
    expected_calibration_error: _Share
    # over the classes of these segments and `unknown`; None if the model has no such score
    macro_f1: _Share | None = None
    # 95 %, bootstrap over source groups
    macro_f1_interval: Annotated[list[_Share], Field(min_length=2, max_length=2)] | None = None
    classes: dict[_ClassName, _Share] = {}
    # by class, if at least ten of these segments were labelled as the class: distance of the mean
    # probability from the share of correct labels
    calibration_errors: dict[_ClassName, _Share] = {}


SmoothingMethod = Literal["hmm", "merge"]


class Smoothing(_Record):
    """How labels become segments."""

    method: SmoothingMethod
    lag_seconds: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0
    # weight of a frame's probabilities in the hidden Markov model
    weight: Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)] = 1.0
    # largest shift of a border of silence, to the change of level
    reach_seconds: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    shortest_seconds: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    # exponent of the likelihood of a class other than silence, relative to the likeliest of them;
    # the probability of silence is then separate. None: the probabilities are used unchanged
    class_exponent: Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)] | None = None


class NamesHead(_Record):
    """An untrained head: the names of a network as they are."""

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
    """How a model mixes its classifier with heads on network embeddings."""

    network: _Text
    projection_sha256: _Digest
    values: Annotated[int, Field(ge=1, le=MOST_VALUES)]
    head_weights: Annotated[
        list[Annotated[float, Field(gt=0.0, le=MOST_WEIGHT)]],
        Field(min_length=1, max_length=MOST_HEADS),
    ]
    names: Annotated[list[NamesHead], Field(max_length=MOST_HEADS)] = []
    machine_weight: Annotated[float, Field(ge=0.0, le=MOST_WEIGHT)]
    # of the mix, the weighted mean of the logarithms of probabilities
    inverse_temperature: Annotated[float, Field(gt=0.0, le=200.0)]
    # the value before adaptation to a home; None if the model was never adapted
    base_inverse_temperature: Annotated[float, Field(gt=0.0, le=200.0)] | None = None
    bias: dict[_ClassName, Annotated[float, Field(ge=-100.0, le=100.0)]] = {}
    # whether there is an additional linear head of a home: its decision values are not logarithms
    # of probabilities, but are added to the sum over the other heads
    of_home: bool = False

    @property
    def space(self) -> EmbeddingSpace:
        """Embedding space of the heads."""
        return EmbeddingSpace(self.network, self.projection_sha256, self.values)


class Description(_Record):
    """Everything about a model except its arrays."""

    format: Literal[5, 6, 7]
    kind: _Text
    parameters: dict[_Text, Any]
    method: _Text
    classes: Annotated[list[_ClassName], Field(min_length=2, max_length=MOST_CLASSES)]
    feature_set: _Text
    feature_set_version: Annotated[int, Field(ge=1, lt=1 << 31)]
    # SHA-256 of the network that computes the features; empty for other feature sets
    feature_set_sha256: _Digest | Literal[""] = ""
    feature_names: Annotated[list[_Text], Field(min_length=1, max_length=MOST_FEATURES)]
    inputs: _Text
    window_seconds: _Positive
    # index in the window, from 0, of the labelled frame
    label_frame: Annotated[int, Field(ge=0, lt=1000)]
    # in dB: a window is silence unless some band is this much above the room floor; 0 for no gate
    gate: Annotated[float, Field(ge=0.0, le=40.0)]
    scenario_name: _Text
    scenario: dict[_ClassName, list[_Text]]
    copies: _Count = 0
    calibration: Literal["temperature"]
    inverse_temperature: _Positive
    # the value before adaptation to a home; None if the model was not adapted
    base_inverse_temperature: _Positive | None = None
    decision_bias: dict[_ClassName, Annotated[float, Field(ge=-100.0, le=100.0)]]
    # `doubt`: the probability that a label is wrong. `machine`: the value of the kind of
    # classifier, in older models
    novelty: Literal["doubt", "machine"]
    # scores on held-out datasets, which also set the temperature; None if held-out sources set it,
    # for lack of datasets
    elsewhere: Elsewhere | None
    smoothing: Smoothing
    training_data: TrainingData
    metrics: Metrics
    # names of the microphone arrays whose directions the model uses; if any, the format is 6
    direction_microphones: Annotated[list[_Text], Field(max_length=MOST_ARRAYS)] = []
    embedding: EmbeddingMix | None = None  # use of network embeddings; if present, the format is 7
    seed: _Count = 0
    versions: dict[_Text, _Text]

    @property
    def embedding_space(self) -> EmbeddingSpace | None:
        """Embedding space of the model; None if it uses no embeddings."""
        return None if self.embedding is None else self.embedding.space

    @model_serializer(mode="wrap")
    def _as_older_versions_read_it(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit fields that most models lack; older versions refuse unknown fields."""
        content: dict[str, Any] = handler(self)
        if self.embedding is None:
            content.pop("embedding", None)
        if not self.seed:
            content.pop("seed", None)
        if self.smoothing.class_exponent is None and "smoothing" in content:
            content["smoothing"].pop("class_exponent", None)
        return content


def read_description(text: str) -> Description:
    """Read a description of this format or an older format.

    Raise `ModelError` if the description is of a newer format, is not JSON, or is invalid.
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
        versions = content.get("versions")
        written_by = versions.get("hearthlog") if isinstance(versions, dict) else None
        raise ModelError(
            f"is of format {number}, newer than this version of hearthlog; "
            f"{update_advice(written_by)}"
        )
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
        # A label applied to the second that ended with its frame.
        seconds, frames = content.get("window_seconds"), 1
        if isinstance(seconds, int | float) and 0 < seconds <= _LONGEST_SECONDS:
            frames = max(round(seconds / FRAME_SECONDS), 1)
        content = {**content, "label_frame": frames - 1, "gate": 0.0}
        content |= {"decision_bias": {}, "novelty": "machine", "elsewhere": None}
    return {**content, "format": FORMAT} if number in (2, 3, 4) else content


def first_problem(error: ValidationError) -> str:
    """Return the first validation error of a description on one line."""
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part)[:64] for part in first["loc"]) or "description"
    return f"{one_line(where)}: {one_line(first['msg'])}"


def one_line(text: object) -> str:
    """Return text from any file as part of a message: printable, at most 200 characters."""
    return printable(text)[:200]


Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Model:
    """A model.

    Attributes
    ----------
    description : Description
    arrays : mapping of str to np.ndarray
        Arrays of the kind of classifier.
    transitions : np.ndarray [shape=(C, C)], float64
        Probability of the column's class after a frame of the row's class; empty if the smoothing
        merges segments.
    training_digests : np.ndarray [shape=(k,)], int64
        Digests of the training segments.
    training_windows : np.ndarray [shape=(m, window_frames, d)], float32
        Training features, in some models of earlier versions; else empty.
    training_floor : np.ndarray [shape=(m, b)], float64
        Floor of the room in each training window; empty for a feature set without bands.
    training_target, training_group : np.ndarray [shape=(m,)], int64
        Classes of the training windows, and numbers of their source groups.
    direction_weights : np.ndarray [shape=(M, C, S)], float64
        For each array of the description, log-likelihood ratio of each class in each sector of the
        circle; empty without arrays.
    embedding_weights : np.ndarray [shape=(H, W, C)], int32
        Of H linear heads on the W logged values of a window of sound, in units of
        `hearthlog.models.classifiers.evidence.UNIT`; empty without heads.
    embedding_bias : np.ndarray [shape=(H, C)], int32
        In the same units.
    embedding_scaler : np.ndarray [shape=(2, W)], float64
        Mean and standard deviation of these values in the heads' training data.
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
    """Return whether a model trained on a recording may be shipped, with attribution.

    The licence must begin with CC0, public domain, CC BY, CC BY-SA, ODbL or Apache-2.0, and contain
    no restriction or doubt.
    """
    return bool(_ALLOWED.match(licence.strip())) and not _FORBIDDEN.search(licence)
