"""From labelled clips to what a classifier learns from: statistics of one-second segments."""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analyzer.errors import DataError
from analyzer.manifest import Clip
from analyzer.scenario import Scenario
from models.inputs import WINDOW_FRAMES
from recorder.features import FEATURE_NAMES, FRAME_SAMPLES, SAMPLE_RATE, FeatureExtractor
from recorder.sources.files import read_audio
from recorder.statistics import RollingStatistics

HOP_FRAMES = 10
SEGMENTS_PER_GROUP = 24
_ENERGY = FEATURE_NAMES.index("energy")
_FLOOR = 10 ** (-60 / 10)  # -60 dBFS
_BELOW_CLIP = 10 ** (-12 / 10)  # 12 dB
_UNGATED = "silence"

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Dataset:
    """Segments to learn from.

    Attributes
    ----------
    statistics : np.ndarray [shape=(n, 42)], float32
        Mean, then standard deviation of the 21 features over each segment.
    target : np.ndarray [shape=(n,)], intp
        Index into `classes`.
    group : np.ndarray [shape=(n,)], intp
        Number of the source group.
    classes : tuple of str
    clips : tuple of Clip
        Those that gave segments.
    clip_seconds : tuple of float
        How long they are.
    skipped : dict of str to int
        Why clips gave no segment, and how many.
    """

    statistics: Float32
    target: NDArray[np.intp]
    group: NDArray[np.intp]
    classes: tuple[str, ...]
    clips: tuple[Clip, ...]
    clip_seconds: tuple[float, ...]
    skipped: dict[str, int]

    @property
    def digest(self) -> str:
        """SHA-256 of the segments, their classes and their groups."""
        digest = hashlib.sha256("\n".join(self.classes).encode())
        for array in (self.statistics, self.target.astype("<i8"), self.group.astype("<i8")):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def build_dataset(
    clips: Sequence[Clip], scenario: Scenario, progress: Callable[[int, int], None]
) -> Dataset:
    """Cut the clips of a scenario's labels into one-second segments, half a second apart.

    A segment is kept if it is no more than 12 dB below its clip's mean level and above -60 dBFS;
    of silence all are. A clip shorter than a second gives none. At most 24 segments, evenly
    spaced, are kept for each class and source group.

    Parameters
    ----------
    clips : sequence of Clip
    scenario : Scenario
    progress : callable
        Told how many clips of how many are done.

    Raises
    ------
    DataError
        If a class is left without segments.
    SourceError
        If a clip cannot be read.
    """
    class_of = scenario.class_of
    classes = tuple(scenario.classes)
    groups: dict[str, int] = {}
    skipped: Counter[str] = Counter()
    used: list[Clip] = []
    seconds: list[float] = []
    statistics: list[Float32] = []
    target: list[int] = []
    group: list[int] = []
    for number, clip in enumerate(clips):
        progress(number, len(clips))
        name = class_of.get(clip.label)
        if name is None:
            skipped[f"label {clip.label} is not in the scenario"] += 1
            continue
        features = _features(clip)
        if len(features) < WINDOW_FRAMES:  # the recorder labels whole windows only
            skipped["shorter than a second"] += 1
            continue
        segments = _segments(features, gated=clip.label != _UNGATED)
        if not len(segments):
            skipped["nowhere above -60 dBFS"] += 1
            continue
        used.append(clip)
        seconds.append(len(features) * FRAME_SAMPLES / SAMPLE_RATE)
        statistics.append(segments)
        target.append(classes.index(name))
        group.append(groups.setdefault(clip.source_group, len(groups)))
    progress(len(clips), len(clips))
    for index, name in enumerate(classes):
        if index not in target:
            labels = ", ".join(scenario.classes[name])
            raise DataError(f"class {name} has no segments: no usable clip is labelled {labels}")
    counts = [len(segments) for segments in statistics]
    clip_of = np.repeat(np.arange(len(used)), counts)
    target_of, group_of = np.array(target)[clip_of], np.array(group)[clip_of]
    kept = _thinned(target_of * len(groups) + group_of)
    return Dataset(
        np.concatenate(statistics)[kept],
        target_of[kept],
        group_of[kept],
        classes,
        tuple(used),
        tuple(seconds),
        dict(sorted(skipped.items())),
    )


def _features(clip: Clip) -> Float32:
    extract = FeatureExtractor()
    features = [np.empty((0, len(FEATURE_NAMES)), np.float32)]
    rest = np.empty(0, np.float32)
    for block in read_audio(clip.path):
        samples = np.concatenate([rest, block])
        whole = len(samples) // FRAME_SAMPLES * FRAME_SAMPLES
        features.append(extract(samples[:whole].reshape(-1, FRAME_SAMPLES)))
        rest = samples[whole:]
    return np.concatenate(features)


def _segments(features: Float32, *, gated: bool) -> Float32:
    """Statistics of the segments of one clip that are loud enough, shape (n, 42)."""
    mean, std = RollingStatistics()(features)
    ends = slice(WINDOW_FRAMES - 1, None, HOP_FRAMES)
    segments = np.concatenate([mean[ends], std[ends]], axis=1)
    if not gated:
        return segments
    energy = segments[:, _ENERGY]
    clip_energy = features[:, _ENERGY].mean(dtype=np.float64)
    return segments[energy > max(_FLOOR, clip_energy * _BELOW_CLIP)]


def _thinned(key: NDArray[np.intp]) -> NDArray[np.intp]:
    """Choose at most 24 evenly spaced rows of each key; return their indices in order."""
    kept = []
    for value in np.unique(key):
        rows = np.flatnonzero(key == value)
        count = min(len(rows), SEGMENTS_PER_GROUP)
        kept.append(rows[np.linspace(0, len(rows) - 1, count).round().astype(np.intp)])
    return np.sort(np.concatenate(kept))
