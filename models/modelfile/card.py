"""Attachments about a model in a log: a card for people, a description for programs."""

import json

from hearthlog.models.classes import UNKNOWN
from hearthlog.models.classifiers.description import Description
from hearthlog.models.classifiers.installed import classifier_kind
from hearthlog.models.classifiers.model import Model
from hearthlog.models.licences import may_be_shipped
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.logs.writer import Attachment

CARD = "model_card.md"
DESCRIPTION = "model.json"
_FEW = 12  # sources


def attachment_of(name: str, microphone: str) -> str:
    """Name an attachment about the model of one microphone, where others have another model."""
    stem, suffix = name.rsplit(".", 1)
    return f"{stem}.{microphone}.{suffix}"


def model_attachments(model: Model) -> list[Attachment]:
    """Return the attachments of a log with labels of a model: its card and its description.

    Raise `ModelError` if the model's kind of classifier is not installed, or cannot be
    imported.
    """
    description = {"name": model.name, "sha256": model.sha256, **model.description.model_dump()}
    text = json.dumps(description, ensure_ascii=False)
    return [
        Attachment(CARD, "text/markdown", model_card(model).encode()),
        Attachment(DESCRIPTION, "application/json", text.encode()),
    ]


def model_card(model: Model) -> str:
    """Describe a model for people, as Markdown.

    Raise `ModelError` if the model's kind of classifier is not installed, or cannot be
    imported.
    """
    description, metrics = model.description, model.description.metrics
    amounts = description.training_data.classes
    purpose = (
        f"Tells apart {len(description.classes)} classes of sound in windows of "
        f"{description.window_seconds:g} s, from feature set {description.feature_set} "
        f"({description.kind}, {classifier_kind(description.kind).summary(model)})."
    )
    rest = f" without {UNKNOWN}" * (UNKNOWN in description.classes)
    lines = [
        f"# Model {model.name or description.scenario_name}",
        "",
        purpose,
        "",
        f"- sha256: {model.sha256 or 'not saved'}",
        f"- scenario: {description.scenario_name}",
        f"- macro F1{rest}: {metrics.macro_f1:.3f} ({metrics.folds} folds, none splits a source)",
        f"- expected calibration error: {metrics.expected_calibration_error:.3f}",
        f"- training data sha256: {description.training_data.sha256}",
        f"- made with: {', '.join(f'{k} {v}' for k, v in sorted(description.versions.items()))}",
        "",
        "| class | labels | sources | seconds | precision | recall | F1 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in description.classes:
        amount, result = amounts[name], metrics.classes[name]
        figures = (f"{value:.3f}" for value in (result.precision, result.recall, result.f1))
        if not amount.sources:  # a class of the home
            figures = ("-" for _ in range(3))
        lines.append(
            f"| {name} | {', '.join(description.scenario[name])} | {amount.sources} | "
            f"{amount.seconds:.0f} | {' | '.join(figures)} |"
        )
    thin = [f"{name} ({one.sources})" for name, one in amounts.items() if 0 < one.sources < _FEW]
    if thin:
        lines += ["", f"Thin, by sources, and not to be trusted much: {', '.join(thin)}"]
    if description.training_data.home:
        lines += [
            "",
            "Adapted to a home (the figures above are those before); learned besides:",
        ]
        kept = description.training_data.home_confirmed
        lines += [""] + [
            f"- {name}: {amount.segments} segments from {amount.sources} sources"
            + (f", {kept[name]} of them as they were labelled" if name in kept else "")
            for name, amount in description.training_data.home.items()
        ]
    if frames := description.training_data.home_frames:
        minutes = frames * FRAME_SECONDS / 60
        lines += ["", f"What follows what is from {minutes:.0f} minutes of a home without marks."]
    if arrays := description.direction_microphones:
        named = ", ".join(arrays)
        lines += ["", f"Takes the directions of {named}; other microphones are labelled without."]
    if (mix := description.embedding) is not None:
        wanted = (
            f"Takes what the network {mix.network} hears (projection {mix.projection_sha256[:12]}) "
            "where a log has it; elsewhere it labels by the features alone, and less often rightly."
        )
        lines += ["", wanted]
    if description.training_data.simulated:
        lines += ["", "Learned from simulated sounds alone: the figures are not of real ones."]
    lines += [*_elsewhere(description), "", "Learned from recordings of:", ""]
    lines += [
        f"- {item.name or 'unnamed'}: {item.clips} clips, {item.licence or 'licence unstated'}"
        for item in description.training_data.collections
    ]
    kept_back = [
        f"{item.name or 'unnamed'} ({item.licence or 'unstated'})"
        for item in description.training_data.collections
        if not may_be_shipped(item.licence)
    ]
    if kept_back:
        lines += ["", "Not to be passed on without asking, for what it learned from:", ""]
        lines += [f"- {text}" for text in kept_back]
    return "\n".join(lines) + "\n"


def _elsewhere(description: Description) -> list[str]:
    """Describe the scores in collections of which nothing was learned."""
    elsewhere = description.elsewhere
    if elsewhere is None:
        return []
    collections, segments = elsewhere.collections, elsewhere.segments
    amount = f"{collections} left out in turn, {segments} segments of its classes"
    lines = [
        "",
        f"In collections of which nothing was learned, as in a new home ({amount}):",
        "",
        f"- right: {elsewhere.right:.0%}",
        f"- expected calibration error: {elsewhere.expected_calibration_error:.3f}",
    ]
    if elsewhere.macro_f1 is None:
        return lines
    interval = elsewhere.macro_f1_interval
    between = f" ({interval[0]:.3f} to {interval[1]:.3f})" if interval else ""
    lines += [f"- macro F1: {elsewhere.macro_f1:.3f}{between}"]
    errors = {
        name: f", calibration error {error:.3f}"
        for name, error in elsewhere.calibration_errors.items()
    }
    lines += [
        f"- F1 of {name}: {f1:.3f}{errors.get(name, '')}" for name, f1 in elsewhere.classes.items()
    ]
    untried = [name for name in description.classes if name not in {*elsewhere.classes, UNKNOWN}]
    if untried:
        lines += [f"- not tried, for the other collections have too little: {', '.join(untried)}"]
    return lines
