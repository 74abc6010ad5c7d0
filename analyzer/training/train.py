"""Training of a model with an installed method, and the method's cross-validated scores."""

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any, Literal, get_args

import numpy as np
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support
from sklearn.model_selection import LeaveOneGroupOut, StratifiedGroupKFold, StratifiedKFold

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.calibration import (
    Fold,
    calibrate_elsewhere,
    collection_folds,
    cross_validate,
    inverse_temperature,
    nested_probabilities,
    scores_elsewhere,
    softmax,
    trained_elsewhere,
    unknown_bias,
)
from hearthlog.analyzer.training.clips import ClipEmbedder, network_embedder
from hearthlog.analyzer.training.dataset import Dataset, segment_digests
from hearthlog.analyzer.training.direction_samples import with_directions
from hearthlog.analyzer.training.heads import (
    Mixture,
    Tried,
    best_mix,
    can_learn_heads,
    head_inputs_of,
    learn_mixture,
    scaler_of,
)
from hearthlog.analyzer.training.manifest import Scenario
from hearthlog.analyzer.training.method import Learned, Method, prepare
from hearthlog.analyzer.training.scores import Bin, Scores, calibration_error, reliability, score
from hearthlog.analyzer.training.window_methods import (
    BANDS,
    EMBEDDING,
    PAPER,
    ROOM,
    ROOM21,
    SVM,
    network_method,
)
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name, find_class
from hearthlog.models.classifiers.model import (
    FORMAT,
    FORMAT_OF_EMBEDDINGS,
    MOST_SPANS,
    MOST_WEIGHT,
    ClassMetrics,
    Description,
    Metrics,
    Model,
    PublicCollection,
    Smoothing,
    TrainingData,
)
from hearthlog.models.embedding.networks import find_network
from hearthlog.models.extensions import Extensions
from hearthlog.models.features.installed import is_network
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64
from hearthlog.schemas.errors import Progress
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS

DEFAULT: Method = ROOM
_INSTALLED = [ROOM, EMBEDDING, ROOM21, BANDS, PAPER, SVM]
_METHODS = Extensions("hearthlog.methods", Method, "method", _INSTALLED, DataError)  # type: ignore[type-abstract]


def default_method() -> Method:
    """Return the best available method: with a network if one is installed."""
    runtime = find_spec("ai_edge_litert") is not None
    return EMBEDDING if runtime and find_network(EMBEDDING.network) is not None else DEFAULT


def clip_embedder(method: Method) -> ClipEmbedder | None:
    """Return the clip embedder of a method; None if the method uses no embeddings.

    Raise `ModelError` if the network is unknown, missing, a different file, or unusable.
    """
    return network_embedder(method.network, method.seed) if method.network else None


def method_named(name: str) -> Method:
    """Return a method by name.

    A name is `embedding`, `room`, `room21`, `bands`, `paper`, `svm`, the name of an entry point in
    the group `hearthlog.methods`, or the name of a network with a card.

    Raise `DataError` if no method has this name, or both a network and a method have it;
    `ModelError` if the entry point cannot be imported, or is no method of this name, or if the card
    is invalid.
    """
    if is_network(name):
        if _METHODS.has(name):
            raise DataError(f"{name} is a method, and a network: give its card another name")
        return network_method(name)
    return _METHODS.get(name)


LAG_SECONDS = 2.0  # equals the offline path on 90 minutes of real clips; 1 s does not
REACH_SECONDS = 0.3
SHORTEST_SECONDS = 0.25

_SOUND_AFTER_SOUND = 0.007  # relative to equally likely classes
_DURATION_SECONDS = 10.0  # of a class outside the table of classes


def default_transitions(classes: Sequence[str]) -> Float64:
    """Return transition probabilities [shape=(C, C)] of two or more classes from their durations.

    A value is for the column's class in the frame after a frame of the row's class. Durations are
    `expected_durations`. A sound is mostly followed by silence, if that is a class, and seldom by
    another sound: most changes from one sound to another are errors within one of them.
    """
    leave = 1.0 / np.maximum(expected_durations(classes) / FRAME_SECONDS, 1.0)
    is_sound = np.array([class_name(name) != SILENCE for name in classes])
    following = np.where(np.outer(is_sound, is_sound), _SOUND_AFTER_SOUND, 1.0)
    np.fill_diagonal(following, 0.0)
    transitions: Float64 = following * (leave / following.sum(axis=1))[:, np.newaxis]
    np.fill_diagonal(transitions, 1.0 - leave)
    return transitions


