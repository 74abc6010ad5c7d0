"""A home's own sound to learn from: marked spans of its logs, and enrolled sounds."""

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.logs.layers import find_chains
from hearthlog.analyzer.logs.recorder_info import models_for
from hearthlog.analyzer.marks.marks import Mark, read_marks
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.models.classes import SILENCE, class_name, translation
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.floor import BLOCK_FRAMES, FloorTracker, is_quiet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import HearthlogWarning, LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import ENROLLED, find_logs
from hearthlog.schemas.messages.topics import topic
from hearthlog.schemas.times import NANOSECONDS

_FIELDS = ("header.stamp", "frame", "values")
HOME_WEIGHT = 5.0  # of a segment of the home; others have 1
HOME = "this home"


def home_recordings(
    folder: Path, features: FeatureSet = DEFAULT, gate: float = 0.0
) -> Iterator[Recording]:
    """Read the features of all marks in the logs of a folder.

    A mark shorter than a window is extended to one. All marks of a UTC day are of one group. An
    enrolled sound is without a room, unless it is silence.

    Parameters
    ----------
    folder : Path
        Folder of logs, with review layers beside them, and of enrolled sounds.
    features : FeatureSet, optional
        Marks in logs of another set give recordings without features.
    gate : float
        A mark in which nothing is so many dB above the floor of the room is left out, unless it is
        silence; a `HearthlogWarning` counts them. 0 for none.

    Yields
    ------
    Recording
        A mark, or a part of one that lies between gaps; log by log.

    Raises
    ------
    LogError
        If there is no log, or if a log or a layer is damaged.
    DataError
        If there are marks, and all of them are in logs of other sets.
    """
    other: tuple[Path, str] | None = None  # log and microphone of another set
    usable, quiet = False, list[str]()
    for log in find_logs(folder, enrolled=True):
        marks = read_marks(log)
        if not marks:
            continue
        topics = {topic(mark.microphone, "features") for mark in marks}
        columns = read_columns([log], topics, fields=_FIELDS)
        earlier = _columns_before(log, topics)
        floors = {
            name: _floors(recorded, earlier.get(name), features)
            for name, recorded in columns.items()
        }
        for mark in marks:
            name = topic(mark.microphone, "features")
            if name not in columns or not len(columns[name]):
                continue
            if _is_of(columns[name], features):
                usable = True
            else:
                other = log, mark.microphone
            silence = class_name(mark.label) == SILENCE
            floor = floors[name] if silence or ENROLLED not in log.parts else None
            pieces = list(_recordings(columns[name], floor, mark, features))
            if gate and not silence and all(_is_quiet(piece, features, gate) for piece in pieces):
                quiet.append(f"{mark.label} in {log.name}")
            else:
                yield from pieces
    if quiet:
        text = (
            f"{len(quiet)} marks lie where nothing is louder than the floor of the room, the first "
            f"is {quiet[0]}: they are left out; mark what can be heard, or mark it as silence"
        )
        warnings.warn(HearthlogWarning(text, folder), stacklevel=2)
    if other is not None and not usable:
        name = _set_of(*other)
        raise DataError(
            f"{folder}: what is marked there has features of set {name}, and {features.name} is "
            f"needed: {models_for(name)}"
        )


def home_sequences(folder: Path, classes: Sequence[str]) -> list[Int64]:
    """Read the sequences of classes in a home from marks that follow each other without a gap.

    Parameters
    ----------
    folder : Path
        Folder of logs, with review layers beside them.
    classes : sequence of str
        Their names; the index of a name is its number in the sequences.

    Returns
    -------
    list of np.ndarray [shape=(n,)], int64
        Numbers of the classes of successive frames; marks on their own are left out.

    Raises
    ------
    LogError
        If there is no log, or if a layer is damaged.
    """
    numbers = {name: number for number, name in enumerate(classes)}
    sequences: list[Int64] = []
    for log in find_logs(folder, enrolled=True):
        runs: list[list[Mark]] = []
        marks = read_marks(log)
        names = translation({mark.label for mark in marks}, classes)
        for mark in sorted(mark._replace(label=names[mark.label]) for mark in marks):
            last = runs[-1][-1] if runs else None
            follows = (
                last is not None
                and mark.microphone == last.microphone
                and mark.start - last.end < FRAME_NANOSECONDS
                and mark.label in numbers
            )
            if follows and last is not None and last.label in numbers:
                runs[-1].append(mark)
            else:
                runs.append([mark])
        sequences += [_frames_of(run, numbers) for run in runs if len(run) > 1]
    return sequences


def _frames_of(run: Sequence[Mark], numbers: Mapping[str, int]) -> Int64:
    frames = [max((mark.end - mark.start) // FRAME_NANOSECONDS, 1) for mark in run]
    return np.repeat(np.array([numbers[mark.label] for mark in run], np.int64), frames)


def _columns_before(log: Path, topics: Collection[str]) -> dict[str, Columns]:
    """Read the log before another one, if there is one and it can be read."""
    with suppress(LogError):
        for chain in find_chains([log]):
            for place in chain.asked:
                return read_columns(chain.logs[max(place - 1, 0) : place], topics, fields=_FIELDS)
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


def _is_quiet(recording: Recording, features: FeatureSet, gate: float) -> bool:
    """Tell whether no window of 0.4 s is above the floor of the room."""
    windows = len(recording.features) - BLOCK_FRAMES + 1
    if recording.floor is None or features.band_powers is None or windows < 1:
        return recording.floor is not None
    powers = features.band_powers(recording.features)
    return bool(is_quiet(powers, recording.floor[-windows:], BLOCK_FRAMES, gate).all())


def _is_of(recorded: Columns, features: FeatureSet) -> bool:
    names = array_names(recorded.metadata, "values")
    return not names or tuple(names) == features.feature_names


def _set_of(log: Path, microphone: str) -> str:
    """Return the name of the feature set of a microphone in a log."""
    name = topic(microphone, "info")
    said = read_columns([log], {name}, fields={"feature_set"}).get(name)
    return "unknown" if said is None or not len(said) else str(said["feature_set"][0])


def _recordings(
    recorded: Columns, floors: Float64 | None, mark: Mark, features: FeatureSet
) -> Iterator[Recording]:
    """Yield the features of a mark, in pieces where there are gaps in it."""
    window, values = features.window_frames, recorded["values"]
    if not _is_of(recorded, features):
        values = np.empty((len(values), 0), np.float32)
    stamps, frames = recorded["header.stamp"], recorded["frame"].astype(np.int64)
    first, last = np.searchsorted(stamps, [mark.start, mark.end]).tolist()
    missing = max(window - (last - first), 0)
    first = max(first - missing // 2, 0)
    last = min(max(last + missing - missing // 2, first + window), len(stamps))
    day = np.datetime64(mark.start // NANOSECONDS, "s").astype("datetime64[D]")
    breaks = np.flatnonzero(np.diff(frames[first:last]) != 1) + 1
    for piece in np.split(np.arange(first, last), breaks):
        floor = None if floors is None else floors[piece]
        yield Recording(mark.label, f"{HOME} {day}", HOME, "", values[piece], HOME_WEIGHT, floor)
