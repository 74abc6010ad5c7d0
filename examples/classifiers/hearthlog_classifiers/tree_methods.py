"""Methods that learn many trees: a random forest, extremely randomised trees, gradient boosting."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import (
    ExtraTreesClassifier,
    GradientBoostingClassifier,
    RandomForestClassifier,
)

from hearthlog.analyzer.training.window_methods import WindowMethod, as_room, balanced
from hearthlog.models.classifiers import Machine
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog_classifiers.trees import TREES, TreesMachine


@dataclass(frozen=True)
class ForestMethod(WindowMethod):
    """A forest, whose trees vote.

    Attributes
    ----------
    forest : type
        Class of scikit-learn.
    trees : int
    levels : int
        Questions on the way to a leaf, at most.
    leaf_windows : int
        That a leaf holds at least.
    """

    forest: type[RandomForestClassifier | ExtraTreesClassifier] = RandomForestClassifier
    trees: int = 100
    levels: int = 20
    leaf_windows: int = 5

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Learn from windows, as of `WindowMethod.learn`."""
        forest = self.forest(
            self.trees,
            max_depth=self.levels,
            min_samples_leaf=self.leaf_windows,
            random_state=self.random_state,
        ).fit(inputs, target, balanced(target, weight))
        arrays = forest_arrays(forest)
        return TreesMachine(arrays), arrays, {}


@dataclass(frozen=True)
class BoostingMethod(WindowMethod):
    """Trees of which each adds to what those before it have not learned.

    Attributes
    ----------
    rounds : int
        Of which each adds a tree for each class.
    levels : int
        Questions on the way to a leaf.
    rate : float
        Share of its values that a tree adds.
    share : float
        Of the windows, drawn for each tree; it asks for the square root of the inputs in each node.
    """

    rounds: int = 60
    levels: int = 3
    rate: float = 0.1
    share: float = 0.5

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple[Machine, dict[str, NDArray[Any]], dict[str, Any]]:
        """Learn from windows, as of `WindowMethod.learn`."""
        boosted = GradientBoostingClassifier(
            n_estimators=self.rounds,
            max_depth=self.levels,
            learning_rate=self.rate,
            subsample=self.share,
            max_features="sqrt",
            init="zero",  # the classes weigh alike
            random_state=self.random_state,
        ).fit(inputs, target, balanced(target, weight))
        arrays = boosted_arrays(boosted)
        return TreesMachine(arrays), arrays, {}


def forest_arrays(
    forest: RandomForestClassifier | ExtraTreesClassifier,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of `hearthlog_classifiers.trees.TreesKind`.

    Parameters
    ----------
    forest : RandomForestClassifier or ExtraTreesClassifier
        Fitted.
    """
    trees = [one.tree_ for one in forest.estimators_]
    values = [tree.value[_leaves(tree), 0] for tree in trees]
    return _flattened(trees, values) | {"importances": forest.feature_importances_}


def boosted_arrays(boosted: GradientBoostingClassifier) -> dict[str, NDArray[Any]]:
    """Return the arrays of `hearthlog_classifiers.trees.TreesKind`.

    Parameters
    ----------
    boosted : GradientBoostingClassifier
        Fitted, with `init="zero"`.
    """
    classes = len(boosted.classes_)
    of_class = np.eye(classes) if classes > 2 else np.eye(2)[1:]  # one value tells two classes
    trees, values = [], []
    for a_round in boosted.estimators_:
        for column, one in zip(of_class, a_round, strict=True):
            trees.append(one.tree_)
            values.append(boosted.learning_rate * one.tree_.value[_leaves(one.tree_), 0] * column)
    return _flattened(trees, values) | {
        "importances": boosted.feature_importances_,
        "intercepts": np.zeros(classes),
    }


def _leaves(tree: Any) -> Indices:
    return np.flatnonzero(tree.children_left < 0)


def _flattened(trees: Sequence[Any], values: Iterable[Float64]) -> dict[str, NDArray[Any]]:
    """Put the nodes of trees one behind the other."""
    roots = np.cumsum([0, *(tree.node_count for tree in trees)])[:-1]
    children = [
        np.stack([tree.children_left, tree.children_right], axis=1) + root
        for tree, root in zip(trees, roots, strict=True)
    ]
    feature = np.concatenate([np.maximum(tree.feature, -1) for tree in trees])
    return {
        "roots": roots.astype(np.int32),
        "feature": feature.astype(np.int16),
        "threshold": _not_above(np.concatenate([tree.threshold for tree in trees])),
        "children": np.where(feature[:, np.newaxis] < 0, 0, np.concatenate(children)).astype(
            np.int32
        ),
        "values": np.concatenate(list(values)).astype(np.float32),
    }


def _not_above(thresholds: Float64) -> Float32:
    """Round down to single precision: inputs of single precision are divided as before."""
    nearest = thresholds.astype(np.float32)
    below: Float32 = np.where(
        nearest > thresholds, np.nextafter(nearest, np.float32(-np.inf)), nearest
    )
    return below


FOREST = ForestMethod("forest", **as_room(TREES))
EXTRA_TREES = ForestMethod("extra-trees", forest=ExtraTreesClassifier, **as_room(TREES))
BOOSTING = BoostingMethod("boosting", **as_room(TREES))
