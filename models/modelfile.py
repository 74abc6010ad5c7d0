"""The model file: one `.safetensors` file, arrays and a JSON description, checked when loaded."""

import hashlib
import json
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import safetensors
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError
from safetensors.numpy import load, save

from hearthlog.models.errors import ModelError
from hearthlog.models.inputs import WINDOW_FRAMES, Kind, input_width
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import check_new, new_file

SUFFIX = ".safetensors"
CLASS_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
TEXT = re.compile(r"[^\x00-\x1f\x7f]{0,300}")  # any other string of a description
_FEATURE_COUNTS = {"auros21": 21}
_KEY = "hearthlog"
_SHOWN = 200  # characters of an error of others
_SIZE_LIMIT = 64 << 20  # a hundred times what a home needs
_HEADER_LIMIT = 4 << 20  # parsed, it takes many times its size
MOST_CLASSES = 32  # more would let the BLAS divide the products of the pairs among threads
_LARGEST = 1e9  # with _SMALLEST_SCALE: no product of finite statistics overflows
_SMALLEST_SCALE = 1e-30
_ROUNDING = 1e-9
_DTYPES: dict[str, np.dtype[Any]] = {
    "scaler_mean": np.dtype(np.float64),
    "scaler_scale": np.dtype(np.float64),
    "support_vectors": np.dtype(np.float32),
    "support_counts": np.dtype(np.int64),
    "dual_coefficients": np.dtype(np.float64),
    "intercepts": np.dtype(np.float64),
}
_OPTIONAL: dict[str, np.dtype[Any]] = {
    "transitions": np.dtype(np.float64),
    "home_vectors": np.dtype(np.float32),
    "home_target": np.dtype(np.int64),
    "training_windows": np.dtype(np.float32),
    "training_target": np.dtype(np.int64),
    "training_group": np.dtype(np.int64),
}

Float64 = NDArray[np.float64]

