"""Adaptation: what a home teaches is added to the weights of a model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.calibration import home_temperature
from hearthlog.analyzer.training.cross_validation import cross_validate
from hearthlog.analyzer.training.dataset import CONFIRMED, Dataset, EmbeddingWindows
from hearthlog.analyzer.training.home_heads import Heads, base_heads, learn_home
from hearthlog.analyzer.training.home_landmarks import HomeLandmarks, is_moved, learned_over
from hearthlog.analyzer.training.home_spans import merged_spans
from hearthlog.analyzer.training.learned_inputs import kept_inputs
from hearthlog.analyzer.training.learned_segments import learned_digests, segment_digests
from hearthlog.analyzer.training.method import Examples, Method, prepare
from hearthlog.analyzer.training.scenario import Scenario
from hearthlog.analyzer.training.sightings import with_directions
from hearthlog.analyzer.training.transitions import default_transitions
from hearthlog.models.classifiers.evidence import EmbeddingHeads, mixed, sounds_of
from hearthlog.models.classifiers.model import (
    FORMAT,
    FORMAT_OF_EMBEDDINGS,
    MOST_WEIGHT,
    Amount,
    ClassMetrics,
    Description,
    Model,
)
from hearthlog.models.classifiers.names import insist_taught
from hearthlog.schemas.arrays import Bool, Float64, Indices
from hearthlog.schemas.errors import ignore_progress

_FEWEST_SEGMENTS = 10
_FOLDS = 3  # by which the temperature is found


def base_classes(model: Model) -> tuple[str, ...]:
    """Return the classes of a model without those that it has from a home alone."""
    insist_taught(model)
    kept = kept_inputs(model)
    if kept is None or not len(kept[1]):
        return model.classes
    return model.classes[: int(kept[1].max()) + 1]


def adapt_model(base: Model, home: Dataset) -> Model:
    """Add what a home teaches to the weights of a model.

    Parameters
    ----------
    base : Model
        One whose classifier is not on landmarks is learned over by what it says, if it has kept
        windows that it learned from.
    home : Dataset
        Of the `base_classes` of the model, some of which may have no segments, and of new ones
        behind them, which have some.

    Returns
    -------
    Model
        With the parameters, transitions and metrics of `base`, which are those of other homes.
        Parts of the home that were left out in turn move the temperature that the model had before
        it was ever adapted. It can be adapted again to more of the home.

    Raises
    ------
    DataError
        If the home has no segments, or no loud ones of a new class, or if the base cannot be
        learned over.
    ModelError
        If the feature set or the kind of classifier of the base is not installed.
    """
    insist_taught(base)
    if not len(home):
        raise DataError("the home has no segments of a class of the model")
    moved = base if is_moved(base) else learned_over(base)
    description, method = moved.description, HomeLandmarks.of(moved)
    examples, here = prepare(method, home), np.arange(len(home))
    _check_new_classes(base, examples, home.classes)
    learned = method.fit(examples)
    before = description.base_inverse_temperature or description.inverse_temperature
    description = _of_classes(description, home.classes)
    left_out = _left_out(method, examples, here, ~_is_confirmed(home), description)
    inverse = _temperature_here(left_out, examples, here, description)
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
        adapted = _with_heads(adapted, base, home, inverse * left_out[here])
    return with_directions(adapted, home.target, home.sightings)


def _with_heads(adapted: Model, base: Model, home: Dataset, decisions: Float64) -> Model:
    """Let the heads of a model learn from a home, too; the classifier's decisions are left out."""
    heads = base_heads(base, home.classes)
    marked = home.embedding_windows.collection != _confirmed_number(home)
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
    """Return how sure the mix may be of sounds of a home, by parts of it left out."""
    base, sounds = heads.mix.inverse_temperature, sounds_of(home.classes)
    marked = ~_is_confirmed(home)
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
    """Let heads learn from some segments of a home instead of all windows."""
    own = seen[home.is_embedded[seen]]
    windows = EmbeddingWindows(
        home.embedded[own],
        home.target[own],
        home.group[own],
        home.collection[own],
        np.ones(len(own), bool),
        np.arange(len(own)),
    )
    return learn_home(heads, windows, windows.collection != _confirmed_number(home), home.classes)


def _confirmed_number(home: Dataset) -> int:
    names = home.collection_names
    return names.index(CONFIRMED) if CONFIRMED in names else -1


def _check_new_classes(base: Model, examples: Examples, classes: Sequence[str]) -> None:
    """Refuse what would leave a class that the base lacks without a window to learn from."""
    usable = examples.target[examples.usable.any(axis=(0, 2))]
    for number in range(len(base_classes(base)), len(classes)):
        if number not in usable:
            raise DataError(
                f"the home has no sound of {classes[number]} above its noise: mark louder ones"
            )


def _of_classes(description: Description, classes: Sequence[str]) -> Description:
    """Return a description with other classes at its end, of which no figures are known."""
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
    labels = kept.with_taught(new).classes
    update = {
        "classes": list(classes),
        "scenario": {name: list(labels[name]) for name in classes},
        "decision_bias": {name: value for name, value in bias.items() if name in classes},
        "metrics": metrics.model_copy(update={"classes": figures, "confusion": confusion.tolist()}),
        "training_data": training.model_copy(update={"classes": amounts}),
    }
    return description.model_copy(update=update)


def _left_out(
    method: Method, examples: Examples, home: Indices, marked: Bool, description: Description
) -> Float64:
    """Return what a classifier says of parts of a home that it was not adapted to.

    NaN for all but the home, and for all if too little of it is marked.
    """
    everything, count = np.arange(len(examples.target)), len(description.classes)
    if marked.sum() < _FEWEST_SEGMENTS:
        return np.full((len(everything), count), np.nan)
    parts = [home[part] for part in _parts(marked)]
    folds = [(np.setdiff1d(everything, part), part) for part in parts]
    [decisions] = cross_validate([method], examples, count, folds, ignore_progress)
    bias = np.array([description.decision_bias.get(name, 0.0) for name in description.classes])
    return decisions + bias


def _parts(marked: Bool) -> list[Indices]:
    """Divide the segments of a home into parts, each with its share of the marked ones."""
    of_marks, others = (np.array_split(np.flatnonzero(same), _FOLDS) for same in (marked, ~marked))
    return [np.concatenate(pair) for pair in zip(of_marks, others, strict=True)]


def _temperature_here(
    left_out: Float64, examples: Examples, home: Indices, description: Description
) -> float:
    """Return the inverse temperature of a model adapted to a home, by parts of it left out.

    Marks alone, of what was hard, would make it unsure of all the rest.
    """
    before = description.base_inverse_temperature or description.inverse_temperature
    tried = home[np.isfinite(left_out[home]).all(axis=1)]
    return home_temperature(left_out[tried], examples.target[tried], before)


def _is_confirmed(home: Dataset) -> Bool:
    names = np.array(home.collection_names)
    confirmed: Bool = names[home.collection] == CONFIRMED
    return confirmed


def _confirmed(home: Dataset) -> dict[str, int]:
    """Count the segments of each class that are as they were labelled."""
    counts = np.bincount(home.target[_is_confirmed(home)], minlength=len(home.classes))
    return {name: int(count) for name, count in zip(home.classes, counts, strict=True) if count}
