"""Labels of two models for the same time of a home, and the changes between them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError, collect_errors
from hearthlog.analyzer.evaluation import Events, LabellingDifference
from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.logs.spans import Spans, union
from hearthlog.analyzer.promotion.recent_time import (
    LogSpan,
    RecentLog,
    ReferenceSound,
    choose,
    learned_time,
    minutes_a_day,
    recorded_minutes,
    reference,
    sounding_time,
    spans_of,
    unlearned_time,
)
from hearthlog.analyzer.relabel.stream_labeller import infos_for_model, label_span
from hearthlog.models.classes import SILENCE, find_class, translation
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS


class PairedFrames(NamedTuple):
    """Frames with labels of two models."""

    stamps: Int64  # [shape=(n,)]; starts in nanoseconds of UTC
    before: Indices  # [shape=(n,)]; class of the segment of the first model around the frame
    after: Indices  # [shape=(n,)]; likewise of the second
    confidence: Float32  # [shape=(n,)]; probability of the first model's label
    weight: Float64  # [shape=(n,)]; frames of the home's time that each frame represents


NO_FRAMES = PairedFrames(
    np.empty(0, np.int64),
    np.empty(0, np.intp),
    np.empty(0, np.intp),
    np.empty(0, np.float32),
    np.empty(0),
)


def joined_frames(several: Sequence[PairedFrames]) -> PairedFrames:
    """Concatenate frames."""
    columns = zip(NO_FRAMES, *several, strict=True)
    return PairedFrames(*(np.concatenate(column) for column in columns))


class TwoModels:
    """Two models of the same feature set, ready to label.

    `classes` are those of the first model, then other classes of the second.
    """

    def __init__(self, before: Model, after: Model) -> None:
        names = translation(after.classes, before.classes)
        self.classes = list(dict.fromkeys([*before.classes, *names.values()]))
        self.before = len(before.classes)
        self._numbers = np.array([self.classes.index(names[name]) for name in after.classes])
        self._model = before
        self._classifiers = Classifier(before), Classifier(after)

    def label(self, part: LogSpan) -> PairedFrames:
        """Label a part of a log with both models, each as a recorder would.

        Raise `LogError` if the log cannot be read, or has no features of the set of the models.
        """
        infos, _ = infos_for_model(part.log, self._model, part.log)
        wanted = [info for info in infos if part.microphone in {None, info.microphone}]
        return joined_frames([self._label(info, part) for info in wanted])

    def _label(self, info: RecorderInfo, part: LogSpan) -> PairedFrames:
        first, second = label_span(info, self._classifiers, part.start, part.end)
        stamps, a, b = np.intersect1d(first.stamps, second.stamps, return_indices=True)
        before, after = first.classes[a], self._numbers[second.classes[b]]
        weights = np.full(len(stamps), part.weight)
        return PairedFrames(stamps, before, after, first.probabilities[a, before], weights)


A_DAY = " a day"
_LEAST_MINUTES = 0.5  # of a reported change


class LabelChange(NamedTuple):
    """Time with one class in one labelling and another class in the other."""

    before: str
    after: str
    minutes: float
    each: str  # time unit of the minutes, as in `LabelChanges`

    def __str__(self) -> str:
        """Format it as `20 h 15 min a day from silence to household sounds`."""
        before, after = class_words(self.before), class_words(self.after)
        return f"{time_words(self.minutes)}{self.each} from {before} to {after}"


@dataclass(frozen=True, eq=False)
class LabelChanges:
    """Two labellings of the same time."""

    classes: Sequence[str]
    # [shape=(C, C)]; of the row's class in the first labelling, the column's in the second
    minutes: Float64
    each: str = A_DAY  # ` a day` for minutes of a mean day; empty for the total recorded minutes

    @property
    def before(self) -> Float64:
        """Minutes of each class in the first labelling."""
        return self.minutes.sum(axis=1)

    @property
    def after(self) -> Float64:
        """Minutes of each class in the second labelling."""
        return self.minutes.sum(axis=0)

    def pairs(self) -> list[LabelChange]:
        """Return the changes of half a minute or more, the longest first."""
        reported = (self.minutes >= _LEAST_MINUTES) & ~np.eye(len(self.classes), dtype=bool)
        places = np.argwhere(reported)
        changes = [
            LabelChange(self.classes[i], self.classes[j], float(self.minutes[i, j]), self.each)
            for i, j in places.tolist()
        ]
        return sorted(changes, key=lambda change: -change.minutes)

    def words(self, minutes: float) -> str:
        """Format minutes as `20 h 15 min a day`."""
        return time_words(minutes) + self.each


def changes_of_frames(
    classes: Sequence[str],
    before: Indices,
    after: Indices,
    minutes: Float64,
    each: str = A_DAY,
) -> LabelChanges:
    """Count the changes of frames, each of which represents some minutes, in two labellings."""
    counts = np.bincount(before * len(classes) + after, minutes, len(classes) ** 2)
    table = counts.reshape(len(classes), len(classes)).astype(np.float64)
    return LabelChanges(classes, table, each)


def changes_of_labellings(difference: LabellingDifference) -> LabelChanges:
    """Count the changes between two compared labellings, per mean day that both label."""
    minutes = np.array(difference.confusion, np.float64)
    return LabelChanges(difference.classes, minutes / len(difference.days))


def class_words(name: str) -> str:
    """Format a class name for the middle of a sentence."""
    row = None if name == SILENCE else find_class(name)
    return name.replace("_", " ") if row is None else row.words.lower()


def time_words(minutes: float) -> str:
    """Format a duration: `20 h 15 min`, `0.7 min`."""
    if minutes < 10:
        return f"{minutes:.1f} min"
    hours, rest = divmod(round(minutes), 60)
    return f"{hours} h {rest:02} min" if hours else f"{rest} min"


LoggedReferences = list[tuple[RecentLog, list[ReferenceSound]]]


def reference_sounds(logs: Sequence[RecentLog], losses: list[str]) -> LoggedReferences:
    """Read the sounds of known label of each log."""
    references, paths = [], [log.path for log in logs]
    for place, log in enumerate(logs, 1):
        with collect_errors(losses, DataError, LogError):
            references.append((log, reference(log.path, paths[place:])))
    return references


def learned_by(before: Model, after: Model, references: LoggedReferences) -> Spans:
    """Return the training time of two models together."""
    chosen = [(s.start, s.end) for _, sounds in references for s in sounds if not s.random]
    marked = spans_of(chosen)
    return union(learned_time(before, marked), learned_time(after, marked))


def unlearned_sample(logs: Sequence[RecentLog], learned: Spans) -> list[LogSpan]:
    """Choose parts of the time outside the training set of any model."""
    return choose(unlearned_time(logs, learned), sounding_time(logs))


def label_parts(
    models: TwoModels, parts: Sequence[LogSpan], losses: list[str], progress: Progress
) -> Iterator[PairedFrames]:
    """Label one part after the other; an unreadable part has no frames.

    `progress` receives the completed share of the parts, 0 to 1.
    """
    for i, part in enumerate(parts):
        frames = NO_FRAMES
        with collect_errors(losses, LogError):
            frames = models.label(part)
        progress((i + 1) / len(parts))
        yield frames


def changes_of_sample(
    classes: Sequence[str], frames: PairedFrames, logs: Sequence[RecentLog], sure: float = 0.0
) -> LabelChanges:
    """Count the changes per mean day, or in total if less than a day is recorded.

    A frame counts if its label by the first model has a probability of `sure` or more.
    """
    share = frames.weight / max(frames.weight.sum(), 1.0)
    day = minutes_a_day(logs)
    minutes = share * (recorded_minutes(logs) if day is None else day)
    counted = minutes * (frames.confidence >= sure)
    each = "" if day is None else A_DAY
    return changes_of_frames(classes, frames.before, frames.after, counted, each)


@dataclass(frozen=True, eq=False)
class ChangedTime:
    """Spans in which two models differ, in the sample for the promotion check.

    The label of a span is the row of the first model's class in `changes` times the number of
    classes, plus the column of the second model's class.
    """

    spans: Events  # in order of time
    changes: LabelChanges
    losses: list[str]


def find_changed_time(
    before: Model,
    after: Model,
    logs: Sequence[RecentLog],
    microphone: str,
    progress: Progress = ignore_progress,
) -> ChangedTime:
    """Run two models over the sample of a home's recent time, as `gather_evidence` does.

    `progress` receives the completed share of the sound, 0 to 1. Raise `ModelError` if the feature
    set of the models, or a kind of classifier, is not installed.
    """
    losses: list[str] = []
    learned = learned_by(before, after, reference_sounds(logs, losses))
    models = TwoModels(before, after)
    parts = [part._replace(microphone=microphone) for part in unlearned_sample(logs, learned)]
    frames = joined_frames(list(label_parts(models, parts, losses, progress)))
    changes = changes_of_sample(models.classes, frames, logs)
    return ChangedTime(_differing(frames, len(models.classes)), changes, losses)


def _differing(frames: PairedFrames, classes: int) -> Events:
    """Merge successive frames with the same change."""
    order = np.argsort(frames.stamps)
    stamps, before, after = (column[order] for column in frames[:3])
    pairs = before * classes + after
    broken = np.diff(stamps, prepend=-FRAME_NANOSECONDS) > 1.5 * FRAME_NANOSECONDS
    first = np.flatnonzero(broken | (np.diff(pairs, prepend=-1) != 0))
    last = np.append(first[1:], len(stamps))[: len(first)] - 1
    spans = Events(stamps[first], stamps[last] + FRAME_NANOSECONDS, pairs[first])
    return spans.select(before[first] != after[first])
