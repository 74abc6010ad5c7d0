"""What a file of hearthlog says of what made it: its metadata record `hearthlog`."""

import warnings
from collections.abc import Mapping
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from hearthlog._version import __version__
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.versions import SCHEMA_VERSION

METADATA = "hearthlog"
THINNED = "thinned"  # what was dropped of a log
THINNED_OF = "thinned_of"  # digests that it had before, one for each time
_KEY = "schema_version"
_FIRST = "1"  # did not write it
_KNOWN = {str(number): number for number in range(1, SCHEMA_VERSION + 1)}
_LARGEST, _MOST = 1 << 20, 64 << 20  # bytes of one record, and of all; ours have less than 1000


def provenance(node: str, **more: str) -> dict[str, str]:
    """Make the record of a file that this version writes."""
    return {"version": __version__, _KEY: str(SCHEMA_VERSION), "node": node, **more}


def read_provenance(file: LogFile) -> list[Mapping[str, str]]:
    """Read the records of a file, each different one once.

    A record of a newer version gives a `HearthlogWarning`.

    Returns
    -------
    list of mapping of str to str
        One, or those of all logs that were merged; empty if the file is not of hearthlog.

    Raises
    ------
    LogError
        If a record is damaged.
    """
    records = provenance_records(file)
    for record in records:
        check_version(record, file.path)
    return records


def provenance_records(file: LogFile) -> list[Mapping[str, str]]:
    """Read the records of a file as `read_provenance` does, whatever their version.

    Raise `LogError` if a record is damaged.
    """
    different: dict[frozenset[tuple[str, str]], Mapping[str, str]] = {}
    size = 0
    for place in file.record_locations:
        if place.opcode == Opcode.METADATA and place.length <= _LARGEST and size < _MOST:
            record = file.record(place)
            size += place.length
            if isinstance(record, Metadata) and record.name == METADATA:
                different.setdefault(frozenset(record.metadata.items()), record.metadata)
    return list(different.values())


def version_text(record: Mapping[str, str]) -> str:
    """Return the schema version that a record names, which need not be a number."""
    return record.get(_KEY, _FIRST)


def schema_version(record: Mapping[str, str]) -> int | None:
    """Return the schema version of a record.

    Returns
    -------
    int or None
        None if this version of hearthlog does not know it.
    """
    return _KNOWN.get(version_text(record))


def describes_model(record: Mapping[str, str]) -> bool:
    """Tell whether a log with such a record has `model.json`, if it has labels."""
    version = schema_version(record)
    return version is not None and version > 1


def unknown_version(record: Mapping[str, str]) -> str:
    """Say that a record has a schema version that this version does not know.

    Returns
    -------
    str
        The rest of a sentence that begins with the file; empty if the version is known.
    """
    if schema_version(record) is not None:
        return ""
    return (
        f"is of schema version {version_text(record)[:20]!r}, and this hearthlog knows up to "
        f"{SCHEMA_VERSION}: what is newer in it is not read; update hearthlog"
    )


def check_version(record: Mapping[str, str], path: Path) -> None:
    """Give a `HearthlogWarning` if a file has a schema version that this version does not know."""
    text = unknown_version(record)
    if text:
        warnings.warn(HearthlogWarning(text, path), stacklevel=2)
