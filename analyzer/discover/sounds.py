"""Sounds of a home: reading of logs, group assignment, and marks of named groups."""

import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.discover import (
    NO_CLUSTER,
    NamedSpans,
    Occurrences,
    places,
    read_each,
)
from hearthlog.analyzer.discover.groups import (
    GROUPS,
    LEAST,
    Groups,
    add_groups,
    describe,
    descriptor_width,
    identified,
    is_embedded,
    new_groups,
)
from hearthlog.analyzer.errors import DataError, collect_errors
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs
from hearthlog.analyzer.logs.selection import checked_array_names
from hearthlog.analyzer.logs.sound_vectors import mean_embeddings
from hearthlog.analyzer.logs.spans import concatenated_ranges
from hearthlog.analyzer.marks.marks import (
    Mark,
    MarkedSpan,
    ReviewedSpan,
    read_marks,
    read_reviewed,
    write_marks,
)
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, EmbeddingSpace, topic

ALL, UNSURE, ONLY_UNKNOWN = CHOICES = ("all", "unsure", "unknown")
# A sound has at least four frames and may contain two silent ones; stamps follow a clock.
_PAUSE = 3 * FRAME_NANOSECONDS + FRAME_NANOSECONDS // 2
_LEAST_NANOSECONDS = 3 * FRAME_NANOSECONDS - FRAME_NANOSECONDS // 2
_BEFORE = np.int64(-1 << 62)  # before any time
_UNSURE_CONFIDENCE = 0.5  # same as for clips that the model is unsure of
_FIELDS = {"header.stamp", "values", "label", "confidence"}


class SoundSpans(NamedTuple):
    """Sounds of one microphone in one log."""

    starts: Int64  # [shape=(n,)], in nanoseconds of UTC, ascending
    ends: Int64  # likewise
    first: Int64  # [shape=(n,)]; feature row
    last: Int64  # [shape=(n,)]; exclusive
    labels: NDArray[np.str_]  # [shape=(n,)]; most frequent label of the sounding frames
    confidence: Float64  # [shape=(n,)]; mean of the labels

    def rows(self, rows: Bool) -> "SoundSpans":
        """Select rows."""
        return SoundSpans(*map(itemgetter(rows), self))

    def chosen(self, choice: str) -> "SoundSpans":
        """Return all sounds, the sounds with unsure labels, or the sounds of unknown class."""
        if choice == ALL:
            return self
        keep = self.labels == UNKNOWN
        if choice == UNSURE:
            keep |= self.confidence < _UNSURE_CONFIDENCE
        return self.rows(keep)


def _find_sounds(
    stamps: Int64, label_stamps: Int64, labels: NDArray[np.object_], confidence: Float32
) -> SoundSpans:
    """Return the sounds of a log, runs of labels other than silence; all stamps ascend."""
    rows = np.minimum(np.searchsorted(stamps, label_stamps), max(len(stamps) - 1, 0))
    there = labels != SILENCE
    there &= stamps[rows] == label_stamps if len(stamps) else False
    rows, sounding = rows[there], label_stamps[there]
    first = np.flatnonzero(np.diff(sounding, prepend=_BEFORE) > _PAUSE)
    counts = np.diff(np.append(first, len(rows)))
    enough = sounding[first + counts - 1] - sounding[first] >= _LEAST_NANOSECONDS
    first, counts = first[enough], counts[enough]
    sound, inside = concatenated_ranges(first, counts)
    begin, end = rows[first], rows[first + counts - 1]
    sums = np.bincount(sound, confidence[there][inside], len(first))
    return SoundSpans(
        stamps[begin],
        stamps[end] + FRAME_NANOSECONDS,
        begin.astype(np.int64),
        end.astype(np.int64) + 1,
        _most_frequent(labels[there][inside], sound, len(first)),
        sums / counts,
    )