def expected_durations(classes: Sequence[str]) -> Float64:
    """Return durations in seconds; a class outside `hearthlog.models.classes` lasts 10 s."""
    rows = map(find_class, classes)
    return np.array([_DURATION_SECONDS if row is None else row.seconds for row in rows])


_MERGED_WITHIN = 60 * NANOSECONDS


def merged_spans(spans: Int64) -> list[list[int]]:
    """Merge spans [shape=(n, 2)], in any order, that are less than a minute apart (in ns of UTC).

    The nearest spans are merged too if a description cannot hold all of them.
    """
    if not len(spans):
        return []
    ordered = spans[np.argsort(spans[:, 0], kind="stable")]
    ends = np.maximum.accumulate(ordered[:, 1])
    apart = ordered[1:, 0] - ends[:-1]
    widest = np.argsort(-apart, kind="stable")[: MOST_SPANS - 1]
    breaks = np.sort(widest[apart[widest] >= _MERGED_WITHIN])
    starts = ordered[np.concatenate([[0], breaks + 1]), 0]
    return np.stack([starts, ends[np.append(breaks, -1)]], axis=1).tolist()


MOST_FOLDS = 5
_SHUFFLES = 20


def train_model(  # noqa: PLR0913, PLR0917
    data: Dataset,
    scenario: Scenario,
    progress: Progress,
    method: Method = DEFAULT,
    smoothing: str = "hmm",
    others: tuple[Float32, Indices] | None = None,
) -> Model:
    """Train a model; calibrate and score it on folds that never split a source group.

    `progress` receives the completed share of the fits, 0 to 1. `smoothing` is `hmm` or `merge`, as
    in field `method` of `Smoothing`. `others` has inputs [shape=(k, width)] of further windows,
    always in the training set, and their classes, which may have segments of one source group, or
    none.

    Raise `DataError` if a class outside `others` comes from fewer than two source groups, if no
    division into folds leaves training data for every class, if all segments are equal, or if the
    method wants augmented copies and its feature set has none; `ModelError` if the feature set of
    the method is not installed.
    """
    check_varied(data)
    taught = frozenset() if others is None else frozenset(others[1].tolist())
    sources, collections = group_folds(data, taught), collection_folds(data, taught)
    examples, fits = prepare(method, data), len(sources) + len(collections) + 1
    if others is not None:
        inputs, target = others
        examples = examples._replace(
            more_inputs=np.concatenate([examples.more_inputs, inputs]),
            more_target=np.concatenate([examples.more_target, target]),
        )

    def decide(folds: list[Fold], before: int) -> Float64:
        def report(share: float) -> None:
            progress((before + share * len(folds)) / fits)

        return cross_validate([method], examples, len(data.classes), folds, report)[0]

    decisions = decide(sources, 0)
    bias = unknown_bias(decisions, data.target, data.classes)
    decisions += bias
    inverse, elsewhere = inverse_temperature(decisions, data.target), None
    left_out = None
    if collections:
        left_out = decide(collections, len(sources)) + bias
        inverse, elsewhere = calibrate_elsewhere(left_out, data, collections)
    mixture, measured, sure = None, decisions, inverse
    if method.network and can_learn_heads(data):
        mixture = _mixture(data, method, inverse, (sources, decisions), (collections, left_out))
        measured, sure = mixture.of_sources, 1.0
        if mixture.of_collections is not None:
            probabilities = softmax(mixture.of_collections)
            tried = trained_elsewhere(data, collections)
            elsewhere = scores_elsewhere(probabilities, data, tried)
    learned = method.fit(examples)
    progress(1.0)
    model = Model(
        Description(
            **_method_fields(method, learned, data.classes, mixture),
            **_scenario_fields(scenario, data),
            calibration="temperature",
            inverse_temperature=inverse,
            decision_bias={
                name: float(value) for name, value in zip(data.classes, bias, strict=True) if value
            },
            novelty="doubt",
            elsewhere=elsewhere,
            smoothing=_smoothing(smoothing, method, sure, mixture),
            metrics=_metrics(data, measured, sure, len(sources)),
        ),
        learned.arrays(),
        transitions=(default_transitions(data.classes) if smoothing == "hmm" else np.empty((0, 0))),
        training_digests=segment_digests(data.windows),
    )
    if mixture is not None:
        model = replace(
            model,
            embedding_weights=mixture.heads.weights,
            embedding_bias=mixture.heads.bias,
            embedding_scaler=scaler_of(data.embedding_windows, data.classes),
        )
    return with_directions(model, data.target, data.sightings)


