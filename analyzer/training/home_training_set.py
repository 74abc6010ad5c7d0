"""Training set of a home: its marks and pseudo-labels."""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.adaptation import base_classes
from hearthlog.analyzer.training.dataset import CONFIRMED, Dataset, Recording, cut_recordings
from hearthlog.analyzer.training.home_recordings import (
    HOME,
    HomeSound,
    is_short_silence,
    marked_recordings,
    read_reviewed_sound,
    without_excluded_marks,
)
from hearthlog.analyzer.training.manifest import Scenario, scenario_of
from hearthlog.analyzer.training.pseudo_labels import (
    FEWEST,
    MOST_CONFIRMED,
    Candidates,
    chosen,
    confirmed_segments,
    unreviewed_silence,
    unreviewed_sounds,
)
from hearthlog.models.classes import (
    OTHER,
    OTHER_NEGATIVE,
    SILENCE,
    TELEVISION,
    UNKNOWN,
    class_name,
    meant_by,
)
from hearthlog.models.classifiers.model import MOST_CLASSES, Model
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.messages.topics import EmbeddingSpace

_FEWEST_DAYS = 2  # of a new class
_FEWEST_SECONDS = 10.0
_NO_SILENCE = (
    "nowhere in the logs is it silent, as the model to be adapted hears it: by marks of other "
    "sounds alone it would forget silence; mark some seconds in which nothing sounds as silence"
)
_NOTHING_REVIEWED = (
    "no time of this home was looked at: only silence, and what the model is very sure of, is kept "
    "as it is; what a review leaves alone, such as `hearthlog review --queue`, keeps more"
)


class HomeTrainingSet(NamedTuple):
    """Training set of a home."""

    # classes of the originally adapted model, then new ones; empty if no mark can be used
    segments: Dataset
    notes: list[str]
    nothing: str  # reason for an empty training set


def read_home_training_set(
    folders: Sequence[Path], model: Model, scenario: str = ""
) -> HomeTrainingSet:
    """Read the training marks of a home, and pseudo-labels that preserve the model.

    Only marks of the scenario are used; by default only marks without one. Raise `LogError` if
    there is no log, or if a log or a layer is damaged; `DataError` if there are marks, and all of
    them are in logs of other feature sets, or if there is no silence for rehearsal.
    """
    features = feature_set(model.description.feature_set)
    marked: list[Recording] = []
    candidates: list[Candidates] = []
    counts, window = _Counts(), features.window_frames
    marked_as: set[str] = set()
    for folder in folders:
        space = model.description.embedding_space
        sounds = list(read_reviewed_sound(folder, features, scenario, space))
        marked_as |= {class_name(mark.label) for sound in sounds for mark in sound.marks}
        taught = [counts.add(sound, features, model.classes) for sound in sounds]
        marked += marked_recordings(taught, folder, features, model.description.gate)
        candidates += [confirmed_segments(sound, model.classes, window) for sound in sounds]
    learned, notes, unlearned = _with_new_classes(marked, model, features)
    marked = [one for one in marked if one.label not in unlearned]
    notes += counts.notes()
    if note := counts.embedding_note(model):
        notes.append(note)
    in_room = [one for one in marked if one.floor is not None]
    kept: list[Recording] = []
    if marked:
        kept = chosen(candidates, model)
        if in_room and SILENCE in model.classes and _silent(kept) < MOST_CONFIRMED:
            kept = chosen([*candidates, *unreviewed_silence(folders, model, scenario)], model)
            if not _silent([*kept, *in_room]):
                raise DataError(_NO_SILENCE)
        if in_room:
            kept += unreviewed_sounds(folders, model, _seldom_kept(kept, model), scenario)
        if in_room and not counts.has_reviewed:
            notes.append(_NOTHING_REVIEWED)
    segments = cut_recordings([*marked, *_as_unknown(kept, model, learned)], learned, features)
    if CONFIRMED in segments.collection_names and HOME not in segments.collection_names:
        segments = cut_recordings([], learned, features)
    nothing = "none of the marks can be learned from" if counts.marks else "nothing is marked"
    if marked_as == {TELEVISION}:
        nothing = (
            "a television is all that is marked; that takes sounds out of the counts, and teaches "
            "no class. Mark sounds of the home as what they are"
        )
    return HomeTrainingSet(segments, notes, "" if len(segments) else nothing)


