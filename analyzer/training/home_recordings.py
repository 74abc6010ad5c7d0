"""Recordings of a home for training: marked, reviewed and enrolled sound."""

import hashlib
import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
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
from hearthlog.analyzer.training.clips import AS_IT_IS, ClipEmbeddings, spread
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.analyzer.training.direction_samples import sighting_of
from hearthlog.models.classes import SILENCE, UNDECIDED, UNKNOWN, class_name
from hearthlog.models.classifiers.evidence import NOWHERE, Directions
from hearthlog.models.embedding import (
    HOP_FRAMES,
    NO_EMBEDDINGS,
    WINDOW_FRAMES,
    Embeddings,
)
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.floor import BLOCK_FRAMES, FloorTracker, is_quiet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices, Int64
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import CUT, ENROLLED, find_logs
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
_AROUND = 2 * NANOSECONDS  # covers the extension of a short mark


@dataclass(frozen=True)
class HomeSound:
    """Sound of one microphone in one log, with its review."""

    log: Path
    microphone: str
    marks: Sequence[Mark]
    reviewed: Sequence[ReviewedSpan]
    stamps: Int64  # [shape=(n,)]; start of each frame in nanoseconds of UTC
    frames: Int64  # [shape=(n,)]; numbers
    values: Float32  # [shape=(n, d)]; d is 0 if they are of another feature set
    floors: Float64 | None  # [shape=(n, b)]; None for a feature set without bands
    labelling: str = LIVE
    directions: Directions = NOWHERE  # from an array; empty if only features were requested
    embeddings: Embeddings = NO_EMBEDDINGS  # of the requested network; empty for other networks
    embedding: EmbeddingSpace | None = None

    @property
    def enrolled(self) -> bool:
        """Whether the sound was cut out of its room."""
        return ENROLLED in self.log.parts

    @property
    def confirmed(self) -> list[ReviewedSpan]:
        """Reviewed spans for training: labels without a mark in them are correct."""
        return [span for span in self.reviewed if span.chosen != RANDOM]

    @property
    def drawn(self) -> list[tuple[int, int]]:
        """Spans drawn at random, which are excluded from training."""
        return [(span.start, span.end) for span in self.reviewed if span.chosen == RANDOM]

    def inside(self, spans: Sequence[tuple[int, int]], aside: int = 0) -> Bool:
        """Return which frames overlap spans, extended by `aside` at both ends, in nanoseconds."""
        change = np.zeros(len(self.stamps) + 1, np.int64)
        times = np.array(spans, np.int64).reshape(-1, 2) + np.array([-aside, aside])
        first = np.searchsorted(self.stamps + FRAME_NANOSECONDS, times[:, 0], "right")
        last = np.maximum(np.searchsorted(self.stamps, times[:, 1]), first)
        np.add.at(change, first, 1)
        np.add.at(change, last, -1)
        return change.cumsum()[:-1] > 0


def read_reviewed_sound(
    folder: Path, features: FeatureSet, scenario: str = "", space: EmbeddingSpace | None = None
) -> Iterator[HomeSound]:
    """Read the marked or reviewed sound in the logs of a folder, log by log.

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
    """Read the sound of microphones in a part of a log, and some seconds around it.

    `limits` are start and end in nanoseconds of UTC; floor tracking starts ten minutes earlier.
    Frames logged coarsely for privacy are dropped: their values are not those of real sound. Raise
    `LogError` if the log or its review layer is damaged.
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
    """Read the embeddings between limits in nanoseconds of UTC, if a model uses them (`space`).

    Raise `LogError` if the log has embeddings that no recorder writes.
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
    """Return which frames equal a neighbour though there is sound, or border on such frames.

    A bordering frame may be the only one of its second there, and share its values with frames
    farther away in that second.
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
    """Read the log before another one from a time on, if it exists and is readable."""
    with suppress(LogError):
        for chain in find_chains([log]):
            for place in chain.requested:
                return read_columns(
                    chain.logs[max(place - 1, 0) : place], topics, start, fields=_FIELDS
                )
    return {}


