"""Stamps follow the sound card's clock, whatever it is off by, and never jump."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.sources.framing import FrameCutter, Framer, SampleBlock, SampleClock
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES

RATE = 16_000
BLOCK = 8_000
BOOT = 5_000.0  # CLOCK_MONOTONIC when the capture starts
OFFSET = 1_700_000_000_000_000_000


def true_time(index, ppm=0.0):
    return BOOT + np.asarray(index) / (RATE * (1 + ppm * 1e-6))


def errors_of(ppm, noise, seconds, seed=0):
    """Seconds that the clock is off by at each frame."""
    rng = np.random.default_rng(seed)
    clock = SampleClock(RATE)
    found = []
    for index in range(0, seconds * RATE, BLOCK):
        clock.observe(index, float(true_time(index, ppm)) + rng.exponential(noise))
        frames = np.arange(index, index + BLOCK, FRAME_SAMPLES, dtype=float)
        found.append(clock.time(frames) - true_time(frames, ppm))
    return np.concatenate(found), clock


@settings(deadline=None, max_examples=30)
@given(st.floats(-100, 100), st.sampled_from([0, 20e-6, 100e-6]), st.integers(0, 2**32))
def test_drift_is_followed_within_a_millisecond_from_the_first_frame_on(ppm, noise, seed):
    errors, clock = errors_of(ppm, noise, 120, seed)
    assert np.abs(errors).max() < 1e-3
    assert np.abs(errors[len(errors) // 2 :]).max() < 0.15e-3
    assert clock.ppm == pytest.approx(ppm, abs=3)


def test_late_observations_do_not_pull_the_clock():
    errors, _ = errors_of(50, 5e-3, 600)
    assert np.abs(errors[len(errors) // 2 :]).max() < 2e-3


@settings(deadline=None, max_examples=30)
@given(st.floats(-100, 100), st.floats(8, 60), st.floats(2, 4), st.floats(1e-3, 0.1))
def test_seconds_in_which_the_machine_is_late_throughout_do_not_move_the_clock(
    ppm, start, length, lateness
):
    clock, errors = SampleClock(RATE), []
    for index in range(0, 90 * RATE, BLOCK):
        late = lateness if start <= index / RATE < start + length else 0.0
        clock.observe(index, float(true_time(index, ppm)) + late)
        errors.append(float(clock.time(index) - true_time(index, ppm)))
    assert np.abs(errors).max() < 1e-3


@settings(deadline=None, max_examples=30)
@given(st.floats(-30, 30), st.integers(0, 2**32))
def test_behind_a_sound_server_stamps_stay_within_20_milliseconds_after_ten_seconds(ppm, seed):
    """Blocks arrive at once or up to half a second late, some minutes only late."""
    rng = np.random.default_rng(seed)
    clock, errors = SampleClock(RATE), []
    for index in range(0, 600 * RATE, BLOCK):
        is_late = rng.random() < 0.8 or 100 * RATE < index < 200 * RATE
        late = rng.uniform(0.1, 0.5) if is_late and index else rng.uniform(0, 0.005)
        clock.observe(index, float(true_time(index, ppm)) + late, is_exact=False)
        errors.append(float(clock.time(index) - true_time(index, ppm)))
    assert np.abs(errors[10 * RATE // BLOCK :]).max() < 0.020
    assert clock.ppm == 0


@settings(deadline=None, max_examples=30)
@given(st.floats(-300, 300), st.floats(0, 0.02), st.integers(0, 2**32))
def test_time_never_jumps_nor_runs_backwards(ppm, noise, seed):
    rng = np.random.default_rng(seed)
    clock, times = SampleClock(RATE), []
    for index in range(0, 60 * RATE, BLOCK):
        clock.observe(index, float(true_time(index, ppm)) + rng.uniform(0, noise))
        times.append(clock.time(np.arange(index, index + BLOCK, FRAME_SAMPLES, dtype=float)))
    steps = np.diff(np.concatenate(times))
    assert np.abs(steps - 0.05).max() < 0.05 * (noise + 1e-3)


def test_frames_stay_in_order_where_the_first_sound_came_seconds_late():
    clock, times = SampleClock(RATE), []
    for index in range(0, 60 * RATE, BLOCK):
        late = 3.0 if index < 4 * RATE else 0.0
        clock.observe(index, float(true_time(index)) + late, is_exact=False)
        times.append(clock.time(np.arange(index, index + BLOCK, FRAME_SAMPLES, dtype=float)))
    times = np.concatenate(times)
    assert np.diff(times).min() > 0.04
    assert times[-1] == pytest.approx(float(true_time(60 * RATE - FRAME_SAMPLES)), abs=1e-3)


def block(index, taken_at, count=BLOCK, *, overflowed=False, position=None):
    samples = (np.arange(index, index + count) % 30_000).astype(np.int16)
    return SampleBlock(
        index if position is None else position, samples, overflowed, taken_at, taken_at
    )


def framer():
    made = Framer()
    made.begin(RATE, OFFSET, "started")
    return made


def test_blocks_of_any_size_become_whole_frames_in_order():
    made, index, found = framer(), 0, []
    for count in [1, 799, 800, 5_000, 3, 12_345, 2_400]:
        found += made.add(block(index, float(true_time(index)), count))
        index += count
    samples = np.concatenate([event.samples.ravel() for event in found])
    expected = (np.arange(index // FRAME_SAMPLES * FRAME_SAMPLES) % 30_000).astype(np.int16)
    np.testing.assert_array_equal(samples, expected.astype(np.float32) / np.float32(32768))
    stamps = np.concatenate([event.stamps for event in found])
    steps = np.diff(stamps)
    np.testing.assert_array_less(np.abs(steps - FRAME_NANOSECONDS), 1_000)


@pytest.mark.parametrize("lost", [160, 16_000, 48_123])
def test_samples_that_the_sound_card_lost_are_counted_from_its_times(lost):
    made, events = framer(), []
    for number in range(200):
        index = number * BLOCK
        missing = lost if number >= 150 else 0
        taken = float(true_time(index + missing))
        events += made.add(block(index, taken, overflowed=number in (150, 151)))
    gaps = [event for event in events if isinstance(event, Gap)]
    assert [gap.reason for gap in gaps] == ["the sound card lost samples"]
    before = [event for event in events[: events.index(gaps[0])] if isinstance(event, Frames)]
    after = events[events.index(gaps[0]) + 1]
    assert gaps[0].start == int(before[-1].stamps[-1]) + FRAME_NANOSECONDS
    assert gaps[0].end == int(after.stamps[0])
    assert after.first == before[-1].first + len(before[-1].samples) + gaps[0].frames_lost
    # The block with the loss inside is not used: it cannot be said where in it the loss lies.
    true = true_time(151 * BLOCK + lost) * 1e9 + OFFSET
    assert abs(int(after.stamps[0]) - true) < 200_000


def test_a_jump_of_a_steady_adc_counts_as_loss_even_without_a_flag():
    made, events = framer(), []
    for number in range(200):
        index = number * BLOCK
        events += made.add(block(index, float(true_time(index + (4000 if number > 99 else 0)))))
    (gap,) = [event for event in events if isinstance(event, Gap)]
    assert gap.end - gap.start == pytest.approx((4000 + BLOCK) / RATE * 1e9, abs=2e5)


def test_times_on_a_clock_nobody_knows_are_not_believed():
    rng = np.random.default_rng(0)
    made, events = framer(), []
    for number in range(200):
        index = number * BLOCK
        arrival = float(true_time(index + BLOCK)) + rng.exponential(0.002)
        adc_time = 1.7e9 + number * 0.5 + rng.normal(0, 0.1)
        samples = np.ones(BLOCK, np.int16)
        events += made.add(SampleBlock(index, samples, False, adc_time, arrival))
    assert all(isinstance(event, Frames) for event in events)
    stamps = np.concatenate([event.stamps for event in events])
    true = true_time(np.arange(len(stamps)) * FRAME_SAMPLES) * 1e9 + OFFSET
    assert np.abs(stamps - true).max() < 10e6


def test_blocks_that_the_recorder_did_not_take_in_time_are_a_gap():
    made = framer()
    first = made.add(block(0, float(true_time(0))))
    gap, frames = made.add(block(5 * BLOCK, float(true_time(5 * BLOCK))))
    assert gap.reason == "the recorder was too slow"
    assert gap.frames_lost == 40
    assert frames.first == len(first[0].samples) + 40


def test_setting_the_wall_clock_is_a_gap_of_the_step_in_which_hardly_a_frame_is_lost():
    made = framer()
    made.add(block(0, float(true_time(0))))
    hour = 3_600_000_000_000
    made.step_clock(OFFSET + hour)
    gap, frames = made.add(block(BLOCK, float(true_time(BLOCK))))
    assert gap.reason == "the clock was set by +3600.000 s"
    assert gap.frames_lost <= 1
    assert gap.end - gap.start == pytest.approx(hour, abs=50e6)
    assert int(frames.stamps[0]) == gap.end


def test_sound_that_another_device_heard_already_is_not_heard_twice():
    made = framer()
    made.add(block(0, float(true_time(0))))
    made.begin(RATE, OFFSET, "labmic is there again")
    assert made.add(block(0, float(true_time(-BLOCK)))) == []
    gap, frames = made.add(block(BLOCK, float(true_time(0)), 2 * BLOCK))
    assert gap.end - gap.start == pytest.approx(0, abs=1e3)
    assert len(frames.samples) == 10
    assert int(frames.stamps[0]) == gap.end


@pytest.mark.parametrize("size", [1, 799, 800, 801, 5000])
def test_samples_in_pieces_of_any_size_are_cut_into_the_same_frames(size):
    samples = np.arange(12_345, dtype=np.float32)
    cutter = FrameCutter()
    pieces = [cutter.push(samples[start : start + size]) for start in range(0, 12_345, size)]
    assert np.concatenate(pieces).tolist() == samples[:12_000].reshape(15, 800).tolist()
