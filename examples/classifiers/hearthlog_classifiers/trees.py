"""Many decision trees: forests, whose trees vote, and boosted trees, whose values are added."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hearthlog.models.classifiers import (
    LEARNED,
    ClassifierKind,
    NoParameters,
    learned_shapes,
    target_problem,
)
from hearthlog.models.classifiers.model import Array, Model
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices, Int64
from hearthlog_classifiers.shares import log_shares

MOST_LEVELS = 64
_TREES_AT_ONCE = 64  # bounds memory
_SUM_ERROR = 1e-3  # of probabilities in single precision


class TreesKind(ClassifierKind):
    """Decision trees; the arrays for C classes.

    roots : [shape=(trees,)], int32
        The first node of each tree; its other nodes follow.
    feature : [shape=(nodes,)], int16
        Number of the input that a node asks for; -1 in a leaf.
    threshold : [shape=(nodes,)], float32
        An input up to this leads to the first child, a larger one to the second.
    children : [shape=(nodes, 2)], int32
        Nodes of the same tree behind their parent; anything in a leaf.
    values : [shape=(leaves, C)], float32
        Of the leaves, in the order of the nodes: probabilities of the classes, or, with
        intercepts, what is added to decision values.
    intercepts : [shape=(C,)], float64, optional
        Decision values of boosted trees before anything is added.
    importances : [shape=(width,)], float64
        How much each input decides, as scikit-learn's `feature_importances_`.
    learned_inputs, learned_target : optional
        As of `hearthlog.models.classifiers`.
    """

    name = "trees"
    parameters = NoParameters
    arrays: Mapping[str, np.dtype[Any]] = {
        "roots": np.dtype(np.int32),
        "feature": np.dtype(np.int16),
        "threshold": np.dtype(np.float32),
        "children": np.dtype(np.int32),
        "values": np.dtype(np.float32),
        "importances": np.dtype(np.float64),
    }
    optional: Mapping[str, np.dtype[Any]] = {"intercepts": np.dtype(np.float64), **LEARNED}

    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return shapes, as of `ClassifierKind.shapes`."""
        nodes = arrays["feature"].size
        shapes: dict[str, tuple[int, ...]] = {
            "roots": (arrays["roots"].size,),
            "feature": (nodes,),
            "threshold": (nodes,),
            "children": (nodes, 2),
            "values": (int(np.count_nonzero(arrays["feature"] < 0)), classes),
            "importances": (width,),
        }
        if "intercepts" in arrays:
            shapes["intercepts"] = (classes,)
        return shapes | learned_shapes(width, arrays)

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return what is wrong with the arrays, as of `ClassifierKind.problem`."""
        if not _are_in_order(arrays["roots"], len(arrays["feature"])):
            return "roots are not the first nodes of trees, in order"
        if (arrays["feature"] >= len(arrays["importances"])).any():
            return "feature has numbers of inputs that there are not"
        if not _stays_in_its_tree(arrays):
            return "children has nodes that are not behind their parent in the same tree"
        if levels(arrays) > MOST_LEVELS:
            return f"has a tree of more than {MOST_LEVELS} levels"
        if "intercepts" not in arrays and not _are_probabilities(arrays["values"]):
            return "the rows of values are no probabilities"
        return target_problem(classes, arrays, "learned_target")

    def machine(self, model: Model) -> "TreesMachine":
        """Prepare a model for inference."""
        return TreesMachine(model.arrays)

    def summary(self, model: Model) -> str:
        """Return the number of trees and leaves, in words."""
        return f"{len(model.arrays['roots'])} trees, {len(model.arrays['values'])} leaves"


TREES = TreesKind()


class TreesMachine:
    """Inference of one model, as scikit-learn's within 1e-5.

    Parameters
    ----------
    arrays : mapping of str to np.ndarray
        As of `TreesKind`.
    """

    def __init__(self, arrays: Mapping[str, Array]) -> None:
        is_leaf = arrays["feature"] < 0
        itself = np.arange(len(is_leaf))[:, np.newaxis]
        self._roots = arrays["roots"].astype(np.intp)
        self._feature = np.maximum(arrays["feature"], 0).astype(np.intp)
        self._threshold = arrays["threshold"]
        self._children = np.where(is_leaf[:, np.newaxis], itself, arrays["children"]).ravel()
        self._leaf = np.cumsum(is_leaf) - 1
        self._values = arrays["values"].astype(np.float64)
        self._intercepts = arrays.get("intercepts")
        self._levels = levels(arrays)

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return decision values, and NaN as novelty.

        Those of a forest are the logarithms of its mean probabilities (`log_shares`).
        """
        total = np.zeros((len(inputs), self._values.shape[1]))
        for start in range(0, len(self._roots), _TREES_AT_ONCE):
            leaves = self._leaves(inputs, self._roots[start : start + _TREES_AT_ONCE])
            total += self._values[leaves].sum(axis=1)
        if self._intercepts is None:
            decisions = log_shares(total / len(self._roots))
        else:
            decisions = total + self._intercepts
        return decisions, np.full(len(inputs), np.nan)

    def _leaves(self, inputs: Float32, roots: Indices) -> Indices:
        """Return the leaf of each row in each tree, shape (n, trees)."""
        starts = inputs.shape[1] * np.arange(len(inputs))[:, np.newaxis]
        values = inputs.ravel()
        nodes = np.broadcast_to(roots, (len(inputs), len(roots)))
        for _ in range(self._levels):
            is_larger = values[starts + self._feature[nodes]] > self._threshold[nodes]
            nodes = self._children[2 * nodes + is_larger]
        leaves: Indices = self._leaf[nodes]
        return leaves


def levels(arrays: Mapping[str, Array]) -> int:
    """Count the questions on the longest way from a root to a leaf, up to `MOST_LEVELS` + 1.

    Parameters
    ----------
    arrays : mapping of str to np.ndarray
        As of `TreesKind`; every child is behind its parent.
    """
    nodes, count = arrays["roots"], 0
    while count <= MOST_LEVELS:
        nodes = nodes[arrays["feature"][nodes] >= 0]
        if not len(nodes):
            break
        nodes = np.unique(arrays["children"][nodes])
        count += 1
    return count


def _are_in_order(roots: Array, nodes: int) -> bool:
    is_first = len(roots) and roots[0] == 0
    return bool(is_first and (roots[1:] > roots[:-1]).all() and roots[-1] < nodes)


def _stays_in_its_tree(arrays: Mapping[str, Array]) -> bool:
    roots, count = arrays["roots"], len(arrays["feature"])
    inner: Indices = np.flatnonzero(arrays["feature"] >= 0)
    ends: Int64 = np.append(roots[1:], count)[np.searchsorted(roots, inner, side="right") - 1]
    children = arrays["children"][inner]
    behind: Bool = (children > inner[:, np.newaxis]) & (children < ends[:, np.newaxis])
    return bool(behind.all())


def _are_probabilities(values: Float32) -> bool:
    sums = values.sum(axis=1, dtype=np.float64)
    return bool((values >= 0.0).all() and (np.abs(sums - 1.0) <= _SUM_ERROR).all())
