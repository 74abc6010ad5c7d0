"""The names that a channel gives to the elements of an array of its messages."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns

_MOST_NAMES = 256


def array_names(metadata: Mapping[str, str], field: str) -> list[str]:
    """Return the names that a channel has for the elements of an array; none if one is unfit."""
    names = _names(metadata, field)
    fit = all(name.isprintable() for name in names) and len(set(names)) == len(names)
    return names if fit else []


def checked_array_names(path: Path, columns: Columns, field: str) -> tuple[str, ...]:
    """Return the names that a channel has for the elements of an array: one for each.

    Parameters
    ----------
    path : Path
        Of the log, for the message.
    columns : Columns
    field : str

    Raises
    ------
    LogError
        If there are no names, or too many, equal ones, or another number than elements.
    """
    where = f"{path}: {columns.topic}"
    names = _names(columns.metadata, field)
    if not names:
        raise LogError(f"{where}: the channel does not name its values")
    if len(names) > _MOST_NAMES or len(set(names)) < len(names):
        raise LogError(f"{where}: {len(names)} names, more than {_MOST_NAMES} or not all different")
    if columns[field].shape[1:] != (len(names),):
        raise LogError(f"{where}: some messages do not have a value for each of {len(names)} names")
    return tuple(names)


def _names(metadata: Mapping[str, str], field: str) -> list[str]:
    """Read a list of texts; none if it is anything else."""
    try:
        names: Any = json.loads(metadata.get(f"{field}_names", ""))
        "".join(names).encode()  # or JSON has other things than texts, or halves of characters
    except (ValueError, TypeError, RecursionError):
        return []
    return names if isinstance(names, list) else []