def check_varied(data: Dataset) -> None:
    """Raise `DataError` if there are segments and their features never change."""
    if len(data) and (np.ptp(data.windows.reshape(-1, data.windows.shape[2]), axis=0) == 0).all():
        raise DataError("all segments are alike: their features never change; is this sound?")


def group_folds(data: Dataset, taught: AbstractSet[int] = frozenset()) -> list[Fold]:
    """Divide the segments into up to five folds that never split a source group.

    Raise `DataError` if a class outside `others` comes from fewer than two groups, or no division
    leaves training data for every such class.
    """
    sources = [amount.sources for amount in data.amounts.values()]
    needed = [number for number in range(len(data.classes)) if number not in taught]
    fewest = min(needed, key=sources.__getitem__)
    if sources[fewest] < 2:
        raise DataError(
            f"class {data.classes[fewest]} has {sources[fewest]} source group; it needs at least "
            f"2, better {MOST_FOLDS}, to be tested on recordings that were not learned from"
        )
    count = min(MOST_FOLDS, sources[fewest])
    for seed in range(_SHUFFLES):
        divider = StratifiedGroupKFold(count, shuffle=True, random_state=seed)
        folds = list(divider.split(data.target, data.target, data.group))
        if all(np.isin(needed, data.target[seen]).all() for seen, _ in folds):
            return folds
    raise DataError(
        f"class {data.classes[fewest]} has {sources[fewest]} source groups, shared with other "
        "classes: no division into folds leaves every class something to learn from; add sources"
    )


def _metrics(data: Dataset, decision: Float64, inverse: float, folds: int) -> Metrics:
    predicted = decision.argmax(axis=1)
    numbers = range(len(data.classes))
    precision, recall, f1, _ = precision_recall_fscore_support(
        data.target, predicted, labels=numbers, zero_division=0.0
    )
    confusion = confusion_matrix(data.target, predicted, labels=numbers)
    occurs = np.bincount(data.target, minlength=len(data.classes)) > 0
    scored = [number for number in numbers if data.classes[number] != UNKNOWN and occurs[number]]
    return Metrics(
        folds=folds,
        macro_f1=float(f1[scored].mean()),
        expected_calibration_error=calibration_error(softmax(inverse * decision), data.target),
        classes={
            name: ClassMetrics(
                precision=float(precision[i]), recall=float(recall[i]), f1=float(f1[i])
            )
            for i, name in enumerate(data.classes)
        },
        confusion=confusion.tolist(),
    )


def _mixture(
    data: Dataset,
    method: Method,
    inverse: float,
    sources: tuple[list[Fold], Float64],
    collections: tuple[list[Fold], Float64 | None],
) -> Mixture:
    """Train heads for a classifier, given its decision values for held-out segments."""
    folds, decisions = sources
    used = np.array([name != UNKNOWN for name in data.classes])[data.target]
    of_sources, of_collections = Tried(folds, inverse * decisions, used), None
    folds, left_out = collections
    if left_out is not None:
        of_collections = Tried(folds, inverse * left_out, trained_elsewhere(data, folds))
    return learn_mixture(data, head_inputs_of(method.network), of_sources, of_collections)


def _smoothing(name: str, method: Method, inverse: float, mixture: Mixture | None) -> Smoothing:
    if name == "merge":
        return Smoothing(method="merge")
    return Smoothing(
        method="hmm",
        lag_seconds=LAG_SECONDS,
        weight=min(method.observation_weight / inverse, MOST_WEIGHT),
        reach_seconds=REACH_SECONDS,
        shortest_seconds=SHORTEST_SECONDS,
        class_exponent=None if mixture is None else method.class_exponent,
    )


