"""Classes hidden from people, and common names of classes that a model confuses."""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from hearthlog.analyzer.logs.recorder_info import attachments_of
from hearthlog.models.classes import (
    RUNNING_WATER,
    WATER,
    class_name,
)
from hearthlog.models.modelfile import DESCRIPTION
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.logs.metadata import NEVER_TELL
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.new_files import create_file, replaced_file

NEVER_TELL_FILE = f"{NEVER_TELL}.json"
_LARGEST = 1 << 16  # bytes of the file
_MOST = 256  # classes
_NAMES = TypeAdapter(list[str])
_LEVELS = 4  # folders between a log and the folder of logs: year, month and day


def read_hidden_classes(folder: Path) -> frozenset[str]:
    """Return the classes of the list in a folder of logs; empty without a list.

    Raise `LogError` if the list is damaged.
    """
    path = folder / NEVER_TELL_FILE
    if not path.exists():
        return frozenset()
    try:
        names = _NAMES.validate_json(read_limited(path, "list of classes", _LARGEST, LogError))
    except ValidationError as error:
        raise LogError(f"{path}: is no list of classes; delete it, or write one anew") from error
    return frozenset(map(class_name, names[:_MOST]))


def write_hidden_classes(folder: Path, names: Iterable[str]) -> None:
    """Replace the list in a folder of logs; raise `LogError` or `OSError` on a failure."""
    with replaced_file(folder / NEVER_TELL_FILE) as temporary, create_file(temporary) as stream:
        stream.write(json.dumps(sorted(set(names))).encode())


def recorded_hidden_classes(record: Mapping[str, str]) -> frozenset[str]:
    """Return the classes of the configuration that a log was recorded with."""
    return frozenset(map(class_name, filter(None, record.get(NEVER_TELL, "").split(","))))


def hidden_classes_of_log(log: Path) -> frozenset[str]:
    """Return the classes of the list in the folder of logs that a log is in.

    Raise `LogError` if the list is damaged.
    """
    for folder in list(log.parents)[:_LEVELS]:
        if (folder / NEVER_TELL_FILE).exists():
            return read_hidden_classes(folder)
    return frozenset()


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
