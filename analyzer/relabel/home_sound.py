"""What a home recorded of late, as probabilities of a model's classes."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.logs.home_logs import HomeLog, find_home_logs
from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.relabel.reading import info_for_model, read_sound
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.messages.topics import topic
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.times import NANOSECONDS

_SPAN = 14 * 86_400 * NANOSECONDS
_MOST_LOGS = 24  # of a node, evenly spaced
_MOST_RELABELLED = 2  # of a node
_SILENT_FRAMES = 100  # that are kept at each end of a silence
_EVER = 1 << 62


class HomeProbabilities(NamedTuple):
    """What a home recorded of late.

    Attributes
    ----------
    sound : list of np.ndarray [shape=(n, C)], float32
        Probabilities of successive frames; of a silence five seconds at each end, for who learned
        that silence lasts for hours would miss a cough.
    losses : list of str
        What could not be used, and why.
    """

    sound: list[Float32]
    losses: list[str]


def read_home_sound(
    folders: Sequence[Path], model: Model, progress: Progress = ignore_progress
) -> HomeProbabilities:
    """Read the probabilities of a model in logs of the last two weeks of a home.

    They are those of the recorder, where it had the model, or the one that was adapted. If it never
    had, the model labels the latest logs.

    Parameters
    ----------
    folders : sequence of Path
        Folders of logs; enrolled sounds in them are passed over.
    model : Model
    progress : callable, optional
        Told the share of the logs that is read, 0 to 1.

    Raises
    ------
    ModelError
        If the feature set of the model, or its kind of classifier, is not installed.
    """
    try:
        home = find_home_logs(folders)
    except LogError:  # nothing but enrolled sounds
        return HomeProbabilities([], [])
    logs, result = home.between(0, _EVER), HomeProbabilities([], [*home.losses])
    nodes = [list(same) for _, same in groupby(sorted(logs, key=_by_node), lambda log: log.node)]
    for number, same in enumerate(nodes):
        recent = [log.path for log in same if same[-1].start - log.start <= _SPAN]
        _add_node(recent, model, result)
        progress((number + 1) / len(nodes))
    return result


def _by_node(log: HomeLog) -> tuple[str, int]:
    return log.node, log.start


def _add_node(logs: Sequence[Path], model: Model, result: HomeProbabilities) -> None:
    """Add the sound of some logs of a node."""
    places = np.linspace(0, len(logs) - 1, min(len(logs), _MOST_LOGS)).round().astype(int)
    others: list[RecorderInfo] = []
    own = {model.sha256, model.description.training_data.base_sha256}
    found = False
    for place in places.tolist():
        try:
            info, _ = info_for_model(logs[place], model, logs[place])
            if info.model_sha256 and info.model_sha256 in own and _labelled_by_one(info):
                result.sound.extend(_recorded(info, model.classes))
                found = True
            else:
                others.append(info)
        except LogError as error:
            result.losses.append(str(error))
    for info in [] if found else others[-_MOST_RELABELLED:]:
        try:
            result.sound.extend(_stretches(info, Classifier(model)))
        except LogError as error:
            result.losses.append(str(error))


def _labelled_by_one(info: RecorderInfo) -> bool:
    """Tell whether the recorder had one model in the whole log."""
    name = topic(info.microphone, "info")
    said = read_columns([info.path], {name}, fields={"model_sha256"}).get(name)
    return said is not None and set(said["model_sha256"]) == {info.model_sha256}


def _recorded(info: RecorderInfo, classes: Sequence[str]) -> Iterator[Float32]:
    """Yield the probabilities in a log of frames that follow each other."""
    name = topic(info.microphone, "label")
    labels = read_columns([info.path], {name}, fields={"frame", "probabilities"}).get(name)
    if labels is None or not len(labels):
        return
    names = array_names(labels.metadata, "probabilities")
    said = labels["probabilities"]
    if said.ndim != 2 or len(names) != said.shape[1] or not set(names) <= set(classes):
        return
    probabilities = np.zeros((len(said), len(classes)), np.float32)
    probabilities[:, [classes.index(each) for each in names]] = said
    breaks = np.flatnonzero(np.diff(labels["frame"].astype(np.int64)) != 1) + 1
    for stretch in np.split(probabilities, breaks):
        yield _cut_silence(stretch, classes)


def _stretches(info: RecorderInfo, classifier: Classifier) -> Iterator[Float32]:
    """Yield the probabilities of frames that follow each other."""
    labeller, last = StreamLabeller(classifier), 0
    stretch: list[Float32] = []
    for event in read_sound(info, 0):
        labels = labeller.push(event)
        if labels is None or not len(labels.frames):
            continue
        if stretch and labels.frames[0] != last + 1:
            yield _cut_silence(np.concatenate(stretch), classifier.classes)
            stretch = []
        stretch.append(labels.probabilities)
        last = labels.frames[-1]
    if stretch:
        yield _cut_silence(np.concatenate(stretch), classifier.classes)


def _cut_silence(probabilities: Float32, classes: Sequence[str]) -> Float32:
    """Leave out what is more than five seconds within a silence."""
    if SILENCE not in classes:
        return probabilities
    sounding = probabilities.argmax(axis=1) != classes.index(SILENCE)
    return probabilities[maximum_filter1d(sounding, 2 * _SILENT_FRAMES + 1, mode="constant")]
