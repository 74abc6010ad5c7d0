"""Promotion check: a candidate against the champion of a home, and the rules for damage."""

import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.promotion.comparison import (
    HomeComparison,
    NamedSounds,
    PairedAccuracy,
    gather_evidence,
    right_at_random,
)
from hearthlog.analyzer.promotion.paired_labels import class_words, time_words
from hearthlog.analyzer.promotion.recent_time import RecentLog, recent_logs
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile import load_model
from hearthlog.models.registry import (
    CHAMPION,
    Judgement,
    find_model_by_sha256,
    load,
    read_judgement,
    write_judgement,
)
from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.errors import LogError, ModelError, Progress, ignore_progress

LEAST_MINUTES = 10.0  # minimum sound for a decision
_SILENCE_FALLS = 0.10  # of the time
_MUCH = 0.01  # of the time: minimum for a class to have a rule
_MUCH_OF_SOUND = 0.10  # of the time that is not silence
_KEPT = 0.75  # of the time in which the champion is sure
_SOUND_LEFT = 0.5  # of the time that is not silence
_MANY = 0.05  # of the time: limit for a class that grew manifold
_TIMES = 4.0
_CHANGED = 0.20  # of the time that is not silence
_CHANGED_MINUTES = 10.0
_SILENCE_OF_NEW = 0.5  # of the time of a new class
_ROOM = 0.5  # of the time: a larger new class is the room itself
_MANY_NAMED, _SEVERAL = 20, 3  # sounds and classes that show that marks are wrong
_BY_CHANCE = 0.1  # of the sounds: a model of eight classes that knows nothing is right about more
_MARKS_ALONE = 3  # marks that show a wrong class, if no sound of that class is known


def regressions(evidence: HomeComparison, champion: str) -> list[str]:
    """Return a sentence for each damage by a model, or one on too little sound for a decision."""
    if evidence.minutes < LEAST_MINUTES:
        loss = f" ({evidence.losses[0]})" if evidence.losses else ""
        missing = math.ceil(LEAST_MINUTES - evidence.minutes)
        text = (
            f"of the last two weeks only {time_words(evidence.minutes)} are recorded and not "
            f"learned from, and it takes {time_words(LEAST_MINUTES)} to judge it{loss}: record "
            f"{missing} more minute{'s' * (missing > 1)}, then promote it"
        )
        return [text]
    if _are_marks_wrong(evidence.named):
        named = evidence.named
        text = (
            f"of {named.sounds} sounds of the minutes that were drawn at random, {champion} gives "
            f"{named.right} the class that a person gave, fewer than by chance: the marks are "
            "wrong, perhaps all by one class; correct them in `hearthlog review`, then train again"
        )
        return [text]
    reasons = [*_silence_lost(evidence), *_not_better(evidence, champion)]
    right = evidence.random
    better = clearly_better(right.combined_with(evidence.quiet))
    if not (better and right.sounds and right.gained >= right.lost):  # silence alone is not enough
        reasons += [*_sure_lost(evidence, champion), *_out_of_proportion(evidence)]
        reasons += _swallowed(evidence, champion)
    return reasons


def _are_marks_wrong(named: NamedSounds) -> bool:
    """Return whether a person and a model agree on fewer sounds than by chance."""
    is_enough = named.sounds >= _MANY_NAMED and named.classes >= _SEVERAL
    return is_enough and named.right <= _BY_CHANCE * named.sounds


def clearly_better(right: PairedAccuracy) -> bool:
    """Return whether the second model labels significantly more sounds correctly."""
    return right.gained - right.lost > 2 * np.sqrt(right.gained + right.lost)


def is_worse(right: PairedAccuracy) -> bool:
    """Return whether the second model is worse by more than a standard error."""
    return bool(right.lost - right.gained > np.sqrt(right.gained + right.lost))


