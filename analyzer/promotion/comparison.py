"""Comparison of two models in a home: over its recent time, and for a candidate on trial."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.event_counts import beta_quantile
from hearthlog.analyzer.errors import DataError, collect_errors
from hearthlog.analyzer.evaluation import compare_labellings
from hearthlog.analyzer.logs.labelling import Labelling, find_labellings, unified
from hearthlog.analyzer.logs.spans import Spans, rows_at
from hearthlog.analyzer.promotion.paired_labels import (
    LabelChanges,
    LoggedReferences,
    PairedFrames,
    TwoModels,
    changes_of_labellings,
    changes_of_sample,
    joined_frames,
    label_parts,
    learned_by,
    reference_sounds,
    unlearned_sample,
)
from hearthlog.analyzer.promotion.recent_time import (
    LogSpan,
    RecentLog,
    ReferenceSound,
    left_alone,
    recorded_minutes,
    reference,
    spans_of,
)
from hearthlog.models.classes import (
    OTHER,
    OTHER_NEGATIVE,
    SILENCE,
    UNDECIDED,
    UNKNOWN,
    class_name,
    translation,
)
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Bool, Float64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.logs.metadata import read_provenance
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import CANDIDATE, LIVE

SURE = 0.9  # probability
_REFERENCE_SECONDS = 3_600.0
_LEARNED_SECONDS = 900.0  # of the marks of a new class, and of confirmed labels
_NEAR = 60 * NANOSECONDS
_MOST = 0.5  # of a sound


class PairedAccuracy(NamedTuple):
    """Sounds of known label, and those labelled correctly for most of their time by each model."""

    sounds: int = 0
    before: int = 0  # correct in the first model
    after: int = 0  # correct in the second
    gained: int = 0  # correct in the second alone
    lost: int = 0  # correct in the first alone

    def combined_with(self, other: "PairedAccuracy") -> "PairedAccuracy":
        """Return the sums."""
        return PairedAccuracy(*(a + b for a, b in zip(self, other, strict=True)))


NO_PAIRS = PairedAccuracy()


class NamedSounds(NamedTuple):
    """Sounds to which a person and the first model each give a class of that model."""

    sounds: int = 0
    right: int = 0  # with the same class
    classes: int = 0  # that the person gives


NOTHING_NAMED = NamedSounds()


@dataclass(frozen=True, eq=False)
class HomeComparison:
    """Two models on the same recent time of a home."""

    minutes: float
    recorded: float  # total minutes
    changes: LabelChanges  # first to second model, per mean day, or in total below a day
    sure: Float64  # [shape=(C, C)]; as `changes.minutes`, where the first model is sure
    random: PairedAccuracy  # sounds of the minutes drawn at random
    marks: PairedAccuracy  # sounds of other marks outside both training sets
    losses: list[str]
    quiet: PairedAccuracy = NO_PAIRS  # silences of the minutes drawn at random
    # classes of the second model from marks of the home, without those of the first
    taught: frozenset[str] = frozenset()
    # sounds of known label, including training sounds, by reviewed class, class of the first model
    # and class of the second; empty if the second was not trained here
    known: Mapping[tuple[str, str, str], int] = field(default_factory=dict)
    named: NamedSounds = NOTHING_NAMED  # of the minutes drawn at random


def gather_evidence(
    before: Model,
    after: Model,
    logs: Sequence[RecentLog],
    progress: Progress = ignore_progress,
) -> HomeComparison:
    """Run two models over a sample of a home's recent time, and over its known sounds.

    The models have the same feature set; the second would replace the first. `progress` receives
    the completed share of the sound, 0 to 1. Raise `ModelError` if the feature set of the models,
    or a kind of classifier, is not installed.
    """
    losses: list[str] = []
    references = reference_sounds(logs, losses)
    learned = learned_by(before, after, references)
    chosen = unlearned_sample(logs, learned)
    unlearned = [[s for s in own if s.random or not _is_in(learned, s)] for _, own in references]
    places = _places([(log, own) for (log, _), own in zip(references, unlearned, strict=True)])
    models = TwoModels(before, after)
    taught = _taught(models, after)
    count = len(chosen) + len(places)
    of_home = any(one.segments for one in after.description.training_data.home.values())
    if of_home:
        rest = [
            (log, [*left_alone(log.path), *(s for s in own if s not in new)])
            for (log, own), new in zip(references, unlearned, strict=True)
        ]
        places += _places(rest, _LEARNED_SECONDS)
    parts = [*chosen, *(part for part, _ in places)]
    labelled = list(label_parts(models, parts, losses, progress))
    frames = joined_frames(labelled[: len(chosen)])
    outcomes = [
        list(_outcomes(sounds, own, models.classes))
        for (_, sounds), own in zip(places, labelled[len(chosen) :], strict=True)
    ]
    right = [one for each in outcomes[: count - len(chosen)] for one in each]
    return HomeComparison(
        minutes=len(frames.stamps) * FRAME_SECONDS / 60,
        recorded=recorded_minutes(logs),
        changes=changes_of_sample(models.classes, frames, logs),
        sure=changes_of_sample(models.classes, frames, logs, SURE).minutes,
        random=_right(one for one in right if one.random and one.label != SILENCE),
        marks=_right(one for one in right if not one.random and one.label != SILENCE),
        losses=losses,
        quiet=_right(one for one in right if one.random and one.label == SILENCE),
        named=_named((one for one in right if one.random), models.classes[: models.before]),
        taught=taught,
        known=Counter(one[1:] for each in outcomes for one in each) if of_home else {},
    )


def right_at_random(before: Model, after: Model, logs: Sequence[RecentLog]) -> PairedAccuracy:
    """Run two models over the sounds of the minutes drawn at random only.

    Raise `ModelError` as `gather_evidence`.
    """
    losses: list[str] = []
    references = reference_sounds(logs, losses)
    places = _places([(log, [sound for sound in own if sound.random]) for log, own in references])
    models = TwoModels(before, after)
    labelled = label_parts(models, [part for part, _ in places], losses, ignore_progress)
    return _right(
        one
        for (_, sounds), own in zip(places, labelled, strict=True)
        for one in _outcomes(sounds, own, models.classes)
        if one.label != SILENCE
    )


def _taught(models: TwoModels, after: Model) -> frozenset[str]:
    """Return the classes that the second model has from marks of the home, and the first lacks."""
    training = after.description.training_data
    of_home, elsewhere = (
        {name for name, amount in amounts.items() if amount.segments}
        for amounts in (training.home, training.classes)
    )
    return frozenset((of_home - elsewhere) & set(models.classes[models.before :]))


def _is_in(spans: Spans, sound: ReferenceSound) -> bool:
    return bool(rows_at(spans, np.array([(sound.start + sound.end) // 2]))[0] >= 0)


def _places(
    references: LoggedReferences, most: float = _REFERENCE_SECONDS
) -> list[tuple[LogSpan, list[ReferenceSound]]]:
    """Merge nearby sounds, to label them at once; the latest ones."""
    places: list[tuple[LogSpan, list[ReferenceSound]]] = []
    by_microphone = (
        (log.path, name, [sound for sound in sounds if sound.microphone == name])
        for log, sounds in references
        for name in sorted({sound.microphone for sound in sounds})
    )
    for log, microphone, sounds in by_microphone:
        times = spans_of([(s.start, s.end) for s in sounds], _NEAR)
        rows = rows_at(times, np.array([s.start for s in sounds], np.int64))
        for row, (start, end) in enumerate(times.pairs()):
            inside = [sound for sound, own in zip(sounds, rows, strict=True) if own == row]
            places.append((LogSpan(log, start, end, microphone), inside))
    # Random minutes first, then the latest.
    places.sort(key=lambda place: (any(s.random for s in place[1]), place[0].start), reverse=True)
    seconds = np.cumsum([(part.end - part.start) / NANOSECONDS for part, _ in places])
    return places[: int(np.searchsorted(seconds, most, side="right"))]


class _Outcome(NamedTuple):
    """A known sound: its true class, and the class by each model for most of its time."""

    random: bool
    label: str
    before: str
    after: str


def _outcomes(
    sounds: Sequence[ReferenceSound], frames: PairedFrames, classes: Sequence[str]
) -> Iterator[_Outcome]:
    """Yield the outcomes of two models for labelled known sounds; named as in `classes`.

    A name is empty if no class has most of the sound.
    """
    names = translation({sound.label for sound in sounds}, classes)
    for sound in sounds:
        first, last = np.searchsorted(frames.stamps, [sound.start, sound.end])
        if last > first:
            name = names[sound.label]
            if class_name(name) == OTHER_NEGATIVE and UNKNOWN in classes:
                name = UNKNOWN
            counts = (
                np.bincount(labels[first:last], minlength=len(classes)) / (last - first)
                for labels in (frames.before, frames.after)
            )
            most = (classes[c.argmax()] if c.max() > _MOST else "" for c in counts)
            yield _Outcome(sound.random, name, *most)


def _named(outcomes: Iterable[_Outcome], classes: Sequence[str]) -> NamedSounds:
    """Count the sounds with a class by a person and by the first model, of the model's classes."""
    named = set(classes) - {SILENCE, UNKNOWN, OTHER}
    pairs = [(one.label, one.before) for one in outcomes if {one.label, one.before} <= named]
    right = sum(label == before for label, before in pairs)
    return NamedSounds(len(pairs), right, len({label for label, _ in pairs}))


