"""Inputs of a classifier: the same bits in any blocks, the paper's where it is asked for."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hearthlog.models.features.auros21 import AUROS21, bands_of, dct_weights
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.features.home33 import HOME33
from hearthlog.recorder.stream.stages import RollingStatistics

pytestmark = pytest.mark.fast

SETS = [AUROS21, HOME33]
KINDS = [(described, kind) for described in SETS for kind in described.inputs]


def values_of(described, count, seed=0):
    values = np.abs(np.random.default_rng(seed).standard_normal((count, described.width)))
    return values.astype(np.float32)


def floors_of(count, seed=0):
    return np.random.default_rng(seed).gamma(1.0, 0.3, (count, 33))


@pytest.mark.parametrize(("described", "kind"), KINDS)
@given(st.lists(st.integers(0, 70), max_size=30), st.integers(1, 700), st.integers(0, 2**32))
def test_blocks_of_any_size_agree_bit_for_bit(described, kind, sizes, count, seed):
    values, inputs = values_of(described, count, seed), described.inputs[kind]
    floors = floors_of(count, seed)
    full, stream = inputs.stream()(values, floors), inputs.stream()
    borders = [0, *np.cumsum(sizes).clip(0, count).tolist(), count]
    parts = [stream(values[a:b], floors[a:b]) for a, b in pairwise(borders)]
    np.testing.assert_array_equal(np.concatenate(parts), full)
    assert full.shape == (max(count - inputs.window_frames + 1, 0), inputs.width)


@pytest.mark.parametrize(("described", "kind"), KINDS)
def test_windows_on_their_own_give_what_the_stream_gives(described, kind):
    values, inputs = values_of(described, 400), described.inputs[kind]
    length, floors = inputs.window_frames, np.tile(floors_of(1), (400, 1))
    windows = np.lib.stride_tricks.sliding_window_view(values, length, axis=0).transpose(0, 2, 1)
    np.testing.assert_array_equal(
        inputs.of_windows(windows, floors[: len(windows)]), inputs.stream()(values, floors)
    )


@pytest.mark.parametrize("described", SETS)
def test_inputs_above_the_floor_need_a_floor(described):
    with pytest.raises(TypeError, match="need the floor of the room"):
        described.inputs["above_floor"].stream()(values_of(described, 30))


@pytest.mark.parametrize("described", SETS)
def test_statistics_are_those_of_the_log(described):
    values = values_of(described, 300)
    logged = np.concatenate(RollingStatistics(20, described.width)(values), axis=1)
    np.testing.assert_array_equal(described.inputs["statistics"].stream()(values), logged[19:])


def test_after_a_restart_the_window_fills_again():
    values, inputs = values_of(AUROS21, 100), AUROS21.inputs["bands"]
    stream = inputs.stream()
    stream(values[:50])
    stream.restart()
    np.testing.assert_array_equal(stream(values[50:]), inputs.stream()(values[50:]))


def test_bands_of_a_smooth_spectrum_come_back_from_its_cepstra():
    smooth = 10.0 * np.cos(np.pi * (np.arange(32) + 0.5) / 32 * 3) - 40.0
    cepstra = (smooth @ dct_weights())[np.newaxis].astype(np.float32)
    np.testing.assert_allclose(bands_of(cepstra)[0], smooth, atol=1e-4)


@pytest.mark.parametrize("described", SETS)
@pytest.mark.parametrize("value", [-1e30, 1e30])
def test_features_that_no_sound_has_give_finite_inputs(value, described):
    values = np.full((100, described.width), value, np.float32)
    powers = described.band_powers(values)
    assert np.isfinite(np.square(powers)).all()
    floors = FloorTracker()(powers, 0).powers
    stream = described.inputs["above_floor"].stream()
    assert np.isfinite(stream(values[: len(floors)], floors)).all()
