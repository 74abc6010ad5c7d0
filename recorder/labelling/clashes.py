"""Classes that two models label at once: who counts sounds by class could not tell them apart."""

from collections.abc import Iterable, Mapping

from hearthlog.models.classes import OF_EVERY_SCENARIO, class_name
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.messages.topics import LIVE, spelt


def clash(model: Model, others: Mapping[str, Model]) -> str:
    """Say which class of a model another one labels as well.

    Returns
    -------
    str
        The rest of a sentence that begins with the model; empty if there is none. Two names of a
        class are one class; `silence`, `unknown` and `other` may be of every model.
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
    """Return the classes of a model that others label as well, by its names."""
    theirs = {name for other in others for name in _classes(other)}
    return [label for name, label in _classes(model).items() if name in theirs]


def _classes(model: Model) -> dict[str, str]:
    """Return the names of classes of a model, by those that two spellings share."""
    names = {class_name(spelt(label)): label for label in model.classes}
    return {name: label for name, label in names.items() if name not in OF_EVERY_SCENARIO}
