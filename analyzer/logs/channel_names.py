"""The names that a channel gives to the elements of an array of its messages."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns

_MOST_NAMES = 256


def array_names(metadata: Mapping[str, str], field: str) -> list[str]:
    """Return the names that a channel gives to the elements of an array.

    Parameters
    ----------
    metadata : mapping of str to str
        Of the channel; its `<field>_names` is a JSON list of texts.
    field : str
        Path of the array in the message, such as `values`.

    Returns
    -------
    list of str
        In the order of the elements; empty if there are no names, if one cannot be printed, or if
        two are equal.
    """
    names = _names(metadata, field)
    fit = all(name.isprintable() for name in names) and len(set(names)) == len(names)
    return names if fit else []


def checked_array_names(path: Path, columns: Columns, field: str) -> tuple[str, ...]:
    """Return the names that a channel gives to the elements of an array: one for each.

    Parameters
    ----------
    field : str
        Path of the array in the message, such as `values`.

    Raises
    ------
    LogError
        If the messages have no such field, if there are no names or more than 256, if two names
        are equal, or if there are more or fewer names than elements.
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
