"""Checks of rules against the configuration and models: rules that can never notify."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.activity import ANY_SOUND
from hearthlog.analyzer.activity.day_anomaly import FEWEST as FEWEST_ROUTINE
from hearthlog.analyzer.activity.segments import source_microphone, source_name
from hearthlog.analyzer.activity.values import FEWEST as FEWEST_USUAL
from hearthlog.analyzer.bridge.alerts.rules import (
    MINUTE,
    AlertRule,
    MoreThan,
    SoundRule,
    UnlikeUsual,
    UnusualDay,
    duration_words,
    is_hidden,
    pause_of,
)
from hearthlog.models.classes import OF_EVERY_SCENARIO, SILENCE, class_name
from hearthlog.models.classifiers.network_names import AUDIOSET
from hearthlog.models.embedding.sound_names import audioset_names
from hearthlog.models.modelfile import SUFFIX, load_model, starter_for
from hearthlog.models.registry import DEFAULT_FOLDER, DEFAULT_MODEL, list_models
from hearthlog.models.starter import GENERAL
from hearthlog.recorder.config import NO_MODEL, Settings
from hearthlog.recorder.labelling.embedder_probe import likely_network
from hearthlog.schemas.errors import ModelError, listed


def unknown_class(rule: AlertRule, classes: Mapping[str, Collection[str]]) -> str:
    """Report that no model has the class of a rule; empty if one has, or no classes are known."""
    if not isinstance(rule, SoundRule) or rule.label == ANY_SOUND:
        return ""
    own = [
        names for name, names in classes.items() if rule.microphone in {"", source_microphone(name)}
    ]
    if not own or any(rule.label in names for names in own):
        return ""
    there = listed(sorted(set().union(*own) - {SILENCE}), "and")
    return (
        f"{rule.name}: no model here has the class {rule.label!r}; there are "
        f"{there}{_of_network(rule.label)}"
    )


def _of_network(label: str) -> str:
    """Format a hint if the embedding network has a name for a class; empty otherwise."""
    name = next((each for each in audioset_names() if each.name == label), None)
    if name is None:
        return ""
    if name.is_event:
        return f'; scenarios = {{{AUDIOSET} = "{AUDIOSET}"}} brings it, with a network of sounds'
    return "; the network has a name for it, but its names are hints and not counted"


def unknown_microphone(
    rule: AlertRule, microphones: Collection[str], *, recorded: bool = False
) -> str:
    """Report that a rule's microphone is not configured or, if `recorded`, not in the logs.

    Empty if the microphone is there.
    """
    name = rule.microphone if isinstance(rule, SoundRule) else ""
    if not microphones or name in {"", *microphones}:
        return ""
    lacks = (
        f"nothing of the microphone {name!r} was recorded in this time"
        if recorded
        else f"there is no microphone {name!r}"
    )
    return f"{rule.name}: {lacks}; there is {listed(sorted(microphones))}"


def hidden_class(rule: AlertRule, hidden: Collection[str]) -> str:
    """Report that nobody is told of the class of a rule; empty if it is not hidden."""
    if not is_hidden(rule, hidden):
        return ""
    return (
        f"{rule.name}: {rule.words.lower()} is hidden (never_tell, or the page of the home), so it "
        "never notifies"
    )


_JUDGED_AND_TODAY = 2  # days, in addition to the baseline


def rule_doubts(
    rules: Sequence[AlertRule], settings: Settings, microphones: Sequence[str]
) -> Iterator[str]:
    """Report the rules that can never notify with the configuration of the recorder.

    Names are not checked if no configured microphones are given.
    """
    hidden = set(map(class_name, settings.never_tell))
    for rule in rules:
        lines = (
            hidden_class(rule, hidden),
            unknown_microphone(rule, microphones),
            impossible_amount(rule),
        )
        yield from filter(None, (*lines, unkept_days(rule, settings)))


def impossible_amount(rule: AlertRule) -> str:
    """Report that the limit of a rule cannot be exceeded in its window; empty if it can."""
    if not isinstance(rule, MoreThan):
        return ""
    if rule.minutes is not None and rule.minutes * MINUTE >= rule.window:
        amount = f"{rule.minutes:g} minutes"
    # Events are more than a pause apart, and the first one may end as the window begins.
    elif rule.count is not None and rule.count > rule.window // pause_of(rule) + 1:
        amount = f"{rule.count} events"
    else:
        return ""
    return (
        f"{rule.name}: there cannot be more than {amount} in a window of "
        f"{duration_words(rule.window)}, so it never notifies"
    )


def unkept_days(rule: AlertRule, settings: Settings) -> str:
    """Report that logs are deleted before a baseline has enough days; empty if not."""
    if isinstance(rule, UnlikeUsual):
        fewest = FEWEST_USUAL
    elif isinstance(rule, UnusualDay):
        fewest = FEWEST_ROUTINE
    else:
        return ""
    needed, kept = fewest + _JUDGED_AND_TODAY, settings.retention_days
    if not 0 < kept < needed:
        return ""
    return (
        f"{rule.name}: retention_days = {kept} leaves it no {fewest} days to compare with, so it "
        f"never notifies; keep {needed} or more"
    )


def unknown_class_problems(
    rules: Sequence[AlertRule], settings: Settings, microphones: Sequence[str]
) -> Iterator[str]:
    """Report rules with a class that no model has, or with a microphone without a model."""
    models = {
        each.name: (each.model or settings.model or NO_MODEL, settings.scenarios_of(each))
        for each in settings.microphone
    }
    network = likely_network(settings.embedding)
    classes: dict[str, set[str]] = {}
    for name, (model, scenarios) in models.items():
        if model != NO_MODEL and (own := _classes_of(model, network)):
            others = (_classes_of(each, network) for each in _neighbours(model))
            classes[name] = own.union(*others)
        for scenario, file in scenarios.items():
            if own := _classes_of(file, network) - OF_EVERY_SCENARIO:
                classes[source_name(name, scenario)] = own
    without = [name for name in microphones if models[name] == (NO_MODEL, {})]
    for rule in rules:
        line = unknown_class(rule, classes)
        if isinstance(rule, SoundRule) and rule.microphone in without:
            line = (
                f"{rule.name}: the microphone {rule.microphone!r} has no model, so that no sound "
                "of it has a class"
            )
        yield from filter(None, [line])


def _classes_of(path: Path, network: str) -> set[str]:
    is_none_yet = path == DEFAULT_MODEL and not path.is_symlink()
    model = starter_for(Path(GENERAL) if is_none_yet else path, network)
    try:
        return set(map(class_name, load_model(model).classes))
    except ModelError:  # reported by the check of models
        return set()


def _neighbours(path: Path) -> list[Path]:
    """Return the models in the folder of a model, any of which may be promoted."""
    folder = path.parent if path.suffix == SUFFIX else DEFAULT_FOLDER
    try:
        entries = list_models(folder)
    except ModelError:
        return []
    return [folder / f"{one.name}{SUFFIX}" for one in entries if one.model and not one.starter]
