"""Text of a model's promotion: changes in a home, verdict, and trial."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hearthlog.analyzer.promotion.comparison import Trial, gain_interval
from hearthlog.analyzer.promotion.paired_labels import time_words
from hearthlog.schemas.errors import printable
from hearthlog.tools.cli.terminal import print_notice, print_table

if TYPE_CHECKING:
    from hearthlog.analyzer.promotion import Verdict
    from hearthlog.analyzer.promotion.comparison import HomeComparison, PairedAccuracy
    from hearthlog.analyzer.promotion.paired_labels import LabelChanges
    from hearthlog.models.registry import Judgement


_SHOWN = 8  # changes listed


def print_changes(changes: "LabelChanges", before: str, after: str) -> None:
    """Print the longest changes, and the minutes of each class."""
    for change in changes.pairs()[:_SHOWN]:
        print(f"  {change}")
    rows = [
        (name, time_words(first), time_words(second))
        for name, first, second in zip(changes.classes, changes.before, changes.after, strict=True)
        if first or second
    ]
    print()
    print_table((changes.each.strip() or "in all", before, after), rows)


_COMPLETE_DAY = 0.95 * 24 * 60  # minutes


def print_verdict(verdict: "Verdict", home: Sequence[Path], model: str) -> None:
    """Print what would change, how to listen to the changes, and the evidence."""
    evidence = verdict.evidence
    if evidence is None:
        return
    for loss in evidence.losses[:1]:
        more = f" (and {len(evidence.losses) - 1} more)" if len(evidence.losses) > 1 else ""
        print_notice(f"not heard: {loss}{more}")
    if not evidence.minutes:
        return
    _print_changes(evidence, verdict.model, verdict.champion)
    if evidence.changes.pairs():
        command = shlex.join(["hearthlog", "review", *map(str, home), "--queue", model])
        print(printable(f"listen to the changes: `{command}`"))
    models = verdict.model, verdict.champion
    _print_right("sounds of the minutes that were drawn at random", evidence.random, *models)
    _print_right("silences of these minutes", evidence.quiet, *models)
    _print_right("other marked sounds that it was not trained on", evidence.marks, *models)
    if not evidence.random.sounds + evidence.quiet.sounds:
        print(
            "no randomly drawn minutes of this home are reviewed, so wrong marks go unnoticed; "
            "`hearthlog review logs --queue` offers some"
        )


def refusal(judgement: "Judgement", name: str) -> str:
    """Return a line on why a model may not label, and how to override."""
    return (
        f"{name} refused: {'; '.join(judgement.reasons)}; `hearthlog models promote {name} "
        "--anyway` promotes it all the same"
    )


def _print_changes(evidence: "HomeComparison", model: str, champion: str) -> None:
    changes = evidence.changes
    much, end = ("", ":") if changes.pairs() else (f" less than half a minute{changes.each}", "")
    period = "" if changes.each else f" of the {time_words(evidence.recorded)} recorded"
    day = changes.minutes.sum()
    mean = f" (a day: the {time_words(day)} that a mean day with logs has)"
    end = (mean if changes.each and day < _COMPLETE_DAY else "") + end
    print(
        f"\n{model} in place of {champion} would change{much}{period}, judged by "
        f"{time_words(evidence.minutes)} of the last two weeks that it was not trained on{end}"
    )
    print_changes(changes, champion, model)


def _print_right(what: str, right: "PairedAccuracy", model: str, champion: str) -> None:
    if right.sounds:
        count = f"of {right.sounds} {what} {model} is right about {right.after}"
        print(printable(f"{count}, {champion} about {right.before}"))


def trial_as_json(trial: Trial) -> dict[str, Any]:
    """Return a trial as a JSON object."""
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
        "verdict": _trial_verdict(trial),
    }


def print_trial(trial: Trial) -> None:
    """Print how two models on trial differ, and which is correct more often."""
    models = f"{trial.candidate}, a candidate, beside {trial.champion}"
    print(printable(f"{models}: {time_words(trial.minutes)} in which both labelled"))
    print_changes(trial.changes, trial.champion, trial.candidate)
    print()
    both = trial.candidate, trial.champion
    _print_right("sounds of minutes drawn at random", trial.random, *both)
    _print_right("silences of minutes drawn at random", trial.quiet, *both)
    others = "other marked sounds (marks are where the champion was wrong)"
    _print_right(others, trial.marks, *both)
    print(printable(_trial_verdict(trial)))


def _trial_verdict(trial: Trial) -> str:
    random, name = trial.random.combined_with(trial.quiet), trial.candidate
    if not random.sounds:
        return (
            "no randomly drawn minutes were reviewed since, so neither can be called better; "
            "`hearthlog review logs --queue` offers some"
        )
    low, high = gain_interval(random)
    where = f"right where {trial.champion} is not {random.gained} times, the reverse {random.lost}"
    if low > 0.5:
        return f"{name} is better: {where}; `hearthlog models promote {name}` makes it champion"
    if high < 0.5:
        return f"{name} is worse: {where}"
    return f"no clear difference: {where}"
