"""DESED: sounds of homes, with times; ten categories.

Layout as its repository says, https://github.com/turpaultn/DESED, and its user
https://github.com/DCASE-REPO/DESED_task: below `metadata/train`, `metadata/validation` and
`metadata/eval` lie tables with `filename`, `onset`, `offset`, `event_label`, separated by tabs, in
which a file without any of the ten has empty fields; tables of other columns are weak labels or
none. Audio lies below `audio`, called `Y<YouTube id>_<from>_<to>.wav`, in `eval/public` without the
Y. Several tables have the same files.

Synthetic soundscapes, which have no YouTube id, are mixed from sounds that they share, and could
not be told apart as sources: they are left out. The sound of the others is of YouTube, without a
statement of a licence.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.analyzer.collections.files import audio_by_name, inside, read_table, seconds
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import read_text
from hearthlog.recorder.sources.audio_files import files_below

_COLUMNS = "filename", "onset", "offset", "event_label"
_NAME = re.compile(r"Y?([\w-]{11})_([\d.]+)_([\d.]+)\.wav", re.ASCII)
_TABLE_LIMIT = 128 << 20


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the files of the collection.

    Raise `DataError` if a table of the collection cannot be read, or there is none with times.
    """
    sounds: dict[str, dict[Sound, None]] = {}
    wheres: dict[str, str] = {}
    for path in _tables(folder):
        for where, (name, onset, offset, category) in read_table(path, _COLUMNS, "\t"):
            wheres.setdefault(name, where)
            heard = sounds.setdefault(name, {})
            if category:
                heard[Sound((category,), *seconds(where, onset, offset))] = None
    audio = audio_by_name(folder / "audio")
    for name, heard in sounds.items():
        found = _NAME.fullmatch(name)
        group, start, end = found.groups() if found else ("", "0", "0")
        path = inside(wheres[name], folder / "audio", name)
        first, last = seconds(wheres[name], start, end)
        yield CollectionClip(
            audio.get(path.name, path),
            tuple(heard),
            f"youtube_{group}",
            "unstated (sound of YouTube)",
            last - first,
            "" if found else "no YouTube id in its name",
        )


def _tables(folder: Path) -> list[Path]:
    """List the tables with times."""
    found = []
    for path in files_below(folder / "metadata"):
        if path.suffix == ".tsv":
            head = read_text(path, "table", _TABLE_LIMIT).partition("\n")[0]
            if set(_COLUMNS) <= {name.strip() for name in head.split("\t")}:
                found.append(path)
    if not found:
        columns = ", ".join(_COLUMNS)
        raise DataError(f"{folder / 'metadata'}: no *.tsv in it has the columns {columns}")
    return found
