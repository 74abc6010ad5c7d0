"""`python -m hearthlog.tools.lab.promotion HOME --model FILE`: which models a home lets speak.

Of a composed home (`python -m hearthlog.tools.lab.home`, labelled by the model) the first day is
learned from; minutes of the others are drawn at random and reviewed, all of it as it is true.
Models that have learned so, and models that are harmful in known ways, are judged; beside each
verdict stands how right the model is on other parts of those days, by their truth.
"""

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.logs.labelling import Labelling, find_labellings
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    intersection_rows,
    overlay,
    rows_at,
    single_span,
)
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.promotion import Verdict, judge
from hearthlog.analyzer.promotion.paired_labels import TwoModels, joined_frames
from hearthlog.analyzer.promotion.recent_time import (
    RecentLog,
    choose,
    recent_logs,
    sounding_time,
    unlearned_time,
)
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.models.classes import OTHER_NEGATIVE, SILENCE, UNKNOWN
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.schemas.arrays import Float64, Indices
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.home.person import read_truth

_DAY = 86_400 * NANOSECONDS
_MINUTE = 60 * NANOSECONDS
_LONGEST = 10 * NANOSECONDS  # of a mark
_SHORTEST = NANOSECONDS // 2
_MARKS = (30, 100)
_SEED_OF_GRADES = 1
_BETTER, _WORSE, _DEAF = 0.01, 0.02, 0.1  # of F1
_TRUTHS = "better", "same", "worse"
_SWAPS = (("speech", "music"), ("speech", "objects_activity"), ("objects_activity", SILENCE))


