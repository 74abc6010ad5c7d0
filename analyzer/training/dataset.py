"""From labelled sound to the windows of one second that classifiers learn from."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.analyzer.training.scenario import Scenario
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.classifiers.description import Amount
from hearthlog.models.features.feature_set import SILENCE_POWER, FeatureSet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.frame_cutter import FrameCutter
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.progress import Progress

HOP_FRAMES = 10
SEGMENTS_PER_GROUP = 24
_BELOW_CLIP = 10 ** (-12 / 10)  # 12 dB


class Recording(NamedTuple):
    """Sound of one label.

    Attributes
    ----------
    label, group, collection, licence : str
        As in a manifest; a group is never both learned from and tested on.
    features : np.ndarray [shape=(n, d)], float32
        Features of successive frames.
    weight : float
        Weight of its segments.
    """

    label: str
    group: str
    collection: str
    licence: str
    features: Float32
    weight: float = 1.0


@dataclass(frozen=True)
class Dataset:
    """Segments to learn from: windows of one second.

    Attributes
    ----------
    windows : np.ndarray [shape=(n, window_frames, d)], float32
        Features.
    target : np.ndarray [shape=(n,)], intp
        Index into `classes`.
    group, collection : np.ndarray [shape=(n,)], intp
        Number of the source group, and of the collection.
    weight : np.ndarray [shape=(n,)], float64
        Weight of the segment.
    classes : tuple of str
    seconds : dict of str to float
        Seconds of sound of each class, before it was thinned out.
    collection_names : tuple of str
        Names behind `collection`.
    collections : dict of (name, licence) to int
        Number of recordings that were used.
    skipped : dict of str to int
        Number of recordings that gave no segment, by the reason.
    """

    windows: Float32
    target: Indices
    group: Indices
    collection: Indices
    weight: Float64
    classes: tuple[str, ...]
    seconds: Mapping[str, float]
    collection_names: tuple[str, ...]
    collections: Mapping[tuple[str, str], int]
    skipped: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.target)

    @property
    def digest(self) -> str:
        """SHA-256 of the segments, their classes and their groups, in hexadecimal."""
        digest = hashlib.sha256("\n".join(self.classes).encode())
        for array in (self.windows, self.target.astype("<i8"), self.group.astype("<i8")):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @property
    def amounts(self) -> dict[str, Amount]:
        """Amount of each class."""
        return {
            name: Amount(
                sources=len(np.unique(self.group[self.target == i])),
                segments=int((self.target == i).sum()),
                seconds=round(self.seconds.get(name, 0.0), 3),
            )
            for i, name in enumerate(self.classes)
        }


def build_dataset(
    clips: Sequence[LabelledClip],
    scenario: Scenario,
    progress: Progress,
    home: Iterable[Recording] = (),
    features: FeatureSet = DEFAULT,
) -> Dataset:
    """Cut clips, and recordings of a home, into the segments of a scenario.

    Parameters
    ----------
    clips : sequence of LabelledClip
    scenario : Scenario
    progress : callable
        Is told the share of the clips that is done, 0 to 1.
    home : iterable of Recording
        Further recordings; their labels may be names of classes.
    features : FeatureSet
        The features to compute; those of `home` are of the same set.

    Returns
    -------
    Dataset
        As `cut_recordings` makes it.

    Raises
    ------
    DataError
        If a class is left without segments.
    SourceError
        If a clip cannot be read.
    """
    recordings = chain(clip_recordings(clips, scenario, progress, features), home)
    data = cut_recordings(recordings, scenario, features)
    for name, amount in data.amounts.items():
        if not amount.segments:
            labels = ", ".join(scenario.classes[name])
            raise DataError(f"class {name} has no segments: no usable clip is labelled {labels}")
    return data


def clip_recordings(
    clips: Sequence[LabelledClip],
    scenario: Scenario,
    progress: Progress,
    features: FeatureSet = DEFAULT,
) -> Iterator[Recording]:
    """Read clips and compute their features; clips of labels outside the scenario have none.

    Parameters
    ----------
    clips : sequence of LabelledClip
    scenario : Scenario
    progress : callable
        Is told the share of the clips that is done, 0 to 1.
    features : FeatureSet, optional
        The features to compute.

    Yields
    ------
    Recording
        In the order of the clips.

    Raises
    ------
    SourceError
        If a clip cannot be read.
    """
    for number, clip in enumerate(clips):
        progress(number / len(clips))
        values = np.empty((0, features.width), np.float32)
        if scenario.find(clip.label) is not None:
            values = clip_features(clip, features)
        yield Recording(clip.label, clip.source_group, clip.source, clip.licence, values)
    progress(1.0)


def cut_recordings(
    recordings: Iterable[Recording], scenario: Scenario, features: FeatureSet = DEFAULT
) -> Dataset:
    """Cut recordings into segments of one window, half a second apart.

    Segments of silence are all kept, others if they are above -60 dBFS and at most 12 dB below the
    mean level of their recording. Of each class and source group at most 24 segments, times their
    weight, are kept, evenly spaced.

    Parameters
    ----------
    recordings : iterable of Recording
        Their labels may be names of classes.
    scenario : Scenario
        Which class a label belongs to.
    features : FeatureSet, optional
        Of the recordings; one with another number of features is skipped.

    Returns
    -------
    Dataset
        Its classes are those of the scenario, some of which may have no segments; `skipped` says
        why recordings gave none.
    """
    classes = tuple(scenario.classes)
    groups: dict[str, int] = {}
    collections: dict[str, int] = {}
    used: Counter[tuple[str, str]] = Counter()
    skipped: Counter[str] = Counter()
    seconds: dict[str, float] = {}
    windows = [np.empty((0, features.window_frames, features.width), np.float32)]
    weights = [np.empty(0)]
    rows = [np.empty((0, 3), np.intp)]
    for item in recordings:
        name = scenario.find(item.label, marked=True)
        if name is None:
            skipped[f"label {item.label} is not in the scenario"] += 1
            continue
        reason, segments = _segments(item, features)
        if reason:
            skipped[reason] += 1
            continue
        used[item.collection, item.licence] += 1
        seconds[name] = seconds.get(name, 0.0) + len(item.features) * FRAME_SECONDS
        windows.append(segments)
        weights.append(np.full(len(segments), item.weight))
        group = groups.setdefault(item.group, len(groups))
        collection = collections.setdefault(item.collection, len(collections))
        rows.append(np.tile([classes.index(name), group, collection], (len(segments), 1)))
    target, group_of, collection_of = np.concatenate(rows).T
    weight = np.concatenate(weights)
    kept = _thinned(target * len(groups) + group_of, weight)
    return Dataset(
        np.concatenate(windows)[kept],
        target[kept],
        group_of[kept],
        collection_of[kept],
        weight[kept],
        classes,
        seconds,
        tuple(collections),
        dict(used),
        dict(sorted(skipped.items())),
    )


def clip_features(clip: LabelledClip, features: FeatureSet) -> Float32:
    """Compute the features of a clip.

    Parameters
    ----------
    clip : LabelledClip
    features : FeatureSet

    Returns
    -------
    np.ndarray [shape=(n, d)], float32
        A row for each frame; units as in `features.units`.

    Raises
    ------
    SourceError
        If the clip cannot be read.
    """
    extract = features.extractor()
    values = [np.empty((0, features.width), np.float32)]
    cutter = FrameCutter()
    values += [extract(cutter.push(block)) for block in read_audio(clip.path)]
    return np.concatenate(values)


def _segments(recording: Recording, features: FeatureSet) -> tuple[str, Float32]:
    """Return the segments that are loud enough, and why there are none."""
    values, window = recording.features, features.window_frames
    nothing = np.empty((0, window, features.width), np.float32)
    if values.shape[1] != features.width:
        return f"its features are not {features.name}", nothing
    if len(values) < window:  # the recorder labels whole windows only
        return f"shorter than {features.window_seconds:g} s", nothing
    every = np.lib.stride_tricks.sliding_window_view(values, window, axis=0)
    windows = every[::HOP_FRAMES].transpose(0, 2, 1)
    if class_name(recording.label) == SILENCE:
        return "", windows
    power = features.power(windows).mean(axis=1, dtype=np.float64)
    level = features.power(values).mean(dtype=np.float64)
    loud = windows[power > max(SILENCE_POWER, level * _BELOW_CLIP)]
    return ("" if len(loud) else "nowhere above -60 dBFS"), loud


def _thinned(key: Indices, weight: Float64) -> Indices:
    """Return the indices of evenly spaced rows of each key, at most 24 times their weight."""
    kept = [np.empty(0, np.intp)]
    for value in np.unique(key):
        rows = np.flatnonzero(key == value)
        count = min(len(rows), int(SEGMENTS_PER_GROUP * weight[rows[0]]))
        kept.append(rows[np.linspace(0, len(rows) - 1, count).round().astype(np.intp)])
    return np.sort(np.concatenate(kept))
