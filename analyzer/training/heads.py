"""Linear heads on embeddings, and their mixture with a classifier."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from sklearn.metrics import f1_score

from hearthlog.analyzer.training.calibration import Fold, inverse_temperature
from hearthlog.analyzer.training.dataset import Dataset, EmbeddingWindows, source_counts
from hearthlog.analyzer.training.manifest import BUILTIN
from hearthlog.models.classes import FLUSHING_WATER, OTHER, SILENCE, UNKNOWN
from hearthlog.models.classifiers.evidence import UNIT, UNTAUGHT, EmbeddingHeads, mixed, sounds_of
from hearthlog.models.classifiers.model import EmbeddingMix, NamesHead
from hearthlog.models.embedding import read_projection
from hearthlog.models.embedding.networks import NETWORKS
from hearthlog.schemas.arrays import Bool, Float64, Indices, Int32

_ALPHA = 30.0  # for standardised inputs, independent of the window count
_ROOT = 0.5  # exponent of a collection's window count in its weight
_FEWEST_COLLECTIONS = 3
_PARTS = 5  # folds of the sources, with fewer collections
FEWEST_SOURCES = 3  # of a class; other heads and names handle smaller classes
_LARGEST = 2**31 - 1
_STEPS = 200  # of a regression


class LinearHeads(NamedTuple):
    """Linear heads as stored in a model."""

    weights: Int32  # [shape=(H, W, C)], in `hearthlog.models.classifiers.evidence.UNIT`
    bias: Int32  # [shape=(H, C)]


def learn_heads(
    windows: EmbeddingWindows,
    classes: Sequence[str],
    inputs: Sequence[slice],
    seen: Bool | None = None,
) -> LinearHeads:
    """Fit heads on `seen` windows [shape=(m,)]; held-out collections give the temperature of each.

    Ridge regression suits classes of few sources: a logistic head separates nine coughs by any
    feature they share, ridge regression weights features by their variation over all windows.
    """
    sound = np.array([name != SILENCE for name in classes])[windows.target]
    chosen = sound if seen is None else sound & seen
    sources = source_counts(windows.target[chosen], windows.group[chosen], len(classes))
    rows = windows.rows(chosen & (sources >= FEWEST_SOURCES)[windows.target])
    width, count = windows.values.shape[1], len(classes)
    weights = np.zeros((len(inputs), width, count))
    bias = np.full((len(inputs), count), UNTAUGHT, np.int32)
    for number, columns in enumerate(inputs):
        values = rows.values[:, columns].astype(np.float64)
        if len(values):
            slopes, constants, learned = _calibrated(values, rows, count)
            weights[number, columns], bias[number, learned] = slopes, in_units(constants)
    return LinearHeads(in_units(weights), bias)


def regressed(  # noqa: PLR0913
    inputs: Float64, truth: Float64, weight: Float64, before: Float64, pull: Float64, *, free: bool
) -> tuple[Float64, Float64]:
    """Fit weights [shape=(d, C)] and biases [shape=(C,)] of a correction to decision values.

    This is multinomial logistic regression of `inputs` [shape=(n, d)]. `truth` [shape=(n, C)] has
    target probabilities, `weight` [shape=(n,)]; `before` [shape=(n, C)] has log probabilities
    before the correction, up to a constant; `pull` [shape=(C,)] regularises weights and biases to
    zero.
    """
    width, count = inputs.shape[1], before.shape[1]
    pulls = np.tile(pull, (width + 1, 1))
    if free:
        pulls[-1] = 0.0

    def loss(flat: Float64) -> tuple[float, Float64]:
        both = flat.reshape(width + 1, count)
        decisions = before + inputs @ both[:-1] + both[-1]
        decisions -= decisions.max(axis=1, keepdims=True)
        grown = np.exp(decisions)
        total = grown.sum(axis=1, keepdims=True)
        lost = -(weight @ (truth * (decisions - np.log(total)))).sum()
        wrong = weight[:, np.newaxis] * (grown / total - truth)
        slope = np.concatenate([inputs.T @ wrong, wrong.sum(axis=0, keepdims=True)])
        value = lost + (pulls * np.square(both)).sum() / 2
        return float(value), (slope + pulls * both).ravel()

    start = np.zeros((width + 1) * count)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": _STEPS})
    both = found.x.reshape(width + 1, count)
    return both[:-1], both[-1]


def scaler_of(windows: EmbeddingWindows, classes: Sequence[str]) -> Float64:
    """Return mean and standard deviation over windows with sound, shape (2, W)."""
    sound = np.array([name != SILENCE for name in classes])[windows.target]
    values = windows.values[sound].astype(np.float64)
    return np.stack([values.mean(axis=0), np.maximum(values.std(axis=0), 1.0)])


def in_units(values: Float64) -> Int32:
    """Round weights or biases to the integer units of a model."""
    steps = np.clip(np.rint(values / UNIT), -_LARGEST, _LARGEST)
    return steps.astype(np.int32)


def _calibrated(
    values: Float64, rows: EmbeddingWindows, count: int
) -> tuple[Float64, Float64, Indices]:
    """Fit one head; return its weights and biases, scaled by inverse temperature, and classes."""
    unit = rows.collection
    if len(np.unique(unit)) < _FEWEST_COLLECTIONS:
        unit = rows.group % _PARTS
    sums = _Sums(values, rows.target, rows.collection, unit)
    left_out = np.full((len(values), count), -np.inf)
    for one in np.unique(unit):
        weights, bias, learned = sums.ridge(sums.unit != one)
        own = unit == one
        left_out[np.ix_(own, learned)] = values[own] @ weights + bias
    usable = rows.tried & np.isfinite(left_out[np.arange(len(values)), rows.target])
    inverse = inverse_temperature(left_out[usable], rows.target[usable]) if usable.any() else 1.0
    weights, bias, learned = sums.ridge(np.ones(len(sums.unit), bool))
    slopes = np.zeros((values.shape[1], count))
    slopes[:, learned] = inverse * weights
    return slopes, inverse * bias, learned


class _Sums:
    """Sums of windows [shape=(m, d)] by class, collection and unit; each can be held out."""

    def __init__(
        self, values: Float64, target: Indices, collection: Indices, unit: Indices
    ) -> None:
        keys = np.stack([target, collection, unit], axis=1)
        distinct, row = np.unique(keys, axis=0, return_inverse=True)
        self.target, self.collection, self.unit = distinct.reshape(-1, 3).T
        parts = [values[row.ravel() == number] for number in range(len(distinct))]
        self._count = np.array([len(part) for part in parts], np.float64)
        width = values.shape[1]
        self._sum = np.array([part.sum(axis=0) for part in parts]).reshape(-1, width)
        self._gram = np.array([part.T @ part for part in parts]).reshape(-1, width, width)

    def ridge(self, kept: Bool) -> tuple[Float64, Float64, Indices]:
        """Fit ridge regression with equal class weights; return weights, biases, classes."""
        target, collection = self.target[kept], self.collection[kept]
        count, total, gram = self._count[kept], self._sum[kept], self._gram[kept]
        windows = count.sum()
        mean = total.sum(axis=0) / windows
        power = np.einsum("kii->i", gram) / windows
        scale = np.sqrt(np.maximum(power - mean**2, 0.0)) + 1e-6
        learned, number = np.unique(target, return_inverse=True)
        weight = self._weights(number, collection, count) * windows
        centre = (weight / count * total.T).sum(axis=1) / windows
        spread = np.tensordot(weight / count, gram, 1) - windows * np.outer(centre, centre)
        spread /= np.outer(scale, scale)
        own = np.zeros((len(learned), len(mean)))
        np.add.at(own, number, (weight / count)[:, np.newaxis] * total)
        each = windows / len(learned)
        toward = 2.0 * (own - each * centre) / scale
        spread[np.diag_indices(len(spread))] += _ALPHA
        weights = np.linalg.solve(spread, toward.T) / scale[:, np.newaxis]
        bias = 2.0 / len(learned) - 1.0 - centre @ weights
        return weights, bias, learned

    @staticmethod
    def _weights(number: Indices, collection: Indices, count: Float64) -> Float64:
        """Return weights of the sums with total 1: classes equal, collections by square root."""
        pairs, of_pair = np.unique(np.stack([number, collection]), axis=1, return_inverse=True)
        of_pair = of_pair.ravel()
        together = np.bincount(of_pair, count)
        root = together**_ROOT
        root /= np.bincount(pairs[0], root)[pairs[0]]
        return (root / together)[of_pair] * count / (number.max() + 1)


HEAD_WEIGHT = 1.0
MACHINE_WEIGHT = 0.75
_SUREST = 4.0  # maximum inverse temperature: without errors the sample was too small
_WEIGHT_NEXT_TO_HEADS = 0.5  # of names, next to both heads
_NAMES_WEIGHT, _NAMES_SLOPE = 1.25, 0.2  # of a step of a quarter of a logit
_NAMES_BIAS = {FLUSHING_WATER: 2.5, OTHER: 1.5}  # classes that names alone miss
_FOR_NAMES = 0.02  # F1: folds share recordists and rooms with the training set, not with names
_REJECTING_WEIGHT, _REJECTING_BIAS = 0.75, -0.8
_OF_GENERAL = frozenset(BUILTIN["general"].classes) - {SILENCE}


@dataclass(frozen=True)
class HeadInputs:
    """Values of an embedding that are the inputs of a model's linear heads."""

    network: str
    projection_sha256: str
    names: tuple[str, ...]
    inputs: tuple[slice, ...]

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups that the last head uses."""
        return self.names[self.inputs[-1]]


def head_inputs_of(network: str) -> HeadInputs:
    """Return the embedding values of a network that are the inputs of linear heads.

    Raise `ModelError` if the network is unknown, or its projection is damaged.
    """
    projection = read_projection(NETWORKS.get(network).projection)
    components = projection.components.shape[1]
    groups = projection.names.index("outside") + 1
    return HeadInputs(
        network,
        projection.sha256,
        projection.names,
        (slice(0, components), slice(components, groups)),
    )


def unseen_windows(data: Dataset, unseen: Indices) -> Bool:
    """Return which head windows must be excluded when segments are held out.

    Sources and collections are excluded if all their segments are held out.
    """
    seen = np.setdiff1d(np.arange(len(data)), unseen)
    lost = np.zeros(len(data.embedding_windows.target), bool)
    for of_segments, of_windows in (
        (data.group, data.embedding_windows.group),
        (data.collection, data.embedding_windows.collection),
    ):
        lost |= np.isin(of_windows, np.setdiff1d(of_segments[unseen], of_segments[seen]))
    return lost


def cross_validated_heads(
    data: Dataset, mix: EmbeddingMix, inputs: Sequence[slice], folds: Sequence[Fold]
) -> Float64:
    """Return the outputs of heads for held-out segments [shape=(n, C)].

    As from `EmbeddingHeads.log_probabilities`; NaN for segments without an embedding or fold.
    """
    by_heads = np.full((len(data), len(data.classes)), np.nan)
    for _, unseen in folds:
        seen = ~unseen_windows(data, unseen)
        learned = learn_heads(data.embedding_windows, data.classes, inputs, seen)
        heads = EmbeddingHeads(mix, *learned, data.classes)
        embedded = unseen[data.is_embedded[unseen]]
        by_heads[embedded] = heads.log_probabilities(data.embedded[embedded])
    return by_heads


def can_learn_heads(data: Dataset) -> bool:
    """Return whether heads can be trained: two classes of sound with enough sources each."""
    sources = _sources(data)[sounds_of(data.classes)]
    return int((sources >= FEWEST_SOURCES).sum()) > 1


class Tried(NamedTuple):
    """A cross-validation scheme and the held-out decisions of a classifier."""

    folds: Sequence[Fold]
    decisions: Float64  # [shape=(n, C)]; times the inverse temperature
    used: Bool  # [shape=(n,)]; segments for fitting the temperature of the mix


class Mixture(NamedTuple):
    """Fitted heads and temperature of the mix, with log probabilities of held-out segments."""

    mix: EmbeddingMix
    heads: LinearHeads
    of_sources: Float64  # [shape=(n, C)]; each fold uses the temperature of the others
    of_collections: Float64 | None  # [shape=(n, C)]; likewise


class BestMix(NamedTuple):
    """The best mix of heads, names and classifier."""

    mix: EmbeddingMix
    inputs: tuple[slice, ...]
    by_heads: list[Float64]  # of each scheme [shape=(n, C)], outputs of heads for segments
    # [shape=(n, C)]; log probabilities, with the temperature of other folds
    left_out: list[Float64]


def best_mix(data: Dataset, taken: HeadInputs, ways: Sequence[Tried]) -> BestMix:
    """Compare mixes of heads and classifier, with and without the class names of the network.

    Class names of the network detect sounds of no class of the scenario. Where the classes are a
    few sounds among all others, such as sounds of water, names can also replace the trained head
    for a class. The mix with the best score on held-out segments is chosen; a mix with such names
    may score slightly worse. `ways` has at least one.
    """
    single = _plain(taken, taken.inputs[:1])
    by_head = [
        [cross_validated_heads(data, single, [columns], way.folds) for way in ways]
        for columns in taken.inputs
    ]
    tried, scores = [], []
    for inputs, names, advantage in _candidates(data, taken):
        mix = _plain(taken, inputs)
        by_heads = [sum(each) for each in zip(*by_head[: len(inputs)], strict=True)]
        if names:
            mix = mix.model_copy(update={"names": names})
            of_names = _of_names_alone(data, mix)
            by_heads = [one + of_names for one in by_heads]
        left_out = [_nested(data, mix, way, one) for way, one in zip(ways, by_heads, strict=True)]
        tried.append(BestMix(mix, inputs, by_heads, left_out))
        scores.append(_right(data, left_out) + advantage)
    return tried[int(np.argmax(scores))]


def _candidates(
    data: Dataset, taken: HeadInputs
) -> Iterator[tuple[tuple[slice, ...], list[NamesHead], float]]:
    """Yield inputs of linear heads, names, and their advantage in score, of each mix to compare.

    A class of few sources cannot be scored without names.
    """
    rejecting = rejecting_head(taken, data.classes)
    names = names_head(taken, data.classes)
    by_rejecting = [] if rejecting is None else [rejecting]
    own = [n for n, name in enumerate(data.classes) if name not in {SILENCE, UNKNOWN}]
    if names is not None and (_sources(data)[own] < FEWEST_SOURCES).any():
        weighted = names.model_copy(update={"weight": _WEIGHT_NEXT_TO_HEADS})
        yield taken.inputs, [*by_rejecting, weighted], 0.0
    else:
        yield taken.inputs, [], 0.0
        if by_rejecting:
            yield taken.inputs, by_rejecting, 0.0
    if names is not None and OTHER in data.classes:
        yield taken.inputs[:1], [*by_rejecting, names], _FOR_NAMES


def _sources(data: Dataset) -> Indices:
    """Return the number of sources of the head windows by class."""
    windows = data.embedding_windows
    return source_counts(windows.target, windows.group, len(data.classes))


def learn_mixture(
    data: Dataset, taken: HeadInputs, sources: Tried, collections: Tried | None
) -> Mixture:
    """Fit heads and the temperature of their mix with a classifier.

    `collections` is None if there are too few collections.
    """
    ways = [sources] if collections is None else [sources, collections]
    best = best_mix(data, taken, ways)
    everything = np.ones(len(data), bool)
    inverse = _inverse_temperature(data, best.mix, ways[-1], best.by_heads[-1], everything)
    mix = best.mix.model_copy(update={"inverse_temperature": inverse})
    heads = learn_heads(data.embedding_windows, data.classes, best.inputs)
    return Mixture(mix, heads, best.left_out[0], None if collections is None else best.left_out[1])


def _plain(taken: HeadInputs, inputs: Sequence[slice]) -> EmbeddingMix:
    return EmbeddingMix(
        network=taken.network,
        projection_sha256=taken.projection_sha256,
        values=len(taken.names),
        head_weights=[HEAD_WEIGHT] * len(inputs),
        machine_weight=MACHINE_WEIGHT,
        inverse_temperature=1.0,
    )


def rejecting_head(taken: HeadInputs, classes: Sequence[str]) -> NamesHead | None:
    """Return the head that detects unknown sounds by the class names of a network.

    None without a class `unknown`, or if no other class has a name.
    """
    first, groups = taken.inputs[-1].start, taken.groups
    own = [name for name in classes if name not in {SILENCE, UNKNOWN}]
    named = {group for name in own for group in _groups_of(name)} & set(groups)
    others = set(groups) - named - {SILENCE}
    if UNKNOWN not in classes or not named or not others:
        return None
    inside = [first + number for number, group in enumerate(groups) if group in named]
    outside = [first + number for number, group in enumerate(groups) if group in others]
    return NamesHead(
        weight=_REJECTING_WEIGHT,
        slope=_NAMES_SLOPE,
        classes={**dict.fromkeys(own, inside), UNKNOWN: outside},
        bias={UNKNOWN: _REJECTING_BIAS},
    )


def names_head(taken: HeadInputs, classes: Sequence[str]) -> NamesHead | None:
    """Return the head of class names of a network; None if a class has no name."""
    first, groups = taken.inputs[-1].start, taken.groups
    named = {name: _groups_of(name) for name in classes if name != SILENCE}
    if len(named) < 2 or not all(one in groups for same in named.values() for one in same):
        return None
    numbers = {name: [first + groups.index(one) for one in same] for name, same in named.items()}
    bias = {name: value for name, value in _NAMES_BIAS.items() if name in numbers}
    return NamesHead(weight=_NAMES_WEIGHT, slope=_NAMES_SLOPE, classes=numbers, bias=bias)


def _groups_of(name: str) -> list[str]:
    """Return the groups of names for a class."""
    return {UNKNOWN: ["outside"], OTHER: sorted(_OF_GENERAL)}.get(name, [name])


def _of_names_alone(data: Dataset, mix: EmbeddingMix) -> Float64:
    """Return the outputs of names alone for all segments; names need no training."""
    by_heads = np.zeros((len(data), len(data.classes)))
    nothing = np.zeros((0, mix.values, len(data.classes)), np.int32)
    alone = mix.model_copy(update={"head_weights": []})
    heads = EmbeddingHeads(alone, nothing, nothing[:, 0], data.classes)
    if data.is_embedded.any():
        by_heads[data.is_embedded] = heads.log_probabilities(data.embedded[data.is_embedded])
    return by_heads


def _nested(data: Dataset, mix: EmbeddingMix, way: Tried, by_heads: Float64) -> Float64:
    """Mix held-out outputs; each fold uses the temperature of the other folds."""
    result = way.decisions - _log_sum(way.decisions)
    for _, unseen in way.folds:
        others = np.ones(len(data), bool)
        others[unseen] = False
        inverse = _inverse_temperature(data, mix, way, by_heads, others)
        embedded = unseen[~np.isnan(by_heads[unseen]).any(axis=1)]
        surer = mix.model_copy(update={"inverse_temperature": inverse})
        result[embedded] = mixed(way.decisions[embedded], by_heads[embedded], surer, data.classes)
    return result


def _inverse_temperature(
    data: Dataset, mix: EmbeddingMix, way: Tried, by_heads: Float64, chosen: Bool
) -> float:
    """Fit the inverse temperature of the mix on some of the segments."""
    sounds = sounds_of(data.classes)
    used = chosen & way.used & np.isin(data.target, sounds) & ~np.isnan(by_heads).any(axis=1)
    if not used.any():
        return 1.0
    plain = mix.model_copy(update={"inverse_temperature": 1.0})
    decisions = mixed(way.decisions[used], by_heads[used], plain, data.classes)[:, sounds]
    found = inverse_temperature(decisions, np.searchsorted(sounds, data.target[used]))
    return min(found, _SUREST)


def _right(data: Dataset, results: Sequence[Float64]) -> float:
    """Return the mean macro F1 over cross-validation schemes."""
    options: dict[str, Any] = {"average": "macro", "zero_division": 0}
    numbers, truth = np.unique(data.target), data.target
    scores = [f1_score(truth, one.argmax(axis=1), labels=numbers, **options) for one in results]
    return float(np.mean(scores))


def _log_sum(values: Float64) -> Float64:
    highest = values.max(axis=1, keepdims=True)
    return np.log(np.exp(values - highest).sum(axis=1, keepdims=True)) + highest
