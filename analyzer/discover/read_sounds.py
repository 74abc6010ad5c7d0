"""The sounds of a home, log by log, with what describes them."""

import tempfile
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from hearthlog.analyzer.discover.descriptors import describe, descriptor_width
from hearthlog.analyzer.discover.groups import Groups
from hearthlog.analyzer.discover.sound_spans import FrameLabels, SoundSpans, find_sounds
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.selection import checked_array_names
from hearthlog.analyzer.logs.sound_vectors import mean_embeddings
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import EmbeddingSpace, topic

_FIELDS = {"header.stamp", "values", "label", "confidence"}


class LogSounds(NamedTuple):
    """Sounds of one microphone in one log.

    Attributes
    ----------
    descriptors : np.ndarray [shape=(n, width)], float32
    embedding : EmbeddingSpace or None
        Of the embeddings; None if the log has none.
    embeddings : np.ndarray [shape=(n, k)], float32
        By which they are described, too; NaN for a sound without any.
    lost : int
        Sounds that are left out, for they have features that are no numbers.
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
    """Sounds of a home, in the order of `logs`, and in each of time.

    Attributes
    ----------
    log, microphone : np.ndarray [shape=(n,)], int64
        Of each sound: where it is in these lists.
    descriptors : np.ndarray [shape=(n, width)], float32
        On the disk.
    embeddings : np.ndarray [shape=(n, k)], float32
        On the disk; NaN for a sound without any, or with one of another network or projection.
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
    """Read the sounds of a home; what describes them is on the disk meanwhile.

    Parameters
    ----------
    progress : callable, optional
        Told the share of the logs that is read, 0 to 1.
    groups : Groups, optional
        By which they are to be known: only their embeddings are read. Without groups those of the
        last log that has any.

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
        # The last log first: what it has been described by, the others have to be, too.
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
        spans = find_sounds(stamps, FrameLabels(*_by_time(labels, "label", "confidence")))
        spans = spans.chosen(choice)
        described = describe(values, names, spans.first, spans.last)
        is_finite: Bool = np.isfinite(described).min(axis=1, initial=True)
        lost = int((~is_finite).sum())
        spans = spans.rows(is_finite)
        heard = mean_embeddings(columns.get(topic(name, "embedding")), spans.starts, spans.ends)
        yield LogSounds(name, names, spans, described[is_finite], *heard, lost)


def lost_text(log: Path, lost: int) -> str:
    """Say how many sounds of a log are left out, and why."""
    return f"{log}: {lost} sounds with features that are no numbers; left out"


class _Reader:
    """Reads logs, the last one first: as its sounds are described, all have to be."""

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
        self._width = 0  # of what is embedded
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
        """Keep embeddings, if they can be compared with those of the later logs."""
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
    """Return the stamps of messages and some of their fields, in the order of the stamps.

    In logs that were joined, frames begin anew, and where a clock was set back, times do.
    """
    stamps = columns["header.stamp"]
    values = [stamps, *(columns[name] for name in fields)]
    if (np.diff(stamps) >= 0).all():
        return tuple(values)
    order = np.argsort(stamps, kind="stable")
    return tuple(each[order] for each in values)
