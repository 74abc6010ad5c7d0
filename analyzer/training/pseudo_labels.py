"""Pseudo-labels: segments of a home, reviewed or not, that keep the labels of its model."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import SEGMENT_FIELDS, Labelling, labelling_of
from hearthlog.analyzer.logs.recorder_info import read_recorder_infos
from hearthlog.analyzer.training.clips import spread
from hearthlog.analyzer.training.dataset import CONFIRMED, HOP_FRAMES, Recording
from hearthlog.analyzer.training.direction_samples import evidence_of
from hearthlog.analyzer.training.home_recordings import (
    HomeSound,
    read_sound_of,
    recording_of,
    with_embeddings,
)
from hearthlog.analyzer.training.method import loud_windows
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name, translation
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import of_segments, window_places
from hearthlog.models.features.floor import is_quiet
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.arrays import Bool, Float64, Indices
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import relabel_path
from hearthlog.schemas.messages.topics import LIVE, labelling_topic, relabelling, scenario_labelling

MOST_CONFIRMED = 60  # segments of a class
_WEIGHT = 1.0  # of a segment: with the weight of marks, half-filled windows become silence
SURE = 0.5
FEWEST = 20  # of a class
_ASIDE = NANOSECONDS // 2  # of marks
SEGMENT_FRAMES = 20
_MOST_TRIED = 240  # segments of a class in a log
_MOST_SILENT = 2000  # of silence, mostly below the gate


class Candidates(NamedTuple):
    """Segments that may keep the labels of the model."""

    recordings: list[Recording]
    target: Indices  # [shape=(n,)]; their classes


def confirmed_segments(
    sound: HomeSound, classes: Sequence[str], segment_frames: int = SEGMENT_FRAMES
) -> Candidates:
    """Cut segments from reviewed spans without marks.

    Marks correct errors. A model trained on marks alone forgets correct labels, silence first: the
    only windows with the floor of this room would be of other classes.

    Raise `LogError` if the reviewed labelling cannot be read.
    """
    confirmed: list[Candidates] = []
    for name in sorted({span.corrects or LIVE for span in sound.confirmed}):
        labelling = _labelling(sound, name)
        if labelling is not None and sound.values.shape[1]:
            spans = [
                (span.start, span.end)
                for span in sound.confirmed
                if (span.corrects or LIVE) == name
            ]
            target = _classes_of(sound, labelling, classes)
            target = np.where(sound.inside(spans), target, -1)
            confirmed.append(_cut(sound, target, classes, segment_frames))
    return _joined(confirmed)


def labelled_segments(
    sound: HomeSound,
    classes: Sequence[str],
    names: Collection[str],
    segment_frames: int = SEGMENT_FRAMES,
) -> Candidates:
    """Cut segments with labels of some classes, reviewed or not.

    Raise `LogError` if the labels cannot be read.
    """
    if not sound.values.shape[1]:
        return _joined([])
    labelling = _labelling(sound, LIVE)
    if labelling is not None:
        target = _classes_of(sound, labelling, classes)
    else:  # the model decides
        target = np.full(len(sound.stamps), classes.index(SILENCE) if SILENCE in classes else -1)
    own = [number for number, name in enumerate(classes) if name in names]
    return _cut(sound, np.where(np.isin(target, own), target, -1), classes, segment_frames)


def chosen(
    candidates: Iterable[Candidates], model: Model, least: float = SURE, fewest: int = FEWEST
) -> list[Recording]:
    """Choose up to 60 segments of each class with high model probability, evenly if possible.

    `least` is the minimum probability; `fewest`, the minimum number of a class, is reached with the
    most probable segments. Silence below the gate of the model, which needs no training, is used
    only if other silence is scarce.
    """
    recordings, target = _joined(candidates)
    if not recordings:
        return []
    silent = np.array([class_name(recording.label) == SILENCE for recording in recordings])
    probabilities, quiet = _probabilities(recordings, silent, model)
    rows = np.arange(len(target))
    sure = np.where(probabilities.argmax(axis=1) == target, probabilities[rows, target], 0.0)
    kept: list[int] = []
    for number in np.unique(target):
        same = np.flatnonzero((target == number) & (sure > 0.0))
        loud = same[~quiet[same]]
        if model.classes[number] == SILENCE and len(loud) < fewest:
            same = np.sort(np.concatenate([loud, same[quiet[same]][: fewest - len(loud)]]))
        else:
            same = loud
        enough = same[sure[same] >= least]
        if len(enough) < fewest:
            enough = np.sort(same[np.argsort(-sure[same], kind="stable")[:fewest]])
        kept += spread(enough, MOST_CONFIRMED).tolist()
    unknown = model.description.scenario.get(UNKNOWN, [UNKNOWN])[0]  # otherwise `unknown` itself
    labels = [unknown if name == UNKNOWN else name for name in model.classes]
    return [recordings[i]._replace(label=labels[target[i]]) for i in sorted(kept)]


def _labelling(sound: HomeSound, name: str) -> Labelling | None:
    path, labelled = sound.log, sound.labelling
    if name not in {LIVE, labelled}:
        name = name.removeprefix(relabelling(""))
        path, labelled = relabel_path(sound.log, name), relabelling(name)
    topic = labelling_topic(sound.microphone, labelled, "segment")
    if not path.exists():
        return None
    columns = read_columns([path], {topic}, fields=SEGMENT_FIELDS).get(topic)
    return None if columns is None else labelling_of(columns)


def _classes_of(sound: HomeSound, labelling: Labelling, classes: Sequence[str]) -> Indices:
    """Return the class of each frame; -1 for other classes and unlabelled frames."""
    names = translation(set(labelling.labels), classes)
    numbers = {name: number for number, name in enumerate(classes)}
    own = np.array([numbers.get(names[label], -1) for label in labelling.labels], np.intp)
    middle = sound.stamps + FRAME_NANOSECONDS // 2
    row = np.maximum(np.searchsorted(labelling.starts, middle, "right") - 1, 0)
    inside = (labelling.starts[row] <= middle) & (middle < labelling.ends[row])
    return np.where(inside, own[row], -1)


def _cut(
    sound: HomeSound, target: Indices, classes: Sequence[str], segment_frames: int
) -> Candidates:
    """Cut segments by the class at their centre (silence: throughout), away from marks and -1."""
    marks = [(mark.start, mark.end) for mark in sound.marks]
    away = ~sound.inside(marks, _ASIDE) & ~sound.inside(sound.drawn)
    silence = classes.index(SILENCE) if SILENCE in classes else -2
    starts = np.arange(0, max(len(target) - segment_frames + 1, 0), HOP_FRAMES)
    frames = starts[:, np.newaxis] + np.arange(segment_frames)
    own = target[frames[:, segment_frames // 2]]
    fit = (away[frames] & (target[frames] >= 0)).all(axis=1)
    fit &= (own != silence) | (target[frames] == silence).all(axis=1)
    fit &= sound.frames[frames[:, -1]] - sound.frames[frames[:, 0]] == segment_frames - 1
    frames, own = frames[fit], own[fit]
    tried = [
        spread(np.flatnonzero(own == number), _MOST_SILENT if number == silence else _MOST_TRIED)
        for number in np.unique(own)
    ]
    rows = np.sort(np.concatenate([np.empty(0, np.intp), *tried]))
    cut = [recording_of(sound, classes[own[row]], frames[row]) for row in rows.tolist()]
    recordings = [one._replace(collection=CONFIRMED, weight=_WEIGHT) for one in cut]
    return Candidates(recordings, own[rows])


def _joined(parts: Iterable[Candidates]) -> Candidates:
    """Merge candidates in order of time, without duplicates."""
    parts = list(parts)
    recordings = [recording for part in parts for recording in part.recordings]
    target = np.concatenate([np.empty(0, np.intp), *(part.target for part in parts)])
    once = {recording.features.tobytes(): row for row, recording in enumerate(recordings)}
    rows = sorted(once.values(), key=lambda row: recordings[row].span or (0, 0))
    return Candidates([recordings[row] for row in rows], target[rows])


def _probabilities(
    recordings: Sequence[Recording], silent: Bool, model: Model
) -> tuple[Float64, Bool]:
    """Return the model's probabilities of segments, and which are below its gate.

    They are over the training windows: all of silence, else those at most 6 dB below the segment.
    """
    classifier = Classifier(model)
    features, inputs = classifier.feature_set, classifier.inputs
    segments = np.stack([recording.features for recording in recordings])
    floors = np.zeros((len(segments), features.bands))
    places = window_places(segments.shape[1], inputs.window_frames)
    quiet = np.zeros((len(segments), len(places)), bool)
    for row, recording in enumerate(recordings):
        if recording.floor is not None:
            floors[row] = recording.floor[-1]
            quiet[row] = _quiet_windows(recording, recording.floor, classifier)
    of_each = of_segments(inputs, segments, floors)
    by_window = np.zeros((*quiet.shape, len(model.classes)))
    evidence = evidence_of(classifier, [recording.sighting for recording in recordings])
    loud_rows = np.nonzero(~quiet)[0]
    of_windows = None if evidence is None else evidence[loud_rows]
    by_heads = _by_heads(recordings, classifier)[loud_rows]
    by_window[~quiet] = classifier.classify(of_each[~quiet], of_windows, by_heads)[0]
    if quiet.any():
        by_window[quiet, model.classes.index(SILENCE)] = 1.0
    loud = loud_windows(features.power(segments).astype(np.float64), inputs.window_frames)
    loud |= ~loud.any(axis=1, keepdims=True) | silent[:, np.newaxis]
    share = (loud / loud.sum(axis=1, keepdims=True))[:, :, np.newaxis]
    probabilities: Float64 = (by_window * share).sum(axis=1)
    return probabilities, quiet.min(axis=1)


def _by_heads(recordings: Sequence[Recording], classifier: Classifier) -> Float64:
    """Return the outputs of a classifier's heads for segments; NaN without an embedding."""
    by_heads = np.full((len(recordings), len(classifier.classes)), np.nan)
    if classifier.embedding_heads is None:
        return by_heads
    for row, recording in enumerate(recordings):
        embedded = None if recording.embedded is None else recording.embedded.at(0)
        if embedded is not None and len(embedded):
            by_heads[row] = classifier.embedding_heads.log_probabilities(embedded)[0]
    return by_heads


