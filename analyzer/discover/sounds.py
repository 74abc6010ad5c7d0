"""Sounds of a home: spans, reading of logs, and group assignment."""

import tempfile
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.discover.groups import (
    LEAST,
    NO_GROUP,
    Groups,
    add_groups,
    describe,
    descriptor_width,
    identified,
    new_groups,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.selection import checked_array_names
from hearthlog.analyzer.logs.sound_vectors import mean_embeddings
from hearthlog.analyzer.logs.spans import ranges
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import EmbeddingSpace, topic

ALL, UNSURE, NOT_KNOWN = CHOICES = ("all", "unsure", "unknown")
# A sound has at least four frames and may contain two silent ones; stamps follow a clock.
_PAUSE = 3 * FRAME_NANOSECONDS + FRAME_NANOSECONDS // 2
_LEAST_NANOSECONDS = 3 * FRAME_NANOSECONDS - FRAME_NANOSECONDS // 2
_BEFORE = np.int64(-1 << 62)  # before any time
_UNSURE_CONFIDENCE = 0.5  # same as for clips that the model is unsure of


class LabelledStamps(NamedTuple):
    """Labels of frames.

    Attributes
    ----------
    stamps : np.ndarray [shape=(n,)], int64
        Ascending, in nanoseconds of UTC.
    labels : np.ndarray [shape=(n,)] of str
    confidence : np.ndarray [shape=(n,)], float32
    """

    stamps: Int64
    labels: NDArray[np.object_]
    confidence: Float32

    def rows(self, rows: Bool) -> "LabelledStamps":
        """Select rows."""
        return LabelledStamps(self.stamps[rows], self.labels[rows], self.confidence[rows])


class SoundSpans(NamedTuple):
    """Sounds of one microphone in one log.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    first, last : np.ndarray [shape=(n,)], int64
        Feature rows; `last` is exclusive.
    labels : np.ndarray [shape=(n,)], str
        Most frequent label of the sounding frames.
    confidence : np.ndarray [shape=(n,)], float64
        Mean confidence of the labels.
    """

    starts: Int64
    ends: Int64
    first: Int64
    last: Int64
    labels: NDArray[np.str_]
    confidence: Float64

    def chosen(self, choice: str) -> "SoundSpans":
        """Return all sounds, the sounds with unsure labels, or the sounds of unknown class."""
        if choice == ALL:
            return self
        keep = self.labels == UNKNOWN
        if choice == UNSURE:
            keep |= self.confidence < _UNSURE_CONFIDENCE
        return self.rows(keep)

    def rows(self, rows: Bool) -> "SoundSpans":
        """Select rows."""
        return SoundSpans(
            self.starts[rows],
            self.ends[rows],
            self.first[rows],
            self.last[rows],
            self.labels[rows],
            self.confidence[rows],
        )


def find_sounds(stamps: Int64, labels: LabelledStamps) -> SoundSpans:
    """Return the sounds of a log: runs of labels other than silence.

    Parameters
    ----------
    stamps : np.ndarray [shape=(m,)], int64
        Of the frames with features, ascending.
    """
    heard = labels.rows(labels.labels != SILENCE)
    rows = np.minimum(np.searchsorted(stamps, heard.stamps), max(len(stamps) - 1, 0))
    there = stamps[rows] == heard.stamps if len(stamps) else np.zeros(len(rows), np.bool_)
    heard, rows = heard.rows(there), rows[there]
    first = np.flatnonzero(np.diff(heard.stamps, prepend=_BEFORE) > _PAUSE)
    counts = np.diff(np.append(first, len(rows)))
    enough = heard.stamps[first + counts - 1] - heard.stamps[first] >= _LEAST_NANOSECONDS
    first, counts = first[enough], counts[enough]
    sound, inside = ranges(first, counts)
    begin, end = rows[first], rows[first + counts - 1]
    sums = np.bincount(sound, heard.confidence[inside], len(first))
    return SoundSpans(
        stamps[begin],
        stamps[end] + FRAME_NANOSECONDS,
        begin.astype(np.int64),
        end.astype(np.int64) + 1,
        _most_frequent(heard.labels[inside], sound, len(first)),
        sums / counts,
    )


def _most_frequent(labels: NDArray[Any], sound: Int64, count: int) -> NDArray[np.str_]:
    """Return the most frequent label of each sound; ties go to the first in the alphabet."""
    names, codes = np.unique(labels.astype(np.str_), return_inverse=True)
    shape = count, max(len(names), 1)
    counts = np.bincount(sound * shape[1] + codes, minlength=shape[0] * shape[1])
    return names[counts.reshape(shape).argmax(axis=1)] if count else names


_FIELDS = {"header.stamp", "values", "label", "confidence"}


class LogSounds(NamedTuple):
    """Sounds of one microphone in one log, with their descriptors.

    Attributes
    ----------
    descriptors : np.ndarray [shape=(n, width)], float32
    embedding : EmbeddingSpace or None
        Space of the embeddings; None if the log has no embeddings.
    embeddings : np.ndarray [shape=(n, k)], float32
        NaN for a sound without an embedding.
    lost : int
        Number of sounds dropped because of NaN or infinite features.
    """

    microphone: str
    features: tuple[str, ...]
    spans: SoundSpans
    descriptors: Float32
    embedding: EmbeddingSpace | None
    embeddings: Float32
    lost: int


@dataclass(frozen=True)
class HomeSounds:
    """Sounds of a home, in the order of `logs`, and by time within a log.

    Attributes
    ----------
    log, microphone : np.ndarray [shape=(n,)], int64
        Indices of each sound into these lists.
    descriptors : np.ndarray [shape=(n, width)], float32
        On disk.
    embeddings : np.ndarray [shape=(n, k)], float32
        On disk; NaN without an embedding, or with an embedding of another network or projection.
    """

    features: tuple[str, ...]
    logs: list[Path]
    microphones: list[str]
    log: Int64
    microphone: Int64
    spans: SoundSpans
    descriptors: Float32
    embedding: EmbeddingSpace | None
    embeddings: Float32
    without_embedding: int
    other_embeddings: AbstractSet[EmbeddingSpace]
    losses: list[str]
    without: int = 0


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

    Parameters
    ----------
    progress : callable, optional
        Receives the share of the logs read, 0 to 1.
    groups : Groups, optional
        Groups to match: only embeddings of their space are read. Without groups, the space of
        the last log with embeddings is used.

    Raises
    ------
    DataError
        If no log has features and labels.
    """
    entries = home.between(start, end)
    with (
        tempfile.TemporaryFile(prefix="hearthlog-sounds") as store,
        tempfile.TemporaryFile(prefix="hearthlog-embeddings") as embedded,
    ):
        reader = _Reader(choice, (start, end), groups, store, embedded)
        # Last log first: its descriptor format applies to all others.
        for number, entry in enumerate(reversed(entries), 1):
            try:
                reader.read(entry.path)
            except LogError as error:
                reader.losses.append(str(error))
            progress(number / len(entries))
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
        spans = find_sounds(stamps, LabelledStamps(*_by_time(labels, "label", "confidence")))
        spans = spans.chosen(choice)
        described = describe(values, names, spans.first, spans.last)
        is_finite: Bool = np.isfinite(described).min(axis=1, initial=True)
        lost = int((~is_finite).sum())
        spans = spans.rows(is_finite)
        heard = mean_embeddings(columns.get(topic(name, "embedding")), spans.starts, spans.ends)
        yield LogSounds(name, names, spans, described[is_finite], *heard, lost)


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
        self.without = 0
        self._choice = choice
        self._span = span
        self._store, self._embedded = store, embedded
        self._features: tuple[str, ...] = ()
        self._any_embedding = groups is None
        self._embedding = None if groups is None else groups.embedding
        self._width = 0  # of the embeddings
        self._without_embedding = self._count = 0
        self._other_embeddings: set[EmbeddingSpace] = set()
        self._logs: list[Path] = []
        self._microphones: list[str] = []
        self._parts: list[tuple[Int64, Int64, SoundSpans]] = []

    def read(self, log: Path) -> None:
        for sounds in read_log_sounds(log, self._choice, *self._span):
            self._features = self._features or sounds.features
            if sounds.features != self._features:
                raise LogError(f"{log}: has other features than the later logs; left out")
            if sounds.lost:
                self.losses.append(lost_text(log, sounds.lost))
            self._store.write(sounds.descriptors.tobytes())
            self._embed(sounds)
            self._add(log, sounds.microphone, sounds.spans)
        if log not in self._logs:
            self.without += 1

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
            self._without_embedding += 1
            if sounds.embedding is not None:
                self._other_embeddings.add(sounds.embedding)
            own = np.full((len(own), self._width), np.nan, np.float32)
        self._embedded.write(own.tobytes())
        self._count += len(own)

    def _add(self, log: Path, microphone: str, spans: SoundSpans) -> None:
        if microphone not in self._microphones:
            self._microphones.append(microphone)
        count, place = len(spans.starts), self._microphones.index(microphone)
        self._parts.append((np.full(count, len(self._logs)), np.full(count, place), spans))
        self._logs.append(log)

    def sounds(self, losses: Sequence[str]) -> HomeSounds:
        if not self._features:
            what = self.losses[0] if self.losses else "no log has features and labels"
            raise DataError(what)
        logs, microphones, spans = zip(*self._parts, strict=True)
        return HomeSounds(
            self._features,
            self._logs,
            self._microphones,
            np.concatenate(logs),
            np.concatenate(microphones),
            SoundSpans(*(np.concatenate(each) for each in zip(*spans, strict=True))),
            _on_disk(self._store, self._count, descriptor_width(self._features)),
            self._embedding if self._width else None,
            _on_disk(self._embedded, self._count, self._width),
            self._without_embedding,
            self._other_embeddings,
            [*losses, *self.losses],
            self.without,
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
_AT_ONCE = 10_000


def discover(
    sounds: HomeSounds, groups: Groups | None, least: int = LEAST
) -> tuple[Groups, Int64, Float64]:
    """Group sounds: assign existing groups, then find new groups among the others.

    Parameters
    ----------
    groups : Groups or None
        Groups of an earlier run, which stay unchanged; None for the first run.
    least : int, optional
        Minimum of sounds in a new group. Groups are searched in at most 20,000 sounds, drawn
        deterministically.

    Returns
    -------
    of : np.ndarray [shape=(n,)], int64
        Group row of each sound; `NO_GROUP` for a sound without a group.
    points : np.ndarray [shape=(n, d)], float64
        Points of the sounds in the feature space.

    Raises
    ------
    DataError
        If the groups use other features, or there are too few sounds to group.
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
    points, embedded = _points(sounds, groups)
    heard, of = groups.are_comparable(sounds.embeddings), np.full(count, NO_GROUP)
    for own, by_embedding in ((heard, True), (~heard, False)):
        inside = drawn[own[drawn]]
        where = embedded if by_embedding else points
        of[own] = groups.space(embedded=by_embedding).find(where[own])
        groups = add_groups(
            groups,
            points[inside],
            of[inside],
            least,
            embedded[inside] if by_embedding else None,
        )
        rest = own & (of == NO_GROUP)
        of[rest] = groups.space(embedded=by_embedding).find(where[rest])
    return identified(groups) if is_new else groups, of, points


def unembedded_note(sounds: HomeSounds, groups: Groups) -> str:
    """Return a note on sounds grouped by features alone; empty if there are none."""
    others = sorted({space.network for space in sounds.other_embeddings})
    if groups.embedding is None:
        others = sorted({*others, sounds.embedding.network} if sounds.embedding else others)
        return (
            f"these groups are by features alone, and logs have embeddings of {', '.join(others)}: "
            "another file with --groups groups by both"
            if others
            else ""
        )
    if not sounds.without_embedding:
        return ""
    theirs = f" (but of {', '.join(others)}, or of another projection)" if others else ""
    return (
        f"{sounds.without_embedding} of {len(sounds.logs)} logs are without embeddings of "
        f"{groups.embedding.network} as the groups are by{theirs}: their sounds are known by their "
        "features alone"
    )


def _points(sounds: HomeSounds, groups: Groups) -> tuple[Float64, Float64]:
    """Return points in the feature space and the embedding space; NaN without an embedding."""
    points = np.empty((len(sounds.descriptors), len(groups.axes)))
    space = groups.embedded
    embedded = np.full((len(points), 0 if space is None else len(space.axes)), np.nan)
    for first in range(0, len(points), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        descriptors, embeddings = sounds.descriptors[part], sounds.embeddings[part]
        points[part] = groups.points(descriptors)
        if space is not None and groups.are_comparable(embeddings).any():
            embedded[part] = space.points(np.concatenate([descriptors, embeddings], axis=1))
    return points, embedded


def _drawn(sounds: HomeSounds) -> Int64:
    """Draw sounds by a hash of their times, sorted by that hash."""
    starts = sounds.spans.starts
    rows = np.arange(len(starts))
    if len(rows) > _MOST:
        rows = np.argsort(_hashed(starts.astype(np.uint64)), kind="stable")[:_MOST]
    return rows[np.lexsort((sounds.microphone[rows], starts[rows]))]


def _hashed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix the bits of numbers: the finalizer of SplitMix64 (Steele et al., OOPSLA 2014)."""
    numbers = (numbers ^ (numbers >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    numbers = (numbers ^ (numbers >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return numbers ^ (numbers >> np.uint64(31))


class GroupSpans(NamedTuple):
    """Sounds of existing groups, in time order.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    texts : np.ndarray [shape=(n,)] of str
        Group name, or `group 3`.
    """

    starts: Int64
    ends: Int64
    texts: NDArray[np.object_]


def group_spans(
    home: HomeLogs,
    groups: Groups,
    start: int | None = None,
    end: int | None = None,
    progress: Progress = ignore_progress,
) -> tuple[dict[str, GroupSpans], list[str]]:
    """Find the sounds of existing groups; no group is added.

    Parameters
    ----------
    progress : callable, optional
        Receives the share of the logs read, 0 to 1.

    Raises
    ------
    DataError
        If no log has features and labels, or the groups use other features.
    """
    texts = np.array(
        [
            name or f"group {number}"
            for name, number in zip(groups.names, groups.numbers.tolist(), strict=True)
        ],
        object,
    )
    found = {}
    with read_sounds(home, ALL, start, end, progress, groups) as sounds:
        _, of, _ = discover(sounds, groups)
        of = np.where(of < len(texts), of, NO_GROUP)
        order = np.argsort(sounds.spans.starts, kind="stable")
        for place, name in enumerate(sounds.microphones):
            rows = order[(sounds.microphone[order] == place) & (of[order] != NO_GROUP)]
            spans = sounds.spans.starts[rows], sounds.spans.ends[rows]
            found[name] = GroupSpans(*spans, texts[of[rows]])
    return found, sounds.losses