def gate(
    home: Annotated[Path, typer.Argument(help="Composed home of two days or more.")],
    model: Annotated[Path, typer.Option(help="That labelled it.")],
    minutes: Annotated[int, typer.Option(help="That are drawn at random.")] = 20,
    other: Annotated[
        list[Path] | None, typer.Option(help="Another model to judge; may be given again.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of what is drawn.")] = 0,
) -> None:
    """Judge models that have learned from a home, and harmful ones."""
    with tempfile.TemporaryDirectory(prefix="hearthlog-gate-") as place:
        folder, logs = Path(place) / "models", Path(place) / "logs"
        folder.mkdir()
        shutil.copytree(home / "logs", logs)
        shutil.copy(model, folder / "champion.safetensors")
        recent = recent_logs([logs])
        truth = read_truth(home, recent[0].start // _DAY * _DAY)
        _review_at_random(recent, truth, minutes, np.random.default_rng(seed))
        champion = load_model(model)
        counts: Counter[tuple[str, bool]] = Counter()
        models = chain(_candidates(champion, recent, truth, logs), map(load_model, other or []))
        for number, candidate in enumerate(models):
            path = folder / f"model-{number}.safetensors"
            save_model(candidate, path)
            verdict = judge(folder, load_model(path), [logs])
            grade = _grade(champion, candidate, recent, truth)
            counts[grade.truth, verdict.judgement.may_label] += 1
            print(_line(candidate.name, grade, verdict), flush=True)
    for what in _TRUTHS:
        refused, let = (counts[what, may_label] for may_label in (False, True))
        print(f"{what}: {refused} of {refused + let} refused")


class _Grade(NamedTuple):
    """F1 of frames by truth, macro and of silence: of the champion, and of another model."""

    before: tuple[float, float]
    after: tuple[float, float]

    @property
    def truth(self) -> str:
        macro, silence = (b - a for a, b in zip(self.before, self.after, strict=True))
        if macro < -_WORSE or silence < -_DEAF:
            return "worse"
        return "better" if macro > _BETTER and silence > -_WORSE else "same"


def _grade(champion: Model, model: Model, logs: Sequence[RecentLog], truth: Labelling) -> _Grade:
    """Score two models on parts of the days behind the first, other than those they are judged on.

    What is true and no class of the champion counts as unknown.
    """
    first = logs[0].start // _DAY * _DAY + _DAY
    later = [log for log in logs if log.start >= first]
    two = TwoModels(champion, model)
    parts = choose(unlearned_time(later, NONE), sounding_time(later), _SEED_OF_GRADES)
    frames = joined_frames([two.label(part) for part in parts])
    rows = rows_at(Spans(truth.starts, truth.ends), frames.stamps)
    names = list(dict.fromkeys([*champion.classes, UNKNOWN]))
    numbers = {name: i for i, name in enumerate(names)}
    true = np.array([numbers.get(_label(name), numbers[UNKNOWN]) for name in truth.labels])[rows]
    labels = np.array([numbers.get(name, numbers[UNKNOWN]) for name in two.classes])
    weight = np.where(rows < 0, 0.0, frames.weight)
    sides = (_f1(true, labels[side], weight, names) for side in (frames.before, frames.after))
    return _Grade(*sides)


def _f1(
    true: Indices, labelled: Indices, weight: Float64, names: Sequence[str]
) -> tuple[float, float]:
    """Return the macro F1 of the classes that occur, and the F1 of silence."""
    count = len(names)
    frames = np.bincount(true * count + labelled, weight, count * count).reshape(count, count)
    both = frames.sum(axis=0) + frames.sum(axis=1)
    f1 = 2 * np.diag(frames) / np.maximum(both, 1.0)
    return float(f1[frames.any(axis=1)].mean()), float(f1[names.index(SILENCE)])


def _line(name: str, grade: _Grade, verdict: Verdict) -> str:
    random = None if verdict.evidence is None else verdict.evidence.random
    right = "" if random is None else f"{random.after} of {random.sounds}, not {random.before}"
    verdict_text = "; ".join(verdict.judgement.reasons) or "may label"
    (macro, silence), (macro_now, silence_now) = grade
    f1 = f"{macro:.3f} -> {macro_now:.3f}, silence {silence:.3f} -> {silence_now:.3f}"
    return f"{name:32} {grade.truth:6} {f1}  {right:20} {verdict_text}"


def _review_at_random(
    logs: Sequence[RecentLog], truth: Labelling, minutes: int, rng: np.random.Generator
) -> None:
    """Draw minutes behind the first day, three of four with sound; mark what is true in them."""
    first = logs[0].start // _DAY * _DAY + _DAY
    starts = np.arange(first, logs[-1].end - _MINUTE, _MINUTE)
    sounds = Labelling(*(column[truth.labels != SILENCE] for column in vars(truth).values()))
    low = np.searchsorted(sounds.ends, starts, side="right")
    sounding = np.searchsorted(sounds.starts, starts + _MINUTE) > low
    quiet = minutes // 4
    drawn = [
        *rng.permutation(starts[sounding])[: minutes - quiet],
        *rng.permutation(starts[~sounding])[:quiet],
    ]
    for start in map(int, drawn):
        for log in logs:
            if log.start <= start and start + _MINUTE <= log.end:
                span = ReviewedSpan(_microphone(log), start, start + _MINUTE, chosen=RANDOM)
                write_marks(log.path, _marks(log, truth, start, start + _MINUTE), reviewed=[span])


def _marks(log: RecentLog, truth: Labelling, start: int, end: int) -> list[Mark]:
    inside, rows, _ = intersection_rows(truth, single_span(start, end))
    name = _microphone(log)
    return [
        Mark(name, int(a), int(b), _label(truth.labels[row]))
        for a, b, row in zip(inside.starts, inside.ends, rows, strict=True)
    ]


def _candidates(
    champion: Model, logs: Sequence[RecentLog], truth: Labelling, folder: Path
) -> Iterator[Model]:
    names = sorted({_label(label) for label in truth.labels} - {SILENCE})
    others = {name: names[(i + 1) % len(names)] for i, name in enumerate(names)}
    for count in _MARKS:
        right = _spread(logs, truth, count)
        yield replace(_learned(champion, right, folder), name=f"marks {count}")
        wrong = [mark._replace(label=others.get(mark.label, mark.label)) for mark in right]
        yield replace(_learned(champion, wrong, folder), name=f"shifted marks {count}")
    for pair in _SWAPS:
        if set(pair) <= set(champion.classes):
            other = dict([pair, pair[::-1]])
            yield _described(
                champion,
                f"swapped {' and '.join(pair)}",
                classes=[other.get(name, name) for name in champion.classes],
            )
    yield _described(champion, "deaf to silence", gate=0.0, decision_bias={SILENCE: -10.0})


def _described(model: Model, name: str, **changes: object) -> Model:
    description = model.description.model_copy(update=changes)
    return replace(model, name=name, description=description)


def _spread(logs: Sequence[RecentLog], truth: Labelling, count: int) -> list[Mark]:
    """Mark what the recorder labelled wrongly on the first day, and as much that it had right."""
    end = logs[0].start // _DAY * _DAY + _DAY
    first = [log for log in logs if log.end <= end]
    sources = find_labellings(*[log.path for log in first])
    labels = sources.read(sources.microphone(None), LIVE).labelling
    both = overlay([truth, labels]).in_all()
    true = np.array([_label(label) for label in truth.labels[both.rows[0]]], object)
    wrong = true != labels.labels[both.rows[1]]
    long = both.ends - both.starts >= _SHORTEST
    marks = []
    for which in (wrong & long, ~wrong & long):
        rows = np.flatnonzero(which)
        for i in rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)]:
            start = int(both.starts[i])
            stop = min(int(both.ends[i]), start + _LONGEST)
            marks.append(Mark(_microphone(first[0]), start, stop, true[i]))
    return marks


def _learned(base: Model, marks: Sequence[Mark], logs: Path) -> Model:
    """Adapt a model to marks, which are gone from the logs afterwards."""
    by_log = [
        (log, [mark for mark in marks if log.start <= mark.start and mark.end <= log.end])
        for log in recent_logs([logs])
    ]
    with tempfile.TemporaryDirectory(prefix="hearthlog-gate-") as place:
        for log, own in by_log:
            if own:
                copy = Path(place) / log.path.name
                shutil.copy(log.path, copy)
                write_marks(copy, own)
        return adapt_model(base, read_home_training_set([Path(place)], base).segments)


def _microphone(log: RecentLog) -> str:
    return find_labellings(log.path).microphone(None)


def _label(label: str) -> str:
    return UNKNOWN if label == OTHER_NEGATIVE else label


if __name__ == "__main__":
    run(gate)
