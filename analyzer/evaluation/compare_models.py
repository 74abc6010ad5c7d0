"""Two models on the same sound that neither has learned from: which is better, and how surely."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.evaluate_model import (
    check_classes,
    heads_of_segments,
    segment_probabilities,
)
from hearthlog.analyzer.training.dataset import Dataset, Recording, cut_recordings
from hearthlog.analyzer.training.learned_segments import learned_groups
from hearthlog.analyzer.training.scenario import Scenario
from hearthlog.analyzer.training.scores import (
    F1Difference,
    Scores,
    calibration_error,
    difference,
    score,
)
from hearthlog.analyzer.training.sightings import evidence_of
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.names import insist_taught
from hearthlog.models.features.window_inputs import of_segments
from hearthlog.schemas.arrays import Bool, Float32, Float64


@dataclass(frozen=True)
class ComparedModel:
    """One of the models."""

    name: str
    sha256: str
    scores: Scores
    expected_calibration_error: float
    sources_learned: int  # sources of the data that it has learned from


@dataclass(frozen=True)
class Comparison:
    """Two models on the same clips.

    Attributes
    ----------
    a, b : ComparedModel
    difference : F1Difference
        Macro F1 of b minus that of a.
    sources_left_out : int
        One of the models has learned from these.
    held_out : bool
        False if there are no others, and all were used.
    skipped : mapping of str to int
        Why recordings gave no segment, and how many.
    """

    a: ComparedModel
    b: ComparedModel
    difference: F1Difference
    sources_left_out: int
    held_out: bool
    skipped: Mapping[str, int]

    @property
    def clear(self) -> bool:
        """Whether one is better: the interval of the difference does not include 0."""
        interval = self.difference.interval
        return interval is not None and not interval[0] <= 0.0 <= interval[1]


def compare_models(
    a: Model, b: Model, recordings: Iterable[Recording], scenario: Scenario
) -> Comparison:
    """Run two models on the same segments of a second.

    Sources that one of them has learned from are left out.

    Parameters
    ----------
    a, b : Model
    recordings : iterable of Recording
        With features of the set of both models.
    scenario : Scenario
        With the classes of both.

    Raises
    ------
    DataError
        If the classes of a model are not those of the scenario, the models are for different
        feature sets, or there is no segment.
    """
    for model in (a, b):
        insist_taught(model)
    check_features(a, b)
    check_classes(a, scenario)
    check_classes(b, scenario)
    first, second = Classifier(a), Classifier(b)
    features = first.feature_set
    data = cut_recordings(recordings, scenario, features)
    if not len(data):
        reasons = "; ".join(f"{count}: {reason}" for reason, count in data.skipped.items())
        raise DataError(f"there is no segment to compare on ({reasons[:300] or 'no marks'})")
    inputs = [of_segments(one.inputs, data.windows, data.floor) for one in (first, second)]
    sources = [learned_groups(model, data) for model in (a, b)]
    learned = np.isin(data.group, np.concatenate(sources))
    kept = np.ones(len(data), bool) if learned.all() else ~learned
    target, group = data.target[kept], data.group[kept]
    sightings = list(compress(data.sightings, kept))
    probabilities = [
        _probabilities(
            one, i[kept], evidence_of(one, sightings), _by_heads(one, data, kept), data.classes
        )
        for one, i in zip((first, second), inputs, strict=True)
    ]
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
    """Check that two models can be compared on the same features.

    Raise `DataError` if they are for different feature sets.
    """
    own, theirs = (one.description.feature_set for one in (a, b))
    if own != theirs:
        raise DataError(
            f"{a.name} is for feature set {own}, {b.name} for {theirs}: they cannot be compared on "
            "the same features; evaluate each of them on clips"
        )


def _by_heads(classifier: Classifier, data: Dataset, kept: Bool) -> Float64 | None:
    by_heads = heads_of_segments(classifier, data)
    return None if by_heads is None else by_heads[kept]


def _probabilities(
    classifier: Classifier,
    inputs: Float32,
    evidence: Float64 | None,
    by_heads: Float64 | None,
    classes: Sequence[str],
) -> Float64:
    order = [classifier.classes.index(name) for name in classes]
    return segment_probabilities(classifier, inputs, evidence, by_heads)[:, order]
