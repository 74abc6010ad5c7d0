"""The model file, validated on loading, and the attachments of a model in a log."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from numpy.typing import NDArray
from pydantic import ValidationError

from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.classifier import classifier_kind
from hearthlog.models.classifiers.evidence import MOST_EVIDENCE, SECTORS, UNTAUGHT, sounds_of
from hearthlog.models.classifiers.model import (
    FORMAT_OF_DIRECTIONS,
    FORMAT_OF_EMBEDDINGS,
    Array,
    Description,
    Model,
    first_problem,
    may_be_shipped,
    one_line,
    read_description,
)
from hearthlog.models.classifiers.network_names import AUDIOSET, KEY, audioset_file
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import feature_set
from hearthlog.models.starter import (
    BY_FEATURES,
    NETWORK,
    SHA256,
    STARTERS,
    starter_file,
    with_network,
)
from hearthlog.schemas.arrays import damage, read_sealed, write_sealed
from hearthlog.schemas.errors import LogError, ModelError
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.logs.writer import Attachment
from hearthlog.schemas.new_files import check_new, new_file

SUFFIX = ".safetensors"
_SIZE_LIMIT = 64 << 20  # a hundred times the usual size
_HEADER_LIMIT = 4 << 20  # parsing takes many times this size
_LARGEST = 1e9  # no product of finite inputs overflows
_ROUNDING = 1e-9
_COMMON: dict[str, np.dtype[Any]] = {  # of all kinds of classifiers; all optional
    "transitions": np.dtype(np.float64),
    "training_digests": np.dtype(np.int64),
    "training_windows": np.dtype(np.float32),
    "training_floor": np.dtype(np.float64),
    "training_target": np.dtype(np.int64),
    "training_group": np.dtype(np.int64),
    "direction_weights": np.dtype(np.float64),
    "embedding_weights": np.dtype(np.int32),
    "embedding_bias": np.dtype(np.int32),
    "embedding_scaler": np.dtype(np.float64),
}


def check_output(path: Path) -> None:
    """Check that a model can be saved at a path.

    Raise `ModelError` if the suffix is wrong, the name is not printable, the file exists, or the
    folder does not exist or is not writable.
    """
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

    Raise `ModelError` if `check_output` refuses the path, the file cannot be written, or the model
    is inconsistent.
    """
    check_output(path)
    common = {name: getattr(model, name) for name in _COMMON if getattr(model, name).size}
    arrays = {name: np.ascontiguousarray(a) for name, a in {**model.arrays, **common}.items()}
    _check(path, model.description, arrays)
    text = json.dumps(model.description.model_dump(), ensure_ascii=False)
    data = write_sealed({name: _halved(array) for name, array in arrays.items()}, KEY, text)
    _check_header(path, data)
    try:
        with new_file(path) as temporary:
            temporary.write_bytes(data)
    except LogError as error:
        raise ModelError(str(error)) from error


def load_model(path: Path, on_damage: Callable[[str], object] | None = None) -> Model:
    """Read and validate a model file, whose name the model takes; nothing in it is executed.

    `path` may be a symbolic link; without such a file, it is the name of a starter model
    (`hearthlog.models.starter`), or `audioset` for the names of YAMNet. `on_damage` receives one
    line if the checksum does not match; by default a mismatch is an error. Raise `ModelError` if
    the file is missing, larger than 64 MiB, damaged or inconsistent, if its name is not printable,
    or if the model needs another feature set, or a feature set or kind of classifier that is not
    installed.
    """
    path, data = _read(path)
    _check_header(path, data)
    try:
        arrays, text, damaged = read_sealed(path, data, KEY)
    except (safetensors.SafetensorError, KeyError) as error:  # KeyError: a type that numpy lacks
        raise ModelError(f"{path}: is not a model file ({one_line(error)})") from error
    digest = hashlib.sha256(data).hexdigest()
    if path.stem in STARTERS and path == starter_file(path.stem) and digest != SHA256[path.stem]:
        damaged = damage(path, SHA256[path.stem], digest, "install hearthlog again")
    if damaged and on_damage is None:
        raise ModelError(damaged)
    description = _description(path, text)
    arrays = _widened(description, arrays)
    _check(path, description, arrays)
    for array in arrays.values():
        array.flags.writeable = False
    common = {name: arrays.pop(name) for name in _COMMON if name in arrays}
    if damaged and on_damage is not None:
        on_damage(damaged)
    return Model(description, arrays, **common, name=path.stem, sha256=digest)