def _most_frequent(labels: NDArray[Any], sound: Int64, count: int) -> NDArray[np.str_]:
    """Return the most frequent label of each sound; ties go to the first in the alphabet."""
    names, codes = np.unique(labels.astype(np.str_), return_inverse=True)
    shape = count, max(len(names), 1)
    counts = np.bincount(sound * shape[1] + codes, minlength=shape[0] * shape[1])
    return names[counts.reshape(shape).argmax(axis=1)] if count else names


class LogSounds(NamedTuple):
    """Sounds of one microphone in one log, with their descriptors."""

    microphone: str
    features: tuple[str, ...]
    spans: SoundSpans
    descriptors: Float32  # [shape=(n, width)]
    embedding: EmbeddingSpace | None  # None if the log has no embeddings
    embeddings: Float32  # [shape=(n, k)]; NaN for a sound without an embedding
    lost: int  # number of sounds dropped because of NaN or infinite features


@dataclass(frozen=True)
class HomeSounds(Occurrences):
    """Sounds of a home.

    Embeddings are NaN without one, or with one of another network or projection.
    """

    features: tuple[str, ...]
    labels: NDArray[np.str_]  # [shape=(n,)]
    descriptors: Float32  # [shape=(n, width)]; on disk
    embedding: EmbeddingSpace | None
    embeddings: Float32  # [shape=(n, k)]; on disk
    unfit: list[EmbeddingSpace | None]  # of each log whose sounds have NaN; None without embeddings


@contextmanager
def read_sounds(  # noqa: PLR0913, PLR0917
    home: HomeLogs,
    choice: str,
    start: int | None = None,
    end: int | None = None,
    progress: Progress = ignore_progress,
    groups: Groups | None = None,
) -> Iterator[HomeSounds]:
    """Read the sounds of a home; their descriptors stay on disk meanwhile.

    Only embeddings of the space of the groups to match are read; without groups, the space of the
    last log with embeddings is used. `progress` receives the share of the logs read, 0 to 1. Raise
    `DataError` if no log has features and labels.
    """
    entries = home.between(start, end)
    with (
        tempfile.TemporaryFile(prefix="hearthlog-sounds") as store,
        tempfile.TemporaryFile(prefix="hearthlog-embeddings") as embedded,
    ):
        reader = _Reader(choice, (start, end), groups, store, embedded)
        # Last log first: its descriptor format applies to all others.
        read_each(entries[::-1], reader.read, reader.losses, progress)
        yield reader.sounds(home.losses)


def read_log_sounds(
    log: Path, choice: str, start: int | None = None, end: int | None = None
) -> Iterator[LogSounds]:
    """Read the sounds of a log.

    Raise `LogError` if the log cannot be read.
    """
    columns = read_columns([log], None, start, end, fields=_FIELDS)
    for features in columns.values():
        name = features.topic.split("/")[1]
        labels = columns.get(topic(name, "label"))
        if features.type != message_types.FEATURES or labels is None or not len(labels):
            continue
        names = checked_array_names(log, features, "values")
        stamps, values = _by_time(features, "values")
        spans = _find_sounds(stamps, *_by_time(labels, "label", "confidence")).chosen(choice)
        described = describe(values, names, spans.first, spans.last)
        is_finite: Bool = np.isfinite(described).min(axis=1, initial=True)
        lost = int((~is_finite).sum())
        spans = spans.rows(is_finite)
        embedded = columns.get(topic(name, "embedding"))
        embeddings = mean_embeddings(embedded, spans.starts, spans.ends)
        yield LogSounds(name, names, spans, described[is_finite], *embeddings, lost)


def lost_text(log: Path, lost: int) -> str:
    """Return a message with the number of dropped sounds of a log, and the reason."""
    return f"{log}: {lost} sounds with features that are no numbers; left out"


