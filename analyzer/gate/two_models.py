"""The labels of two models for the same sound, frame by frame."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.gate.recent_time import Part
from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.logs.spans import Spans, rows_at
from hearthlog.analyzer.relabel.reading import infos_for_model
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller
from hearthlog.analyzer.replay.recorded import Features, read_recorded
from hearthlog.models.classes import translation
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.recorder.events import Gap
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64
from hearthlog.schemas.frames import NANOSECONDS

_FLOOR_WARM_UP = 150 * NANOSECONDS
_LABELS_WARM_UP = 5 * NANOSECONDS
_BEHIND = 5 * NANOSECONDS  # sound after the part that its last labels depend on


class LabelledFrames(NamedTuple):
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


NO_FRAMES = LabelledFrames(
    np.empty(0, np.int64),
    np.empty(0, np.intp),
    np.empty(0, np.intp),
    np.empty(0, np.float32),
    np.empty(0),
)


def joined_frames(several: Sequence[LabelledFrames]) -> LabelledFrames:
    """Put frames behind each other."""
    columns = zip(NO_FRAMES, *several, strict=True)
    return LabelledFrames(*(np.concatenate(column) for column in columns))


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

    def label(self, part: Part, weight: float = 1.0) -> LabelledFrames:
        """Label a part of a log with both models, each as a recorder would.

        Raise `LogError` if the log cannot be read, or has no features of the set of the models.
        """
        infos, _ = infos_for_model(part.log, self._model, part.log)
        wanted = [info for info in infos if part.microphone in {None, info.microphone}]
        return joined_frames([self._label(info, part, weight) for info in wanted])

    def _label(self, info: RecorderInfo, part: Part, weight: float) -> LabelledFrames:
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
        return LabelledFrames(stamps, first.labels[a], after, first.confidence[a], weights)


class _Labelled(NamedTuple):
    stamps: Int64
    labels: Indices
    confidence: Float32


def _labelled(sound: Sequence[Features | Gap], part: Part, labeller: StreamLabeller) -> _Labelled:
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