_ClassName = Annotated[str, StringConstraints(pattern=rf"^{CLASS_NAME.pattern}$")]
_Text = Annotated[str, StringConstraints(pattern=rf"^{TEXT.pattern}$")]
_Digest = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
_Count = Annotated[int, Field(ge=0, lt=1 << 53)]
_Positive = Annotated[float, Field(gt=0.0, le=1e6)]
_Seconds = Annotated[float, Field(ge=0.0, le=1e12)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class Amount(_Record):
    """How much of something was learned from; a source is a source group of the manifest."""

    sources: _Count
    segments: _Count
    seconds: _Seconds


class Collection(_Record):
    """A public collection the audio came from: to be named wherever the model goes."""

    name: _Text
    licence: _Text
    clips: _Count


class TrainingData(_Record):
    """What the model learned from; the digest is of its segments, not of files.

    Attributes
    ----------
    home : dict of str to Amount
        What a home of its own added, by class, if it was adapted.
    base_sha256 : str
        Of the model file that was adapted, or empty.
    """

    sha256: _Digest
    classes: dict[_ClassName, Amount]
    collections: list[Collection]
    home: dict[_ClassName, Amount] = {}
    base_sha256: _Text = ""


class ClassMetrics(_Record):
    """Of the segments of one class, cross-validated."""

    precision: _Share
    recall: _Share
    f1: _Share


class Metrics(_Record):
    """Cross-validated by source group, with the model's own parameters.

    The confusion matrix has a row for each true class and a column for each predicted one.
    """

    folds: _Count
    macro_f1: _Share
    expected_calibration_error: _Share
    classes: dict[_ClassName, ClassMetrics]
    confusion: list[list[_Count]]


class Smoothing(_Record):
    """How labels become segments.

    Attributes
    ----------
    method : str
        `merge`: successive equal labels become one. `hmm`: the labels are those of the likeliest
        path through a hidden Markov model, decided `lag_seconds` after the sound.
    lag_seconds : float
    """

    method: Literal["merge", "hmm"]
    lag_seconds: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0


class Description(_Record):
    """Everything about a model that is no array.

    `inverse_temperature` calibrates: it multiplies the decision values before the softmax.
    `copies` says how often each segment was learned from as another microphone would hear it.
    """

    format: Literal[2]
    kind: Literal["svm-rbf"]
    classes: Annotated[list[_ClassName], Field(min_length=2, max_length=MOST_CLASSES)]
    feature_set: _Text
    feature_names: Annotated[list[_Text], Field(min_length=1, max_length=1000)]
    inputs: Kind = "statistics"
    window_seconds: _Positive
    scenario_name: _Text
    scenario: dict[_ClassName, list[_Text]]
    cost: _Positive
    gamma: _Positive
    copies: _Count = 0
    calibration: Literal["temperature"]
    inverse_temperature: _Positive
    smoothing: Smoothing
    training_data: TrainingData
    metrics: Metrics
    versions: dict[_Text, _Text]


@dataclass(frozen=True, eq=False)
class Model:
    """A support vector machine with RBF kernel, one against one.

    Attributes
    ----------
    description : Description
    scaler_mean, scaler_scale : np.ndarray [shape=(width,)], float64
        Of the inputs that `hearthlog.models.inputs` makes.
    support_vectors : np.ndarray [shape=(n, width)], float32
        Inputs, not scaled, class after class.
    support_counts : np.ndarray [shape=(C,)], int64
        Support vectors of each class.
    dual_coefficients : np.ndarray [shape=(C - 1, n)], float64
        As in libsvm: row j of a vector of class i is against class j if j < i, else j + 1.
    intercepts : np.ndarray [shape=(C (C - 1) / 2,)], float64
        Of the pairs (0, 1), (0, 2) … (1, 2) …; a positive decision is for the first of a pair.
    transitions : np.ndarray [shape=(C, C)], float64
        Of the hidden Markov model, from row to column, a frame; empty where segments are merged.
    home_vectors : np.ndarray [shape=(h, width)], float32
        Inputs that a home has corrected, which draw what is like them to their class.
    home_target : np.ndarray [shape=(h,)], int64
        Their classes.
    training_windows : np.ndarray [shape=(m, 20, d)], float32
        Features that it was learned from, to learn from them again; empty if they are not kept.
    training_target, training_group : np.ndarray [shape=(m,)], int64
        Their classes, and the numbers of their sources.
    name : str
        Stem of the file it was loaded from.
    sha256 : str
        Of that file.
    """

    description: Description
    scaler_mean: Float64
    scaler_scale: Float64
    support_vectors: NDArray[np.float32]
    support_counts: NDArray[np.int64]
    dual_coefficients: Float64
    intercepts: Float64
    transitions: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    home_vectors: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 0), np.float32))
    home_target: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    training_windows: NDArray[np.float32] = field(
        default_factory=lambda: np.empty((0, 0, 0), np.float32)
    )
    training_target: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    training_group: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    name: str = ""
    sha256: str = ""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the probabilities."""
        return tuple(self.description.classes)

    def card(self) -> str:
        """Describe the model to people, as Markdown."""
        about, metrics = self.description, self.description.metrics
        amounts = about.training_data.classes
        purpose = (
            f"Tells apart {len(about.classes)} classes of sound in windows of "
            f"{about.window_seconds:g} s, from feature set {about.feature_set} "
            f"({about.kind}, {len(self.support_vectors)} support vectors)."
        )
        lines = [
            f"# Model {self.name or about.scenario_name}",
            "",
            purpose,
            "",
            f"- sha256: {self.sha256 or 'not saved'}",
            f"- scenario: {about.scenario_name}",
            f"- macro F1: {metrics.macro_f1:.3f} ({metrics.folds} folds, no source in two of them)",
            f"- expected calibration error: {metrics.expected_calibration_error:.3f}",
            f"- training data sha256: {about.training_data.sha256}",
            f"- made with: {', '.join(f'{k} {v}' for k, v in sorted(about.versions.items()))}",
            "",
            "| class | labels | sources | seconds | precision | recall | F1 |",
            "|---|---|---|---|---|---|---|",
        ]
        for name in about.classes:
            amount, result = amounts[name], metrics.classes[name]
            lines.append(
                f"| {name} | {', '.join(about.scenario[name])} | {amount.sources} | "
                f"{amount.seconds:.0f} | {result.precision:.3f} | {result.recall:.3f} | "
                f"{result.f1:.3f} |"
            )
        if about.training_data.home:
            lines += [
                "",
                "Adapted to a home (the figures above are those before); learned besides:",
            ]
            lines += [""] + [
                f"- {name}: {amount.segments} segments from {amount.sources} sources"
                for name, amount in about.training_data.home.items()
            ]
        lines += ["", "Learned from recordings of:", ""]
        lines += [
            f"- {item.name or 'unnamed'}: {item.clips} clips, {item.licence or 'licence unstated'}"
            for item in about.training_data.collections
        ]
        return "\n".join(lines) + "\n"


def check_output(path: Path) -> None:
    """Raise ModelError unless a model can be saved under this name."""
    if path.suffix != SUFFIX:
        raise ModelError(f"{path}: the name of a model file must end in {SUFFIX}")
    if not path.stem.isprintable():
        raise ModelError(f"{str(path)!a}: give the model a name that can be printed")
    try:
        check_new(path)
    except LogError as error:
        raise ModelError(str(error)) from error


def save_model(model: Model, path: Path) -> None:
    """Write a model file; the same model gives the same bytes.

    Raises
    ------
    ModelError
        If the file exists, the folder does not or cannot be written, or the model is inconsistent.
    """
    check_output(path)
    every = {name: np.ascontiguousarray(getattr(model, name)) for name in _DTYPES | _OPTIONAL}
    arrays = {name: array for name, array in every.items() if name in _DTYPES or array.size}
    _check(path, model.description, arrays)
    text = json.dumps(model.description.model_dump(), ensure_ascii=False)
    data = save(arrays, {_KEY: text})
    _check_header(path, data)
    try:
        with new_file(path) as temporary:
            temporary.write_bytes(data)
    except LogError as error:
        raise ModelError(str(error)) from error


def load_model(path: Path) -> Model:
    """Read a model file and check everything in it; nothing of it is executed.

    Raises
    ------
    ModelError
        If it is missing, too large, damaged, inconsistent, or made for another feature set.
    """
    path = _pointed_to(path)
    data = _read(path)
    _check_header(path, data)
    try:
        arrays = load(data)
    except (safetensors.SafetensorError, KeyError) as error:  # KeyError: a type numpy has not
        raise ModelError(f"{path}: is no model file ({str(error)[:_SHOWN]})") from error
    description = _description(path, data)
    if not _DTYPES.keys() <= arrays.keys() <= (_DTYPES | _OPTIONAL).keys():
        raise ModelError(f"{path}: has other arrays than a model of hearthlog")
    _check(path, description, arrays)
    for array in arrays.values():
        array.flags.writeable = False
    name, digest = path.stem, hashlib.sha256(data).hexdigest()
    return Model(description, **arrays, name=name, sha256=digest)


def _pointed_to(path: Path) -> Path:
    """Follow a link such as `champion`: its name does not say which model it is."""
    try:
        return Path(os.path.realpath(path)) if path.is_symlink() else path
    except OSError:
        return path  # why, reading it will say


def _read(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise ModelError(f"{path}: no such model file")
        if not path.stem.isprintable():
            raise ModelError(f"{str(path)!a}: give the model a name that can be printed")
        if path.stat().st_size > _SIZE_LIMIT:
            raise ModelError(f"{path}: larger than {_SIZE_LIMIT >> 20} MB; this is no model file")
        with path.open("rb") as stream:
            return stream.read(_SIZE_LIMIT)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror})") from error


def _check_header(path: Path, data: bytes) -> None:
    if int.from_bytes(data[:8], "little") > _HEADER_LIMIT:
        raise ModelError(f"{path}: is no model file (its header is too large)")


def _description(path: Path, data: bytes) -> Description:
    length = int.from_bytes(data[:8], "little")
    text = json.loads(data[8 : 8 + length]).get("__metadata__", {}).get(_KEY)
    if text is None:
        raise ModelError(f"{path}: is no model of hearthlog: it does not describe itself")
    try:
        return Description.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:64] for part in first["loc"]) or "description"
        raise ModelError(f"{path}: {where[:_SHOWN]}: {first['msg'][:_SHOWN]}") from error


def _problem(about: Description) -> str | None:
    """Say what in a description contradicts the rest of it."""
    classes = set(about.classes)
    tables = (about.scenario, about.training_data.classes, about.metrics.classes)
    confusion = about.metrics.confusion
    if about.feature_set not in _FEATURE_COUNTS:
        known = ", ".join(_FEATURE_COUNTS)
        return f"is for feature set {about.feature_set!r}; this version has {known}"
    if len(about.feature_names) != _FEATURE_COUNTS[about.feature_set]:
        return f"names {len(about.feature_names)} features, which {about.feature_set} has not"
    if len(classes) != len(about.classes):
        return "names a class twice"
    if any(table.keys() != classes for table in tables):
        return "its scenario, training data and metrics are not all of its classes"
    if {len(confusion), *map(len, confusion)} != {len(classes)}:
        return "its confusion matrix does not fit its classes"
    return None


def _check(path: Path, about: Description, arrays: dict[str, NDArray[Any]]) -> None:
    problem = _problem(about)
    if problem:
        raise ModelError(f"{path}: {problem}")
    shapes = _shapes(about, arrays)
    if shapes.keys() != arrays.keys():
        name = min(shapes.keys() ^ arrays.keys())
        raise ModelError(f"{path}: {name} {'is missing' if name in shapes else 'is out of place'}")
    for name, shape in shapes.items():
        _check_array(path, name, arrays[name], shape)
    if not (arrays["scaler_scale"] >= _SMALLEST_SCALE).all():
        raise ModelError(f"{path}: scaler_scale has values that are not positive")
    counts = arrays["support_counts"]
    total = len(arrays["support_vectors"])
    if (counts < 0).any() or counts.sum() != total:
        raise ModelError(f"{path}: support_counts do not add up to the {total} support vectors")
    for name in ("training_target", "home_target"):
        target = arrays.get(name, counts[:0])
        if ((target < 0) | (target >= len(about.classes))).any():
            raise ModelError(f"{path}: {name} has classes that the model has not")
    transitions = arrays.get("transitions", np.ones((1, 1)))
    if (transitions < 0).any() or (np.abs(transitions.sum(axis=1) - 1.0) > _ROUNDING).any():
        raise ModelError(f"{path}: the rows of transitions are no probabilities")


def _check_array(path: Path, name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    dtype = (_DTYPES | _OPTIONAL)[name]
    if array.dtype != dtype:
        raise ModelError(f"{path}: {name} is of type {array.dtype}, not {dtype}")
    if array.shape != shape:
        raise ModelError(f"{path}: {name} has shape {array.shape}, not {shape}")
    if not np.isfinite(array).all():
        raise ModelError(f"{path}: {name} has values that are not finite")
    if array.dtype == np.float64 and not (np.abs(array) <= _LARGEST).all():
        raise ModelError(f"{path}: {name} has values that make no sense")


def _shapes(about: Description, arrays: dict[str, NDArray[Any]]) -> dict[str, tuple[int, ...]]:
    """Return the shape that each array must have."""
    classes, width = len(about.classes), input_width(about.inputs)
    total, home, kept = (
        len(arrays[name]) if name in arrays and arrays[name].ndim else 0
        for name in ("support_vectors", "home_vectors", "training_windows")
    )
    shapes: dict[str, tuple[int, ...]] = {
        "scaler_mean": (width,),
        "scaler_scale": (width,),
        "support_vectors": (total, width),
        "support_counts": (classes,),
        "dual_coefficients": (classes - 1, total),
        "intercepts": (classes * (classes - 1) // 2,),
    }
    if about.smoothing.method == "hmm":
        shapes["transitions"] = (classes, classes)
    if home:
        shapes["home_vectors"], shapes["home_target"] = (home, width), (home,)
    if kept:
        shapes["training_windows"] = (kept, WINDOW_FRAMES, len(about.feature_names))
        shapes["training_target"] = shapes["training_group"] = (kept,)
    return shapes
