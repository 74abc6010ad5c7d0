"""Probabilities from inputs: ours, and scikit-learn's of the same calibrated model."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from sklearn.calibration import CalibratedClassifierCV
from sklearn.frozen import FrozenEstimator

from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.landmark_method import ROOM
from hearthlog.analyzer.training.method import prepare
from hearthlog.analyzer.training.svm_method import SVM
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.installed import classifier_kind
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.floor import FloorTracker
from hearthlog.schemas.arrays import Float32
from hearthlog.tools.bench.table import Row, Table, Target
from hearthlog.tools.bench.timing import best_of
from hearthlog.tools.bench.workload import Workload

_SECONDS = 200.0
_BLOCK = 10  # frames, as from a microphone
_HUNDRED_TIMES = Target(100)


def measure(work: Workload) -> Table:
    """Measure both on the sound."""
    ours, machine = Classifier(work.model).probabilities, Classifier(_svm_of(work)).probabilities
    theirs = fit_scikit_learn(work.training[0]).predict_proba
    rows = _inputs(work)
    rows_as_theirs = rows.astype(np.float64)
    measured = []
    for count in (len(rows), _BLOCK):
        best = best_of(
            {
                "ours": partial(ours, rows[:count]),
                "machine": partial(machine, rows[:count]),
                "theirs": partial(theirs, rows_as_theirs[:count]),
            }
        )
        mine, svm, other = (seconds / (count / 1e6) for seconds in best.values())
        unit, target = "µs a row", _HUNDRED_TIMES if count > _BLOCK else None
        measured += [
            Row(f"landmarks, {count} rows a call", mine.cpu, unit, elapsed=mine.elapsed),
            Row(
                f"support vectors, {count} rows a call",
                svm.cpu,
                unit,
                svm.cpu / mine.cpu,
                elapsed=svm.elapsed,
            ),
            Row(
                f"scikit-learn, {count} rows a call",
                other.cpu,
                unit,
                other.cpu / mine.cpu,
                target,
                elapsed=other.elapsed,
            ),
        ]
    size, classes = (
        classifier_kind(work.model.description.kind).summary(work.model),
        len(work.model.classes),
    )
    return Table(f"inference: {size}, {classes} classes, CPU time", measured)


def contests(work: Workload) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Return our probabilities of some rows, and scikit-learn's."""
    rows = _inputs(work)
    theirs = fit_scikit_learn(work.training[0]).predict_proba
    ours = Classifier(work.model).probabilities
    as_theirs = rows.astype(np.float64)
    return {"inference: scikit-learn": (partial(ours, rows), partial(theirs, as_theirs))}


def fit_scikit_learn(data: Dataset) -> CalibratedClassifierCV:
    """Fit the support vector machine of `svm`, and calibrate it as scikit-learn does."""
    examples = prepare(SVM, data)
    machine = SVM.fit(examples).machine
    machine[-1].decision_function_shape = "ovr"  # the default, which its calibration needs
    calibrated = CalibratedClassifierCV(
        FrozenEstimator(machine), method="temperature", ensemble=False
    )
    return calibrated.fit(examples.inputs[0, :, 0].astype(np.float64), data.target)


def _svm_of(work: Workload) -> Model:
    """Return the model with a support vector machine in the place of its landmarks."""
    learned = SVM.fit(prepare(SVM, work.training[0]))
    update = {"kind": SVM.kind, "parameters": learned.parameters()}
    described = work.model.description.model_copy(update=update)
    return replace(work.model, description=described, arrays=learned.arrays())


def _inputs(work: Workload) -> Float32:
    features = ROOM.features.extractor()(work.frames(_SECONDS))
    return inputs_above_floor(ROOM.features, features)


def inputs_above_floor(described: FeatureSet, features: Float32) -> Float32:
    """Compute the inputs of a model from the features of successive frames, the first being 0."""
    assert described.band_powers is not None
    floors = FloorTracker()(described.band_powers(features), 0).powers
    heard = features[len(features) - len(floors) :]
    return described.inputs[ROOM.inputs].stream()(heard, floors)