def _floors(recorded: Columns, earlier: Columns | None, features: FeatureSet) -> Float64 | None:
    """Return the floor of the room at each frame of a log, as a recorder tracks it.

    Tracking starts with earlier recordings that lead up to the log without a gap.
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


_DAY = 86_400 * NANOSECONDS
HOME_WEIGHT = 3.0  # of a segment of the home; other segments weigh 1
# With embeddings, heads learn from the home too; a greater classifier weight then loses
# labels of the home that were correct.
HOME_WEIGHT_WITH_EMBEDDINGS = 1.0
MOST_OF_MARK = 6  # segments, so that a mark of minutes counts as a few marks of seconds
HOME = "this home"


def home_recordings(
    folder: Path,
    features: FeatureSet = DEFAULT,
    gate: float = 0.0,
    space: EmbeddingSpace | None = None,
) -> Iterator[Recording]:
    """Read the features of all marks in the logs of a folder.

    Raise `LogError` if there is no log, or if a log or a layer is damaged. Raise `DataError` if
    there are marks, and all of them are in logs of other sets.
    """
    sounds = read_reviewed_sound(folder, features, space=space)
    for recording in marked_recordings(sounds, folder, features, gate):
        yield recording._replace(most=None)


def marked_recordings(
    sounds: Iterable[HomeSound], folder: Path, features: FeatureSet, gate: float
) -> Iterator[Recording]:
    """Cut marks, or parts of them between gaps, out of the sound of a home, log by log.

    A mark shorter than a second is extended to one second; a short mark of silence is dropped
    instead, because its second contains other sounds. All marks of a UTC day form one group, and so
    does an enrolled recording. An enrolled sound has no room, unless it is silence.

    Marks with no sound `gate` dB above the floor of the room are dropped, except silence; a
    `HearthlogWarning` counts them and marks of unrecorded time. 0 disables the gate.
    """
    quiet: list[str] = []
    missing: list[str] = []
    for sound in sounds:
        for mark in sound.marks:
            if not sound.inside([(mark.start, mark.end)]).any():
                missing.append(f"{mark.label} in {sound.log.name}")
                continue
            silence = class_name(mark.label) == SILENCE
            if is_short_silence(mark, features):
                continue
            floored = silence or not sound.enrolled
            pieces = list(_recordings(sound, mark, features, floored=floored))
            if gate and not silence and all(_is_quiet(piece, features, gate) for piece in pieces):
                quiet.append(f"{mark.label} in {sound.log.name}")
            else:
                yield from pieces
    if missing:
        text = (
            f"{len(missing)} marks lie where nothing was recorded, the first is {missing[0]}: they "
            "are left out"
        )
        warnings.warn(HearthlogWarning(text, folder), stacklevel=2)
    if quiet:
        text = (
            f"{len(quiet)} marks lie where nothing is louder than the floor of the room, the first "
            f"is {quiet[0]}: they are left out; mark what can be heard, or mark it as silence"
        )
        warnings.warn(HearthlogWarning(text, folder), stacklevel=2)


def is_short_silence(mark: Mark, features: FeatureSet) -> bool:
    """Whether a mark of silence is shorter than a window, and so useless for training."""
    is_short = mark.end - mark.start < features.window_seconds * NANOSECONDS
    return is_short and class_name(mark.label) == SILENCE


def training_recordings(
    folder: Path,
    features: FeatureSet = DEFAULT,
    gate: float = 0.0,
    space: EmbeddingSpace | None = None,
) -> Iterator[Recording]:
    """Read the training marks in the logs of a folder; at most six segments of each.

    Raise `LogError` or `DataError` as `home_recordings` does.
    """
    sounds = (
        without_excluded_marks(sound)
        for sound in read_reviewed_sound(folder, features, space=space)
    )
    yield from marked_recordings(sounds, folder, features, gate)


def without_excluded_marks(sound: HomeSound, classes: Collection[str] = ()) -> HomeSound:
    """Drop marks that are excluded from training.

    These are marks that a reviewer could not decide, marks that touch a span drawn at random, and
    marks of a television, which sounds like people, unless that is one of the model's `classes`.
    """
    untaught = UNDECIDED.difference({*classes} - {UNKNOWN})
    marks = [
        mark
        for mark in sound.marks
        if class_name(mark.label) not in untaught
        and not any(mark.start < end and start < mark.end for start, end in sound.drawn)
    ]
    return replace(sound, marks=marks)


def _is_quiet(recording: Recording, features: FeatureSet, gate: float) -> bool:
    """Return whether no window of 0.4 s is above the floor of the room."""
    windows = len(recording.features) - BLOCK_FRAMES + 1
    if recording.floor is None or features.band_powers is None or windows < 1:
        return recording.floor is not None
    powers = features.band_powers(recording.features)
    return bool(is_quiet(powers, recording.floor[-windows:], BLOCK_FRAMES, gate).all())


def _recordings(
    sound: HomeSound, mark: Mark, features: FeatureSet, *, floored: bool
) -> Iterator[Recording]:
    """Yield the features of a mark, split at gaps."""
    window = features.window_frames
    first, last = np.searchsorted(sound.stamps, [mark.start, mark.end]).tolist()
    missing = max(window - (last - first), 0)
    first = max(first - missing // 2, 0)
    last = min(max(last + missing - missing // 2, first + window), len(sound.stamps))
    breaks = np.flatnonzero(np.diff(sound.frames[first:last]) != 1) + 1
    for piece in np.split(np.arange(first, last), breaks):
        yield recording_of(sound, mark.label, piece, floored=floored)


def recording_of(
    sound: HomeSound, label: str, frames: Indices, *, floored: bool = True
) -> Recording:
    """Cut successive frames, by index, out of the sound of a home."""
    stamps = sound.stamps[frames]
    span = int(stamps[0]), int(stamps[-1]) + FRAME_NANOSECONDS
    embedded = _embedded(sound, frames)
    return Recording(
        label,
        _group(sound, span[0]),
        HOME,
        "",
        sound.values[frames],
        HOME_WEIGHT if embedded is None else HOME_WEIGHT_WITH_EMBEDDINGS,
        None if sound.floors is None or not floored else sound.floors[frames],
        most=MOST_OF_MARK,
        span=span,
        sighting=sighting_of(sound.microphone, sound.directions.begun_in(*span)),
        embedded=embedded,
    )


def _embedded(sound: HomeSound, frames: Indices) -> ClipEmbeddings | None:
    """Return the embedded windows of successive frames that are at least half filled."""
    first, count = int(sound.frames[frames[0]]), len(frames)
    windows = sound.embeddings
    starts = windows.frames - first
    inside = (starts >= -HOP_FRAMES) & (starts + WINDOW_FRAMES <= count + HOP_FRAMES)
    rows = np.flatnonzero(inside)
    if not len(rows):
        return None
    taught = np.zeros(len(rows), bool)
    taught[spread(np.arange(len(rows)), MOST_OF_MARK)] = True
    version = np.full(len(rows), AS_IT_IS)
    return ClipEmbeddings(windows.values[rows], version, taught, starts[rows])


def _group(sound: HomeSound, start: int) -> str:
    """Return the source of a recording: its day, or the enrolment it belongs to.

    An enrolment across midnight is in two logs, and named by that midnight.
    """
    if sound.enrolled and not sound.log.stem.endswith(CUT):
        edges = int(sound.stamps[0]), int(sound.stamps[-1]) + FRAME_NANOSECONDS
        for edge in edges:
            night = round(edge / _DAY)
            if abs(edge - night * _DAY) < FRAME_NANOSECONDS:
                return f"{HOME} night {night}"
        return f"{HOME} {hashlib.sha256(sound.values.tobytes()).hexdigest()}"
    day = np.datetime64(start // NANOSECONDS, "s").astype("datetime64[D]")
    return f"{HOME} {day}"
