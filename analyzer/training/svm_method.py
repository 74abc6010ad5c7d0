"""Methods that train support vector machines with scikit-learn."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.svm import SVC

from hearthlog.analyzer.training.learned_inputs import (
    balanced,
    fitted_scaler,
    rounded_to_steps,
    scaler_arrays,
)
from hearthlog.analyzer.training.window_method import KernelMethod, as_room
from hearthlog.models.classifiers.svm_rbf import SVM_RBF, weakest_pairs
from hearthlog.models.features.network import INPUTS
from hearthlog.schemas.arrays import Float32, Float64, Indices


@dataclass(frozen=True)
class SvmMethod(KernelMethod):
    """Support vector machine with RBF kernel and balanced class weights.

    Source: "A ROS framework for audio-based activity recognition", section 4.
    """

    steps: int | None = 50  # rounding steps of inputs per standard deviation; None disables it

    def learn(
        self, inputs: Float32, target: Indices, weight: Float64
    ) -> tuple["LearnedSvm", dict[str, NDArray[Any]], dict[str, Any]]:
        """Train on windows; see `WindowMethod.learn`."""
        scaler = rounded_to_steps(fitted_scaler(inputs), self.steps)
        svc = SVC(C=self.cost, gamma=self.gamma / inputs.shape[1], decision_function_shape="ovo")
        svc.fit(
            scaler.transform(inputs.astype(np.float64)),
            target,
            sample_weight=balanced(target, weight),
        )
        # scikit-learn inverts the sign if there are two classes only; the file does not.
        sign = -1.0 if len(svc.classes_) == 2 else 1.0
        arrays = {
            **scaler_arrays(scaler[0]),
            "support_vectors": inputs[svc.support_],
            "support_counts": svc.n_support_.astype(np.int64),
            "dual_coefficients": sign * svc.dual_coef_,
            "intercepts": sign * svc.intercept_,
        }
        steps = {} if self.steps is None else {"steps": self.steps}
        parameters = {"cost": float(svc.C), "gamma": float(svc.gamma), **steps}
        return LearnedSvm(make_pipeline(*scaler, svc)), arrays, parameters


class LearnedSvm:
    """A fitted support vector machine, which decides as `SvmMachine` does."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Return the minimum over the pairs of each class, and no novelty; see `Machine.decide`."""
        values = self.pipeline.decision_function(inputs.astype(np.float64))
        pairs = -values[:, np.newaxis] if values.ndim == 1 else values
        decisions = weakest_pairs(pairs, len(self.pipeline.classes_))
        return decisions, np.full(len(inputs), np.nan)


BANDS = SvmMethod("bands", "auros21", "bands", SVM_RBF.name, copies=1, cost=4.0, gamma=1.25)
PAPER = SvmMethod("paper", "auros21", "statistics", SVM_RBF.name, copies=0, cost=4.0, gamma=0.5)
SVM = SvmMethod("svm", **as_room(SVM_RBF), cost=1.0, gamma=0.5)


def network_method(name: str) -> SvmMethod:
    """Return the method that trains on the embeddings of a network."""
    return SvmMethod(name, name, INPUTS, SVM_RBF.name, copies=0, rooms=1, cost=4.0, gamma=0.5)