class _Reader:
    """Reader of logs, last log first; its descriptor format applies to all others."""

    def __init__(
        self,
        choice: str,
        span: tuple[int | None, int | None],
        groups: Groups | None,
        store: IO[bytes],
        embedded: IO[bytes],
    ) -> None:
        self.losses: list[str] = []
        self._selection = choice, *span
        self._store, self._embedded = store, embedded
        self._features: tuple[str, ...] = ()
        self._any_embedding = groups is None
        self._embedding = None if groups is None else groups.embedding
        self._width = 0  # of the embeddings
        self._without = self._count = 0
        self._unfit: list[EmbeddingSpace | None] = []
        self._parts: list[tuple[Path, str, SoundSpans]] = []

    def read(self, entry: HomeLog) -> None:
        log, count = entry.path, len(self._parts)
        for sounds in read_log_sounds(log, *self._selection):
            self._features = self._features or sounds.features
            if sounds.features != self._features:
                raise LogError(f"{log}: has other features than the later logs; left out")
            if sounds.lost:
                self.losses.append(lost_text(log, sounds.lost))
            self._store.write(sounds.descriptors.tobytes())
            self._embed(sounds)
            self._parts.append((log, sounds.microphone, sounds.spans))
        self._without += len(self._parts) == count

    def _embed(self, sounds: LogSounds) -> None:
        """Store embeddings that are comparable with those of later logs."""
        if self._any_embedding and self._embedding is None:
            self._embedding = sounds.embedding
        own = sounds.embeddings
        fits = sounds.embedding is not None and sounds.embedding == self._embedding
        fits = fits and self._width in {0, own.shape[1]}
        if fits and not self._width:
            self._width = own.shape[1]
            self._embedded.write(np.full((self._count, self._width), np.nan, np.float32).tobytes())
        if not fits:
            self._unfit.append(sounds.embedding)
            own = np.full((len(own), self._width), np.nan, np.float32)
        self._embedded.write(own.tobytes())
        self._count += len(own)

    def sounds(self, losses: Sequence[str]) -> HomeSounds:
        if not self._features:
            what = self.losses[0] if self.losses else "no log has features and labels"
            raise DataError(what)
        parts = [spans for _, _, spans in self._parts]
        starts, ends, _, _, labels, _ = map(np.concatenate, zip(*parts, strict=True))
        return HomeSounds(
            *places(self._parts),
            starts,
            ends,
            [*losses, *self.losses],
            self._without,
            self._features,
            labels,
            _on_disk(self._store, self._count, descriptor_width(self._features)),
            self._embedding if self._width else None,
            _on_disk(self._embedded, self._count, self._width),
            self._unfit,
        )


def _on_disk(store: IO[bytes], count: int, width: int) -> Float32:
    store.flush()
    if not count or not width:
        return np.empty((count, width), np.float32)
    return np.memmap(store, np.float32, "r", shape=(count, width))


def _by_time(columns: Columns, *fields: str) -> tuple[Any, ...]:
    """Return stamps and some fields of messages, sorted by stamp.

    Frame numbers restart in merged logs, and times go back where a clock was set back.
    """
    stamps = columns["header.stamp"]
    values = [stamps, *(columns[name] for name in fields)]
    if (np.diff(stamps) >= 0).all():
        return tuple(values)
    order = np.argsort(stamps, kind="stable")
    return tuple(each[order] for each in values)


_MOST = 20_000  # sounds used to search for groups