def starter_for(path: Path, network: str) -> Path:
    """Return the variant of a starter model for the available embedding network, empty for none.

    `general` and `bathroom` select their variants with embeddings if those use this network and
    there is no file of this name; other models stay.
    """
    named = str(path) in BY_FEATURES and not os.path.lexists(path)
    return Path(with_network(str(path))) if named and network == NETWORK else path


def name_and_digest(path: Path) -> tuple[str, str]:
    """Return `Model.name` and `Model.sha256` without loading the model.

    Raise `ModelError` if the file is missing or larger than 64 MiB, or its name is not printable.
    """
    path, data = _read(path)
    return path.stem, hashlib.sha256(data).hexdigest()


def _read(path: Path) -> tuple[Path, bytes]:
    """Resolve a path to a model file and read the file."""
    if str(path) == AUDIOSET:  # even if a folder of recordings has this name
        return path.with_suffix(SUFFIX), audioset_file()
    path = _starter(path) or _pointed_to(path)
    if not path.stem.isprintable():
        raise ModelError(f"{str(path)!a}: give the model a name that can be printed")
    if path.suffix != SUFFIX and not os.path.lexists(path):
        raise ModelError(
            f"{path}: there is no such model file; the starter models are "
            f"{' and '.join(BY_FEATURES)}"
        )
    return path, read_limited(path, "model file", _SIZE_LIMIT, ModelError)


def _halved(array: Array) -> Array:
    """Return an array in half precision if that is lossless, else unchanged."""
    if array.dtype != np.float32:
        return array
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    return half if np.array_equal(half, array) else array


def _widened(description: Description, arrays: dict[str, Array]) -> dict[str, Array]:
    """Undo `_halved` for the arrays of a model."""
    try:
        kind = classifier_kind(description.kind)
    except ModelError:
        return arrays  # the validation reports what is not installed
    dtypes = {**kind.arrays, **kind.optional, **_COMMON}
    halved = {
        name: array.astype(np.float32)
        for name, array in arrays.items()
        if array.dtype == np.float16 and dtypes.get(name) == np.float32
    }
    return arrays | halved


def _starter(path: Path) -> Path | None:
    """Return the file of the starter model of this name, or None."""
    if str(path) not in STARTERS or os.path.lexists(path):
        return None
    file = starter_file(str(path))
    if not file.exists():
        raise ModelError(
            f"{path}: this installation of hearthlog lacks its starter models ({file} is missing); "
            "install it again, or name a model file"
        )
    return file


def _pointed_to(path: Path) -> Path:
    """Follow a link such as `champion` to the file with the model's name."""
    try:
        return Path(os.path.realpath(path)) if path.is_symlink() else path
    except OSError:
        return path  # reading the file raises the error


def _check_header(path: Path, data: bytes) -> None:
    if int.from_bytes(data[:8], "little") > _HEADER_LIMIT:
        raise ModelError(f"{path}: is not a model file (its header is too large)")


def _description(path: Path, text: str) -> Description:
    if not text:
        raise ModelError(f"{path}: is no model of hearthlog: it does not describe itself")
    try:
        return read_description(text)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def _check(path: Path, description: Description, arrays: Mapping[str, Array]) -> None:
    try:
        problem = _problem(description) or _problem_of(description, arrays)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    if problem:
        raise ModelError(f"{path}: {problem}")


def _problem(description: Description) -> str | None:
    """Return a contradiction within a description, or with the installed extensions."""
    features = feature_set(description.feature_set)
    if description.feature_set_version != features.version:
        return (
            f"is for version {description.feature_set_version} of feature set {features.name}; "
            f"this is version {features.version}: retrain it"
        )
    if description.feature_set_sha256 != features.digest:
        digest = description.feature_set_sha256[:12]
        return (
            f"is for the network {features.name} with sha256 {digest}; here is "
            f"{features.digest[:12]}: retrain it, or restore that network"
        )
    if len(description.feature_names) != features.width:
        count = len(description.feature_names)
        return f"names {count} features, which {description.feature_set} has not"
    if description.inputs not in features.inputs:
        return f"inputs: {features.name} has no {one_line(description.inputs)[:64]!r}"
    try:
        classifier_kind(description.kind).parameters.model_validate(description.parameters)
    except ValidationError as error:
        return first_problem(error)
    return (
        _problem_of_labels(description, features)
        or _problem_of_classes(description)
        or _problem_of_arrays(description)
        or _problem_of_heads(description)
    )


