"""Which parameters of a method tell segments apart best.

Run by `python -m hearthlog.tools.lab.grid_search`.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, NamedTuple

import typer

from hearthlog.analyzer.training.calibration import cross_validate
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.method import Method, prepare
from hearthlog.analyzer.training.scores import Scores, score
from hearthlog.analyzer.training.train import DEFAULT, Kind, check_varied, divide
from hearthlog.schemas.errors import Progress
from hearthlog.tools.cli.evaluate import Folds, ScenarioOption, end_with_left_out, learning
from hearthlog.tools.cli.options import Clips, Json, Scheduler, chosen_method
from hearthlog.tools.cli.tables import between
from hearthlog.tools.cli.terminal import print_json, print_table, wrong_use
from hearthlog.tools.lab.command import run

OfFeatures = Annotated[
    str | None, typer.Argument(help="How to learn, by features alone.", show_default="room")
]


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


def main(
    method: OfFeatures = None,
    *,
    data: Clips,
    scenario: ScenarioOption,
    folds: Folds = "source",
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Cross-validate a way to learn with other costs and gammas, and list the best first."""
    method = by_features(method, "its classifier has the costs and gammas of room")
    with learning(method, data, scenario, scheduler) as (chosen, segments, progress):
        tried = search(segments, chosen.variations(), folds, progress)
    if as_json:
        rows = [one.method.parameters | asdict(one.scores) for one in tried]
        print_json({"scenario": scenario, "method": chosen.name, "by": folds, "tried": rows})
        end_with_left_out(segments.left_out)
        return
    print(
        f"method {chosen.name}, scenario {scenario}: {len(segments)} segments of "
        f"{chosen.features.window_seconds:g} s, folds by {folds}\n"
    )
    print_search(tried)
    best = tried[0].method.parameters
    options = "".join(f" --{name} {value:g}" for name, value in best.items())
    print(f"\nhearthlog train --method {chosen.name}{options} …")
    end_with_left_out(segments.left_out)


def by_features(name: str | None, why: str) -> str:
    """Return the name of a method of features alone, by default the best; refuse others."""
    if name is not None and chosen_method(name).network:
        wrong_use(f"{name}: only methods of features alone are tried so, such as room; {why}")
    return name or DEFAULT.name


def print_search(tried: Sequence[GridPoint]) -> None:
    """Print the scores of each method that was tried."""
    rows = [
        (
            *(f"{value:g}" for value in method.parameters.values()),
            f"{scores.macro_f1:.3f}",
            between(scores.macro_f1_interval),
        )
        for method, scores in tried
    ]
    print_table((*tried[0].method.parameters, "macro F1", "95 %"), rows, words=0)


if __name__ == "__main__":
    run(main)
