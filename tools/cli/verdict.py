"""What a model would change in a home, and whether it may label there, in lines."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hearthlog.schemas.errors import printable
from hearthlog.tools.cli.changes_table import print_changes
from hearthlog.tools.cli.text import tell

if TYPE_CHECKING:
    from hearthlog.analyzer.gate.comparison import HomeComparison, PairedAccuracy
    from hearthlog.analyzer.gate.promotion_check import Verdict
    from hearthlog.models.modelfile.registry import Judgement

_WHOLE_DAY = 0.95 * 24 * 60  # minutes


def print_verdict(verdict: "Verdict", home: Sequence[Path], model: str) -> None:
    """Print what would change, how to hear that, and on what it is seen."""
    evidence = verdict.evidence
    if evidence is None:
        return
    for loss in evidence.losses[:1]:
        more = f" (and {len(evidence.losses) - 1} more)" if len(evidence.losses) > 1 else ""
        tell(f"not heard: {loss}{more}")
    if not evidence.minutes:
        return
    _print_changes(evidence, verdict.model, verdict.champion)
    if evidence.changes.pairs():
        command = shlex.join(["hearthlog", "review", *map(str, home), "--queue", model])
        print(printable(f"hear what changes: `{command}`"))
    _print_right("sounds of the minutes that were drawn at random", evidence.random, verdict)
    _print_right("silences of these minutes", evidence.quiet, verdict)
    _print_right("other sounds that were marked and not learned from", evidence.marks, verdict)
    if not evidence.random.sounds + evidence.quiet.sounds:
        print(
            "no minutes of this home that were drawn at random are reviewed: wrong marks cannot be "
            "seen; `hearthlog review logs --queue` asks for some"
        )


def refusal(judgement: "Judgement", name: str) -> str:
    """Say in a line why a model may not label, and how to insist."""
    return (
        f"{name} refused: {'; '.join(judgement.reasons)}; "
        f"`hearthlog models promote {name} --anyway` lets it label all the same"
    )


def _print_changes(evidence: "HomeComparison", model: str, champion: str) -> None:
    from hearthlog.analyzer.gate.paired_labels import time_words

    changes = evidence.changes
    much, end = ("", ":") if changes.pairs() else (f" less than half a minute{changes.each}", "")
    whole = "" if changes.each else f" of the {time_words(evidence.recorded)} recorded"
    day = changes.minutes.sum()
    mean = f" (a day: the {time_words(day)} that a mean day with logs has)"
    end = (mean if changes.each and day < _WHOLE_DAY else "") + end
    print(
        f"\n{model} in place of {champion} would change{much}{whole}, judged by "
        f"{time_words(evidence.minutes)} of the last two weeks that it has not learned from{end}"
    )
    print_changes(changes, champion, model)


def _print_right(what: str, right: "PairedAccuracy", verdict: "Verdict") -> None:
    if right.sounds:
        print(
            f"of {right.sounds} {what} {verdict.model} is right about {right.after}, "
            f"{verdict.champion} about {right.before}"
        )
