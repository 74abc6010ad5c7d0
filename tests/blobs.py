"""Segments of made-up features, to train on in no time."""

from dataclasses import replace

import numpy as np

from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.manifest import Scenario
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import DEFAULT

SOURCES = 6


def blobs(
    classes: int, count: int, *, spread: float = 1.5, features: FeatureSet = DEFAULT
) -> tuple[Dataset, Scenario]:
    """Make `count` segments of each class around a centre of its own, from six sources each."""
    rng = np.random.default_rng(classes)
    names = tuple(f"class_{i}" for i in range(classes))
    target = np.repeat(np.arange(classes), count)
    width, frames = features.width, features.window_frames
    centre = rng.standard_normal((classes, width))
    around = centre[target] + spread * rng.standard_normal((len(target), width))
    windows = around[:, np.newaxis] + 0.1 * rng.standard_normal((len(target), frames, width))
    windows *= np.geomspace(1e-2, 10, width)
    windows[:, :, [0, 6]] = np.exp(windows[:, :, [0, 6]])  # energy and flux are never negative
    group = target * SOURCES + np.arange(len(target)) % SOURCES
    data = Dataset(
        windows=windows.astype(np.float32),
        target=target,
        group=group,
        collection=np.zeros_like(group),
        weight=np.ones(len(target)),
        floor=np.zeros((len(target), features.bands)),
        copies=np.empty((0, *windows.shape), np.float32),
        copy_floor=np.empty((0, len(target), features.bands)),
        classes=names,
        seconds=dict.fromkeys(names, float(count)),
        collection_names=("made up",),
        collections={("made up", "CC0"): classes},
        skipped={},
    )
    return data, Scenario("blobs", {name: (name,) for name in names})


def with_arrays(model: Model, **arrays: np.ndarray) -> Model:
    """Return a model with other arrays of its classifier."""
    return replace(model, arrays={**model.arrays, **arrays})
