"""Cross-validated scores of a training method."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from sklearn.model_selection import LeaveOneGroupOut, StratifiedKFold

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.calibration import (
    Fold,
    cross_validate,
    inverse_temperature,
    nested_probabilities,
    softmax,
)
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.heads import Tried, best_mix, can_learn_heads, head_inputs_of
from hearthlog.analyzer.training.method import Method, prepare
from hearthlog.analyzer.training.scores import Bin, Scores, calibration_error, reliability, score
from hearthlog.analyzer.training.train import MOST_FOLDS, check_varied, group_folds
from hearthlog.models.classes import UNKNOWN
from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.errors import Progress

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