def _problem_of_labels(description: Description, features: FeatureSet) -> str | None:
    window = features.inputs[description.inputs].window_frames
    if description.label_frame >= window:
        return f"label_frame: a window has {window} frames"
    if description.gate and (features.band_powers is None or SILENCE not in description.classes):
        return "has a gate, but no class silence, or its feature set has no bands"
    return None


def _problem_of_classes(description: Description) -> str | None:
    classes = set(description.classes)
    tables = (description.scenario, description.training_data.classes, description.metrics.classes)
    confusion = description.metrics.confusion
    if len(classes) != len(description.classes):
        return "names a class twice"
    if any(table.keys() != classes for table in tables):
        return "its scenario, training data and metrics are not all of its classes"
    if not description.decision_bias.keys() <= classes:
        return "its decision_bias has a class that it has not"
    if {len(confusion), *map(len, confusion)} != {len(classes)}:
        return "its confusion matrix does not fit its classes"
    times = [time for span in description.training_data.home_spans for time in span]
    if any(later <= time for time, later in pairwise(times)):
        return "its home_spans are not in order"
    return None


def _problem_of_arrays(description: Description) -> str | None:
    """Check the microphone arrays whose directions a model uses."""
    names = description.direction_microphones
    if len(set(names)) < len(names):
        return "its direction_microphones name one twice"
    if description.format == FORMAT_OF_EMBEDDINGS:
        return None
    if bool(names) != (description.format == FORMAT_OF_DIRECTIONS):
        return f"format: is {description.format}; those with directions are {FORMAT_OF_DIRECTIONS}"
    return None


def _problem_of_heads(description: Description) -> str | None:
    """Check a model's use of network embeddings."""
    mix, classes = description.embedding, set(description.classes)
    if (mix is not None) != (description.format == FORMAT_OF_EMBEDDINGS):
        return f"format: is {description.format}; those with heads are {FORMAT_OF_EMBEDDINGS}"
    if mix is None:
        exponent = description.smoothing.class_exponent
        return None if exponent is None else "smoothing: has a class_exponent without heads"
    if len(classes - {SILENCE}) < 2:
        return "embedding: there are no two sounds to tell apart"
    named = {name for head in mix.names for name in [*head.classes, *head.bias]}
    if not (named | mix.bias.keys()) <= classes - {SILENCE}:
        return "embedding: has a class that the model has not, or silence"
    numbers = [one for head in mix.names for same in head.classes.values() for one in same]
    if max(numbers, default=0) >= mix.values:
        return f"embedding: names values beyond the {mix.values} of a window"
    return None


def _problem_of(description: Description, arrays: Mapping[str, Array]) -> str | None:
    kind, classes = classifier_kind(description.kind), len(description.classes)
    dtypes = {**kind.arrays, **kind.optional, **_COMMON}
    if not kind.arrays.keys() <= arrays.keys() <= dtypes.keys():
        return f"has other arrays than a model of kind {kind.name}"
    shapes = _shapes(description, arrays)
    if shapes.keys() != arrays.keys():
        name = min(shapes.keys() ^ arrays.keys())
        return f"{name} {'is missing' if name in shapes else 'is out of place'}"
    for name, shape in shapes.items():
        if problem := _problem_of_array(arrays[name], dtypes[name], shape):
            return f"{name} {problem}"
    return (
        _problem_of_values(classes, arrays)
        or _problem_of_untaught(description, arrays)
        or kind.problem(classes, arrays)
    )


def _problem_of_untaught(description: Description, arrays: Mapping[str, Array]) -> str | None:
    """Check the classes that the heads leave to other heads."""
    mix = description.embedding
    if mix is None:
        return None
    sounds = sounds_of(description.classes)
    untaught = arrays["embedding_bias"][:, sounds] == UNTAUGHT
    if untaught.all(axis=1).any():
        return "embedding_bias has a head without a class"
    if mix.of_home and untaught[-1].any():
        return "embedding_bias leaves a class out in what a home adds"
    return None


