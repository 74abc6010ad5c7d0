"""Probabilities from statistics: ours, and scikit-learn's of the same calibrated model."""

from functools import partial

import numpy as np
from numpy.typing import NDArray
from sklearn.calibration import CalibratedClassifierCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from analyzer.train import group_folds
from models.classifier import Classifier
from models.inputs import WINDOW_FRAMES
from recorder.features import FeatureExtractor
from recorder.statistics import RollingStatistics
from tools.bench.table import Row, Table, Target
from tools.bench.timing import best_of
from tools.bench.workload import Workload

_SECONDS = 200.0
_BLOCK = 10  # frames, as from a microphone
_THE_SAME = Target(1e-5, at_most=True)


def measure(work: Workload) -> Table:
    """Measure both on statistics of the sound."""
    ours = Classifier(work.model).probabilities
    theirs = _scikit_learn(work).predict_proba
    rows = _statistics(work)
    rows_as_theirs = rows.astype(np.float64)
    difference = np.abs(ours(rows) - theirs(rows_as_theirs)).max()
    found = []
    for count in (len(rows), _BLOCK):
        best = best_of(
            {
                "ours": partial(ours, rows[:count]),
                "theirs": partial(theirs, rows_as_theirs[:count]),
            }
        )
        mine, other = (1e6 * seconds / count for seconds in best.values())
        found.append(Row(f"hearthlog, {count} rows a call", mine, "µs a row"))
        found.append(Row(f"scikit-learn, {count} rows a call", other, "µs a row", other / mine))
    found.append(Row("largest difference", float(difference), "", target=_THE_SAME))
    support, classes = len(work.model.support_vectors), len(work.model.classes)
    return Table(f"inference: {support} support vectors, {classes} classes, CPU time", found)


def _scikit_learn(work: Workload) -> CalibratedClassifierCV:
    """Fit what `analyzer.train` chose, the way it does."""
    data, _ = work.training
    about = work.model.description
    machine = SVC(C=about.cost, gamma=about.gamma, class_weight="balanced")
    return CalibratedClassifierCV(
        make_pipeline(StandardScaler(), machine),
        method="temperature",
        ensemble=False,
        cv=group_folds(data),
    ).fit(data.statistics.astype(np.float64), data.target)


def _statistics(work: Workload) -> NDArray[np.float32]:
    mean, std = RollingStatistics()(FeatureExtractor()(work.frames(_SECONDS)))
    return np.concatenate([mean, std], axis=1)[WINDOW_FRAMES - 1 :]
