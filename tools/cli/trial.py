"""A candidate on trial, in lines."""

from typing import Any

from hearthlog.analyzer.gate.comparison import Trial, gain_interval
from hearthlog.analyzer.gate.paired_labels import time_words
from hearthlog.schemas.errors import printable
from hearthlog.tools.cli.changes_table import print_changes


def trial_as_json(trial: Trial) -> dict[str, Any]:
    """Return a trial for a program."""
    changes = trial.changes
    return {
        "champion": trial.champion,
        "candidate": trial.candidate,
        "candidate_sha256": trial.candidate_sha256,
        "minutes": trial.minutes,
        "minutes_a_day": {
            name: [before, after]
            for name, before, after in zip(
                changes.classes, changes.before.tolist(), changes.after.tolist(), strict=True
            )
        },
        "changes": [change._asdict() for change in changes.pairs()],
        "random": trial.random._asdict(),
        "marks": trial.marks._asdict(),
        "quiet": trial.quiet._asdict(),
        "verdict": _verdict(trial),
    }


def print_trial(trial: Trial) -> None:
    """Print how two models that label at the same time differ, and which is more often right."""
    print(
        printable(
            f"{trial.candidate}, a candidate, beside {trial.champion}: "
            f"{time_words(trial.minutes)} in which both labelled"
        )
    )
    print_changes(trial.changes, trial.champion, trial.candidate)
    print()
    for what, right in (
        ("sounds of minutes drawn at random", trial.random),
        ("silences of minutes drawn at random", trial.quiet),
        ("other marked sounds (marks are where the champion was wrong)", trial.marks),
    ):
        if right.sounds:
            print(
                printable(
                    f"of {right.sounds} {what} {trial.candidate} is right about {right.after}, "
                    f"{trial.champion} about {right.before}"
                )
            )
    print(printable(_verdict(trial)))


def _verdict(trial: Trial) -> str:
    random, name = trial.random.plus(trial.quiet), trial.candidate
    if not random.sounds:
        return (
            "no minutes drawn at random are reviewed since: which is better cannot be told; "
            "`hearthlog review logs --queue` asks for some"
        )
    low, high = gain_interval(random)
    where = f"right where {trial.champion} is not {random.gained} times, the reverse {random.lost}"
    if low > 0.5:
        return f"{name} is better: {where}; `hearthlog models promote {name}` makes it champion"
    if high < 0.5:
        return f"{name} is worse: {where}"
    return f"no clear difference: {where}"
