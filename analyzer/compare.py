"""Two models on the same sound that neither has learned from: which is better, and how surely."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.dataset import Dataset, Progress, Recording, clip_features, cut_recordings
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.clips import check_classes
from hearthlog.analyzer.evaluation.scores import (
    Difference,
    Scores,
    calibration_error,
    difference,
    score,
)
from hearthlog.analyzer.manifest import Clip
from hearthlog.analyzer.scenario import Scenario
from hearthlog.models.classifier import Classifier
from hearthlog.models.inputs import window_inputs
from hearthlog.models.modelfile import Model
from hearthlog.recorder.features import FEATURE_NAMES

Float32 = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Judged:
    """One of the models.

    Attributes
    ----------
    name, sha256 : str
    scores : Scores
    expected_calibration_error : float
    sources_learned : int
        Sources of the data that it has learned from.
    """

    name: str
    sha256: str
    scores: Scores
    expected_calibration_error: float
    sources_learned: int


@dataclass(frozen=True)
class Comparison:
    """What came of it.

    Attributes
    ----------
    a, b : Judged
    difference : Difference
        Macro F1 of b minus that of a.
    sources_left_out : int
        One of the models has learned from these.
    held_out : bool
        False if there are no others, and all were used.
    skipped : dict of str to int
        Why recordings gave no segment, and how many.
    """

    a: Judged
    b: Judged
    difference: Difference
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
    scenario : Scenario
        With the classes of both.

    Raises
    ------
    DataError
        If the classes of a model are not those of the scenario, or there is no segment.
    """
    check_classes(a, scenario)
    check_classes(b, scenario)
    data = cut_recordings(recordings, scenario)
    if not len(data):
        reasons = "; ".join(f"{count}: {reason}" for reason, count in data.skipped.items())
        raise DataError(f"there is no segment to compare on ({reasons[:300] or 'no marks'})")
    heard = [_learned_sources(model, data) for model in (a, b)]
    learned = np.isin(data.group, np.concatenate(heard))
    kept = np.ones(len(data), bool) if learned.all() else ~learned
    target, group = data.target[kept], data.group[kept]
    first, second = (_probabilities(model, data.windows[kept], data.classes) for model in (a, b))
    judged = [
        Judged(
            name=model.name,
            sha256=model.sha256,
            scores=score(target, found.argmax(axis=1), group, data.classes),
            expected_calibration_error=calibration_error(found, target),
            sources_learned=len(sources),
        )
        for model, found, sources in zip((a, b), (first, second), heard, strict=True)
    ]
    return Comparison(
        a=judged[0],
        b=judged[1],
        difference=difference(target, first, second, group, data.classes),
        sources_left_out=0 if learned.all() else len(np.unique(data.group[learned])),
        held_out=not learned.all(),
        skipped=data.skipped,
    )


def clip_recordings(
    clips: Sequence[Clip], scenario: Scenario, progress: Progress
) -> Iterator[Recording]:
    """Listen to the clips of a scenario's labels; of others the label is all that is told.

    Raises
    ------
    SourceError
        If a clip cannot be read.
    """
    for number, clip in enumerate(clips):
        progress(number, len(clips))
        features = np.empty((0, len(FEATURE_NAMES)), np.float32)
        if scenario.find(clip.label) is not None:
            features = clip_features(clip)
        yield Recording(clip.label, clip.source_group, clip.source, clip.licence, features)
    progress(len(clips), len(clips))


def _probabilities(model: Model, windows: Float32, classes: Sequence[str]) -> Float32:
    found = Classifier(model).probabilities(window_inputs(model.description.inputs, windows))
    return found[:, [model.classes.index(name) for name in classes]]


def _learned_sources(model: Model, data: Dataset) -> NDArray[np.intp]:
    """Return the groups that a model has learned from: of which it has kept a segment."""
    inputs = window_inputs(model.description.inputs, data.windows)
    learned = np.zeros(len(data), bool)
    for found, kept in (
        (inputs, model.support_vectors),
        (inputs, model.home_vectors),
        (data.windows, model.training_windows),
    ):
        if len(kept):
            learned |= np.isin(_as_bytes(found), _as_bytes(kept))
    learned &= (data.windows != data.windows[:, :1]).any(axis=(1, 2))  # digital silence is alike
    return np.unique(data.group[learned])


def _as_bytes(rows: Float32) -> NDArray[np.void]:
    """Make one value of each row, shape (n,)."""
    rows = np.ascontiguousarray(rows).reshape(len(rows), -1)
    return rows.view(np.dtype((np.void, rows.shape[1] * rows.itemsize)))[:, 0]
