"""A home's own sound to learn from: marked spans of its logs, and enrolled sounds."""

import hashlib
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan
from hearthlog.analyzer.training.clip_embeddings import AS_IT_IS, ClipEmbeddings
from hearthlog.analyzer.training.dataset import Recording, spread
from hearthlog.analyzer.training.marked_sound import HomeSound, read_reviewed_sound
from hearthlog.analyzer.training.sightings import sighting_of
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name
from hearthlog.models.embedding.projection import HOP_FRAMES, WINDOW_FRAMES
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.floor import BLOCK_FRAMES, is_quiet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Indices
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import CUT
from hearthlog.schemas.messages.topics import EmbeddingSpace

_DAY = 86_400 * NANOSECONDS
HOME_WEIGHT = 3.0  # of a segment of the home; others have 1
# With embeddings heads learn from it, too, and with more weight in the machine than others a home
# loses what was right in it.
HOME_WEIGHT_WITH_EMBEDDINGS = 1.0
MOST_OF_MARK = 6  # segments, so that a mark of minutes is not more than a few of seconds
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
    """Cut marks out of the sound of a home.

    A mark shorter than a second is extended to one; one of silence is left out instead, for other
    sounds are in the same second. All marks of a UTC day are of one group, and so is an enrolled
    recording. An enrolled sound is without a room, unless it is silence.

    Parameters
    ----------
    gate : float
        A mark in which nothing is so many dB above the floor of the room is left out, unless it is
        silence; a `HearthlogWarning` counts them, and those of what was not recorded. 0 for none.

    Yields
    ------
    Recording
        A mark, or a part of one that lies between gaps; log by log.
    """
    quiet: list[str] = []
    unheard: list[str] = []
    for sound in sounds:
        for mark in sound.marks:
            if not sound.inside([(mark.start, mark.end)]).any():
                unheard.append(f"{mark.label} in {sound.log.name}")
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
    if unheard:
        text = (
            f"{len(unheard)} marks lie where nothing was recorded, the first is {unheard[0]}: they "
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
    """Whether a mark of silence is shorter than a window, so that nothing is learned from it."""
    is_short = mark.end - mark.start < features.window_seconds * NANOSECONDS
    return is_short and class_name(mark.label) == SILENCE


def lesson_recordings(
    folder: Path,
    features: FeatureSet = DEFAULT,
    gate: float = 0.0,
    space: EmbeddingSpace | None = None,
) -> Iterator[Recording]:
    """Read the marks in the logs of a folder that teach something; at most six segments of each.

    Raise `LogError, DataError` as of `home_recordings`.
    """
    sounds = (teaching(sound) for sound in read_reviewed_sound(folder, features, space=space))
    yield from marked_recordings(sounds, folder, features, gate)


def teaching(sound: HomeSound) -> HomeSound:
    """Leave out the marks that teach nothing.

    Those are the marks of what a reviewer could not tell, and those that touch a span that was
    drawn at random.
    """
    return replace(sound, marks=_teaching(sound.marks, sound.reviewed))


def _teaching(marks: Iterable[Mark], reviewed: Iterable[ReviewedSpan]) -> list[Mark]:
    drawn = [span for span in reviewed if span.chosen == RANDOM]
    return [
        mark
        for mark in marks
        if class_name(mark.label) != UNKNOWN
        and not any(
            mark.microphone == span.microphone and mark.start < span.end and span.start < mark.end
            for span in drawn
        )
    ]


def _is_quiet(recording: Recording, features: FeatureSet, gate: float) -> bool:
    """Tell whether no window of 0.4 s is above the floor of the room."""
    windows = len(recording.features) - BLOCK_FRAMES + 1
    if recording.floor is None or features.band_powers is None or windows < 1:
        return recording.floor is not None
    powers = features.band_powers(recording.features)
    return bool(is_quiet(powers, recording.floor[-windows:], BLOCK_FRAMES, gate).all())


def _recordings(
    sound: HomeSound, mark: Mark, features: FeatureSet, *, floored: bool
) -> Iterator[Recording]:
    """Yield the features of a mark, in pieces where there are gaps in it."""
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
    """Cut successive frames out of the sound of a home.

    Parameters
    ----------
    frames : np.ndarray [shape=(n,)], intp
        Places of the frames.
    """
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
    """Return the windows of successive frames as a network heard them, filled by half or more."""
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
    """Name the source of a recording: its day, or what was enrolled, the same sound only once.

    A recording that was enrolled at midnight is in two logs, and named by that midnight.
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
