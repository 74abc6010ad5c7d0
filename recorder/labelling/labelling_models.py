"""Models of a microphone: live, candidate and scenarios, and conflicts between their classes."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple

from hearthlog.models.classes import OF_EVERY_SCENARIO, class_name
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.network_names import is_by_names, without_classes
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import DEFAULT, feature_set
from hearthlog.models.modelfile import SUFFIX
from hearthlog.models.registry import DEFAULT_FOLDER
from hearthlog.recorder.config import NO_MODEL, Settings
from hearthlog.recorder.host import announce
from hearthlog.recorder.labelling.model_watch import (
    CandidateWatch,
    Loaded,
    ModelWatch,
    ReloadRequests,
)
from hearthlog.schemas.errors import ConfigurationError, ModelError
from hearthlog.schemas.messages.topics import CANDIDATE, LIVE, scenario_labelling, spelt


def class_conflict(model: Model, others: Mapping[str, Model]) -> str:
    """Return the rest of a sentence that begins with the model, or an empty text without conflict.

    Aliases of a class are one class; every model may have `silence`, `unknown` and `other`.
    """
    own = _classes(model)
    for labelling, other in others.items():
        for name, theirs in _classes(other).items():
            if name in own:
                alias = "" if own[name] == theirs else f" (there {theirs!r})"
                what = "the live model" if labelling == LIVE else labelling.replace("/", " ")
                return (
                    f"labels {own[name]!r}, and so does {what}, {other.name}{alias}; each class "
                    "can be of one only: leave one of them out, or train one without the class"
                )
    return ""


def shared_classes(model: Model, others: Iterable[Model]) -> list[str]:
    """Return the classes that a model shares with others, as the model names them."""
    theirs = {name for other in others for name in _classes(other)}
    return [label for name, label in _classes(model).items() if name in theirs]


def _classes(model: Model) -> dict[str, str]:
    """Return the class labels of a model, by canonical name."""
    names = {class_name(spelt(label)): label for label in model.classes}
    return {name: label for name, label in names.items() if name not in OF_EVERY_SCENARIO}


class ModelChange(NamedTuple):
    """A change of the model of a labelling."""

    labelling: str
    model: Model | None  # None for no labels
    classifier: Classifier | None


class LabellingModels:
    """The models of some microphones, and their possible replacements; no labels without `watch`.

    Raise `ConfigurationError` if a scenario's model is for another feature set, or two models
    except the candidate label the same class.
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
            if reason := class_conflict(each.first.model, self._others(labelling)):
                self.leave_out(labelling, f"model {each.first.model.name} {reason}")
            else:
                self.in_use[labelling] = each.first
        live = self.in_use.get(LIVE)
        self._features = features if live is None else live.classifier.feature_set
        self._change_names()
        self._change_trial()

    @property
    def model(self) -> Model | None:
        """The live model; None for no labels."""
        return self.in_use[LIVE].model if LIVE in self.in_use else None

    @property
    def starter(self) -> str:
        """Name of the starter model in use at the start; empty for another model."""
        return self._watches[LIVE].starter if LIVE in self._watches else ""

    @property
    def classifier(self) -> Classifier | None:
        """Classifier of the live model."""
        return self.in_use[LIVE].classifier if LIVE in self.in_use else None

    def secondary(self) -> dict[str, Loaded]:
        """Return the models other than the live one, by labelling."""
        return {name: loaded for name, loaded in self.in_use.items() if name != LIVE}

    def leave_out(self, labelling: str, reason: str) -> None:
        """Disable a scenario for a reason that `refusals()` reports.

        Raise `ConfigurationError` if scenarios may not be disabled.
        """
        text = f"{labelling.replace('/', ' ')}: {reason}"
        if self._left_out is None:
            raise ConfigurationError(text)
        self._left_out.append(text)
        del self._watches[labelling]
        self.in_use.pop(labelling, None)

    def refusals(self) -> Sequence[str]:
        """Return the refusals of models since the last call, and check for new models."""
        refusals = [f"{text}; it is left out until the next start" for text in self._left_out or ()]
        for text in refusals:
            announce(text)
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
        """Refuse ready models that share a class with another model in use."""
        refused = []
        for labelling, watch in self._watches.items():
            if watch.ready is None or is_by_names(watch.first.model):
                continue
            if reason := class_conflict(watch.ready.model, self._others(labelling)):
                refused.append(watch.refuse_ready(reason, self.in_use[labelling].model))
        return refused

    def may_change(self) -> bool:
        """Return whether another model is ready to label."""
        is_ready = any(watch.ready is not None for watch in self._watches.values())
        return is_ready or self._trial_changes()

    def change(self) -> list[ModelChange]:
        """Put the ready models into use."""
        changes = []
        for labelling, watch in self._watches.items():
            if watch.ready is not None:
                self.in_use[labelling], watch.ready, watch.held = watch.ready, None, None
                changes.append(ModelChange(labelling, *self.in_use[labelling]))
        changes += self._change_names()
        if self._trial_changes():
            changes.append(self._change_trial())
        return changes

    def _change_names(self) -> list[ModelChange]:
        """Reduce models by names to the classes that no trained model labels."""
        changes = []
        for labelling, watch in self._watches.items():
            if not is_by_names(watch.first.model):
                continue
            full = watch.first.model
            shared = shared_classes(full, self._others(labelling).values())
            model = without_classes(full, shared, self._features)
            before = self.in_use.pop(labelling, None)
            loaded = None
            if len(model.classes) > 1:
                same = before is not None and before.model.sha256 == model.sha256
                loaded = before if same else Loaded(model, Classifier(model))
            if loaded is not None:
                self.in_use[labelling] = loaded
            if _identity(loaded) != _identity(before):
                of_none = None, None
                changes.append(ModelChange(labelling, *(of_none if loaded is None else loaded)))
        return changes

    def _others(self, labelling: str) -> dict[str, Model]:
        """Return the models that must not share classes with the model of a labelling."""
        others = {
            name: watch
            for name, watch in self._watches.items()
            if name != labelling and not is_by_names(watch.first.model)
        }
        loaded = {name: watch.ready or self.in_use.get(name) for name, watch in others.items()}
        return {name: each.model for name, each in loaded.items() if each is not None}

    def _change_trial(self) -> ModelChange:
        loaded = self._on_trial()
        self.in_use.pop(CANDIDATE, None)
        if loaded is None:
            return ModelChange(CANDIDATE, None, None)
        self.in_use[CANDIDATE] = loaded
        return ModelChange(CANDIDATE, *loaded)

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