def less_right(right: PairedAccuracy, name: str) -> str:
    """Format the numbers of correct sounds of a model and the other, in minutes drawn at random."""
    return (
        f"of {right.sounds} sounds of the minutes that were drawn at random it is right about "
        f"{right.after}, {name} about {right.before}"
    )


def _silence_lost(evidence: HomeComparison) -> Iterator[str]:
    changes = evidence.changes
    if SILENCE in changes.classes:
        i = changes.classes.index(SILENCE)
        before, after = float(changes.before[i]), float(changes.after[i])
        if before - after > _SILENCE_FALLS * changes.minutes.sum():
            yield f"silence falls from {changes.words(before)} to {time_words(after)}"


def _not_better(evidence: HomeComparison, champion: str) -> Iterator[str]:
    """Check for fewer correct sounds, or for no more although much changes."""
    right, changes = evidence.random, evidence.changes
    counts, both = less_right(right, champion), right.combined_with(evidence.quiet)
    changed = changes.minutes.sum() - np.trace(changes.minutes)
    much = max(_CHANGED * _sound(evidence), _CHANGED_MINUTES)
    if is_worse(right):
        yield counts
    elif is_worse(evidence.quiet):
        quiet = evidence.quiet
        yield (
            f"of {quiet.sounds} silences of the minutes that were drawn at random it leaves "
            f"{quiet.after} silent, {champion} {quiet.before}"
        )
    elif both.sounds and both.lost >= both.gained and changed > much:
        counts = counts if right.sounds else "nothing sounds in the minutes drawn at random"
        yield (
            f"{counts}, and {changes.words(changed)} would change: `hearthlog review logs --queue` "
            "asks for more such minutes, then promote it again"
        )


def _sound(evidence: HomeComparison) -> float:
    """Return the minutes other than silence in both models."""
    changes = evidence.changes
    silent = [changes.minutes[i, i] for i, name in enumerate(changes.classes) if name == SILENCE]
    return float(changes.minutes.sum() - sum(silent))


def _sure_lost(evidence: HomeComparison, champion: str) -> Iterator[str]:
    changes = evidence.changes
    total, sound = changes.minutes.sum(), _without_silence(changes.before, changes.classes)
    for i, name in enumerate(changes.classes):
        sure, kept = float(evidence.sure[i].sum()), float(evidence.sure[i, i])
        much = sure >= min(_MUCH * total, _MUCH_OF_SOUND * sound)
        others = evidence.sure[i].copy()
        others[i] = 0
        corrected = sum(
            float(others[j])
            for j, new in enumerate(changes.classes)
            if _is_correction(evidence, name, new)
        )
        if sure and much and kept + corrected < _KEPT * sure:
            most = class_words(changes.classes[int(others.argmax())])
            yield (
                f"of {changes.words(sure)} of {class_words(name)} of which {champion} is sure "
                f"{time_words(kept)} are left, most becomes {most}"
            )


def _is_correction(evidence: HomeComparison, name: str, new: str) -> bool:
    """Check whether marks show that a class was wrong where it becomes another class.

    No mark may show that it was right. If the other class is an old one, wrong marks alone are
    weaker evidence: sounds must be known that both models label correctly with the first class.
    """
    wrong = sum(n for (true, old, _), n in evidence.known.items() if (true, old) == (new, name))
    of_home = new in evidence.taught
    own = [
        (after, n)
        for (true, old, after), n in evidence.known.items()
        if true == name and (of_home or old == name)
    ]
    count, lost = sum(n for _, n in own), sum(n for after, n in own if after == new)
    enough = wrong >= (1 if own else _MARKS_ALONE) if of_home else min(wrong, count) >= _MARKS_ALONE
    return enough and lost <= (1.0 - _KEPT) * count


