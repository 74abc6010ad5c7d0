"""Classes of rules that no model knows, by the models that a recorder is configured with."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from hearthlog.analyzer.bridge.alerts.rules import AlertRule, unheard_microphone, unknown_class
from hearthlog.analyzer.bridge.listeners import listener_name
from hearthlog.models.classes import OF_EVERY_SCENARIO, class_name
from hearthlog.models.errors import ModelError
from hearthlog.models.modelfile.modelfile import SUFFIX, load_model, starter_for
from hearthlog.models.modelfile.registry import DEFAULT_FOLDER, DEFAULT_MODEL, list_models
from hearthlog.models.starter import GENERAL
from hearthlog.recorder.config import NO_MODEL, Settings
from hearthlog.recorder.labelling.embedder_probe import likely_network


def unheard_classes(
    rules: Sequence[AlertRule], settings: Settings, microphones: Sequence[str]
) -> Iterator[str]:
    """Say which rules have a class that no model knows, or a microphone without a model."""
    models = {
        each.name: (each.model or settings.model or NO_MODEL, settings.scenarios_of(each))
        for each in settings.microphone
    }
    network = likely_network(settings.embedding)
    classes: dict[str, set[str]] = {}
    for name, (model, scenarios) in models.items():
        if model != NO_MODEL and (own := _classes_of(model, network)):
            beside = (_classes_of(each, network) for each in _beside(model))
            classes[name] = own.union(*beside)
        for scenario, file in scenarios.items():
            if own := _classes_of(file, network) - OF_EVERY_SCENARIO:
                classes[listener_name(name, scenario)] = own
    without = [name for name in microphones if models[name] == (NO_MODEL, {})]
    for rule in rules:
        line = unheard_microphone(rule, without) or unknown_class(rule, classes)
        yield from filter(None, [line])


def _classes_of(path: Path, network: str) -> set[str]:
    is_none_yet = path == DEFAULT_MODEL and not path.is_symlink()
    model = starter_for(Path(GENERAL) if is_none_yet else path, network)
    try:
        return set(map(class_name, load_model(model).classes))
    except ModelError:  # which is said where models are checked
        return set()


def _beside(path: Path) -> list[Path]:
    """Return the models of the same folder, any of which may be promoted."""
    folder = path.parent if path.suffix == SUFFIX else DEFAULT_FOLDER
    try:
        entries = list_models(folder)
    except ModelError:
        return []
    return [folder / f"{one.name}{SUFFIX}" for one in entries if one.model and not one.starter]
