"""Which parameters of a method tell segments apart best."""

from typing import NamedTuple

from hearthlog.analyzer.evaluation.evaluate_method import Kind, divide
from hearthlog.analyzer.training.cross_validation import cross_validate
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.method import Method, prepare
from hearthlog.analyzer.training.scores import Scores, score
from hearthlog.analyzer.training.train import check_varied
from hearthlog.schemas.progress import Progress


class GridPoint(NamedTuple):
    """A method and how good it was on segments that it had not learned from."""

    method: Method
    scores: Scores


def search(data: Dataset, methods: list[Method], by: Kind, progress: Progress) -> list[GridPoint]:
    """Cross-validate methods that differ in their parameters, all on the same folds.

    Parameters
    ----------
    data : Dataset
    methods : list of Method
        At least one; all have the same feature set and make the same copies.
    by : str
        What is never on both sides of a fold: `segment`, `source` or `collection`.
    progress : callable
        Told the share of the fits that is done, 0 to 1.

    Returns
    -------
    list of GridPoint
        The best macro F1 first. It is optimistic, since the same folds chose it.

    Raises
    ------
    DataError
        If all segments are alike, if the methods want augmented copies and their feature set has
        none, and as `divide`.
    """
    check_varied(data)
    folds, examples = divide(data, by), prepare(methods[0], data)
    decisions = cross_validate(methods, examples, len(data.classes), folds, progress)
    tried = [
        GridPoint(method, score(data.target, decided.argmax(axis=1), data.group, data.classes))
        for method, decided in zip(methods, decisions, strict=True)
    ]
    return sorted(tried, key=lambda one: -one.scores.macro_f1)
