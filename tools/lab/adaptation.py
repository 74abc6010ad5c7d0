"""`python -m hearthlog.tools.lab.adaptation HOME --model FILE`: what marks of wrong sounds teach.

Of a composed home (`python -m hearthlog.tools.lab.home`, labelled by the model) a person corrects
the first half: the first sounds that are labelled wrongly get their label, silence is never
marked. The model is adapted as `train --home` does it, and labels the last quarter, which it never
heard.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.logs.labelling import Labelling, find_labellings
from hearthlog.analyzer.logs.layers import find_coverage
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan
from hearthlog.analyzer.promotion.recent_time import RecentLog, recent_logs
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.home.person import Person, read_truth, write_review
from hearthlog.tools.lab.labelling import label_logs
from hearthlog.tools.lab.quarter_scores import scored

_DAY = 86_400 * NANOSECONDS
_RIGHT = 0.3  # F1 of a class that was right before
MARKS = ((10, 0.0), (30, 0.0), (60, 0.0), (200, 0.0), (60, 0.2))  # how many, and wrong ones


class Outcome(NamedTuple):
    """What came of some marks.

    Attributes
    ----------
    marks : int
    wrong : float
        Share of them that has a label drawn at random.
    before, after : dict of str to float
        F1 of the frames of each class that occurs in what was scored.
    false_before, false_after : float
        False events in 24 hours.
    """

    marks: int
    wrong: float
    before: dict[str, float]
    after: dict[str, float]
    false_before: float
    false_after: float

    @property
    def worst(self) -> tuple[str, float, float]:
        """The class that loses most, of those that were right before, and its F1."""
        right = [name for name, f1 in self.before.items() if f1 >= _RIGHT]
        name = min(right, key=lambda name: self.after[name] - self.before[name])
        return name, self.before[name], self.after[name]


def adaptation(
    home: Path, model: Path, marks: Sequence[tuple[int, float]] = MARKS
) -> Iterator[Outcome]:
    """Correct the first half of a home, learn, and score its last quarter.

    Parameters
    ----------
    home : Path
        Composed, of four logs or more, labelled by the model.
    model : Path
    marks : sequence of (int, float)
        How many sounds are marked, and the share that is marked wrongly.

    Yields
    ------
    Outcome

    Raises
    ------
    HearthlogError
        If logs or the model cannot be read, or there is nothing to learn.
    OSError
        If there is no truth.
    """
    base, logs = load_model(model), recent_logs([home / "logs"])
    truth = read_truth(home, logs[0].start // _DAY * _DAY)
    early, late = logs[: len(logs) * 3 // 4], logs[len(logs) * 3 // 4 :]
    end = logs[len(logs) // 2].start
    wrong = wrong_sounds(early, truth, end)
    adapted = [_learned(base, early, _drawn(wrong, base, n, w)) for n, w in marks]
    labelled = label_logs([base, *adapted], [log.path for log in late])
    before, *after = [scored(truth, one) for one in labelled]
    known = [name for name in base.classes if name != UNKNOWN]
    for (count, share), one in zip(marks, after, strict=True):
        false = (sum(each.false_events.values()) for each in (before, one))
        yield Outcome(min(count, len(wrong)), share, before.f1(known), one.f1(known), *false)


def wrong_sounds(
    logs: Sequence[RecentLog], truth: Labelling, end: int, *, unsure: bool = False
) -> list[Mark]:
    """Return marks of the sounds that a recorder labelled wrongly, in the order of time.

    Parameters
    ----------
    logs : sequence of RecentLog
        Of one microphone.
    truth : Labelling
    end : int
        In nanoseconds of UTC; what is later is left out.
    unsure : bool, optional
        Whether what has no class is marked as unknown.

    Returns
    -------
    list of Mark
        As a person sets them; none of silence.
    """
    sources = find_labellings(*[log.path for log in logs])
    microphone = sources.microphone(None)
    labelled = sources.read(microphone, LIVE).labelling
    rng = np.random.default_rng(0)  # draws nothing: this person is never wrong
    corrected = Person(truth).corrections(logs[0].start, end, labelled, rng)
    unmarked = {SILENCE} if unsure else {SILENCE, UNKNOWN}
    return [Mark(microphone, *one) for one in corrected if class_name(one[2]) not in unmarked]


def _drawn(marks: Sequence[Mark], base: Model, count: int, wrong: float) -> list[Mark]:
    """Return the first marks, some of them with another label."""
    rng = np.random.default_rng(count)
    names = [name for name in base.classes if name not in {SILENCE, UNKNOWN}]
    return [
        mark._replace(label=str(rng.choice(names))) if rng.random() < wrong else mark
        for mark in marks[:count]
    ]


def _learned(base: Model, logs: Sequence[RecentLog], marks: Sequence[Mark]) -> Model:
    """Adapt a model as `train --home` does, to marks and the time up to the last one."""
    with tempfile.TemporaryDirectory(prefix="hearthlog-adaptation-") as place:
        folder = Path(place)
        for log in logs:
            (folder / log.path.name).symlink_to(log.path.resolve())
        if marks:
            name = marks[0].microphone
            reviewed = ReviewedSpan(name, logs[0].start, marks[-1].end)
            write_review(find_coverage(folder)[name], marks, reviewed)
        return adapt_model(base, read_home_training_set([folder], base).segments)


def line_of(outcome: Outcome) -> str:
    """Return a row of the table.

    Parameters
    ----------
    outcome : Outcome
    """
    before, after = (np.mean(list(f1.values())) for f1 in (outcome.before, outcome.after))
    silence, still = (f1.get(SILENCE, 0.0) for f1 in (outcome.before, outcome.after))
    name, was, now = outcome.worst
    return (
        f"{outcome.marks:5} {outcome.wrong:5.0%}  {before:.3f} {after:.3f}  "
        f"{silence:.4f} {still - silence:+.4f}  "
        f"{outcome.false_before:5.0f} {outcome.false_after:5.0f}  {name} {was:.3f} {now - was:+.3f}"
    )


def main(
    home: Annotated[Path, typer.Argument(help="That was composed, of two days or more.")],
    model: Annotated[Path, typer.Option(help="That labelled it.")],
) -> None:
    """Print the macro F1 before and after marks, silence, false events in 24 h, the worst class."""
    print("marks wrong  macro  after  silence        false after  worst class that was right")
    for outcome in adaptation(home, model):
        print(line_of(outcome), flush=True)


if __name__ == "__main__":
    run(main)