def _quiet_windows(recording: Recording, floor: Float64, classifier: Classifier) -> Bool:
    """Return which windows of a segment are below the gate of a classifier."""
    length, powers_of = classifier.inputs.window_frames, classifier.feature_set.band_powers
    places = np.array(window_places(len(recording.features), length))
    if not classifier.gate or powers_of is None:
        return np.zeros(len(places), bool)
    quiet = is_quiet(powers_of(recording.features), floor[length - 1 :], length, classifier.gate)
    return quiet[places]


_SILENT_LOGS = 4  # logs to read for silence
_SILENT_PART = 900 * NANOSECONDS  # of each
_LOGS = 6  # logs to read for other classes
_PART = 3600 * NANOSECONDS
_VERY_SURE = 0.8  # a lower limit would train a poor model on its own errors


def unreviewed_silence(
    folders: Sequence[Path], model: Model, scenario: str = ""
) -> Iterator[Candidates]:
    """Cut silence out of some logs of the last two weeks.

    The scenario is empty for the sounds of the home. Raise `LogError` if there is no log.
    """
    recent = [entry.path for entry in find_home_logs(folders).recent()]
    for place in np.linspace(len(recent) - 1, 0, min(len(recent), _SILENT_LOGS)).round():
        log = recent[int(place)]
        yield from _labelled(log, model, {SILENCE}, _SILENT_PART, scenario)


