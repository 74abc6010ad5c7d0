"""The sound of a home that was marked or looked at: features, and the floor of the room."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import find_chains
from hearthlog.analyzer.logs.recorder_info import models_for
from hearthlog.analyzer.logs.selection import array_names
from hearthlog.analyzer.logs.sound_vectors import (
    DIRECTION_FIELDS,
    EMBEDDING_FIELDS,
    directions_of,
    embeddings_of,
)
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, read_review
from hearthlog.models.classifiers.evidence import NOWHERE, Directions
from hearthlog.models.embedding.projection import NO_EMBEDDINGS, Embeddings
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.floor import FloorTracker
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import ENROLLED, find_logs
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    EmbeddingSource,
    EmbeddingSpace,
    scenario_labelling,
    topic,
)

_FIELDS = ("header.stamp", "frame", "values")
_WARM_UP = 600 * NANOSECONDS
_AROUND = 2 * NANOSECONDS  # by which a short mark is extended, and more


@dataclass(frozen=True)
class HomeSound:
    """What one microphone recorded in one log, and what a reviewer said of it.

    Attributes
    ----------
    stamps, frames : np.ndarray [shape=(n,)], int64
        Start of each frame in nanoseconds of UTC, and its number.
    values : np.ndarray [shape=(n, d)], float32
        Features; d is 0 if they are of another set.
    floors : np.ndarray [shape=(n, b)], float64, or None
        Floor of the room; None for a feature set without bands.
    directions : Directions
        Of an array; none where only features were wanted.
    embeddings : Embeddings
        Of the network that was asked for; none of another one.
    """

    log: Path
    microphone: str
    marks: Sequence[Mark]
    reviewed: Sequence[ReviewedSpan]
    stamps: Int64
    frames: Int64
    values: Float32
    floors: Float64 | None
    labelling: str = LIVE
    directions: Directions = NOWHERE
    embeddings: Embeddings = NO_EMBEDDINGS
    embedding: EmbeddingSpace | None = None

    @property
    def enrolled(self) -> bool:
        """Whether it was cut out of its room."""
        return ENROLLED in self.log.parts

    @property
    def drawn(self) -> list[tuple[int, int]]:
        """Spans that were drawn at random, from which nothing is learned."""
        return [(span.start, span.end) for span in self.reviewed if span.chosen == RANDOM]

    def inside(self, spans: Sequence[tuple[int, int]], aside: int = 0) -> Bool:
        """Tell which frames touch spans of time.

        Parameters
        ----------
        spans : sequence of (int, int)
            Starts and ends in nanoseconds of UTC.
        aside : int
            By how much each span is longer at both ends, in nanoseconds.
        """
        change = np.zeros(len(self.stamps) + 1, np.int64)
        times = np.array(spans, np.int64).reshape(-1, 2) + np.array([-aside, aside])
        first = np.searchsorted(self.stamps + FRAME_NANOSECONDS, times[:, 0], "right")
        last = np.maximum(np.searchsorted(self.stamps, times[:, 1]), first)
        np.add.at(change, first, 1)
        np.add.at(change, last, -1)
        touched: Bool = change.cumsum()[:-1] > 0
        return touched


def read_reviewed_sound(
    folder: Path, features: FeatureSet, scenario: str = "", space: EmbeddingSpace | None = None
) -> Iterator[HomeSound]:
    """Read what was marked or looked at in the logs of a folder, log by log.

    Raise `LogError` if there is no log, or if a log or a layer is damaged. Raise `DataError` if
    there are marks, and all of them are in logs of other sets.
    """
    other: tuple[Path, str] | None = None  # log and microphone of another set
    usable = False
    for log in find_logs(folder, enrolled=True):
        marks, reviewed = read_review(log).get(scenario, ((), ()))
        spans: list[Mark | ReviewedSpan] = [*marks, *reviewed]
        if not spans:
            continue
        names = {span.microphone for span in spans}
        limits = min(span.start for span in spans), max(span.end for span in spans)
        for sound in read_sound_of(log, features, names, limits, scenario):
            if sound.values.shape[1]:
                usable = True
            elif sound.marks:
                other = log, sound.microphone
            yield with_embeddings(
                replace(sound, directions=_directions(log, sound.microphone, limits)), limits, space
            )
    if other is not None and not usable:
        name = _set_of(*other)
        raise DataError(
            f"{folder}: what is marked there has features of set {name}, and {features.name} is "
            f"needed: {models_for(name)}"
        )


def read_sound_of(
    log: Path,
    features: FeatureSet,
    microphones: Collection[str],
    limits: tuple[int, int],
    scenario: str = "",
) -> Iterator[HomeSound]:
    """Read what microphones recorded in a part of a log, and some seconds around it.

    Frames that were logged coarsely, for privacy, are left out: no sound is so.

    Parameters
    ----------
    limits : (int, int)
        Start and end of the part, in nanoseconds of UTC. The floor is tracked from ten minutes
        before it on.

    Raises
    ------
    LogError
        If the log or its review layer is damaged.
    """
    marks, reviewed = read_review(log).get(scenario, ((), ()))
    names = {topic(microphone, "features"): microphone for microphone in sorted(microphones)}
    start, end = limits[0] - _WARM_UP, limits[1] + _AROUND
    columns = read_columns([log], names, start, end, _FIELDS)
    earlier: dict[str, Columns] = {}
    if any(len(one) and one["header.stamp"][0] - start > _AROUND for one in columns.values()):
        earlier = _columns_before(log, names, start)
    for name, microphone in names.items():
        recorded = columns.get(name)
        if recorded is None or not len(recorded):
            continue
        values = recorded["values"]
        if not _is_of(recorded, features):
            values = np.empty((len(values), 0), np.float32)
        floors = _floors(recorded, earlier.get(name), features)
        own = ~_coarse(values, features)
        yield HomeSound(
            log,
            microphone,
            [mark for mark in marks if mark.microphone == microphone],
            [span for span in reviewed if span.microphone == microphone],
            recorded["header.stamp"][own],
            recorded["frame"][own].astype(np.int64),
            values[own],
            None if floors is None else floors[own],
            scenario_labelling(scenario) if scenario else LIVE,
        )


def _directions(log: Path, microphone: str, limits: tuple[int, int]) -> Directions:
    name, start, end = topic(microphone, "direction"), limits[0] - _AROUND, limits[1] + _AROUND
    columns = read_columns([log], {name}, start, end, DIRECTION_FIELDS).get(name)
    if columns is None or columns.type != message_types.DIRECTION:
        return NOWHERE
    try:
        return directions_of(columns)
    except LogError as error:
        raise LogError(f"{log}: {error}") from error


def with_embeddings(
    sound: HomeSound, limits: tuple[int, int], space: EmbeddingSpace | None
) -> HomeSound:
    """Read what a network heard in a part of a log, if a model takes it.

    Parameters
    ----------
    limits : (int, int)
        Start and end of the part, in nanoseconds of UTC.
    space : EmbeddingSpace or None
        Of the embeddings that the model takes; None if it takes none.

    Raises
    ------
    LogError
        If the log has embeddings that no recorder writes.
    """
    name = topic(sound.microphone, "embedding")
    start, end = limits[0] - _AROUND, limits[1] + _AROUND
    columns = read_columns([sound.log], {name}, start, end, EMBEDDING_FIELDS).get(name)
    if columns is None or columns.type != message_types.EMBEDDING or not len(columns):
        return sound
    source = EmbeddingSource.from_metadata(columns.metadata)
    sound = replace(sound, embedding=None if source is None else source.space)
    if sound.embedding is None or sound.embedding != space:
        return sound
    try:
        return replace(sound, embeddings=embeddings_of(columns))
    except LogError as error:
        raise LogError(f"{sound.log}: {error}") from error


def _coarse(values: Float32, features: FeatureSet) -> Bool:
    """Return which frames have the very values of one beside them though there is sound, or border.

    One that borders may be the only one there of its second, and share its values with others that
    lie farther away in it.
    """
    coarse = np.zeros(len(values), bool)
    if values.shape[1]:
        same = (values[1:] == values[:-1]).all(axis=1) & (features.power(values[1:]) > 0)
        coarse[1:] |= same
        coarse[:-1] |= same
        inner = coarse.copy()
        coarse[1:] |= inner[:-1]
        coarse[:-1] |= inner[1:]
    return coarse


def _columns_before(log: Path, topics: Collection[str], start: int) -> dict[str, Columns]:
    """Read the log before another one from a time on, if there is one and it can be read."""
    with suppress(LogError):
        for chain in find_chains([log]):
            for place in chain.asked:
                return read_columns(
                    chain.logs[max(place - 1, 0) : place], topics, start, fields=_FIELDS
                )
    return {}


def _floors(recorded: Columns, earlier: Columns | None, features: FeatureSet) -> Float64 | None:
    """Return the floor of the room at each frame of a log, as a recorder tracks it.

    What was recorded earlier is tracked before it, as far as it leads up to the log.
    """
    if features.band_powers is None or not _is_of(recorded, features) or not len(recorded):
        return None
    frames, values = recorded["frame"].astype(np.int64), recorded["values"]
    if earlier is not None and len(earlier) and _is_of(earlier, features):
        frames = np.concatenate([earlier["frame"].astype(np.int64), frames])
        values = np.concatenate([earlier["values"], values])
    floors = np.zeros((len(frames), features.bands))
    breaks = np.flatnonzero(np.diff(frames) != 1) + 1
    for piece in np.split(np.arange(len(frames)), breaks):
        tracked = FloorTracker()(features.band_powers(values[piece]), int(frames[piece[0]])).powers
        floors[piece[len(piece) - len(tracked) :]] = tracked
    return floors[-len(recorded) :]


def _is_of(recorded: Columns, features: FeatureSet) -> bool:
    names = array_names(recorded.metadata, "values")
    return not names or tuple(names) == features.feature_names


def _set_of(log: Path, microphone: str) -> str:
    """Return the name of the feature set of a microphone in a log."""
    name = topic(microphone, "info")
    info = read_columns([log], {name}, fields={"feature_set"}).get(name)
    return "unknown" if info is None or not len(info) else str(info["feature_set"][0])
