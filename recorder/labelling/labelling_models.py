"""The models that label the sound of microphones: one in use, and one on trial beside it."""

from collections.abc import Sequence
from typing import NamedTuple

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.recorder.labelling.candidate_watch import CandidateWatch
from hearthlog.recorder.labelling.model_watch import Loaded, ModelWatch
from hearthlog.schemas.messages.topics import CANDIDATE, LIVE


class Change(NamedTuple):
    """A model takes over a labelling.

    Attributes
    ----------
    labelling : str
        `live`, or `candidate` for the model on trial.
    model : Model or None
        None for no labels.
    classifier : Classifier or None
        Of that model.
    """

    labelling: str
    model: Model | None
    classifier: Classifier | None


class LabellingModels:
    """The models of some microphones, and those that may take their place.

    Parameters
    ----------
    watch : ModelWatch or None
        Gives the models, one after the other; None for no labels.
    candidates : CandidateWatch or None
        Gives the models that label on trial beside them.

    Attributes
    ----------
    model, candidate : Model or None
        In use, and on trial.
    classifier, candidate_classifier : Classifier or None
        Of these.
    """

    def __init__(
        self, watch: ModelWatch | None = None, candidates: CandidateWatch | None = None
    ) -> None:
        self._watch = watch
        self._candidates = candidates
        self.model: Model | None
        self.classifier: Classifier | None
        self.model, self.classifier = (None, None) if watch is None else watch.first
        self._offered = None if candidates is None else candidates.first
        self.candidate: Model | None
        self.candidate_classifier: Classifier | None
        self.candidate, self.candidate_classifier = self._on_trial()

    def refusals(self) -> Sequence[str]:
        """Return why models were refused since the last call, and look for others."""
        refusals: list[str] = []
        if self._watch is not None:
            refusals += self._watch.refusals()
        if self._candidates is not None:
            for candidate in self._candidates.news():
                self._offered = candidate
            refusals += self._candidates.refusals()
        return refusals

    def may_change(self) -> bool:
        """Tell whether another model is ready to label."""
        is_ready = self._watch is not None and self._watch.ready is not None
        return is_ready or self._trial_changes()

    def change(self) -> list[Change]:
        """Put the models in use that are ready."""
        changes = []
        if self._watch is not None and self._watch.ready is not None:
            (self.model, self.classifier), self._watch.ready = self._watch.ready, None
            changes.append(Change(LIVE, self.model, self.classifier))
        if self._trial_changes():
            self.candidate, self.candidate_classifier = self._on_trial()
            changes.append(Change(CANDIDATE, self.candidate, self.candidate_classifier))
        return changes

    def _trial_changes(self) -> bool:
        model, _ = self._on_trial()
        return _identity(model) != _identity(self.candidate)

    def _on_trial(self) -> Loaded | tuple[None, None]:
        """Return the candidate, unless it is the model in use."""
        in_use = "" if self.model is None else self.model.sha256
        if self._offered is None or self._offered.model.sha256 == in_use:
            return None, None
        return self._offered


def _identity(model: Model | None) -> tuple[str, str] | None:
    return None if model is None else (model.name, model.sha256)
