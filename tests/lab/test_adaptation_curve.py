"""Adaptation curves: macro F1 of a home against the number of corrected segments."""

import dataclasses

import numpy as np
import pytest
from blobs import blobs

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.window_methods import BANDS, ROOM
from hearthlog.schemas.errors import ignore_progress
from hearthlog.tools.lab import adaptation_curve as curves
from hearthlog.tools.lab.adaptation_curve import CORRECTED, adaptation_curve


def test_the_curve_of_adaptation_rises_where_homes_differ():
    data, _ = blobs(3, 400, spread=1.0, features=ROOM.features)
    group = np.arange(len(data)) // 4
    far = data.windows + np.float32(20.0) * (group % 2).astype(np.float32)[:, None, None]
    data = dataclasses.replace(
        data, windows=far, group=group, collection=group % 2, collection_names=("a", "b")
    )
    curve = adaptation_curve(data, ROOM, ignore_progress)
    assert curve.corrected == CORRECTED
    assert set(curve.collections) == {"a", "b"}
    assert curve.mean[-1] > curve.mean[0]


def test_no_collection_is_like_a_home_if_all_are_small_or_there_is_but_one():
    data, _ = blobs(3, 30, features=ROOM.features)
    small = dataclasses.replace(
        data, collection=np.arange(len(data)) % 4, collection_names=("a", "b", "c", "d")
    )
    for alike in (data, small):
        with pytest.raises(DataError, match="none can stand for a new home"):
            adaptation_curve(alike, ROOM, ignore_progress)


def test_only_landmarks_have_a_curve_of_adaptation():
    with pytest.raises(DataError, match="method bands learns no landmarks"):
        adaptation_curve(blobs(3, 30, features=BANDS.features)[0], BANDS, ignore_progress)


def test_only_classes_with_ten_segments_in_a_home_count(monkeypatch):
    data, _ = blobs(4, 40, features=ROOM.features)
    there = np.flatnonzero(data.target < 2)
    few = np.flatnonzero(data.target == 2)[:9]
    collection = np.zeros(len(data), np.int64)
    collection[np.concatenate([there[::2], few])] = 1
    data = dataclasses.replace(
        data,
        group=np.arange(len(data)) // 2 * 2 + collection,
        collection=collection,
        collection_names=("elsewhere", "home"),
    )
    tried = []
    original = curves._scores
    monkeypatch.setattr(curves, "_scores", lambda *a: tried.append(a[2]) or original(*a))
    curve = adaptation_curve(data, ROOM, ignore_progress)
    assert {"home"} <= set(curve.collections)
    split = next(one for one in tried if collection[one.test[0]] == 1)
    assert set(data.target[np.concatenate([split.pool, split.test])]) == {0, 1}