def open_models(  # noqa: PLR0913
    settings: Settings,
    microphones: Sequence[str],
    reload_requests: ReloadRequests | None,
    stack: ExitStack,
    *,
    leaves_out: bool = False,
    network: str = "",
) -> dict[str, LabellingModels]:
    """Load and watch the models of microphones; microphones with equal models share them.

    With `leaves_out`, scenarios that cannot label are disabled. Raise `ModelError` if a model
    cannot be used, `ConfigurationError` if models conflict with each other.
    """
    reload_requests = reload_requests or ReloadRequests()
    chosen = {
        each.name: (each.model or settings.model or NO_MODEL, settings.scenarios_of(each))
        for each in settings.microphone
    }
    models: dict[str, LabellingModels] = {}
    for name in microphones:
        same = next((other for other in models if chosen[other] == chosen[name]), None)
        models[name] = (
            _watched_models(
                settings, *chosen[name], reload_requests, stack, network, leaves_out=leaves_out
            )
            if same is None
            else models[same]
        )
    return models


def _watched_models(  # noqa: PLR0913, PLR0917
    settings: Settings,
    path: Path,
    scenarios: Mapping[str, Path],
    reload_requests: ReloadRequests,
    stack: ExitStack,
    network: str,
    *,
    leaves_out: bool,
) -> LabellingModels:
    watches = {}
    left_out: list[str] | None = [] if leaves_out else None
    for name, file in scenarios.items():
        try:
            watch = ModelWatch(file, reload_requests.queue(), name, network)
            watches[name] = stack.enter_context(closing(watch))
        except ModelError as error:
            if left_out is None:
                raise
            left_out.append(str(error))
    if path == NO_MODEL:
        features = feature_set(settings.feature_set or DEFAULT.name)
        return LabellingModels(scenarios=watches, left_out=left_out, features=features)
    watch = ModelWatch(path, reload_requests.queue(), network=network)
    stack.enter_context(closing(watch))
    is_file = path.suffix == SUFFIX  # else the name of a starter model
    folder = path.parent if is_file else DEFAULT_FOLDER
    candidates = CandidateWatch(folder, watch.first.classifier.feature_set)
    stack.enter_context(closing(candidates))
    return LabellingModels(watch, candidates, watches, left_out)
