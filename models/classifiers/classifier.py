"""Probabilities and timing of a model's labels, for all installed kinds of classifier."""

from typing import NamedTuple

import numpy as np

from hearthlog.models.classes import UNKNOWN
from hearthlog.models.classifiers import ClassifierKind
from hearthlog.models.classifiers.evidence import EmbeddingHeads, mixed
from hearthlog.models.classifiers.model import Description, Model
from hearthlog.models.classifiers.network_names import (
    BY_NAMES,
    NAMES,
    NamesParameters,
    names_parameters,
)
from hearthlog.models.classifiers.rbf_machines import RBF_LANDMARKS, SVM_RBF
from hearthlog.models.embedding import DELAY_FRAMES
from hearthlog.models.extensions import Extensions
from hearthlog.models.features.floor import BLOCK_FRAMES
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.messages.topics import EmbeddingSource


class LabelTiming(NamedTuple):
    """The frames that a label needs, and the frame that it labels."""

    window_frames: int
    label_frame: int  # index in the window, from 0, of the labelled frame
    needs_floor: bool  # whether the room floor is required at every frame of the window
    ahead: int = 0  # further frames required after the window, for embeddings that begin in it

    @property
    def delay(self) -> int:
        """Number of frames from the labelled frame to the frame that completes the label."""
        return self.window_frames - 1 - self.label_frame + self.ahead

    def first_window_end(self, start: int) -> int:
        """Return the frame that completes the first label of a sound."""
        if self.needs_floor:  # known at the end of the first complete block
            start += -start % BLOCK_FRAMES + BLOCK_FRAMES - 1
        return start + self.window_frames - 1 + self.ahead


def label_timing(description: Description) -> LabelTiming:
    """Return the timing of a model's labels; raise `ModelError` without its feature set."""
    if description.kind == BY_NAMES:  # per frame, from the windows around the frame
        parameters = NamesParameters.model_validate(description.parameters)
        return LabelTiming(1, 0, needs_floor=False, ahead=parameters.ahead)
    inputs = feature_set(description.feature_set).inputs[description.inputs]
    needs_floor = description.gate > 0.0 or inputs.needs_floor
    timing = LabelTiming(inputs.window_frames, description.label_frame, needs_floor)
    if description.embedding is None:
        return timing
    return timing._replace(ahead=max(DELAY_FRAMES - timing.delay, 0))


CLASSIFIERS = Extensions(
    "hearthlog.classifiers",
    ClassifierKind,  # type: ignore[type-abstract]
    "classifier kind",
    [RBF_LANDMARKS, SVM_RBF, NAMES],
)


def classifier_kind(name: str) -> ClassifierKind:
    """Return a kind of classifier; raise `ModelError` if it is missing or cannot be imported."""
    return CLASSIFIERS.get(name)


_ROWS_AT_ONCE = 256
_TINY = 1e-38
_STEPS = 1 << 16  # steps of a probability; finer digits are noise, partly of the processor


