"""Rolling statistics are those of the window itself, after any number of frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.models.features.auros21 import WINDOW_FRAMES, FeatureExtractor
from hearthlog.recorder.stream.stages import RollingStatistics

pytestmark = pytest.mark.fast


def directly(features):
    values = features.astype(np.float64)
    windows = [values[max(0, i - WINDOW_FRAMES + 1) : i + 1] for i in range(len(values))]
    return np.array([w.mean(axis=0) for w in windows]), np.array([w.std(axis=0) for w in windows])


def in_blocks(features, sizes):
    statistics = RollingStatistics(20, 21)
    ends = np.minimum(np.cumsum(sizes), len(features))
    blocks = [statistics(block) for block in np.split(features, ends)]
    return np.concatenate([b[0] for b in blocks]), np.concatenate([b[1] for b in blocks])


def test_they_equal_the_direct_computation_on_real_features(real_frames):
    features = FeatureExtractor()(real_frames)
    for ours, direct in zip(RollingStatistics(20, 21)(features), directly(features), strict=True):
        np.testing.assert_allclose(ours, direct, rtol=1e-6, atol=1e-6)


def test_they_do_not_drift_over_a_million_frames_of_extreme_values():
    features = np.random.default_rng(1).standard_normal((1_000_000, 3)).astype(np.float32)
    features *= np.float32([1e-6, 1.0, 1e6])
    features[500_000:, :] = 0.25
    mean, std = RollingStatistics(20, 3)(features)
    np.testing.assert_array_equal(mean[500_019:], 0.25)
    np.testing.assert_array_equal(std[500_019:], 0.0)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 70), max_size=30), st.integers(1, 700), st.integers(0, 2**32))
def test_blocks_of_any_size_agree_bit_for_bit(sizes, count, seed):
    features = np.random.default_rng(seed).standard_normal((count, 21)).astype(np.float32)
    for block, full in zip(
        in_blocks(features, sizes), RollingStatistics(20, 21)(features), strict=True
    ):
        np.testing.assert_array_equal(block, full)


def test_after_a_restart_the_window_fills_again():
    features = np.random.default_rng(2).standard_normal((50, 21)).astype(np.float32)
    statistics = RollingStatistics(20, 21)
    statistics(features[:30])
    statistics.restart()
    mean, std = statistics(features[30:])
    np.testing.assert_array_equal(mean, RollingStatistics(20, 21)(features[30:])[0])
    np.testing.assert_array_equal(std[0], 0.0)