def _right(outcomes: Iterable[_Outcome]) -> PairedAccuracy:
    """Count the sounds that each model labels correctly."""
    pairs = [(one.before == one.label, one.after == one.label) for one in outcomes]
    return _counted(*np.array(pairs, bool).reshape(-1, 2).T)


def _counted(before: Bool, after: Bool) -> PairedAccuracy:
    """Count the sounds, given which of them each model labels correctly."""
    columns = before, after, after & ~before, before & ~after
    return PairedAccuracy(len(before), *(int(column.sum()) for column in columns))


_ENDS = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class Trial:
    """A champion and a candidate on the same time of a home."""

    champion: str
    candidate: str
    candidate_sha256: str
    minutes: float
    changes: LabelChanges
    random: PairedAccuracy  # sounds of the minutes drawn at random
    marks: PairedAccuracy  # sounds of other marks
    losses: list[str]
    quiet: PairedAccuracy = NO_PAIRS  # silences of the minutes drawn at random


def compare_on_trial(folders: Sequence[Path]) -> Trial:
    """Compare the latest candidate with the champion that labelled next to it last.

    Raise `DataError` if no candidate labelled in these logs, or both models not long enough for
    a segment, or there are several microphones. Raise `LogError` if there is no log.
    """
    losses: list[str] = []
    records = list(_records(folders, losses))
    tried = [(log, record) for log, record in records if record.get("candidate_sha256")]
    if not tried:
        raise DataError(
            "no candidate labelled in these logs: `hearthlog models promote NAME --to candidate` "
            "lets a model label beside the champion of a running recorder"
        )
    last = tried[-1][1]
    key = ("model_sha256", "candidate_sha256")
    logs = [log for log, one in tried if all(one.get(k) == last.get(k) for k in key)]
    sources = find_labellings(*logs)
    name = sources.microphone(None)
    try:
        live, candidate = (sources.read(name, each) for each in (LIVE, CANDIDATE))
    except LogError as error:
        names = f"{last.get('candidate', '')} with {last.get('model', '')}"
        raise DataError(f"nothing to compare {names} by yet: {error}") from error
    difference = compare_labellings(live, candidate)
    references: list[ReferenceSound] = []
    for place, log in enumerate(logs, 1):
        with collect_errors(losses, LogError):
            sounds = reference(log, logs[place:])
            references += [sound for sound in sounds if sound.microphone == name]
    sounding = [sound for sound in references if class_name(sound.label) != SILENCE]
    sides = [unified(side.labelling) for side in (live, candidate)]
    return Trial(
        champion=last.get("model", ""),
        candidate=last.get("candidate", ""),
        candidate_sha256=last.get("candidate_sha256", ""),
        minutes=difference.total.minutes,
        changes=changes_of_labellings(difference),
        random=_right_on_trial([one for one in sounding if one.random], *sides),
        marks=_right_on_trial([one for one in sounding if not one.random], *sides),
        losses=[*sources.losses, *losses],
        quiet=_right_on_trial(
            [one for one in references if one.random and one not in sounding], *sides
        ),
    )


