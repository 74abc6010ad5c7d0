"""What a home recorded of late, as probabilities of a model's classes."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from hearthlog.analyzer.logs.layers import find_chains
from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.relabel.reading import info_for_model, read_sound
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.times import NANOSECONDS

_SPAN = 14 * 86_400 * NANOSECONDS
_MOST_FRAMES = 4_000_000  # in memory, of a node; two weeks of the usual home have fewer
_SILENT_FRAMES = 100  # that are kept at each end of a silence


class HomeSound(NamedTuple):
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
) -> HomeSound:
    """Label the logs of the last two weeks of a home, and keep the probabilities.

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
    classifier, result = Classifier(model), HomeSound([], [])
    try:
        chains = find_chains(folders)
    except LogError:  # nothing but enrolled sounds
        return result
    for chain in chains:
        logs = [log for _, log in sorted(chain.asked.items(), reverse=True)]
        frames, newest = 0, 0
        for number, log in enumerate(logs):
            try:
                info, (_, begin) = info_for_model(log, model, log)
                newest = max(newest, begin)
                if frames > _MOST_FRAMES or newest - begin > _SPAN:
                    break
                for part in _stretches(info, classifier):
                    result.sound.append(part)
                    frames += len(part)
            except LogError as error:
                result.losses.append(str(error))
            progress((number + 1) / len(logs))
    return result


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