def _method_fields(
    method: Method, learned: Learned, classes: Sequence[str], mixture: Mixture | None
) -> dict[str, Any]:
    features = method.features
    window = features.inputs[method.inputs].window_frames
    return {
        "format": FORMAT if mixture is None else FORMAT_OF_EMBEDDINGS,
        "embedding": None if mixture is None else mixture.mix,
        "kind": method.kind,
        "parameters": learned.parameters(),
        "method": method.name,
        "feature_set": features.name,
        "feature_set_version": features.version,
        "feature_set_sha256": features.digest,
        "feature_names": list(features.feature_names),
        "inputs": method.inputs,
        "window_seconds": window * FRAME_SECONDS,
        "label_frame": window // 2,
        "gate": method.gate if SILENCE in classes else 0.0,
        "copies": method.copies,
        "seed": method.seed,
        "versions": {name: version(name) for name in ("hearthlog", "numpy", *method.libraries)},
    }


def _scenario_fields(scenario: Scenario, data: Dataset) -> dict[str, Any]:
    return {
        "classes": list(data.classes),
        "scenario_name": scenario.name,
        "scenario": {name: list(labels) for name, labels in scenario.classes.items()},
        "training_data": TrainingData(
            sha256=data.digest,
            classes=data.amounts,
            home_spans=merged_spans(data.spans),
            collections=[
                PublicCollection(name=name, licence=licence, clips=clips)
                for (name, licence), clips in sorted(data.collections.items())
            ],
        ),
    }


Kind = Literal["segment", "source", "collection"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class CrossValidation:
    """Cross-validated scores."""

    folds: int
    scores: Scores
    expected_calibration_error: float
    reliability: list[Bin]


def evaluate_method(
    data: Dataset, method: Method, kind: Kind, progress: Progress
) -> CrossValidation:
    """Cross-validate a training method.

    The `kind` is the unit that is never on both sides of a fold: a `segment` (the paper's folds,
    optimistic since segments of one recording are alike), a `source`, or a `collection`, which is
    like a new home. `progress` receives the completed share of the folds, 0 to 1. Raise `DataError`
    if all segments are equal, if the method needs augmented copies and its feature set has none,
    and as for `divide`.
    """
    check_varied(data)
    folds = divide(data, kind)
    examples = prepare(method, data)
    [decisions] = cross_validate([method], examples, len(data.classes), folds, progress)
    probabilities = nested_probabilities(decisions, data.target, folds)
    if method.network and can_learn_heads(data):
        probabilities = _mixed(data, method, folds, decisions)
    return CrossValidation(
        len(folds),
        score(data.target, probabilities.argmax(axis=1), data.group, data.classes),
        calibration_error(probabilities, data.target),
        reliability(probabilities, data.target),
    )


def _mixed(data: Dataset, method: Method, folds: Sequence[Fold], decisions: Float64) -> Float64:
    """Return the probabilities of the mix of a classifier and heads."""
    inverse = inverse_temperature(decisions, data.target)
    used = np.array([name != UNKNOWN for name in data.classes])[data.target]
    way = Tried(folds, inverse * decisions, used)
    return softmax(best_mix(data, head_inputs_of(method.network), [way]).left_out[0])


def divide(data: Dataset, kind: Kind) -> list[Fold]:
    """Divide segments into folds of training and test segments.

    The `kind` is the unit that is never on both sides of a fold: a `segment`, a `source` or a
    `collection`. Raise `DataError` if a class has fewer than five segments (`segment`) or comes
    from fewer than two groups (`source`), if there is one collection (`collection`), or if a fold
    leaves too few classes to learn from.
    """
    if kind == "source":
        return group_folds(data)
    if kind == "segment":
        fewest, name = min((amount.segments, name) for name, amount in data.amounts.items())
        if fewest < MOST_FOLDS:
            raise DataError(f"class {name} has {fewest} segments; {MOST_FOLDS} folds need one each")
        divider = StratifiedKFold(MOST_FOLDS, shuffle=True, random_state=0)
        return list(divider.split(data.target, data.target))
    if len(data.collection_names) < 2:
        raise DataError(
            "all recordings are of one collection (column source of the manifest): there is none "
            "to learn from when it is left out"
        )
    folds = list(LeaveOneGroupOut().split(data.target, data.target, data.collection))
    for seen, unseen in folds:
        if data.target[seen].min() == data.target[seen].max():
            name = data.collection_names[data.collection[unseen[0]]]
            raise DataError(f"without collection {name} there is one class left to learn from")
    return folds