def gain_interval(right: PairedAccuracy) -> tuple[float, float]:
    """Return the 95 % interval of the share of sounds that only the second model gets right.

    The share is of sounds that exactly one model labels correctly; beta distribution with Jeffreys
    prior. 0.5 means no difference.
    """
    low, high = (beta_quantile(right.gained + 0.5, right.lost + 0.5, share) for share in _ENDS)
    return low, high


def _records(folders: Sequence[Path], losses: list[str]) -> Iterable[tuple[Path, dict[str, str]]]:
    for folder in folders:
        for log in find_logs(folder):
            if is_layer(log):
                continue
            with collect_errors(losses, LogError), LogFile(log) as file:
                for record in read_provenance(file):
                    yield log, dict(record)


def _right_on_trial(
    sounds: Iterable[ReferenceSound], before: Labelling, after: Labelling
) -> PairedAccuracy:
    """Count the sounds that a model labels correctly for most of the time that it labelled."""
    decided = [sound for sound in sounds if class_name(sound.label) not in UNDECIDED]
    shares = [[_mostly(sound, labels) for labels in (before, after)] for sound in decided]
    labelled, right = np.array(shares, bool).reshape(-1, 2, 2).transpose(2, 0, 1)
    return _counted(*right[labelled.all(axis=1)].T)


def _mostly(sound: ReferenceSound, labels: Labelling) -> tuple[bool, bool]:
    """Return whether labels, and labels of its class, cover more than half of a sound."""
    first = np.searchsorted(labels.ends, sound.start, side="right")
    rows = slice(first, np.searchsorted(labels.starts, sound.end))
    starts, ends = labels.starts[rows], labels.ends[rows]
    covered = np.minimum(ends, sound.end) - np.maximum(starts, sound.start)
    own = labels.labels[rows] == class_name(sound.label)
    half = (sound.end - sound.start) / 2
    return bool(covered.sum() > half), bool(covered[own].sum() > half)
