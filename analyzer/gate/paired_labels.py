"""Labels of two models for the same time of a home, and the changes between them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.event_scores import Events, LabellingDifference
from hearthlog.analyzer.gate.recent_time import (
    KnownSound,
    LogSpan,
    RecentLog,
    WeightedPart,
    choose,
    learned_time,
    minutes_a_day,
    recorded_minutes,
    reference,
    sounding_time,
    spans_of,
    unlearned_time,
)
from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.logs.spans import Spans, joined, rows_at
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller, infos_for_model
from hearthlog.analyzer.replay.recorded import Features, read_recorded
from hearthlog.models.classes import SILENCE, find_class, translation
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.recorder.events import Gap
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS

_FLOOR_WARM_UP = 150 * NANOSECONDS
_LABELS_WARM_UP = 5 * NANOSECONDS
_BEHIND = 5 * NANOSECONDS  # sound after the part that its last labels depend on


class PairedFrames(NamedTuple):
    """Frames that two models have labelled.

    Attributes
    ----------
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    before, after : np.ndarray [shape=(n,)], int
        Indices of the classes of the segments of each model that the frames lie in.
    confidence : np.ndarray [shape=(n,)], float32
        Probability that the first model gives to its label.
    weight : np.ndarray [shape=(n,)], float64
        How many frames of the home's time each stands for.
    """

    stamps: Int64
    before: Indices
    after: Indices
    confidence: Float32
    weight: Float64


NO_FRAMES = PairedFrames(
    np.empty(0, np.int64),
    np.empty(0, np.intp),
    np.empty(0, np.intp),
    np.empty(0, np.float32),
    np.empty(0),
)


def joined_frames(several: Sequence[PairedFrames]) -> PairedFrames:
    """Put frames behind each other."""
    columns = zip(NO_FRAMES, *several, strict=True)
    return PairedFrames(*(np.concatenate(column) for column in columns))


class TwoModels:
    """Two models of the same feature set, ready to label.

    Attributes
    ----------
    classes : list of str
        Those of the first model, then others of the second.
    """

    def __init__(self, before: Model, after: Model) -> None:
        names = translation(after.classes, before.classes)
        self.classes = list(dict.fromkeys([*before.classes, *names.values()]))
        self.before = len(before.classes)
        self._numbers = np.array([self.classes.index(names[name]) for name in after.classes])
        self._model = before
        self._classifiers = Classifier(before), Classifier(after)

    def label(self, part: LogSpan, weight: float = 1.0) -> PairedFrames:
        """Label a part of a log with both models, each as a recorder would.

        Raise `LogError` if the log cannot be read, or has no features of the set of the models.
        """
        infos, _ = infos_for_model(part.log, self._model, part.log)
        wanted = [info for info in infos if part.microphone in {None, info.microphone}]
        return joined_frames([self._label(info, part, weight) for info in wanted])

    def _label(self, info: RecorderInfo, part: LogSpan, weight: float) -> PairedFrames:
        start, end = part.start - _FLOOR_WARM_UP, part.end + _BEHIND
        sound = [
            event
            for batch in read_recorded(info, start, end, sound_only=True)
            for event in batch.events
            if isinstance(event, Features | Gap)
        ]
        first, second = (
            _labelled(
                sound,
                part,
                StreamLabeller(one, part.start - _LABELS_WARM_UP, info.microphone, info.embedding),
            )
            for one in self._classifiers
        )
        stamps, a, b = np.intersect1d(first.stamps, second.stamps, return_indices=True)
        after, weights = self._numbers[second.labels[b]], np.full(len(stamps), weight)
        return PairedFrames(stamps, first.labels[a], after, first.confidence[a], weights)


class _Labelled(NamedTuple):
    stamps: Int64
    labels: Indices
    confidence: Float32


def _labelled(
    sound: Sequence[Features | Gap], part: LogSpan, labeller: StreamLabeller
) -> _Labelled:
    pieces = [piece for event in sound if (piece := labeller.push(event)) is not None]
    labeller.close()
    segments = labeller.segments
    if not (pieces and segments):
        none = np.empty(0, np.int64)
        return _Labelled(none, none.astype(np.intp), none.astype(np.float32))
    times = np.array([(segment.start, segment.end) for segment in segments], np.int64)
    names = np.array([segment.label for segment in segments], np.intp)
    stamps = np.concatenate([one.stamps for one in pieces])
    rows = rows_at(Spans(times[:, 0], times[:, 1]), stamps)
    kept = (stamps >= part.start) & (stamps < part.end) & (rows >= 0)
    labels = names[rows[kept]]
    probabilities = np.concatenate([one.probabilities for one in pieces])[kept]
    return _Labelled(stamps[kept], labels, probabilities[np.arange(len(labels)), labels])


A_DAY = " a day"
_LEAST_MINUTES = 0.5  # of a change that is told


class LabelChange(NamedTuple):
    """Time that one labelling gives to a class and the other to another class."""

    before: str
    after: str
    minutes: float
    each: str  # a word for the time they are of, as in `LabelChanges`

    def __str__(self) -> str:
        """Say it: `20 h 15 min a day from silence to household sounds`."""
        before, after = class_words(self.before), class_words(self.after)
        return f"{time_words(self.minutes)}{self.each} from {before} to {after}"


@dataclass(frozen=True, eq=False)
class LabelChanges:
    """Two labellings of the same time.

    Attributes
    ----------
    minutes : np.ndarray [shape=(C, C)], float64
        That have the class of the row in the first labelling and that of the column in the second.
    each : str, optional
        ` a day` if the minutes are of a mean day; empty if they are of all that was recorded.
    """

    classes: Sequence[str]
    minutes: Float64
    each: str = A_DAY

    @property
    def before(self) -> Float64:
        """Minutes of each class in the first labelling."""
        return self.minutes.sum(axis=1)

    @property
    def after(self) -> Float64:
        """Minutes of each class in the second labelling."""
        return self.minutes.sum(axis=0)

    def pairs(self) -> list[LabelChange]:
        """List the changes of half a minute or more, the longest first."""
        told = (self.minutes >= _LEAST_MINUTES) & ~np.eye(len(self.classes), dtype=bool)
        places = np.argwhere(told)
        changes = [
            LabelChange(self.classes[i], self.classes[j], float(self.minutes[i, j]), self.each)
            for i, j in places.tolist()
        ]
        return sorted(changes, key=lambda change: -change.minutes)

    def words(self, minutes: float) -> str:
        """Write some of the minutes: `20 h 15 min a day`."""
        return time_words(minutes) + self.each


def changes_of_frames(
    classes: Sequence[str],
    before: Indices,
    after: Indices,
    minutes: Float64,
    each: str = A_DAY,
) -> LabelChanges:
    """Count the changes of frames.

    Parameters
    ----------
    before, after : np.ndarray [shape=(n,)], int
        Indices of the classes of the same frames in both labellings.
    minutes : np.ndarray [shape=(n,)], float64
        That each frame stands for.
    """
    counts = np.bincount(before * len(classes) + after, minutes, len(classes) ** 2)
    table = counts.reshape(len(classes), len(classes)).astype(np.float64)
    return LabelChanges(classes, table, each)


def changes_of_labellings(difference: LabellingDifference) -> LabelChanges:
    """Count the changes of two labellings that were compared, in a mean day of what both label."""
    minutes = np.array(difference.confusion, np.float64)
    return LabelChanges(difference.classes, minutes / len(difference.days))


def class_words(name: str) -> str:
    """Name a class in the middle of a sentence."""
    row = None if name == SILENCE else find_class(name)
    return name.replace("_", " ") if row is None else row.words.lower()


def time_words(minutes: float) -> str:
    """Write a length of time: `20 h 15 min`, `0.7 min`."""
    if minutes < 10:
        return f"{minutes:.1f} min"
    hours, rest = divmod(round(minutes), 60)
    return f"{hours} h {rest:02} min" if hours else f"{rest} min"


KnownSounds = list[tuple[RecentLog, list[KnownSound]]]


def known_sounds(logs: Sequence[RecentLog], losses: list[str]) -> KnownSounds:
    """Read the sounds of each log whose labels are known."""
    known, paths = [], [log.path for log in logs]
    for place, log in enumerate(logs, 1):
        try:
            known.append((log, reference(log.path, paths[place:])))
        except (DataError, LogError) as error:
            losses.append(str(error))
    return known


def learned_by(before: Model, after: Model, known: KnownSounds) -> Spans:
    """Return the time that one of two models has learned from."""
    chosen = [(s.start, s.end) for _, sounds in known for s in sounds if not s.random]
    marked = spans_of(chosen)
    both = [learned_time(model, marked) for model in (before, after)]
    starts, ends = (np.concatenate(edges) for edges in zip(*both, strict=True))
    return joined(starts, ends)


def unlearned_sample(logs: Sequence[RecentLog], learned: Spans) -> list[WeightedPart]:
    """Choose parts of the time that no model has learned from."""
    return choose(unlearned_time(logs, learned), sounding_time(logs))


def label_parts(
    models: TwoModels, parts: Sequence[WeightedPart], losses: list[str], progress: Progress
) -> Iterator[PairedFrames]:
    """Label one part after the other; of one that cannot be read there are no frames.

    Parameters
    ----------
    progress : callable
        Is told the share of the parts that is done, 0 to 1.
    """
    for i, (part, weight) in enumerate(parts):
        try:
            frames = models.label(part, weight)
        except LogError as error:
            losses.append(str(error))
            frames = NO_FRAMES
        progress((i + 1) / len(parts))
        yield frames


def changes_of_sample(
    classes: Sequence[str], frames: PairedFrames, logs: Sequence[RecentLog], sure: float = 0.0
) -> LabelChanges:
    """Count what changes in a mean day, or in all if less than a day is recorded.

    Parameters
    ----------
    sure : float, optional
        Probability: only frames count of which the first model is as sure.
    """
    share = frames.weight / max(frames.weight.sum(), 1.0)
    day = minutes_a_day(logs)
    minutes = share * (recorded_minutes(logs) if day is None else day)
    counted = minutes * (frames.confidence >= sure)
    each = "" if day is None else A_DAY
    return changes_of_frames(classes, frames.before, frames.after, counted, each)


@dataclass(frozen=True, eq=False)
class ChangedTime:
    """Where two models differ, in the sample that a model is judged by.

    Attributes
    ----------
    spans : Events
        In the order of time; the label is the row of the first model's class in `changes` times
        their number, and the column of the second one's.
    """

    spans: Events
    changes: LabelChanges
    losses: list[str]


def find_changed_time(
    before: Model,
    after: Model,
    logs: Sequence[RecentLog],
    microphone: str,
    progress: Progress = ignore_progress,
) -> ChangedTime:
    """Run two models over the sample of the recent time of a home, as `gather_evidence` does.

    Parameters
    ----------
    progress : callable, optional
        Is told the share of the sound that is done, 0 to 1.

    Raises
    ------
    ModelError
        If the feature set of the models, or a kind of classifier, is not installed.
    """
    losses: list[str] = []
    learned = learned_by(before, after, known_sounds(logs, losses))
    models = TwoModels(before, after)
    parts = [
        one._replace(part=one.part._replace(microphone=microphone))
        for one in unlearned_sample(logs, learned)
    ]
    frames = joined_frames(list(label_parts(models, parts, losses, progress)))
    changes = changes_of_sample(models.classes, frames, logs)
    return ChangedTime(_differing(frames, len(models.classes)), changes, losses)


def _differing(frames: PairedFrames, classes: int) -> Events:
    """Join successive frames that change in the same way."""
    order = np.argsort(frames.stamps)
    stamps, before, after = (column[order] for column in frames[:3])
    pairs = before * classes + after
    broken = np.diff(stamps, prepend=-FRAME_NANOSECONDS) > 1.5 * FRAME_NANOSECONDS
    first = np.flatnonzero(broken | (np.diff(pairs, prepend=-1) != 0))
    last = np.append(first[1:], len(stamps))[: len(first)] - 1
    spans = Events(stamps[first], stamps[last] + FRAME_NANOSECONDS, pairs[first])
    return spans.taken(before[first] != after[first])
