"""Public API from sound to features and labels, with the code path of a recorder."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.models import modelfile
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.features.installed import feature_set as installed
from hearthlog.models.labels.labeller import Labeller
from hearthlog.recorder.sources.decoding import convert_sound
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.errors import SourceError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES

__all__ = [
    "Model",
    "SoundFeatures",
    "SoundLabels",
    "classify",
    "extract_features",
    "load_model",
    "save_model",
]


class SoundFeatures(NamedTuple):
    """Features of sound, one row per frame of 50 ms.

    Attributes
    ----------
    names, units : tuple of str
        Names and units of the d values of a frame.
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds.
    values : np.ndarray [shape=(n, d)], float32
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    times: Int64
    values: Float32


class SoundLabels(NamedTuple):
    """Labels of sound, one per frame of 50 ms, from the end of the first complete window on.

    Attributes
    ----------
    classes : tuple of str
    times : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds.
    labels : np.ndarray [shape=(n,)] of str
        The likeliest class of each frame.
    probabilities : np.ndarray [shape=(n, C)], float32
        In the order of `classes`.
    novelty : np.ndarray [shape=(n,)], float32
        From 0 to 1; NaN if the model computes none.
    segments : Labelling
        The time spans from the model's smoothing.
    """

    classes: tuple[str, ...]
    times: Int64
    labels: NDArray[np.object_]
    probabilities: Float32
    novelty: Float32
    segments: Labelling


def extract_features(
    sound: NDArray[np.generic], rate: int, feature_set: str = DEFAULT.name, start: int = 0
) -> SoundFeatures:
    """Compute the features of sound, bit for bit as a recorder would log them.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,) or (n, channels)]
        Integers of the full range of their type, or floats in full scale, -1 to 1. Channels are
        averaged, or the best channel is used where they cancel. An incomplete last frame and frames
        with non-finite samples are dropped.
    rate : int
        Samples per second; rates other than 16000 are resampled.
    feature_set : str
    start : int
        Time of the first sample in nanoseconds.

    Returns
    -------
    SoundFeatures

    Raises
    ------
    ModelError
        If there is no such feature set.
    SourceError
        If the sound is shorter than a frame, or is not a valid array.

    Examples
    --------
    >>> import numpy as np
    >>> tone = 0.1 * np.sin(2 * np.pi * 440 * np.arange(8000) / 16000)
    >>> features = hearthlog.extract_features(tone, 16000)
    >>> features.values.shape, features.names[:2]
    ((10, 33), ('energy', 'zero_crossing_rate'))
    >>> features.values[0, :2].round(3)
    array([0.005, 0.054], dtype=float32)
    """
    described = installed(feature_set)
    samples = convert_sound(sound, rate)
    count = len(samples) // FRAME_SAMPLES
    if count == 0:
        raise SourceError("the sound is shorter than one frame of 50 ms")
    frames = samples[: count * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
    valid = np.flatnonzero(np.isfinite(frames).all(axis=1))
    if not len(valid):
        raise SourceError("the samples are not finite (NaN or infinity)")
    values = [described.extractor()(InfrasoundFilter()(frames[run])) for run in _runs(valid)]
    times = start + valid * FRAME_NANOSECONDS
    return SoundFeatures(described.feature_names, described.units, times, np.concatenate(values))


def classify(model: Model, sound: NDArray[np.generic], rate: int, start: int = 0) -> SoundLabels:
    """Label sound, bit for bit as a single-channel recorder with this model would log it.

    Parameters
    ----------
    model : Model
    sound, rate, start
        As in `extract_features`.

    Returns
    -------
    SoundLabels
        Empty if the sound is shorter than the window of the model's feature set.

    Raises
    ------
    ModelError
        If the model's feature set is not installed.
    SourceError
        If the sound is shorter than a frame, or is not a valid array.

    Examples
    --------
    >>> import soundfile
    >>> sound, rate = soundfile.read("sound.flac", dtype="int16")
    >>> labels = hearthlog.classify(hearthlog.load_model("home.safetensors"), sound, rate)
    >>> labels.times[:2] / 1e9, labels.probabilities.shape
    (array([0.55, 0.6 ]), (3586, 9))
    >>> labels.labels[0], labels.segments.labels[0]
    ('silence', 'silence')
    """
    classifier = Classifier(model)
    features = extract_features(sound, rate, classifier.feature_set.name, start)
    labeller = Labeller(classifier)
    powers = classifier.feature_set.band_powers
    labelled, segments = [], []
    frames = (features.times - start) // FRAME_NANOSECONDS
    for run in _runs(frames):
        rows = np.searchsorted(frames, run)
        values, times, first = features.values[rows], features.times[rows], int(run[0])
        floors = None if powers is None else FloorTracker()(powers(values), first)
        labels, ended = labeller.push(values, floors, first, times)
        labelled.append(labels)
        segments += [*ended, *labeller.close(int(times[-1]) + FRAME_NANOSECONDS)]
    stamps, probabilities, novelty = (
        np.concatenate([getattr(labels, name) for labels in labelled])
        for name in ("stamps", "probabilities", "novelty")
    )
    names = np.array(labeller.classes, object)
    starts, ends, states = (
        np.array([getattr(segment, name) for segment in segments], np.int64)
        for name in ("start", "end", "label")
    )
    return SoundLabels(
        labeller.classes,
        stamps,
        names[probabilities.argmax(axis=1)],
        probabilities,
        novelty,
        Labelling(starts, ends, names[states]),
    )


def _runs(frames: Int64) -> list[Int64]:
    """Split frame numbers into runs of consecutive numbers."""
    return np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)


def load_model(path: Path | str) -> Model:
    """Read and validate a model file; nothing in the file is executed.

    Parameters
    ----------
    path : Path or str

    Returns
    -------
    Model

    Raises
    ------
    ModelError
        If the file is missing or damaged, or needs something that is not installed.

    Examples
    --------
    >>> model = hearthlog.load_model("home.safetensors")
    >>> model.classes[:3], model.description.feature_set
    (('silence', 'speech', 'music'), 'home33')
    """
    return modelfile.load_model(Path(path))


def save_model(model: Model, path: Path | str) -> None:
    """Write a model file; the same model gives the same bytes.

    Parameters
    ----------
    model : Model
    path : Path or str
        Must end in `.safetensors`; the file must not exist.

    Raises
    ------
    ModelError
        If the file exists or cannot be written.

    Examples
    --------
    >>> hearthlog.save_model(hearthlog.load_model("home.safetensors"), "copy.safetensors")
    """
    modelfile.save_model(model, Path(path))