def _problem_of_values(classes: int, arrays: Mapping[str, Array]) -> str | None:
    """Check the values of the arrays that all kinds of classifiers have."""
    target = arrays.get("training_target", np.empty(0))
    if ((target < 0) | (target >= classes)).any():
        return "training_target has classes that the model has not"
    if (np.abs(arrays.get("direction_weights", np.empty(0))) > MOST_EVIDENCE).any():
        return f"direction_weights has values beyond {MOST_EVIDENCE:g}"
    if (arrays.get("embedding_scaler", np.ones((2, 1)))[1] <= 0).any():
        return "embedding_scaler has standard deviations that are not positive"
    transitions = arrays.get("transitions", np.ones((1, 1)))
    if (transitions < 0).any() or (np.abs(transitions.sum(axis=1) - 1.0) > _ROUNDING).any():
        return "the rows of transitions are no probabilities"
    return None


def _problem_of_array(
    array: NDArray[Any], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> str | None:
    if array.dtype != dtype:
        return f"is of type {array.dtype}, not {dtype}"
    if array.shape != shape:
        return f"has shape {array.shape}, not {shape}"
    if not np.isfinite(array).all():
        return "has values that are not finite"
    if array.dtype == np.float64 and not (np.abs(array) <= _LARGEST).all():
        return "has values that make no sense"
    return None


def _shapes(description: Description, arrays: Mapping[str, Array]) -> dict[str, tuple[int, ...]]:
    features, classes = feature_set(description.feature_set), len(description.classes)
    width = features.inputs[description.inputs].width
    shapes = classifier_kind(description.kind).shapes(classes, width, arrays)
    if description.smoothing.method == "hmm":
        shapes["transitions"] = (classes, classes)
    if description.direction_microphones:
        count = len(description.direction_microphones)
        shapes["direction_weights"] = (count, classes, SECTORS)
    if (mix := description.embedding) is not None:
        heads = len(mix.head_weights) + mix.of_home
        shapes["embedding_weights"] = (heads, mix.values, classes)
        shapes["embedding_bias"] = (heads, classes)
        shapes["embedding_scaler"] = (2, mix.values)
    digests = arrays.get("training_digests", np.empty(0))
    if digests.ndim and len(digests):
        shapes["training_digests"] = (len(digests),)
    kept = arrays.get("training_windows", np.empty(0))
    if kept.ndim and len(kept):
        shapes["training_windows"] = (len(kept), features.window_frames, features.width)
        if "training_floor" in arrays:
            shapes["training_floor"] = (len(kept), features.bands)
        shapes["training_target"] = shapes["training_group"] = (len(kept),)
    return shapes


CARD = "model_card.md"
DESCRIPTION = "model.json"
_FEW = 12  # sources


def attachment_of(name: str, microphone: str) -> str:
    """Return the attachment name for one microphone's model, where microphones differ in model."""
    stem, suffix = name.rsplit(".", 1)
    return f"{stem}.{microphone}.{suffix}"


def model_attachments(model: Model) -> list[Attachment]:
    """Return the attachments for a log labelled by a model: its card and its description.

    Raise `ModelError` if the model's kind of classifier is not installed or cannot be imported.
    """
    description = {"name": model.name, "sha256": model.sha256, **model.description.model_dump()}
    text = json.dumps(description, ensure_ascii=False)
    return [
        Attachment(CARD, "text/markdown", model_card(model).encode()),
        Attachment(DESCRIPTION, "application/json", text.encode()),
    ]


def model_card(model: Model) -> str:
    """Render the model card as Markdown.

    Raise `ModelError` if the model's kind of classifier is not installed or cannot be imported.
    """
    description, metrics = model.description, model.description.metrics
    amounts = description.training_data.classes
    purpose = (
        f"Tells apart {len(description.classes)} classes of sound in windows of "
        f"{description.window_seconds:g} s, from feature set {description.feature_set} "
        f"({description.kind}, {classifier_kind(description.kind).summary(model)})."
    )
    rest = f" without {UNKNOWN}" * (UNKNOWN in description.classes)
    lines = [
        f"# Model {model.name or description.scenario_name}",
        "",
        purpose,
        "",
        f"- sha256: {model.sha256 or 'not saved'}",
        f"- scenario: {description.scenario_name}",
        f"- macro F1{rest}: {metrics.macro_f1:.3f} ({metrics.folds} folds, none splits a source)",
        f"- expected calibration error: {metrics.expected_calibration_error:.3f}",
        f"- training data sha256: {description.training_data.sha256}",
        f"- made with: {', '.join(f'{k} {v}' for k, v in sorted(description.versions.items()))}",
        "",
        "| class | labels | sources | seconds | precision | recall | F1 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in description.classes:
        amount, result = amounts[name], metrics.classes[name]
        figures = (f"{value:.3f}" for value in (result.precision, result.recall, result.f1))
        if not amount.sources:  # a class added by the home
            figures = ("-" for _ in range(3))
        lines.append(
            f"| {name} | {', '.join(description.scenario[name])} | {amount.sources} | "
            f"{amount.seconds:.0f} | {' | '.join(figures)} |"
        )
    thin = [f"{name} ({one.sources})" for name, one in amounts.items() if 0 < one.sources < _FEW]
    if thin:
        lines += ["", f"Few sources, so not reliable: {', '.join(thin)}"]
    if description.training_data.home:
        lines += [
            "",
            "Adapted to a home (the figures above are those before); learned besides:",
        ]
        kept = description.training_data.home_confirmed
        lines += [""] + [
            f"- {name}: {amount.segments} segments from {amount.sources} sources"
            + (f", {kept[name]} of them as they were labelled" if name in kept else "")
            for name, amount in description.training_data.home.items()
        ]
    if frames := description.training_data.home_frames:
        minutes = frames * FRAME_SECONDS / 60
        lines += ["", f"What follows what is from {minutes:.0f} minutes of a home without marks."]
    if arrays := description.direction_microphones:
        named = ", ".join(arrays)
        lines += ["", f"Takes the directions of {named}; other microphones are labelled without."]
    if (mix := description.embedding) is not None:
        wanted = (
            f"Takes what the network {mix.network} hears (projection {mix.projection_sha256[:12]}) "
            "where a log has it; elsewhere it labels by the features alone, and less often rightly."
        )
        lines += ["", wanted]
    if description.training_data.simulated:
        lines += ["", "Trained on simulated sounds only: the figures do not hold for real ones."]
    lines += [*_elsewhere(description), "", "Learned from recordings of:", ""]
    lines += [
        f"- {item.name or 'unnamed'}: {item.clips} clips, {item.licence or 'licence unstated'}"
        for item in description.training_data.collections
    ]
    kept_back = [
        f"{item.name or 'unnamed'} ({item.licence or 'unstated'})"
        for item in description.training_data.collections
        if not may_be_shipped(item.licence)
    ]
    if kept_back:
        lines += ["", "Do not pass on without permission, because of the training data:", ""]
        lines += [f"- {text}" for text in kept_back]
    return "\n".join(lines) + "\n"


def _elsewhere(description: Description) -> list[str]:
    elsewhere = description.elsewhere
    if elsewhere is None:
        return []
    collections, segments = elsewhere.collections, elsewhere.segments
    amount = f"{collections} left out in turn, {segments} segments of its classes"
    lines = [
        "",
        f"In collections of which nothing was learned, as in a new home ({amount}):",
        "",
        f"- right: {elsewhere.right:.0%}",
        f"- expected calibration error: {elsewhere.expected_calibration_error:.3f}",
    ]
    if elsewhere.macro_f1 is None:
        return lines
    interval = elsewhere.macro_f1_interval
    between = f" ({interval[0]:.3f} to {interval[1]:.3f})" if interval else ""
    lines += [f"- macro F1: {elsewhere.macro_f1:.3f}{between}"]
    errors = {
        name: f", calibration error {error:.3f}"
        for name, error in elsewhere.calibration_errors.items()
    }
    lines += [
        f"- F1 of {name}: {f1:.3f}{errors.get(name, '')}" for name, f1 in elsewhere.classes.items()
    ]
    untried = [name for name in description.classes if name not in {*elsewhere.classes, UNKNOWN}]
    if untried:
        lines += [f"- not tried, for the other collections have too little: {', '.join(untried)}"]
    return lines