def _swallowed(evidence: HomeComparison, champion: str) -> Iterator[str]:
    """Check whether a new class takes confirmed labels, mostly silence, or most of the day."""
    changes = evidence.changes
    for new in sorted(evidence.taught):
        name, column = class_words(new), changes.minutes[:, changes.classes.index(new)]
        for what, total, taken in _taken(evidence, new):
            if taken >= _MARKS_ALONE and taken > (1.0 - _KEPT) * total:
                yield (
                    f"{name} takes {taken} of {total} {what} that {champion} had right: hear its "
                    "marks, delete wrong ones, and mark what sounds like it as what it is"
                )
                break
        if changes.each and column.sum() > _ROOM * changes.minutes.sum():
            yield (
                f"{name} is {changes.words(column.sum())}, more than half of the time: if that is "
                "the sound of the room, delete its marks"
            )
        elif _takes_silence(evidence, new):
            silence = float(column[changes.classes.index(SILENCE)])
            yield (
                f"{changes.words(silence)} of {name} is silence for {champion}: if that is the "
                "sound of the room, delete its marks; else go through some real silence in "
                "`hearthlog review --queue`, leave it as it is, and train again"
            )


def _takes_silence(evidence: HomeComparison, new: str) -> bool:
    """Check whether a new class is mostly silence without a confirmed silence that stays."""
    changes = evidence.changes
    if SILENCE not in changes.classes:
        return False
    column = changes.minutes[:, changes.classes.index(new)]
    silence = column[changes.classes.index(SILENCE)]
    much = silence > _SILENCE_OF_NEW * column.sum() and silence >= _MUCH * changes.minutes.sum()
    has_silence = any(true == before == SILENCE for true, before, _ in evidence.known)
    return bool(much) and not (has_silence and _is_correction(evidence, SILENCE, new))


def _taken(evidence: HomeComparison, new: str) -> Iterator[tuple[str, int, int]]:
    """Count the first model's correct sounds and those a new class takes: total and by class."""
    right: dict[str, Counter[str]] = {}
    for (true, before, after), number in sorted(evidence.known.items()):
        if true == before and true not in {new, UNKNOWN}:
            right.setdefault(true, Counter())[after] += number
    sounds = [counts for name, counts in right.items() if name != SILENCE]
    yield "sounds of other classes", sum(c.total() for c in sounds), sum(c[new] for c in sounds)
    for name, counts in right.items():
        what = "silences" if name == SILENCE else f"sounds of {class_words(name)}"
        yield what, counts.total(), counts[new]


def _out_of_proportion(evidence: HomeComparison) -> Iterator[str]:
    """Check for a class that grows manifold, and for sound that shrinks much."""
    changes = evidence.changes
    total = changes.minutes.sum()
    for name, before, after in zip(changes.classes, changes.before, changes.after, strict=True):
        if after >= _MANY * total and 0 < before < after / _TIMES:
            times = f"from {changes.words(before)} to {time_words(after)}"
            yield f"{class_words(name)} rises {times}"
    before, after = (
        _without_silence(each, changes.classes) for each in (changes.before, changes.after)
    )
    if before >= _MUCH * total and after < _SOUND_LEFT * before:
        yield f"what is not silence falls from {changes.words(before)} to {time_words(after)}"


def _without_silence(minutes: Float64, classes: Sequence[str]) -> float:
    return float(sum(m for m, name in zip(minutes, classes, strict=True) if name != SILENCE))


_LONGEST = 400  # characters of a reason


@dataclass(frozen=True, eq=False)
class Verdict:
    """Result of the promotion check, with its evidence."""

    judgement: Judgement
    model: str  # name
    champion: str  # name; empty if no model labels yet
    evidence: HomeComparison | None  # None without anything to compare