def discover(
    sounds: HomeSounds, groups: Groups | None, least: int = LEAST
) -> tuple[Groups, Int64, Float64]:
    """Group sounds: assign existing groups, then find new groups among the others.

    Groups of an earlier run stay unchanged; None for the first run. `least` is the minimum of
    sounds in a new group. Groups are searched in at most 20,000 sounds, drawn deterministically.

    Return also the group row of each sound, `NO_CLUSTER` without a group, and the points of the
    sounds in the feature space [shape=(n, d)]. Raise `DataError` if the groups use other features,
    or there are too few sounds to group.
    """
    count = len(sounds.descriptors)
    if groups is not None and groups.features != sounds.features:
        raise DataError(
            f"the groups are of {len(groups.features)} features, the logs have "
            f"{len(sounds.features)} others; name another file with --groups"
        )
    is_new, drawn = groups is None, _drawn(sounds)
    if groups is None:
        if count < 2 * least:
            raise DataError(f"too few sounds to group: {count}, and it takes {2 * least}")
        described = sounds.descriptors[drawn], sounds.embedding, sounds.embeddings[drawn]
        groups = new_groups(sounds.features, *described)
    points, embedded = groups.points(sounds.descriptors, sounds.embeddings)
    has_embedding, of = is_embedded(embedded), np.full(count, NO_CLUSTER)
    for own, by_embedding in ((has_embedding, True), (~has_embedding, False)):
        _assign(of, own, groups, points, embedded)
        inside = drawn[own[drawn]]
        inside_embedded = embedded[inside] if by_embedding else None
        groups = add_groups(groups, points[inside], of[inside], least, inside_embedded)
        _assign(of, own, groups, points, embedded)
    return identified(groups) if is_new else groups, of, points


def _assign(of: Int64, own: Bool, groups: Groups, points: Float64, embedded: Float64) -> None:
    """Find groups, in place, for those of some sounds that have none yet."""
    rest = own & (of == NO_CLUSTER)
    of[rest] = groups.find(points[rest], embedded[rest])


def unembedded_note(sounds: HomeSounds, groups: Groups) -> str:
    """Return a note on sounds grouped by features alone; empty if there are none."""
    others = sorted({space.network for space in sounds.unfit if space})
    if groups.embedding is None:
        others = sorted({*others, sounds.embedding.network} if sounds.embedding else others)
        return (
            f"these groups are by features alone, and logs have embeddings of {', '.join(others)}: "
            "another file with --groups groups by both"
            if others
            else ""
        )
    if not sounds.unfit:
        return ""
    theirs = f" (but of {', '.join(others)}, or of another projection)" if others else ""
    return (
        f"{len(sounds.unfit)} of {len(sounds.logs)} logs are without embeddings of "
        f"{groups.embedding.network} as the groups are by{theirs}: their sounds are known by their "
        "features alone"
    )


def _drawn(sounds: HomeSounds) -> Int64:
    """Draw sounds by a hash of their times, sorted by that hash."""
    starts = sounds.starts
    rows = np.arange(len(starts))
    if len(rows) > _MOST:
        rows = np.argsort(_hashed(starts.astype(np.uint64)), kind="stable")[:_MOST]
    return rows[np.lexsort((sounds.microphone[rows], starts[rows]))]


