"""Which cost and gamma tell segments apart best."""

from itertools import product
from typing import NamedTuple

from hearthlog.analyzer.dataset import Dataset, Progress
from hearthlog.analyzer.evaluation.folds import Kind, divide
from hearthlog.analyzer.evaluation.scores import Scores, score
from hearthlog.analyzer.recipe import Recipe, cross_validate, prepare
from hearthlog.analyzer.train import check_varied

_COST_TIMES = (0.25, 1.0, 4.0)
_GAMMA_TIMES = (0.5, 1.0, 2.0)


class Tried(NamedTuple):
    """A recipe and how good it was on segments that it had not learned from."""

    recipe: Recipe
    scores: Scores


def around(recipe: Recipe) -> list[Recipe]:
    """Return recipes with less, as much and more cost and gamma."""
    return [
        recipe._replace(cost=recipe.cost * cost, gamma=recipe.gamma * gamma)
        for cost, gamma in product(_COST_TIMES, _GAMMA_TIMES)
    ]


def search(data: Dataset, recipes: list[Recipe], kind: Kind, progress: Progress) -> list[Tried]:
    """Cross-validate recipes that differ in cost and gamma, all on the same folds.

    Parameters
    ----------
    data : Dataset
    recipes : list of Recipe
    kind : str
        What is never on both sides of a fold: see `analyzer.evaluation.folds.evaluate_recipe`.
    progress : callable
        Told how many fits of how many are done.

    Returns
    -------
    list of Tried
        The best macro F1 first. It is optimistic, since the same folds chose it.

    Raises
    ------
    DataError
        If there are too few sources or collections.
    """
    check_varied(data)
    folds, examples = divide(data, kind), prepare(recipes[0], data)
    decisions = cross_validate(recipes, examples, len(data.classes), folds, progress)
    tried = [
        Tried(recipe, score(data.target, decided.argmax(axis=1), data.group, data.classes))
        for recipe, decided in zip(recipes, decisions, strict=True)
    ]
    return sorted(tried, key=lambda one: -one.scores.macro_f1)
