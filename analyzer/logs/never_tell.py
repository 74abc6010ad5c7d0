"""Classes that nobody is told of: those of the configuration, and those of a list beside the logs.

The recorder writes those of its configuration into its logs. The list is a file in the folder of
logs, so that it holds wherever the logs are read, and for what was recorded before.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from hearthlog.models.classes import class_name
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import read_limited
from hearthlog.schemas.logs.metadata import NEVER_TELL
from hearthlog.schemas.new_files import create_file, replaced_file

NEVER_TELL_FILE = f"{NEVER_TELL}.json"
_LARGEST = 1 << 16  # bytes of the file
_MOST = 256  # classes
_NAMES = TypeAdapter(list[str])
_LEVELS = 4  # folders between a log and the folder of logs: year, month and day


def read_list(folder: Path) -> frozenset[str]:
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


def write_list(folder: Path, names: Iterable[str]) -> None:
    """Replace the list in a folder of logs; raise `LogError` or `OSError` on a failure."""
    with replaced_file(folder / NEVER_TELL_FILE) as temporary, create_file(temporary) as stream:
        stream.write(json.dumps(sorted(set(names))).encode())


def recorded_list(record: Mapping[str, str]) -> frozenset[str]:
    """Return the classes of the configuration that a log was recorded with."""
    return frozenset(map(class_name, filter(None, record.get(NEVER_TELL, "").split(","))))


def list_of_log(log: Path) -> frozenset[str]:
    """Return the classes of the list in the folder of logs that a log is in.

    Raise `LogError` if the list is damaged.
    """
    for folder in list(log.parents)[:_LEVELS]:
        if (folder / NEVER_TELL_FILE).exists():
            return read_list(folder)
    return frozenset()