def _hashed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix the bits of numbers: the finalizer of SplitMix64 (Steele et al., OOPSLA 2014)."""
    numbers = (numbers ^ (numbers >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    numbers = (numbers ^ (numbers >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return numbers ^ (numbers >> np.uint64(31))


def groups_of(sounds: LogSounds, groups: Groups) -> Int64:
    """Return the group row of each sound of a log; `NO_CLUSTER` for a sound without a group."""
    fits = sounds.embedding == groups.embedding
    embeddings = sounds.embeddings if fits else sounds.embeddings[:, :0]
    return groups.find(*groups.points(sounds.descriptors, embeddings))


def group_spans(
    home: HomeLogs,
    groups: Groups,
    start: int | None = None,
    end: int | None = None,
    progress: Progress = ignore_progress,
) -> tuple[dict[str, NamedSpans], list[str]]:
    """Find the sounds of existing groups by microphone; no group is added.

    `progress` receives the share of the logs read, 0 to 1. Raise `DataError` if no log has features
    and labels, or the groups use other features.
    """
    with read_sounds(home, ALL, start, end, progress, groups) as sounds:
        _, of, _ = discover(sounds, groups)
        of = np.where(of < len(groups.numbers), of, NO_CLUSTER)
        return sounds.spans(of, groups.texts(GROUPS)), sounds.losses


class SoundSelection(NamedTuple):
    """Selection of sounds to search for named groups."""

    choice: str
    start: int | None = None
    end: int | None = None


class MarkCounts(NamedTuple):
    """Changes made by naming a group."""

    made: int = 0
    left: int = 0


def name_groups(  # noqa: PLR0913, PLR0917
    home: HomeLogs,
    groups: Groups,
    names: Mapping[int, str],
    selection: SoundSelection,
    reviewer: str,
    progress: Progress = ignore_progress,
) -> tuple[dict[int, MarkCounts], list[str]]:
    """Mark the sounds of groups; existing marks of a group get its new name.

    Logs are read one at a time, so a box with little memory can name groups found by another.
    `progress` receives the share of the logs read, 0 to 1. Raise `LogError` if a review layer
    cannot be read or written.
    """
    marked, losses = dict.fromkeys(names, MarkCounts()), list(home.losses)
    logs = home.between()
    inside = {entry.path for entry in home.between(selection.start, selection.end)}
    for count, (log, *_) in enumerate(logs, 1):
        spans: dict[int, list[MarkedSpan]] = {}
        if log in inside:
            with collect_errors(losses, LogError):
                spans = _spans(log, groups, selection, losses)
        for number, label in names.items():
            made, left = _mark(
                log, spans.get(number, []), reason_of(groups, number), label, reviewer
            )
            before = marked[number]
            marked[number] = MarkCounts(before.made + made, before.left + left)
        progress(count / len(logs))
    return marked, losses


def _spans(
    log: Path, groups: Groups, selection: SoundSelection, losses: list[str]
) -> dict[int, list[MarkedSpan]]:
    """Return the sounds of groups in a log, by group number."""
    found: dict[int, list[MarkedSpan]] = {}
    for sounds in read_log_sounds(log, *selection):
        if sounds.features != groups.features:
            raise LogError(f"{log}: has other features than the groups; left out")
        if sounds.lost:
            losses.append(lost_text(log, sounds.lost))
        of = groups_of(sounds, groups)
        starts, ends = sounds.spans.starts.tolist(), sounds.spans.ends.tolist()
        for row, start, end in zip(of.tolist(), starts, ends, strict=True):
            if row >= 0:
                span = MarkedSpan(sounds.microphone, start, end)
                found.setdefault(int(groups.numbers[row]), []).append(span)
    return found


def _mark(
    log: Path, wanted: Sequence[MarkedSpan], reason: str, label: str, reviewer: str
) -> MarkCounts:
    """Mark sounds of a log; marks with this reason get the label."""
    now, old, reviewed = time.time_ns(), read_marks(log), read_reviewed(log)
    own = [mark for mark in old if mark.reason == reason]
    others: list[Mark | ReviewedSpan] = [mark for mark in old if mark.reason != reason]
    others += reviewed
    spans = [span for span in wanted if not _any_overlap(span, own)]
    free = [span for span in spans if not _any_overlap(span, others)]
    new = [Mark(*span, label, reviewer, now, LIVE, reason) for span in free]
    new += [
        mark._replace(label=label, reviewer=reviewer, made=now)
        for mark in own
        if mark.label != label
    ]
    if new:
        write_marks(log, new)
    return MarkCounts(len(new), len(spans) - len(free))


def unmark_group(logs: Iterable[Path], reason: str) -> int:
    """Remove the marks of a group; return their number.

    Raise `LogError` if a review layer cannot be read or written.
    """
    count = 0
    for log in logs:
        own = [mark for mark in read_marks(log) if mark.reason == reason]
        if own:
            write_marks(log, [], [MarkedSpan(*mark[:3]) for mark in own])
        count += len(own)
    return count


def reason_of(groups: Groups, number: int) -> str:
    """Return the reason stored in a group's marks, unique to this groups file."""
    return f"group {number} of {groups.id}"


def _any_overlap(span: MarkedSpan, others: Iterable[Mark | ReviewedSpan]) -> bool:
    return any(
        other.microphone == span.microphone and other.start < span.end and span.start < other.end
        for other in others
    )
