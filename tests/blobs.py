"""Segments of made-up statistics, to train on in no time."""

from pathlib import Path

import numpy as np

from analyzer.dataset import Dataset
from analyzer.manifest import Clip
from analyzer.scenario import Scenario

SOURCES = 6


def blobs(classes: int, count: int, *, spread: float = 1.5) -> tuple[Dataset, Scenario]:
    """Make `count` segments of each class around a centre of its own, from six sources each."""
    rng = np.random.default_rng(classes)
    names = tuple(f"class_{i}" for i in range(classes))
    target = np.repeat(np.arange(classes), count)
    centre = rng.standard_normal((classes, 42))
    statistics = centre[target] + spread * rng.standard_normal((len(target), 42))
    statistics = (statistics * np.geomspace(1e-4, 1e3, 42)).astype(np.float32)
    group = target * SOURCES + np.arange(len(target)) % SOURCES
    clips = [Clip(Path(name), name, name, "made up", "CC0") for name in names]
    data = Dataset(
        statistics, target, group, names, tuple(clips), (float(count),) * classes, skipped={}
    )
    return data, Scenario("blobs", {name: (name,) for name in names})


def ignore_progress(_done: int, _total: int) -> None:
    """Take a report of progress."""
