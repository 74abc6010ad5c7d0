"""Manifests of collections: categories mapped to labels, and parts with a single label."""

import csv
import io
import math
import os
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.collections import (
    FOLDER,
    CategorySpan,
    CollectionClip,
    CollectionFormat,
    check_folder,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import disarmed
from hearthlog.analyzer.training.manifest import OPTIONAL, REQUIRED, SIZE_LIMIT
from hearthlog.models.classes import OTHER, OTHER_NEGATIVE, UNKNOWN, find_class
from hearthlog.models.classifiers.model import TEXT
from hearthlog.schemas.errors import Progress, listed
from hearthlog.schemas.files import read_toml
from hearthlog.schemas.new_files import new_file

_KEYS = {"labels", "broad", "skip", "keep"}
BROAD = "only broad categories"
SKIPPED = "may be one of ours"
SEVERAL = "several sounds at once"


class Decision(NamedTuple):
    """Label of simultaneous categories in a manifest."""

    label: str  # empty if skipped
    detail: str
    reason: str = ""  # for skipping


@dataclass(frozen=True)
class LabelMap:
    """A map from categories to labels."""

    label_of: Mapping[str, str]
    broad: frozenset[str]
    skip: frozenset[str]
    keep: bool = False

    def decide(self, categories: Iterable[str]) -> Decision:
        """Return the label of simultaneous categories.

        Broad categories are ignored. The others must all have the same label; a category outside
        the map becomes `other_negative`, or its own name.
        """
        specific = [name for name in categories if name not in self.broad]
        detail = " + ".join(sorted(set(specific)))
        labels = {
            self.label_of.get(name, name if self.keep else OTHER_NEGATIVE) for name in specific
        }
        skipped = [name for name in specific if name in self.skip]
        if not specific:
            return Decision("", "", BROAD)
        if skipped:
            return Decision("", skipped[0], SKIPPED)
        if len(labels) > 1:
            return Decision("", detail, SEVERAL)
        return Decision(labels.pop(), detail)

    def with_classes(self, folder: Path, names: Iterable[str]) -> "LabelMap":
        """Return this map extended by class names as categories.

        Raise `DataError` if a name is neither in this map nor a class name.
        """
        label_of, unknown = dict(self.label_of), []
        for name in sorted(set(names) - self.label_of.keys() - self.broad - self.skip):
            row = find_class(name)
            if row is None or row.name in {OTHER, UNKNOWN}:
                unknown.append(repr(name[:64]))
            else:
                label_of[name] = row.name
        if unknown:
            raise DataError(
                f"{folder}: {listed(unknown[:10])}: no label is called so; rename the folder, or "
                "give a --map"
            )
        return replace(self, label_of=label_of)


def shipped_map(name: str) -> str:
    """Return the map of a collection that is part of hearthlog, as TOML."""
    return _shipped(name).read_text("utf-8")


def read_map(name: str, path: Path | None = None) -> LabelMap:
    """Read a map.

    Raise `DataError` if the file cannot be read, or is no map.
    """
    path = path or _shipped(name)
    content = read_toml(path, "map", DataError)
    unknown = content.keys() - _KEYS
    if unknown:
        raise DataError(
            f"{path}: unknown key {min(unknown)[:64]!r}; known are {', '.join(sorted(_KEYS))}"
        )
    labels = content.get("labels")
    if not isinstance(labels, dict):
        raise DataError(f"{path}: needs a table [labels]")
    keep = content.get("keep", False)
    if not isinstance(keep, bool):
        raise DataError(f"{path}: 'keep' must be true or false")
    rows = [(label, _categories(path, label, names)) for label, names in labels.items()]
    broad, skip = (_categories(path, key, content.get(key, [])) for key in ("broad", "skip"))
    every = [name for names in (broad, skip, *(names for _, names in rows)) for name in names]
    if len(set(every)) < len(every):
        twice = next(name for name in every if every.count(name) > 1)
        raise DataError(f"{path}: {twice[:64]!r} is in two places")
    label_of = {name: label for label, names in rows for name in names}
    return LabelMap(label_of, frozenset(broad), frozenset(skip), keep)


def _shipped(name: str) -> Path:
    return Path(str(files(__package__))) / "maps" / f"{name}.toml"


def _categories(path: Path, key: str, value: object) -> list[str]:
    texts = isinstance(value, list) and all(isinstance(name, str) for name in value)
    if not texts or not key.strip() or not TEXT.fullmatch(key):
        raise DataError(f'{path}: {key[:64]!r} must be a label with categories, such as ["Cough"]')
    assert isinstance(value, list)
    return value


_SHORTEST = 1.0  # seconds, minimum length for `train` to cut a segment

_Span = tuple[float, float]


class LabelledPart(NamedTuple):
    """A part of a file with one label; an infinite `end` is the end of the file."""

    label: str
    detail: str
    start: float
    end: float


def labelled_parts(
    sounds: Sequence[CategorySpan], seconds: float, label_map: LabelMap
) -> tuple[list[LabelledPart], Counter[tuple[str, str]]]:
    """Return the parts of a file, of infinite seconds if unknown, with a single label.

    A sound shorter than a second is extended evenly to one second. Sounds that overlap a sound of
    another label, or of a label that the map skips, are dropped; overlapping sounds of the same
    label are merged.
    """
    decided = [(sound, label_map.decide(sound.categories)) for sound in sounds]
    specific = [(sound, what) for sound, what in decided if what.reason != BROAD]
    covered: dict[str, list[_Span]] = {}
    for sound, what in specific:
        covered.setdefault(what.label, []).append((sound.start, sound.end))
    joined = {label: _joined(spans) for label, spans in covered.items()}
    alone: dict[str, list[tuple[_Span, str]]] = {}
    left_out: Counter[tuple[str, str]] = Counter()
    for sound, what in decided:
        span = _extended(sound, seconds)
        reason = what.reason or _reason(span, what, joined)
        if reason:
            left_out[reason, what.detail] += 1
        else:
            alone.setdefault(what.label, []).append((span, what.detail))
    parts = []
    for label, pieces in alone.items():
        spans = _joined(span for span, _ in pieces)
        names: list[set[str]] = [set() for _ in spans]
        for span, detail in pieces:
            names[bisect_right(spans, (span[0], math.inf)) - 1].add(detail)
        parts += [
            LabelledPart(label, " + ".join(sorted(details)), *span)
            for span, details in zip(spans, names, strict=True)
        ]
    return parts, left_out


def _extended(sound: CategorySpan, seconds: float) -> _Span:
    missing = _SHORTEST - (sound.end - sound.start)
    if missing <= 0:
        return sound.start, sound.end
    start = max(0.0, min(sound.start - missing / 2, seconds - _SHORTEST))
    return start, start + _SHORTEST


def _reason(span: _Span, what: Decision, joined: Mapping[str, list[_Span]]) -> str:
    others = (spans for label, spans in joined.items() if label != what.label)
    return SEVERAL if any(_overlaps(span, spans) for spans in others) else ""


def _overlaps(span: _Span, others: list[_Span]) -> bool:
    """Whether a span overlaps one of others, which are sorted and disjoint."""
    place = bisect_left(others, (span[1],))
    return place > 0 and others[place - 1][1] > span[0]


def _joined(spans: Iterable[_Span]) -> list[_Span]:
    """Sort spans, and merge touching or overlapping ones."""
    joined: list[_Span] = []
    for start, end in sorted(spans):
        if joined and start <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(end, joined[-1][1])
        else:
            joined.append((start, end))
    return joined


_MANIFEST_COLUMNS = (*REQUIRED, *OPTIONAL, "detail")
_UNLABELLED = "nothing in it that the collection has a category for"
_TWICE = "listed twice"
_NOT_UTF_8 = "its name is not UTF-8"


@dataclass
class ManifestSummary:
    """Counts of the clips in a manifest, and of skipped ones."""

    clips: Counter[str] = field(default_factory=Counter)
    groups: dict[str, set[str]] = field(default_factory=dict)
    licences: Counter[str] = field(default_factory=Counter)
    negatives: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    files: int = 0  # listed
    missing: int = 0  # of the listed files
    first_missing: Path | None = None


def make_manifest(  # noqa: PLR0913, PLR0917
    collection: CollectionFormat,
    folder: Path,
    output: Path,
    progress: Progress,
    map_file: Path | None = None,
    source: str = "",
    licence: str = "",
) -> ManifestSummary:
    """Write a manifest, which must not exist, of a collection, with paths relative to its folder.

    Source and licence are for your own folder; an empty source becomes the name of the folder.
    `progress` receives the completed share of the files, 0 to 1.

    Raise `DataError` if the folder is not of this collection, a table of it or the map cannot be
    read, nothing is left for the manifest, or it would be too large; if source or licence is no
    line of at most 300 characters; `LogError` if the manifest exists, or cannot be written.
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
    summary = ManifestSummary(files=len(clips))
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(_MANIFEST_COLUMNS)
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
    clips: Sequence[CollectionClip],
    label_map: LabelMap,
    summary: ManifestSummary,
    progress: Progress,
) -> Iterator[tuple[CollectionClip, LabelledPart]]:
    """Yield the parts for the manifest, and count them and all skipped parts."""
    seen: set[tuple[Path, float, float]] = set()
    for number, clip in enumerate(clips):
        progress(number / len(clips))
        for part in _parts_of_clip(clip, label_map, summary):
            span = clip.path, part.start, part.end
            if span in seen:
                summary.left_out[_TWICE] += 1
                continue
            seen.add(span)
            _count(summary, clip, part)
            yield clip, part
    progress(1.0)


def _parts_of_clip(
    clip: CollectionClip, label_map: LabelMap, summary: ManifestSummary
) -> Iterator[LabelledPart]:
    """Yield the parts of a file for the manifest, and count all others."""
    parts, left_out = labelled_parts(clip.sounds, clip.seconds, label_map)
    if clip.left_out:
        summary.left_out[clip.left_out] += 1
    elif not clip.sounds:
        summary.left_out[_UNLABELLED] += 1
    elif not parts:
        _count_left_out(summary, left_out)
    elif not os.path.isfile(clip.path):  # noqa: PTH113  False for a name too long for any file
        summary.missing += 1
        summary.first_missing = summary.first_missing or clip.path
    elif not _is_utf_8(clip.path):
        summary.left_out[_NOT_UTF_8] += 1
    else:
        _count_left_out(summary, left_out)
        yield from parts


def _count(summary: ManifestSummary, clip: CollectionClip, part: LabelledPart) -> None:
    summary.clips[part.label] += 1
    summary.groups.setdefault(part.label, set()).add(clip.source_group)
    summary.licences[clip.licence] += 1
    if part.label == OTHER_NEGATIVE:
        summary.negatives[part.detail] += 1


def _count_left_out(summary: ManifestSummary, left_out: Counter[tuple[str, str]]) -> None:
    for (reason, categories), count in left_out.items():
        summary.left_out[reason] += count
        if reason == SKIPPED:
            summary.skipped[categories] += count


def _nothing_left(folder: Path, summary: ManifestSummary) -> str:
    if summary.missing:
        return (
            f"{folder}: none of its {summary.missing:,} audio files is there, such as "
            f"{summary.first_missing}; download them too"
        )
    if not summary.left_out:
        return f"{folder}: lists no audio"
    reason, count = summary.left_out.most_common(1)[0]
    return f"{folder}: nothing in it is of use; of {count:,}: {reason}"


def _is_utf_8(path: Path) -> bool:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _seconds_text(value: float) -> str:
    """Format a time; empty for the start and the end of a file."""
    return "" if value in {0.0, math.inf} else f"{value:.3f}".rstrip("0").rstrip(".")
