"""From a folder of a collection to a manifest for `hearthlog train`."""

import csv
import io
import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip
from hearthlog.analyzer.collections.installed import FOLDER, Collection, check_folder
from hearthlog.analyzer.collections.label_map import SKIPPED, LabelMap, read_map
from hearthlog.analyzer.collections.spans import Part, labelled_parts
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import disarmed
from hearthlog.analyzer.training.manifest import OPTIONAL, REQUIRED, SIZE_LIMIT
from hearthlog.models.classes import OTHER_NEGATIVE
from hearthlog.models.classifiers.model import TEXT
from hearthlog.schemas.errors import Progress
from hearthlog.schemas.new_files import new_file

_COLUMNS = (*REQUIRED, *OPTIONAL, "detail")
_UNLABELLED = "nothing in it that the collection has a category for"
_TWICE = "listed twice"
_NOT_UTF_8 = "its name is not UTF-8"


@dataclass
class Summary:
    """What is in a manifest, and what is not.

    Attributes
    ----------
    files, missing : int
        Number of files that the collection lists, and of those that are not there.
    """

    clips: Counter[str] = field(default_factory=Counter)
    groups: dict[str, set[str]] = field(default_factory=dict)
    licences: Counter[str] = field(default_factory=Counter)
    negatives: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    files: int = 0
    missing: int = 0
    first_missing: Path | None = None


def make_manifest(  # noqa: PLR0913, PLR0917
    collection: Collection,
    folder: Path,
    output: Path,
    progress: Progress,
    map_file: Path | None = None,
    source: str = "",
    licence: str = "",
) -> Summary:
    """Write a manifest of a collection.

    Parameters
    ----------
    output : Path
        The manifest; must not exist. Paths in it are relative to its folder.
    progress : callable
        Is told the share of the files that was looked at, 0 to 1.
    source, licence : str
        Of a folder of one's own; the source is the folder's name if it is empty.

    Raises
    ------
    DataError
        If the folder is not of this collection, a table of it or the map cannot be read, nothing
        is left for the manifest, or it would be too large; if source or licence is no line of at
        most 300 characters.
    LogError
        If the manifest exists, or cannot be written.
    """
    check_folder(folder, collection)
    folder = folder.resolve()
    source = source or collection.title or folder.name
    for what, text in (("source", source), ("licence", licence)):
        if not TEXT.fullmatch(text):
            raise DataError(f"{text[:64]!r}: a {what} is one line of at most 300 characters")
    label_map = read_map(collection.name, map_file)
    clips = list(collection.read(folder))
    if collection == FOLDER:
        label_map = label_map.with_classes(folder, (clip.sounds[0].categories[0] for clip in clips))
        clips = [
            clip._replace(source_group=f"{source}_{clip.source_group}", licence=licence)
            for clip in clips
        ]
    summary = Summary(files=len(clips))
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for clip, part in _labelled(clips, label_map, summary, progress):
        path = os.path.relpath(clip.path, output.parent.resolve())
        times = _seconds_text(part.start), _seconds_text(part.end)
        about = part.label, clip.source_group, source, clip.licence
        writer.writerow(map(disarmed, (path, *about, *times, part.detail)))
    if not summary.clips:
        raise DataError(_nothing_left(folder, summary))
    raw = table.getvalue().encode(errors="replace")
    if len(raw) > SIZE_LIMIT:
        raise DataError(
            f"{output}: would be larger than {SIZE_LIMIT >> 20} MB, which `train` does not read; "
            "leave out some of the audio"
        )
    with new_file(output) as temporary:
        temporary.write_bytes(raw)
    return summary


def _labelled(
    clips: Sequence[CollectionClip], label_map: LabelMap, summary: Summary, progress: Progress
) -> Iterator[tuple[CollectionClip, Part]]:
    """Yield what belongs into the manifest, and count it and all else."""
    seen: set[tuple[Path, float, float]] = set()
    for number, clip in enumerate(clips):
        progress(number / len(clips))
        for part in _parts(clip, label_map, summary):
            span = clip.path, part.start, part.end
            if span in seen:
                summary.left_out[_TWICE] += 1
                continue
            seen.add(span)
            _count(summary, clip, part)
            yield clip, part
    progress(1.0)


def _parts(clip: CollectionClip, label_map: LabelMap, summary: Summary) -> Iterator[Part]:
    """Yield the parts of a file that belong into the manifest, and count all others."""
    parts, left_out = labelled_parts(clip.sounds, clip.seconds, label_map)
    if clip.left_out:
        summary.left_out[clip.left_out] += 1
    elif not clip.sounds:
        summary.left_out[_UNLABELLED] += 1
    elif not parts:
        _count_left_out(summary, left_out)
    elif not _is_file(clip.path):
        summary.missing += 1
        summary.first_missing = summary.first_missing or clip.path
    elif not _is_utf_8(clip.path):
        summary.left_out[_NOT_UTF_8] += 1
    else:
        _count_left_out(summary, left_out)
        yield from parts


def _count(summary: Summary, clip: CollectionClip, part: Part) -> None:
    summary.clips[part.label] += 1
    summary.groups.setdefault(part.label, set()).add(clip.source_group)
    summary.licences[clip.licence] += 1
    if part.label == OTHER_NEGATIVE:
        summary.negatives[part.detail] += 1


def _count_left_out(summary: Summary, left_out: Counter[tuple[str, str]]) -> None:
    for (reason, categories), count in left_out.items():
        summary.left_out[reason] += count
        if reason == SKIPPED:
            summary.skipped[categories] += count


def _nothing_left(folder: Path, summary: Summary) -> str:
    if summary.missing:
        return (
            f"{folder}: none of its {summary.missing:,} audio files is there, such as "
            f"{summary.first_missing}; download them too"
        )
    if not summary.left_out:
        return f"{folder}: lists no audio"
    reason, count = summary.left_out.most_common(1)[0]
    return f"{folder}: nothing in it is of use; of {count:,}: {reason}"


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name too long for any file
        return False


def _is_utf_8(path: Path) -> bool:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _seconds_text(value: float) -> str:
    """Write a time; nothing for the start and the end of a file."""
    return "" if value in {0.0, math.inf} else f"{value:.3f}".rstrip("0").rstrip(".")
