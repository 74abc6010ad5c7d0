"""The models that label the sound of microphones: one, a candidate, and those of scenarios."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.names import is_by_names, without_classes
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.journal import say
from hearthlog.recorder.labelling.candidate_watch import CandidateWatch
from hearthlog.recorder.labelling.clashes import clash, shared_classes
from hearthlog.recorder.labelling.model_watch import Loaded, ModelWatch
from hearthlog.schemas.messages.topics import CANDIDATE, LIVE, scenario_labelling


class Change(NamedTuple):
    """A model takes over a labelling.

    Attributes
    ----------
    model : Model or None
        None for no labels.
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

    Raises
    ------
    ConfigurationError
        If one of a scenario is for another feature set, or two of them, the one on trial aside,
        label the same class.
    """

    def __init__(
        self,
        watch: ModelWatch | None = None,
        candidates: CandidateWatch | None = None,
        scenarios: Mapping[str, ModelWatch] | None = None,
        left_out: list[str] | None = None,
        features: FeatureSet = DEFAULT,
    ) -> None:
        self._watches = {} if watch is None else {LIVE: watch}
        for name, each in (scenarios or {}).items():
            self._watches[scenario_labelling(name)] = each
        self._candidates = candidates
        self._offered = None if candidates is None else candidates.first
        self.in_use: dict[str, Loaded] = {}
        self._left_out = left_out
        for labelling, each in list(self._watches.items()):
            if is_by_names(each.first.model):
                continue
            if reason := clash(each.first.model, self._others(labelling)):
                self.leave_out(labelling, f"model {each.first.model.name} {reason}")
            else:
                self.in_use[labelling] = each.first
        live = self.in_use.get(LIVE)
        self._features = features if live is None else live.classifier.feature_set
        self._change_names()
        self._change_trial()

    @property
    def model(self) -> Model | None:
        """The model that labels; None for no labels."""
        return self.in_use[LIVE].model if LIVE in self.in_use else None

    @property
    def starter(self) -> str:
        """Name of the starter model that labels from the start on; empty for another one."""
        return self._watches[LIVE].starter if LIVE in self._watches else ""

    @property
    def classifier(self) -> Classifier | None:
        """Of that model."""
        return self.in_use[LIVE].classifier if LIVE in self.in_use else None

    def beside(self) -> dict[str, Loaded]:
        """Return what labels beside that model, by labelling."""
        return {name: loaded for name, loaded in self.in_use.items() if name != LIVE}

    def leave_out(self, labelling: str, reason: str) -> None:
        """Let a scenario not label, and say why at the next call of `refusals`.

        Raise `ConfigurationError` if none may be left out.
        """
        text = f"{labelling.replace('/', ' ')}: {reason}"
        if self._left_out is None:
            raise ConfigurationError(text)
        self._left_out.append(text)
        del self._watches[labelling]
        self.in_use.pop(labelling, None)

    def refusals(self) -> Sequence[str]:
        """Return why models were refused since the last call, and look for others."""
        refusals = [f"{text}; it is left out until the next start" for text in self._left_out or ()]
        for text in refusals:
            say(text)
        if self._left_out:
            self._left_out = []
        for watch in self._watches.values():
            refusals += watch.refusals()
        if any(watch.ready is not None for watch in self._watches.values()):
            for watch in self._watches.values():
                watch.offer_again()
        while refused := self._refuse_clashes():
            refusals += filter(None, refused)
        if self._candidates is not None:
            for candidate in self._candidates.news():
                self._offered = candidate
            refusals += self._candidates.refusals()
        return refusals

    def _refuse_clashes(self) -> list[str]:
        """Refuse what is ready and shares a class with what would label beside it."""
        refused = []
        for labelling, watch in self._watches.items():
            if watch.ready is None or is_by_names(watch.first.model):
                continue
            if reason := clash(watch.ready.model, self._others(labelling)):
                refused.append(watch.refuse_ready(reason, self.in_use[labelling].model))
        return refused

    def may_change(self) -> bool:
        """Tell whether another model is ready to label."""
        is_ready = any(watch.ready is not None for watch in self._watches.values())
        return is_ready or self._trial_changes()

    def change(self) -> list[Change]:
        """Put the models in use that are ready."""
        changes = []
        for labelling, watch in self._watches.items():
            if watch.ready is not None:
                self.in_use[labelling], watch.ready, watch.held = watch.ready, None, None
                changes.append(Change(labelling, *self.in_use[labelling]))
        changes += self._change_names()
        if self._trial_changes():
            changes.append(self._change_trial())
        return changes

    def _change_names(self) -> list[Change]:
        """Leave to other models the classes that they were taught, and names only what is left."""
        changes = []
        for labelling, watch in self._watches.items():
            if not is_by_names(watch.first.model):
                continue
            whole = watch.first.model
            shared = shared_classes(whole, self._others(labelling).values())
            model = without_classes(whole, shared, self._features)
            before = self.in_use.pop(labelling, None)
            loaded = None
            if len(model.classes) > 1:
                same = before is not None and before.model.sha256 == model.sha256
                loaded = before if same else Loaded(model, Classifier(model))
            if loaded is not None:
                self.in_use[labelling] = loaded
            if _identity(loaded) != _identity(before):
                of_none = None, None
                changes.append(Change(labelling, *(of_none if loaded is None else loaded)))
        return changes

    def _others(self, labelling: str) -> dict[str, Model]:
        """Return the models that a model of a labelling must not share classes with."""
        others = {
            name: watch
            for name, watch in self._watches.items()
            if name != labelling and not is_by_names(watch.first.model)
        }
        loaded = {name: watch.ready or self.in_use.get(name) for name, watch in others.items()}
        return {name: each.model for name, each in loaded.items() if each is not None}

    def _change_trial(self) -> Change:
        loaded = self._on_trial()
        self.in_use.pop(CANDIDATE, None)
        if loaded is None:
            return Change(CANDIDATE, None, None)
        self.in_use[CANDIDATE] = loaded
        return Change(CANDIDATE, *loaded)

    def _trial_changes(self) -> bool:
        return _identity(self._on_trial()) != _identity(self.in_use.get(CANDIDATE))

    def _on_trial(self) -> Loaded | None:
        """Return the candidate, unless it is the model in use."""
        in_use = "" if self.model is None else self.model.sha256
        if self._offered is None or self._offered.model.sha256 == in_use:
            return None
        return self._offered


def _identity(loaded: Loaded | None) -> tuple[str, str] | None:
    return None if loaded is None else (loaded.model.name, loaded.model.sha256)