def unreviewed_sounds(
    folders: Sequence[Path], model: Model, names: Collection[str], scenario: str = ""
) -> list[Recording]:
    """Choose up to 60 one-second sounds of each class with a very high model probability.

    The logs are those of the last two weeks with the longest labelled time of these classes. The
    scenario is empty for the sounds of the home. Raise `LogError` if there is no log.
    """
    recent = [entry.path for entry in find_home_logs(folders).recent()]
    amounts = np.array([_labelled_time(log, names, scenario) for log in recent], np.int64)
    most = np.argsort(-amounts, kind="stable")[:_LOGS]
    candidates = [
        one
        for place in most[amounts[most] > 0]
        for one in _labelled(recent[place], model, names, _PART, scenario)
    ]
    return chosen(candidates, model, least=_VERY_SURE, fewest=0)


def _labelled(
    log: Path, model: Model, names: Collection[str], length: int, scenario: str
) -> Iterator[Candidates]:
    """Cut segments of classes out of the start of a log."""
    with suppress(LogError):  # labelling reports the read error
        features = feature_set(model.description.feature_set)
        for info in read_recorder_infos(log, "features"):
            if info.first_frame is not None:
                begin = info.first_frame[1]
                part = begin, begin + length
                for one in read_sound_of(log, features, {info.microphone}, part, scenario):
                    sound = with_embeddings(one, part, model.description.embedding_space)
                    yield labelled_segments(sound, model.classes, names, features.window_frames)


def _labelled_time(log: Path, names: Collection[str], scenario: str) -> int:
    """Return the labelled time of classes in a log, in nanoseconds."""
    amount = 0
    with suppress(LogError):
        infos = read_recorder_infos(log, "features")
        labelling = scenario_labelling(scenario) if scenario else LIVE
        topics = {labelling_topic(info.microphone, labelling, "segment") for info in infos}
        for columns in read_columns([log], topics, fields=SEGMENT_FIELDS).values():
            labels = labelling_of(columns)
            own = np.isin(labels.labels.astype(str), sorted(names))
            amount += int((labels.ends - labels.starts)[own].sum())
    return amount