class _Counts:
    """Statistics of the marks of a home."""

    def __init__(self) -> None:
        self.marks = 0
        self.left_out = 0  # excluded from training
        self.short = 0  # pauses marked as silence
        self.has_reviewed = False
        self.by_embedding: Counter[EmbeddingSpace | None] = Counter()  # marks

    def add(self, sound: HomeSound, features: FeatureSet, classes: Collection[str]) -> HomeSound:
        """Count the marks of a sound; return it with those that are used for training."""
        taught = without_excluded_marks(sound, classes)
        self.marks += len(sound.marks)
        self.by_embedding[sound.embedding] += len(sound.marks)
        self.left_out += len(sound.marks) - len(taught.marks)
        self.short += sum(is_short_silence(mark, features) for mark in taught.marks)
        self.has_reviewed |= bool(sound.confirmed)
        return taught

    def notes(self) -> list[str]:
        """Return lines on the marks that are not used for training."""
        notes = []
        if self.left_out:
            notes.append(
                f"{self.left_out} of {self.marks} marks are not learned from: they say `unknown` "
                "or `television`, or lie in time that was drawn at random to measure how right the "
                "labels are"
            )
        if self.short:
            notes.append(
                f"{self.short} of {self.marks} marks are of silence for less than a second: not "
                "learned from, for there are other sounds beside it"
            )
        return notes

    def embedding_note(self, model: Model) -> str:
        """Return a line on marks without embeddings although a network exists; else empty."""
        wanted = model.description.embedding_space
        others = sorted({each.network for each in self.by_embedding if each not in {None, wanted}})
        if wanted is None and others:
            return (
                f"the logs have embeddings of {', '.join(others)}, which {model.name} does not "
                "take: marks teach it by features alone"
            )
        left = sum(self.by_embedding.values()) - self.by_embedding[wanted]
        if wanted is None or not left:
            return ""
        theirs = f" (some of {', '.join(others)}, or of another projection)" if others else ""
        return (
            f"{left} of {self.marks} marks lie in logs without embeddings of {wanted.network} as "
            f"{model.name} takes them{theirs}: they teach by features alone"
        )


def _with_new_classes(
    marked: Sequence[Recording], model: Model, features: FeatureSet
) -> tuple[Scenario, list[str], set[str]]:
    """Return a scenario extended by classes with enough marks, shortfalls, and untrainable labels.

    A label that the scenario maps to `unknown` becomes a class like any other, and is trained as
    unknown until then.
    """
    scenario = scenario_of(model).with_classes(base_classes(model))
    as_unknown = set(scenario.classes.get(UNKNOWN, ())) - {OTHER_NEGATIVE}
    listed = {*scenario.classes, *scenario.class_of} - as_unknown
    others = [one for one in marked if not meant_by(one.label, listed)]
    labels: dict[str, set[str]] = {}
    for one in others:
        labels.setdefault(class_name(one.label), set()).add(one.label)
    every = {name: tuple(sorted(same)) for name, same in sorted(labels.items())}
    amounts = (
        cut_recordings(others, Scenario(scenario.name, every), features).amounts if every else {}
    )
    notes: list[str] = []
    learned: dict[str, tuple[str, ...]] = {}
    unlearned: set[str] = set()
    for name, amount in amounts.items():
        seconds = max(_FEWEST_SECONDS - amount.seconds, 0.0)
        room = len(scenario.classes) + len(learned) < MOST_CLASSES
        if room and not seconds and amount.sources >= _FEWEST_DAYS:
            learned[name] = every[name]
            continue
        count = sum(class_name(one.label) == name for one in others)
        rounded = math.ceil(round(seconds, 3))
        more = f"{rounded} more {'second' if rounded == 1 else 'seconds'}" if rounded else "any"
        day = ", from another day," if amount.sources < _FEWEST_DAYS else ""
        what = "the model has no room for it"
        if room:
            what = f"{more}{day} {'make' if rounded > 1 else 'makes'} it a class"
        if any(meant_by(label, as_unknown) for label in every[name]):
            what += "; until then they count as unknown"
        else:
            unlearned |= set(every[name])
        notes.append(f"{count} {'mark' if count == 1 else 'marks'} of {name}: {what}")
    return scenario.with_trained(learned), notes + _lumped(marked, scenario), unlearned


def _lumped(marked: Sequence[Recording], scenario: Scenario) -> list[str]:
    """List the marks that are trained under another class name, such as `other`."""
    counts: Counter[tuple[str, str]] = Counter()
    for one in marked:
        name = scenario.find(one.label, marked=True)
        if name in {OTHER, UNKNOWN} and (name == OTHER or class_name(one.label) == OTHER_NEGATIVE):
            counts[class_name(one.label), name] += class_name(one.label) != name
    return [
        f"{count} {'mark' if count == 1 else 'marks'} of {label}: learned as {name}, "
        "to which the model counts them"
        for (label, name), count in sorted(counts.items())
        if count
    ]


def _as_unknown(kept: Sequence[Recording], model: Model, taught: Scenario) -> Iterator[Recording]:
    """Relabel remaining unknown sounds with a label that no new class has taken."""
    before = model.description.scenario.get(UNKNOWN, [UNKNOWN])[0]
    after = taught.classes.get(UNKNOWN, (before,))[0]
    for one in kept:
        yield one._replace(label=after) if one.label == before else one


def _seldom_kept(kept: Sequence[Recording], model: Model) -> set[str]:
    """List classes that are rare among pseudo-labels; without marks the model forgets them."""
    amounts = Counter(one.label for one in kept)
    return {name for name in model.classes if amounts[name] < FEWEST} - {SILENCE, UNKNOWN}


def _silent(recordings: Iterable[Recording]) -> int:
    return sum(class_name(one.label) == SILENCE for one in recordings)
