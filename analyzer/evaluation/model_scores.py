"""Scores of a model on labelled clips, and comparison of two models."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import Detections, Events, detect
from hearthlog.analyzer.training.calibration import softmax
from hearthlog.analyzer.training.clips import AS_IT_IS, captured, model_embedder, steady_noise
from hearthlog.analyzer.training.dataset import (
    Dataset,
    Recording,
    clip_recordings,
    cut_recordings,
    learned_groups,
)
from hearthlog.analyzer.training.direction_samples import evidence_of
from hearthlog.analyzer.training.manifest import (
    LabelledClip,
    Scenario,
    SkippedClip,
    example_of,
    scenario_of,
    why_skipped,
)
from hearthlog.analyzer.training.scores import (
    Bin,
    F1Difference,
    Scores,
    calibration_error,
    difference,
    reliability,
    score,
)
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import Auxiliary
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.network_names import require_trained
from hearthlog.models.embedding import (
    HOP_FRAMES,
    NO_EMBEDDINGS,
    WINDOW_FRAMES,
    Embeddings,
)
from hearthlog.models.features import FeatureSet, of_segments
from hearthlog.models.features.floor import Floors
from hearthlog.models.labels.labeller import Labeller
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.errors import Progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.messages.topics import EmbeddingSource

_LEAST = 1e-30
_ROOM_SECONDS = 2  # longer than the window extends any label
_ROOM_DBFS = -80.0


@dataclass(frozen=True)
class ModelEvaluation:
    """Scores of a model on labelled clips."""

    scores: Scores  # of segments of a second; the groups are the source groups
    expected_calibration_error: float
    reliability: list[Bin]
    detections: Detections  # of clips in a quiet room
    evaluated_seconds: float  # evaluated time of the detections
    skipped: Mapping[str, int]  # number of clips without a segment, by reason
    sources_learned: int  # sources in the model's training set
    left_out: Sequence[SkippedClip] = ()  # unreadable clips, also counted in `skipped`


def evaluate_model(
    model: Model, clips: Sequence[LabelledClip], scenario: Scenario, progress: Progress
) -> ModelEvaluation:
    """Run a model on clips, and compare its output with their labels.

    `progress` receives the completed share of the clips, 0 to 1. Raise `DataError` if the classes
    of the model are not those of the scenario, or no clip has a segment.
    """
    require_trained(model)
    scenario = fitted(scenario, model)
    classifier = Classifier(model)
    features, embedder = classifier.feature_set, model_embedder(model)
    listener = _Listener(classifier, None if embedder is None else embedder.source)
    recordings = clip_recordings(clips, scenario, progress, features, embedder=embedder)
    data = cut_recordings(listener.overhear(recordings, scenario), scenario, features)
    if not len(data):
        reasons = why_skipped(data.skipped)
        raise DataError(f"no clip has a segment to test on ({reasons}{example_of(data.left_out)})")
    probabilities = segment_probabilities(
        classifier,
        of_segments(classifier.inputs, data.windows, data.floor),
        by_heads=heads_of_segments(classifier, data),
    )
    scores = score(data.target, probabilities.argmax(axis=1), data.group, data.classes)
    return ModelEvaluation(
        scores=scores,
        expected_calibration_error=calibration_error(probabilities, data.target),
        reliability=reliability(probabilities, data.target),
        detections=listener.detections(),
        evaluated_seconds=listener.duration / NANOSECONDS,
        skipped=data.skipped,
        sources_learned=len(learned_groups(model, data)),
        left_out=data.left_out,
    )


def fitted(scenario: Scenario, model: Model) -> Scenario:
    """Return a scenario with classes in the order of a model's probabilities.

    Class `unknown` of the model is added if the scenario lacks it. Raise `DataError` as for
    `check_classes`.
    """
    check_classes(model, scenario)
    labels = {**scenario_of(model).classes, **scenario.classes}
    classes = {name: labels[name] for name in model.classes}
    return Scenario(scenario.name, classes, scenario.ignored)


def check_classes(model: Model, scenario: Scenario) -> None:
    """Raise `DataError` unless a model has the classes of a scenario, in any order."""
    lacking = [name for name in scenario.classes if name not in {*model.classes, UNKNOWN}]
    other = [name for name in model.classes if name not in {*scenario.classes, UNKNOWN}]
    if lacking or other:
        differences = [
            f"{what} {', '.join(names)}"
            for what, names in (("the model lacks", lacking), ("the scenario lacks", other))
            if names
        ]
        raise DataError(
            f"model {model.name or model.description.scenario_name} does not fit scenario "
            f"{scenario.name}: {'; '.join(differences)}; use the scenario it was trained for"
        )


def heads_of_segments(classifier: Classifier, data: Dataset) -> Float64 | None:
    """Return the outputs of heads [shape=(n, C)], as input of `Classifier.classify`, if any.

    They are NaN for segments without an embedding.
    """
    heads = classifier.embedding_heads
    if heads is None or not data.is_embedded.any():
        return None
    by_heads = np.full((len(data), len(classifier.classes)), np.nan)
    by_heads[data.is_embedded] = heads.log_probabilities(data.embedded[data.is_embedded])
    return by_heads


def segment_probabilities(
    classifier: Classifier,
    inputs: Float32,
    evidence: Float64 | None = None,
    by_heads: Float64 | None = None,
) -> Float64:
    """Return class probabilities [shape=(n, C)] of segments over all windows, with sum 1.

    They are geometric means over the windows. Inputs [shape=(n, places, width)] are as from
    `of_segments`; evidence of directions, and outputs of heads, as for `Classifier.classify`.
    """
    if evidence is not None:
        evidence = evidence.repeat(inputs.shape[1], axis=0)
    if by_heads is not None:
        by_heads = by_heads.repeat(inputs.shape[1], axis=0)
    rows, _ = classifier.classify(inputs.reshape(-1, inputs.shape[-1]), evidence, by_heads)
    logarithms = np.log(np.maximum(rows, _LEAST, dtype=np.float64))
    return softmax(logarithms.reshape(*inputs.shape[:2], -1).mean(axis=1))


class _Listener:
    """Collects the events of recordings placed one after the other.

    Each recording is played in a quiet room, so that a label that starts late or outlasts the sound
    is an error. Silence is scored in the recording only; for a model without silence there is no
    room. `duration` is the time of the recordings and of the room, in nanoseconds.
    """

    def __init__(self, classifier: Classifier, source: EmbeddingSource | None) -> None:
        self.duration = 0
        self._source = source
        self._classifier = classifier
        self._silence, self._room = -1, _quiet_room(classifier.feature_set)
        if SILENCE in classifier.classes:
            self._silence = classifier.classes.index(SILENCE)
        else:
            self._room = self._room[:0]
        self._place = 0
        self._reference: list[tuple[int, int, int]] = []
        self._predicted: list[tuple[int, int, int]] = []

    def overhear(self, recordings: Iterable[Recording], scenario: Scenario) -> Iterator[Recording]:
        """Add recordings, passing them through."""
        for recording in recordings:
            name = scenario.find(recording.label)
            if name is not None:
                self._listen(recording, name)
            yield recording

    def _listen(self, recording: Recording, label: str) -> None:
        """Add a recording with one label."""
        features = np.concatenate([self._room, recording.features, self._room])
        stamps = np.arange(len(features)) * FRAME_NANOSECONDS
        length = len(features) * FRAME_NANOSECONDS
        begin = len(self._room) * FRAME_NANOSECONDS
        end = length - begin
        if begin == end:
            return
        labeller = Labeller(self._classifier, embedding=self._source)
        floors, embeddings = self._floors(recording, features), self._embeddings(recording, stamps)
        pushed = labeller.push(features, floors, 0, stamps, Auxiliary(embeddings=embeddings))[1]
        segments = [*pushed, *labeller.close(length)]
        self._add(self._reference, begin, end, self._classifier.classes.index(label))
        for one in segments:
            if one.label == self._silence:
                self._add(self._predicted, max(one.start, begin), min(one.end, end), one.label)
            else:
                self._add(self._predicted, one.start, one.end, one.label)
        self.duration += length
        self._place += (length // NANOSECONDS + 2) * NANOSECONDS  # one second between recordings

    def _add(self, events: list[tuple[int, int, int]], start: int, end: int, label: int) -> None:
        if start < end:
            events.append((self._place + start, self._place + end, label))

    def _embeddings(self, recording: Recording, stamps: Int64) -> Embeddings:
        """Return the embeddings of a recording, at the frames of the room around it."""
        if recording.embedded is None or self._source is None:
            return NO_EMBEDDINGS
        windows = recording.embedded
        frames = windows.starts + len(self._room)
        fit = (windows.version == AS_IT_IS) & (frames % HOP_FRAMES == 0) & (frames >= 0)
        fit &= frames + WINDOW_FRAMES <= len(stamps)
        return Embeddings(frames[fit], stamps[frames[fit]], windows.values[fit])

    def _floors(self, recording: Recording, features: Float32) -> Floors | None:
        """Return the floor of the room in a recording at each frame of its features."""
        powers = self._classifier.feature_set.band_powers
        if powers is None:
            return None
        sound = powers(features)
        floor = np.zeros(sound.shape[1]) if recording.floor is None else recording.floor[-1]
        floors = np.tile(floor, (len(sound), 1))
        return Floors(floors, floors, sound, converged=True)

    def detections(self) -> Detections:
        """Return the detection scores of all recordings."""
        reference, predicted = (
            Events(*np.array(rows, np.int64).T) for rows in (self._reference, self._predicted)
        )
        return detect(reference, predicted, self._classifier.classes, self.duration)


def _quiet_room(features: FeatureSet) -> Float32:
    """Return the features of two seconds of a silent room."""
    samples = _ROOM_SECONDS * SAMPLE_RATE
    return captured(steady_noise(samples, _ROOM_DBFS, np.random.default_rng(0)), features)


@dataclass(frozen=True)
class ComparedModel:
    """Scores of one of the compared models."""

    name: str
    sha256: str
    scores: Scores
    expected_calibration_error: float
    sources_learned: int  # sources of the data in its training set


@dataclass(frozen=True)
class Comparison:
    """Comparison of two models on the same clips.

    Attributes
    ----------
    difference : F1Difference
        Macro F1 of b minus that of a.
    sources_left_out : int
        Number of sources in the training set of either model.
    held_out : bool
        False if there are no other sources, and all were used.
    skipped : mapping of str to int
        Number of recordings without a segment, by reason.
    """

    a: ComparedModel
    b: ComparedModel
    difference: F1Difference
    sources_left_out: int
    held_out: bool
    skipped: Mapping[str, int]

    @property
    def clear(self) -> bool:
        """Whether one model is better: the interval of the difference excludes 0."""
        interval = self.difference.interval
        return interval is not None and not interval[0] <= 0.0 <= interval[1]


def compare_models(
    a: Model, b: Model, recordings: Iterable[Recording], scenario: Scenario
) -> Comparison:
    """Run two models on the same segments of one second.

    Recordings have features of the set of both models, the scenario the classes of both. Sources in
    the training set of either model are excluded. Raise `DataError` if the classes of a model are
    not those of the scenario, the models are for different feature sets, or there is no segment.
    """
    for model in (a, b):
        require_trained(model)
    check_features(a, b)
    check_classes(a, scenario)
    check_classes(b, scenario)
    first, second = Classifier(a), Classifier(b)
    features = first.feature_set
    data = cut_recordings(recordings, scenario, features)
    if not len(data):
        reasons = why_skipped(data.skipped) or "no marks"
        raise DataError(f"there is no segment to compare on ({reasons})")
    sources = [learned_groups(model, data) for model in (a, b)]
    learned = np.isin(data.group, np.concatenate(sources))
    kept = np.ones(len(data), bool) if learned.all() else ~learned
    target, group = data.target[kept], data.group[kept]
    probabilities = [_probabilities(one, data, kept) for one in (first, second)]
    judged = [
        ComparedModel(
            name=model.name,
            sha256=model.sha256,
            scores=score(target, p.argmax(axis=1), group, data.classes),
            expected_calibration_error=calibration_error(p, target),
            sources_learned=len(learned_from),
        )
        for model, p, learned_from in zip((a, b), probabilities, sources, strict=True)
    ]
    return Comparison(
        a=judged[0],
        b=judged[1],
        difference=difference(target, probabilities[0], probabilities[1], group, data.classes),
        sources_left_out=0 if learned.all() else len(np.unique(data.group[learned])),
        held_out=not learned.all(),
        skipped=data.skipped,
    )


def check_features(a: Model, b: Model) -> None:
    """Raise `DataError` if two models are for different feature sets."""
    own, theirs = (one.description.feature_set for one in (a, b))
    if own != theirs:
        raise DataError(
            f"{a.name} is for feature set {own}, {b.name} for {theirs}: they cannot be compared on "
            "the same features; evaluate each of them on clips"
        )


def _probabilities(classifier: Classifier, data: Dataset, kept: Bool) -> Float64:
    """Return the probabilities of some segments, in the order of the classes of the data."""
    inputs = of_segments(classifier.inputs, data.windows, data.floor)[kept]
    evidence = evidence_of(classifier, list(compress(data.sightings, kept)))
    by_heads = heads_of_segments(classifier, data)
    by_heads = None if by_heads is None else by_heads[kept]
    order = [classifier.classes.index(name) for name in data.classes]
    return segment_probabilities(classifier, inputs, evidence, by_heads)[:, order]