def judge(
    folder: Path, model: Model, home: Sequence[Path], progress: Progress = ignore_progress
) -> Verdict:
    """Compare a model with the model that labels a home now, and store the result.

    The champion of `folder`, the folder of the model, labels now, or else the model of the latest
    logs. `progress` receives the completed share, 0 to 1. Raise `ModelError` if the model that
    labels now cannot be found or used, a feature set is not installed, or the result cannot be
    written.
    """
    champion = find_champion(folder, home, model)
    evidence, reasons = None, list[str]()
    if champion is None:
        reasons = [f"there are no labels in {', '.join(map(str, home))} to compare its own with"]
    elif other := other_features(champion, model):
        reasons = [other]
    elif champion.sha256 != model.sha256:
        logs = recent_logs(home)
        evidence = gather_evidence(champion, model, logs, progress)
        reasons = regressions(evidence, champion.name) or _worse_than_at_first(
            folder, model, champion, home, logs
        )
    judgement = Judgement(
        model=model.sha256,
        champion="" if champion is None else champion.sha256,
        judged=time.time_ns(),
        reasons=tuple(reason[:_LONGEST] for reason in reasons),
    )
    write_judgement(folder, judgement)
    return Verdict(judgement, model.name, "" if champion is None else champion.name, evidence)


def other_features(champion: Model, model: Model) -> str:
    """Return a message if two models have different feature sets, so cannot be compared."""
    mine, theirs = (one.description.feature_set for one in (model, champion))
    if mine == theirs:
        return ""
    text = f"it is for feature set {mine}, and {champion.name}, which labels now, for {theirs}"
    return f"{text}: they cannot be compared on the same logs"


def find_champion(folder: Path, home: Sequence[Path], model: Model) -> Model | None:
    """Find the model that labels a home now; None if there are no logs with labels.

    It is the champion of the folder of models, unless that is the checked model or is missing; the
    fallback is the model of the latest log. Of several such models, the one from which the checked
    model was adapted takes precedence. Raise `ModelError` if the model that labelled the latest log
    is missing.
    """
    with suppress(ModelError):
        champion = load(folder, CHAMPION)
        if champion.sha256 != model.sha256:
            return champion
    with suppress(LogError):
        named = [one for one in find_home_logs(home).latest_models() if one.model]
        base = model.description.training_data.base_sha256
        for name, labelled_by in sorted(named, key=lambda one: one.model_sha256 != base)[:1]:
            path = find_model_by_sha256(folder, labelled_by)
            if path is None:
                raise ModelError(
                    f"{name} ({labelled_by[:12]}), which labels now, is neither in {folder} "
                    "nor a starter model of this version: put its file there to compare with "
                    f"it, or insist: `hearthlog models promote {model.name} --anyway`"
                )
            return load_model(path)
    return None


def _worse_than_at_first(
    folder: Path, model: Model, champion: Model, home: Sequence[Path], logs: Sequence[RecentLog]
) -> list[str]:
    """Check for accumulated loss against the first model of the home."""
    first = _first_model(folder, home)
    if first is None or first.sha256 in {model.sha256, champion.sha256}:
        return []
    if first.description.feature_set != model.description.feature_set:
        return []
    right = right_at_random(first, model, logs)
    return [less_right(right, first.name)] if is_worse(right) else []


def _first_model(folder: Path, home: Sequence[Path]) -> Model | None:
    """Return the model that labelled the first log of a home; None if missing."""
    with suppress(LogError, ModelError):
        path = find_model_by_sha256(folder, find_home_logs(home).first_model())
        return None if path is None else load_model(path)
    return None


def judged_against(folder: Path, model: Model, home: Sequence[Path]) -> Judgement | None:
    """Return the stored result that permits a model to label, if it still holds.

    It holds if the model labels now, or was compared with the model that does. A refusal does not
    hold: more evidence may exist since.

    Raise `ModelError` as `find_champion` does.
    """
    judgement = read_judgement(folder, model.sha256)
    if judgement is None or not judgement.may_label:
        return None
    with suppress(ModelError):
        if load(folder, CHAMPION).sha256 == model.sha256:
            return judgement
    champion = find_champion(folder, home, model)
    sha256 = "" if champion is None else champion.sha256
    return judgement if judgement.champion == sha256 else None
