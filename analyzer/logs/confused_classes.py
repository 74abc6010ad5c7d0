"""Classes that a model takes for one another by its own test, and the one name people are shown."""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from hearthlog.analyzer.logs.recorder_info import attachments_of
from hearthlog.models.classes import FLUSHING_WATER, RUNNING_WATER, SHOWER, TAP_WATER, class_name
from hearthlog.models.modelfile.modelfile import DESCRIPTION
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.mcap.logfile import LogFile

WATER = (FLUSHING_WATER, SHOWER, TAP_WATER)
_RECALL = 0.5  # of a class that a model finds
_OF_HOME = 2  # classes that a home must have taught a model, to tell them apart


def common_names(description: Mapping[str, Any]) -> dict[str, str]:
    """Return the common name of each class of water, if a model does not tell them apart.

    A model, described as in `model.json` of a log, does not if, by its own test, it finds less than
    half of the sounds of one of them, unless its home has taught it two of them.
    """
    with suppress(AttributeError, KeyError, TypeError, ValueError):
        water = [name for name in description["classes"] if class_name(name) in WATER]
        taught = description["training_data"]["home"]
        if sum(taught.get(name, {}).get("segments", 0) > 0 for name in water) < _OF_HOME:
            scores = description["metrics"]["classes"]
            if any(float(scores[name]["recall"]) < _RECALL for name in water if name in scores):
                return dict.fromkeys(water, RUNNING_WATER)
    return {}


def common_names_of(path: Path, labels: Iterable[str]) -> dict[str, str]:
    """Read the common names of a log or a relabel layer, of all its models together.

    Empty if the file cannot be read, or does not describe its models, or if no label is of water.
    """
    names: dict[str, str] = {}
    if not any(class_name(label) in WATER for label in set(labels)):
        return names
    stem, suffix = DESCRIPTION.rsplit(".", 1)
    with suppress(LogError, OSError), LogFile(path) as file:
        for each in attachments_of(file):
            if each.name.startswith(stem + ".") and each.name.endswith("." + suffix):
                with suppress(ValueError, RecursionError):
                    found = json.loads(each.data)
                    names |= common_names(found) if isinstance(found, dict) else {}
    return names
