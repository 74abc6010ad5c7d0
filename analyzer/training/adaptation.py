"""Adaptation of a model to the marks of a home."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.calibration import cross_validate, home_temperature, softmax
from hearthlog.analyzer.training.dataset import (
    CONFIRMED,
    Dataset,
    EmbeddingWindows,
    learned_digests,
    segment_digests,
)
from hearthlog.analyzer.training.direction_samples import with_directions
from hearthlog.analyzer.training.heads import in_units, regressed
from hearthlog.analyzer.training.manifest import Scenario
from hearthlog.analyzer.training.method import Examples, Method, prepare
from hearthlog.analyzer.training.train import default_transitions, merged_spans
from hearthlog.analyzer.training.window_methods import (
    ROOM,
    LandmarkMap,
    LearnedMachine,
    balanced,
    centres,
    kept_inputs,
)
from hearthlog.analyzer.workers import single_thread
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.classifier import classifier_kind
from hearthlog.models.classifiers.evidence import UNIT, UNTAUGHT, EmbeddingHeads, mixed, sounds_of
from hearthlog.models.classifiers.model import (
    FORMAT,
    FORMAT_OF_EMBEDDINGS,
    MOST_WEIGHT,
    Amount,
    Array,
    ClassMetrics,
    Description,
    EmbeddingMix,
    Model,
    NamesHead,
)
from hearthlog.models.classifiers.network_names import require_trained
from hearthlog.models.classifiers.rbf_machines import (
    RBF_LANDMARKS,
    SVM_RBF,
    LandmarkParameters,
    LandmarksMachine,
)
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices, Int32
from hearthlog.schemas.errors import ignore_progress

_HEAD_PULL = 10.0  # regularisation to zero, for standardised inputs
_NEW_HEAD_PULL = 1.0  # of a new class, which has no base weights
_CONFIRMED_WEIGHT = 1 / 3  # weight of a window with a confirmed label; a mark has 1
_SHARE = 0.5  # applied part of the correction: marks have few sources, and other sounds lie between
_BELOW = 2.0  # initial offset of a new class below the mean of the others, a logarithm


class Heads(NamedTuple):
    """Mix, head arrays and number of trailing new classes of a model."""

    mix: EmbeddingMix
    weights: Int32
    bias: Int32
    scaler: Float64
    new: int


def base_heads(model: Model, classes: Sequence[str]) -> Heads:
    """Return the heads of a model before any adaptation, with room for new classes."""
    mix = model.description.embedding
    assert mix is not None
    count = len(mix.head_weights)
    same = sum(name in model.classes for name in classes)
    inverse = mix.base_inverse_temperature or mix.inverse_temperature
    weights = model.embedding_weights[:count, :, :same]
    bias = model.embedding_bias[:count, :same]
    new = len(classes) - same
    if new:
        sounds = sounds_of(classes[:same])
        middle = bias[:, sounds] + np.einsum(
            "w,hws->hs", model.embedding_scaler[0], weights[..., sounds].astype(np.float64)
        )
        middle = np.ma.masked_array(middle, bias[:, sounds] == UNTAUGHT)
        constant = np.rint(middle.mean(axis=1).filled(0.0) - _BELOW / inverse / UNIT)
        constant = constant.astype(np.int32)
        weights = np.pad(weights, ((0, 0), (0, 0), (0, new)))
        bias = np.concatenate([bias, np.tile(constant[:, np.newaxis], (1, new))], axis=1)
    update = {
        "names": [_with_classes(head, classes) for head in mix.names],
        "bias": {name: value for name, value in mix.bias.items() if name in classes},
        "inverse_temperature": inverse,
        "base_inverse_temperature": None,
        "of_home": False,
    }
    return Heads(mix.model_copy(update=update), weights, bias, model.embedding_scaler, new)


def _with_classes(head: NamesHead, classes: Sequence[str]) -> NamesHead:
    """Return a head extended by the classes of a home; names score the unknown ones."""
    kept = {name: values for name, values in head.classes.items() if name in classes}
    bias = {name: value for name, value in head.bias.items() if name in classes}
    if UNKNOWN in head.classes:
        for name in classes:
            if name not in kept and name != SILENCE:
                kept[name] = head.classes[UNKNOWN]
                bias |= {name: head.bias[UNKNOWN]} if UNKNOWN in head.bias else {}
    return head.model_copy(update={"classes": kept, "bias": bias})


def learn_home(
    heads: Heads, windows: EmbeddingWindows, marked: Bool, classes: Sequence[str]
) -> Heads:
    """Learn the correction of a home from the windows that a person marked [shape=(m,)].

    Half of the correction is added for classes of the base; the model labelled the windows without
    a mark. The base heads stay fixed. The home adds its own linear head, so adaptation needs none
    of the base's recordings. The head is fitted by logistic regression with a pull to zero: the
    base decides where nothing is marked.

    Without new classes and without marks of class `unknown`, the score of `unknown` against the
    other classes is not learned: marks of sounds wrongly labelled `unknown` would remove nearly all
    of it.
    """
    sounds = sounds_of(classes)
    if UNKNOWN in classes and not heads.new:
        unknown = classes.index(UNKNOWN)
        if not (windows.target[marked] == unknown).any():
            sounds = sounds[sounds != unknown]
    own = np.isin(windows.target, sounds)
    if not own.any():
        return heads
    mix, values = heads.mix, windows.values[own]
    by_heads = EmbeddingHeads(mix, heads.weights, heads.bias, classes).log_probabilities(values)
    shares = sum(mix.head_weights) + sum(head.weight for head in mix.names)
    before = mix.inverse_temperature / shares * by_heads[:, sounds]
    used = np.flatnonzero(heads.weights.any(axis=(0, 2)))
    mean, scale = heads.scaler[:, used]
    inputs = (values[:, used] - mean) / scale
    # The windows of a mark are of one sound: many of them carry no more information than one.
    windows_of = np.bincount(windows.recording[own])[windows.recording[own]]
    weight = np.where(marked[own], 1.0 / windows_of, _CONFIRMED_WEIGHT)
    target = np.searchsorted(sounds, windows.target[own])
    pull = np.full(len(sounds), _HEAD_PULL)
    pull[len(sounds) - heads.new :] = _NEW_HEAD_PULL
    truth = np.eye(len(sounds))[target]
    slopes, constants = regressed(inputs, truth, weight, before, pull, free=False)
    taken = np.where(np.arange(len(sounds)) < len(sounds) - heads.new, _SHARE, 1.0)
    slopes, constants = taken * slopes, taken * constants
    weights = np.zeros((1, *heads.weights.shape[1:]))
    bias = np.zeros((1, heads.bias.shape[1]))
    factor = shares / mix.inverse_temperature
    weights[0][np.ix_(used, sounds)] = factor * slopes / scale[:, np.newaxis]
    bias[0, sounds] = factor * (constants - (mean / scale) @ slopes)
    return heads._replace(
        mix=mix.model_copy(update={"of_home": True}),
        weights=np.concatenate([heads.weights, in_units(weights)]),
        bias=np.concatenate([heads.bias, in_units(bias)]),
    )


_LANDMARK_PULL = 1.0  # regularisation to zero of the correction of weights
_NEW_LANDMARK_PULL = 0.1  # of a new class, which has no base weights
_LANDMARK_WEIGHT = 3.0  # weight of the base's output for a landmark; a window of a mark has 1
_HOME_LANDMARKS = 200  # maximum number from the windows of the home
_IMITATION_COST = 30.0  # fits probabilities more closely than labels, which have errors
_SMOOTHED = 1 / 3  # of an SVM's frame weight: an SVM is less sure between its vectors
_ROWS_AT_ONCE = 256
_MOST_BIAS = 100.0


@dataclass(frozen=True)
class HomeLandmarks(Method):
    """Adapts the weights of a landmark classifier.

    The landmarks, each with the output of the base as target, preserve the base where the home has
    no windows: a home has few sources of few classes. A classifier of another kind is first
    imitated by a landmark classifier.
    """

    base: Mapping[str, Array] = field(default_factory=dict, compare=False)
    values: Mapping[str, float] = field(default_factory=dict)
    inverse: float = 1.0

    @classmethod
    def of(cls, model: Model) -> Self:
        """Return the method that adapts a model of kind `rbf-landmarks`."""
        description = model.description
        return cls(
            description.method,
            description.feature_set,
            description.inputs,
            description.kind,
            copies=0,
            base=model.arrays,
            values=description.parameters,
            inverse=description.base_inverse_temperature or description.inverse_temperature,
        )

    def fit(self, examples: Examples, seen: Indices | slice = slice(None)) -> LearnedMachine:
        """Adapt the base to segments of a home; see `Method.fit`."""
        with single_thread():
            return self._moved(*examples.windows(seen))

    def _moved(self, inputs: Float32, target: Indices, weight: Float64) -> LearnedMachine:
        arrays = dict(self.base)
        arrays.pop("home_landmarks", None)
        base_weights = arrays.setdefault("base_weights", arrays["weights"])
        base_bias = arrays.setdefault("base_bias", arrays["bias"])
        count, old = base_weights.shape
        new = max(int(target.max(initial=-1)) + 1 - old, 0)
        if len(inputs):
            arrays["home_landmarks"], _ = centres(arrays, inputs, target, weight, _HOME_LANDMARKS)
        parameters = LandmarkParameters.model_validate(self.values)
        map_ = LandmarkMap(arrays, parameters)
        kernels = np.concatenate([map_.kernels(arrays["landmarks"]), map_.kernels(inputs)])
        before = self.inverse * (kernels[:, :count] @ base_weights + base_bias)
        constant = before.mean() - _BELOW
        before = np.pad(before, ((0, 0), (0, new)), constant_values=constant)
        mapped = kernels @ map_.root
        mean = mapped[:count].mean(axis=0)
        scale = np.sqrt(np.square(mapped[:count] - mean).sum(axis=1).mean())
        slopes, constants = regressed(
            (mapped - mean) / scale,
            np.concatenate([softmax(before[:count]), np.eye(old + new)[target]]),
            np.concatenate([np.full(count, _LANDMARK_WEIGHT), balanced(target, weight)]),
            before,
            np.where(np.arange(old + new) < old, _LANDMARK_PULL, _NEW_LANDMARK_PULL),
            free=False,
        )
        taken = np.where(np.arange(old + new) < old, _SHARE, 1.0) / self.inverse
        slopes, constants = taken * slopes / scale, taken * constants
        weights, bias = map_.root @ slopes, constants - mean @ slopes
        weights[:count, :old] += base_weights
        bias[:old] += base_bias
        bias[old:] += constant / self.inverse
        arrays["weights"], arrays["bias"] = weights, bias
        arrays["landmark_counts"] = np.pad(arrays["landmark_counts"][:old], (0, new))
        machine = LandmarksMachine(arrays, parameters)
        return LearnedMachine(machine, np.arange(old + new), arrays, parameters.model_dump())


def is_moved(model: Model) -> bool:
    """Return whether the classifier of a model can be adapted without imitation."""
    return model.description.kind == RBF_LANDMARKS.name


def learned_over(base: Model) -> Model:
    """Return a landmark model that imitates a classifier of another kind.

    Raise `DataError` if the classifier has stored no inputs of its kind, or none for one of its
    classes.
    """
    kept = kept_inputs(base)
    if kept is None or not len(kept[0]):
        raise DataError(f"{base.name}: has not kept what it learned from; train it anew to adapt")
    inputs, target = kept
    classes = int(target.max()) + 1
    lacking = np.setdiff1d(np.arange(classes), target)
    if len(lacking):
        name = base.classes[lacking[0]]
        raise DataError(f"{base.name}: has kept nothing of {name}; train it anew to adapt")
    description = base.description
    width, inverse = inputs.shape[1], description.inverse_temperature
    method, smoothed = replace(ROOM, cost=_IMITATION_COST), 1.0
    if description.kind == SVM_RBF.name:
        if description.embedding is None:  # otherwise smoothing also applies to the heads
            smoothed = _SMOOTHED
        method = replace(method, gamma=description.parameters["gamma"] * width)
    machine = classifier_kind(description.kind).machine(base)
    parts = np.array_split(inputs, -(-len(inputs) // _ROWS_AT_ONCE))
    decisions = np.concatenate([machine.decide(part)[0] for part in parts])[:, :classes]
    with single_thread():
        _, arrays, parameters = method.imitate(
            inputs, target, np.ones(len(inputs)), softmax(inverse * decisions)
        )
    smoothing, bias = description.smoothing, description.decision_bias
    update = {
        "kind": RBF_LANDMARKS.name,
        "parameters": parameters,
        "inverse_temperature": 1.0,
        "base_inverse_temperature": None,
        "decision_bias": {
            name: float(np.clip(inverse * value, -_MOST_BIAS, _MOST_BIAS))
            for name, value in bias.items()
        },
        "novelty": "doubt",
        "copies": 0,
        "smoothing": smoothing.model_copy(
            update={"weight": min(smoothed * smoothing.weight * inverse, MOST_WEIGHT)}
        ),
    }
    return replace(base, description=description.model_copy(update=update), arrays=arrays)


_FEWEST_SEGMENTS = 10
_FOLDS = 3  # for fitting the temperature


def base_classes(model: Model) -> tuple[str, ...]:
    """Return the classes of a model without those learned only from a home."""
    require_trained(model)
    kept = kept_inputs(model)
    if kept is None or not len(kept[1]):
        return model.classes
    return model.classes[: int(kept[1].max()) + 1]


def adapt_model(base: Model, home: Dataset) -> Model:
    """Adapt the weights of a model to a home.

    A base of another kind than landmarks is imitated first; it must have stored training windows.
    `home` has segments of the model's `base_classes`, which may be empty, followed by new classes,
    which must have segments. Parameters, transitions and metrics stay those of `base`, measured in
    other homes; the temperature before the first adaptation is adjusted by cross-validation over
    parts of the home. The result can be adapted again to more of the home.

    Raise `DataError` if the home has no segments, or no loud ones of a new class, or if the base
    cannot be imitated; `ModelError` if the feature set or kind of classifier is not installed.
    """
    require_trained(base)
    if not len(home):
        raise DataError("the home has no segments of a class of the model")
    moved = base if is_moved(base) else learned_over(base)
    description, method = moved.description, HomeLandmarks.of(moved)
    examples = prepare(method, home)
    _check_new_classes(base, examples, home.classes)
    learned = method.fit(examples)
    before = description.base_inverse_temperature or description.inverse_temperature
    description = _of_classes(description, home.classes)
    left_out = _left_out(method, examples, ~_is_confirmed(home, home.collection), description)
    # Marks alone are hard cases and would make the model underconfident elsewhere.
    tried = np.isfinite(left_out).all(axis=1)
    inverse = home_temperature(left_out[tried], home.target[tried], before)
    smoothing = description.smoothing
    weight = min(smoothing.weight * description.inverse_temperature / inverse, MOST_WEIGHT)
    training = description.training_data.model_copy(
        update={
            "home": home.amounts,
            "home_confirmed": _confirmed(home),
            "home_spans": merged_spans(home.spans),
            "home_frames": 0,
            "base_sha256": base.sha256,
        }
    )
    update = {
        "training_data": training,
        "inverse_temperature": inverse,
        "base_inverse_temperature": before,
        "smoothing": smoothing.model_copy(update={"weight": weight}),
    }
    transitions = base.transitions
    was_learned = base.description.training_data.home_frames > 0  # by an earlier version
    if len(transitions) and (was_learned or home.classes != base.classes):
        transitions = default_transitions(home.classes)
    plain = {"format": FORMAT, "direction_microphones": []}
    adapted = Model(
        description.model_copy(update=update | plain),
        learned.arrays(),
        transitions=transitions,
        training_digests=np.union1d(learned_digests(base), segment_digests(home.windows)),
    )
    if description.embedding is not None:
        adapted = _with_heads(adapted, base, home, inverse * left_out)
    return with_directions(adapted, home.target, home.sightings)


def _with_heads(adapted: Model, base: Model, home: Dataset, decisions: Float64) -> Model:
    """Adapt the heads of a model too, given held-out decisions of the classifier."""
    heads = base_heads(base, home.classes)
    marked = ~_is_confirmed(home, home.embedding_windows.collection)
    learned = learn_home(heads, home.embedding_windows, marked, home.classes)
    inverse = _inverse_here(heads, home, decisions)
    mix = learned.mix.model_copy(
        update={
            "inverse_temperature": inverse,
            "base_inverse_temperature": heads.mix.inverse_temperature,
        }
    )
    smoothing = adapted.description.smoothing.model_copy(
        update={"weight": base.description.smoothing.weight}  # of probabilities as they are
    )
    update = {"format": FORMAT_OF_EMBEDDINGS, "embedding": mix, "smoothing": smoothing}
    return replace(
        adapted,
        description=adapted.description.model_copy(update=update),
        embedding_weights=learned.weights,
        embedding_bias=learned.bias,
        embedding_scaler=learned.scaler,
    )


def _inverse_here(heads: Heads, home: Dataset, decisions: Float64) -> float:
    """Return the inverse temperature of the mix, cross-validated over parts of a home."""
    base, sounds = heads.mix.inverse_temperature, sounds_of(home.classes)
    marked = ~_is_confirmed(home, home.collection)
    tried = np.isfinite(decisions).all(axis=1) & home.is_embedded & np.isin(home.target, sounds)
    if marked.sum() < _FEWEST_SEGMENTS or not tried.any():
        return base
    by_heads = np.full(decisions.shape, np.nan)
    for part in _parts(marked):
        own = part[tried[part]]
        seen = np.setdiff1d(np.arange(len(home)), part)
        learned = _learned_without(heads, home, seen)
        of_home = EmbeddingHeads(learned.mix, learned.weights, learned.bias, home.classes)
        by_heads[own] = of_home.log_probabilities(home.embedded[own])
    plain = heads.mix.model_copy(update={"inverse_temperature": 1.0})
    logarithms = mixed(decisions[tried], by_heads[tried], plain, home.classes)[:, sounds]
    return home_temperature(logarithms, np.searchsorted(sounds, home.target[tried]), base)


def _learned_without(heads: Heads, home: Dataset, seen: Indices) -> Heads:
    """Fit heads on some segments of a home instead of all windows."""
    own = seen[home.is_embedded[seen]]
    windows = EmbeddingWindows(
        home.embedded[own],
        home.target[own],
        home.group[own],
        home.collection[own],
        np.ones(len(own), bool),
        np.arange(len(own)),
    )
    return learn_home(heads, windows, ~_is_confirmed(home, windows.collection), home.classes)


def _check_new_classes(base: Model, examples: Examples, classes: Sequence[str]) -> None:
    """Raise an error if a new class would have no training window."""
    usable = examples.target[examples.usable.any(axis=(0, 2))]
    for number in range(len(base_classes(base)), len(classes)):
        if number not in usable:
            raise DataError(
                f"the home has no sound of {classes[number]} above its noise: mark louder ones"
            )


def _of_classes(description: Description, classes: Sequence[str]) -> Description:
    """Return a description with other trailing classes and no metrics for them."""
    if tuple(description.classes) == tuple(classes):
        return description
    metrics, training = description.metrics, description.training_data
    confusion = np.zeros((len(classes), len(classes)), int)
    same = len([name for name in classes if name in description.classes])
    confusion[:same, :same] = np.array(metrics.confusion)[:same, :same]
    unknown = ClassMetrics(precision=0.0, recall=0.0, f1=0.0)
    none = Amount(sources=0, segments=0, seconds=0.0)
    figures = {name: metrics.classes.get(name, unknown) for name in classes}
    amounts = {name: training.classes.get(name, none) for name in classes}
    bias = description.decision_bias
    new = {name: (name,) for name in classes if name not in description.classes}
    labelled = {name: tuple(description.scenario.get(name, [name])) for name in description.classes}
    before = Scenario(description.scenario_name, labelled)
    kept = before.with_classes(name for name in classes if name not in new)
    labels = kept.with_trained(new).classes
    update = {
        "classes": list(classes),
        "scenario": {name: list(labels[name]) for name in classes},
        "decision_bias": {name: value for name, value in bias.items() if name in classes},
        "metrics": metrics.model_copy(update={"classes": figures, "confusion": confusion.tolist()}),
        "training_data": training.model_copy(update={"classes": amounts}),
    }
    return description.model_copy(update=update)


def _left_out(
    method: Method, examples: Examples, marked: Bool, description: Description
) -> Float64:
    """Return the decisions of adapted classifiers for held-out parts; NaN if too few are marked."""
    everything, count = np.arange(len(marked)), len(description.classes)
    if marked.sum() < _FEWEST_SEGMENTS:
        return np.full((len(marked), count), np.nan)
    folds = [(np.setdiff1d(everything, part), part) for part in _parts(marked)]
    [decisions] = cross_validate([method], examples, count, folds, ignore_progress)
    bias = np.array([description.decision_bias.get(name, 0.0) for name in description.classes])
    return decisions + bias


def _parts(marked: Bool) -> list[Indices]:
    """Divide the segments of a home into parts with equal shares of the marked ones."""
    of_marks, others = (np.array_split(np.flatnonzero(same), _FOLDS) for same in (marked, ~marked))
    return [np.concatenate(pair) for pair in zip(of_marks, others, strict=True)]


def _is_confirmed(home: Dataset, collection: Indices) -> Bool:
    """Return which of a home's segments or windows keep the label of the model."""
    names = home.collection_names
    return collection == (names.index(CONFIRMED) if CONFIRMED in names else -1)


def _confirmed(home: Dataset) -> dict[str, int]:
    """Count the segments of each class that keep the label of the model."""
    confirmed = home.target[_is_confirmed(home, home.collection)]
    counts = np.bincount(confirmed, minlength=len(home.classes))
    return {name: int(count) for name, count in zip(home.classes, counts, strict=True) if count}