class Classifier:
    """Inference of one model.

    The probabilities of a row do not depend on the rows of the same batch, nor on threads. Raise
    `ModelError` if the model's feature set or kind of classifier is not installed, or cannot be
    imported.

    Attributes
    ----------
    classes : tuple of str
        Names of the columns of the probabilities.
    gate : float
        In dB: a window is silence unless some band is this much above the floor; 0 for no gate.
    transitions : np.ndarray [shape=(C, C)], float64
    calibrated_elsewhere : bool
        Whether the calibration used datasets outside the training data, so that it holds in new
        homes.
    embedding_heads : EmbeddingHeads or None
        None if the model uses no network embeddings.
    names : NamesParameters or None
        Only for a model that labels by the names of a network alone.
    """

    def __init__(self, model: Model) -> None:
        description = model.description
        self.classes = model.classes
        self.feature_set = feature_set(description.feature_set)
        self.inputs = self.feature_set.inputs[description.inputs]
        self.timing = label_timing(description)
        self.gate = description.gate
        self.smoothing = description.smoothing
        self.transitions = model.transitions
        of_home = any(one.segments for one in description.training_data.home.values())
        self.calibrated_elsewhere = description.elsewhere is not None and not of_home
        self._inverse_temperature = description.inverse_temperature
        self._bias = np.array([description.decision_bias.get(name, 0.0) for name in self.classes])
        self._doubts = description.novelty == "doubt"
        self._is_named = np.array([name != UNKNOWN for name in self.classes])
        self._machine = classifier_kind(description.kind).machine(model)
        arrays = description.direction_microphones
        self._direction_weights = dict(zip(arrays, model.direction_weights, strict=True))
        self._mix = description.embedding
        self.embedding_heads: EmbeddingHeads | None = None
        if self._mix is not None:
            heads = model.embedding_weights, model.embedding_bias
            self.embedding_heads = EmbeddingHeads(self._mix, *heads, self.classes)
        by_names = description.kind == BY_NAMES
        self.names: NamesParameters | None = names_parameters(model) if by_names else None

    def direction_weights(self, microphone: str) -> Float64 | None:
        """Return an array's weights [shape=(C, S)] for `DirectionEvidence`, or None."""
        return self._direction_weights.get(microphone)

    def takes_embeddings(self, source: EmbeddingSource | None) -> bool:
        """Return whether the model was trained on embeddings of the same network and projection."""
        if source is None:
            return False
        if self.names is not None:
            return source.space[:2] == (self.names.network, self.names.projection_sha256)
        return self._mix is not None and source.space == self._mix.space

    def lacking_embeddings(self, source: EmbeddingSource | None) -> str:
        """Describe the embeddings that the model needs but lacks; empty if it lacks none."""
        taken = self._mix or self.names
        if taken is None or self.takes_embeddings(source):
            return ""
        theirs = "there are none"
        if source is not None:
            theirs = f"these are of {source.network} with another projection"
            if source.network != taken.network:
                theirs = f"these are of {source.network}"
        so = "it labels by features only, less accurately"
        if self.names is not None:
            so = "it labels nothing"
        return (
            f"it takes embeddings of {taken.network}, and {theirs}: {so} (hearthlog models fetch "
            f"{taken.network})"
        )

    def mix(
        self, probabilities: Float32, by_heads: Float64, evidence: Float64 | None = None
    ) -> tuple[Float32, Float32]:
        """Mix features and embeddings: features decide on silence, both on the class of a sound.

        Parameters
        ----------
        probabilities : np.ndarray [shape=(n, C)], float32
            From `classify` without evidence.
        by_heads : np.ndarray [shape=(n, C)], float64
            From `EmbeddingHeads.log_probabilities`; NaN where there is no embedding. Rows without
            embedding and evidence keep their probabilities.
        evidence : np.ndarray [shape=(n, C)], float64, optional
            Further evidence, as in `classify`.

        Returns
        -------
        probabilities : np.ndarray [shape=(n, C)], float32
        novelty : np.ndarray [shape=(n,)], float32
            As from `classify`.
        """
        embedded = np.isfinite(by_heads.sum(axis=1))
        changed = embedded if evidence is None else embedded | evidence.any(axis=1)
        decision = np.log(np.maximum(probabilities[changed], _TINY, dtype=np.float64))
        if self._mix is not None and embedded.any():
            own = embedded[changed]
            decision[own] = mixed(decision[own], by_heads[embedded], self._mix, self.classes)
        if evidence is not None:
            decision += evidence[changed]
        probabilities = probabilities.copy()
        probabilities[changed] = _softmax(decision)
        return self._in_steps(probabilities)

    def probabilities(self, inputs: Float32) -> Float32:
        """Compute the probability of each class in each window.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
            Finite.

        Returns
        -------
        np.ndarray [shape=(n, C)], float32
            In the order of the model's classes, as from `classify`.
        """
        return self.classify(inputs)[0]

    def classify(
        self,
        inputs: Float32,
        evidence: Float64 | None = None,
        by_heads: Float64 | None = None,
    ) -> tuple[Float32, Float32]:
        """Compute the probability of each class, and the novelty of each window.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
            Finite.
        evidence : np.ndarray [shape=(n, C)], float64, optional
            Further evidence, added to the logarithms of the probabilities.
        by_heads : np.ndarray [shape=(n, C)], float64, optional
            As in `mix`.

        Returns
        -------
        probabilities : np.ndarray [shape=(n, C)], float32
            In the order of the model's classes, in steps of 2**-16; every row sums to 1 within
            half a step per class. Older models' probabilities are not rounded.
        novelty : np.ndarray [shape=(n,)], float32
            Probability that the sound is not of the likeliest class other than `unknown`, 0 to 1;
            for older models the value of the kind of classifier, or NaN.
        """
        if by_heads is not None:
            return self.mix(self.classify(inputs)[0], by_heads, evidence)
        result = np.empty((len(inputs), len(self.classes)), np.float32)
        novelty = np.empty(len(inputs), np.float32)
        for start in range(0, len(inputs), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            decision, novelty[rows] = self._machine.decide(inputs[rows])
            decision += self._bias
            decision *= self._inverse_temperature
            if evidence is not None:
                decision += evidence[rows]
            result[rows] = _softmax(decision)
        if self._doubts:  # models of hearthlog 0.1 keep their labels bit for bit
            return self._in_steps(result)
        return result, novelty

    def _in_steps(self, probabilities: Float32) -> tuple[Float32, Float32]:
        """Round probabilities and return them with the novelty."""
        np.rint(_STEPS * probabilities, out=probabilities)
        probabilities /= _STEPS
        return probabilities, 1.0 - probabilities[:, self._is_named].max(axis=1, initial=0.0)


def _softmax(decision: Float64) -> Float64:
    """Return the probabilities of decision values; overwrites its argument."""
    decision -= decision.max(axis=1, keepdims=True)
    np.exp(decision, out=decision)
    probabilities: Float64 = decision / decision.sum(axis=1, keepdims=True)
    return probabilities
