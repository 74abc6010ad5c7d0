"""AudioSet with times: 456 categories, in ten-second pieces of YouTube's videos.

Layout as https://research.google.com/audioset/download_strong.html says: tables
`audioset_train_strong.tsv` and `audioset_eval_strong.tsv` with `segment_id`, `start_time_seconds`,
`end_time_seconds`, `label`, separated by tabs; a segment is `<YouTube id>_<from, in milliseconds>`,
a label is an id that `mid_to_display_name.tsv` names. The collection has no audio. People keep
theirs as `<YouTube id>.wav` or with times behind it, in seconds or milliseconds, with or without a
leading Y, in any format: all of this is found, anywhere in the folder. It is of YouTube, without a
statement of a licence.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.analyzer.collections.files import inside, read_table, seconds
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import csv_records, read_text
from hearthlog.recorder.sources.audio_files import files_below
from hearthlog.recorder.sources.open_audio import is_audio

_COLUMNS = "segment_id", "start_time_seconds", "end_time_seconds", "label"
_SEGMENT = re.compile(r"([\w-]{11})_(\d{1,12})", re.ASCII)
_FILE = re.compile(r"Y?([\w-]{11})(?:_(\d{1,12}(?:\.\d+)?)(?:_\d{1,12}(?:\.\d+)?)?)?", re.ASCII)
_CLIP_SECONDS = 10.0
_NAMES_LIMIT = 1 << 20


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the segments of the collection.

    Raise `DataError` if a table of the collection cannot be read, or there is none with times.
    """
    names = _names(folder / "mid_to_display_name.tsv")
    tables = sorted(folder.glob("*_strong.tsv"))
    if not tables:
        raise DataError(f"{folder}: no audioset_train_strong.tsv or audioset_eval_strong.tsv in it")
    sounds: dict[str, list[Sound]] = {}
    wheres: dict[str, str] = {}
    for path in tables:
        for where, (segment, start, end, label) in read_table(path, _COLUMNS, "\t"):
            wheres.setdefault(segment, where)
            heard = sounds.setdefault(segment, [])
            heard.append(Sound((names.get(label, label),), *seconds(where, start, end)))
    audio = _audio(folder)
    for segment, heard in sounds.items():
        found = _SEGMENT.fullmatch(segment)
        if found is None:
            raise DataError(f"{wheres[segment]}: {segment[:64]!r} is no segment of AudioSet")
        video, start = found.groups()
        first = float(start)
        paths = (audio.get((video, time)) for time in (first, first / 1000, None))
        yield CollectionClip(
            next(filter(None, paths), inside(wheres[segment], folder, segment)),
            tuple(heard),
            f"youtube_{video}",
            "unstated (sound of YouTube)",
            _CLIP_SECONDS,
        )


def _names(path: Path) -> dict[str, str]:
    """Read the names of labels."""
    rows = csv_records(path, read_text(path, "table", _NAMES_LIMIT), "\t")
    return {row[0].strip(): row[1].strip() for _, row in rows if len(row) > 1}


def _audio(folder: Path) -> dict[tuple[str, float | None], Path]:
    """Find audio by the id of the video and the time in the name of a file."""
    audio: dict[tuple[str, float | None], Path] = {}
    for path in files_below(folder):
        found = _FILE.fullmatch(path.stem) if is_audio(path.name) else None
        if found is not None:
            video, start = found.groups()
            audio.setdefault((video, None if start is None else float(start)), path)
    return audio
