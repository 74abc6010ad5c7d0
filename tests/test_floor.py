"""The floor of a room: what is there while nothing happens, and never what happens."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features import floor as module
from hearthlog.models.features.floor import (
    BLOCK_FRAMES,
    SECTION_BLOCKS,
    FloorTracker,
    decibels,
    is_quiet,
    low_power,
)
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.labels.labeller import Labeller
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES

pytestmark = pytest.mark.fast

BANDS = DEFAULT.bands
SECOND = 20  # frames
MINUTE = 60 * SECOND
SECTION = SECTION_BLOCKS * BLOCK_FRAMES


def noise(level, count, seed=0):
    """Steady noise of a level in dB in all bands: powers of frames."""
    rng = np.random.default_rng(seed)
    return 10 ** (level / 10) * rng.gamma(60.0, 1 / 60, (count, BANDS))


def sound(level, count, spread, seed=0):
    """A sound whose level changes by some dB from each 0.4 s to the next, as of a shower or music.

    Music has a spread of 2 to 7 dB, a shower of 0.7 to 5.
    """
    rng = np.random.default_rng(seed)
    changes = np.repeat(rng.normal(0, spread, (count // 8 + 2, BANDS)), 8, axis=0)[3:][:count]
    return noise(level, count, seed) * 10 ** (changes / 10)


def tracked(powers, first=0, sizes=(10**9,), of="powers"):
    """Floors of a new tracker, or its rooms, from blocks of some sizes in turn."""
    tracker, floors, place, turn = FloorTracker(), [], 0, 0
    while place < len(powers):
        block = powers[place : place + sizes[turn % len(sizes)]]
        floors.append(getattr(tracker(block, first + place), of))
        place, turn = place + len(block), turn + 1
    return np.concatenate([np.empty((0, powers.shape[1])), *floors])


def level_at(floors, powers, frame):
    """Level of the floor at a frame, in dB; the floors are those of the last frames."""
    return 10 * np.log10(floors[frame - len(powers)][-1])


def evening():
    """Two minutes of a room, a fan, talk, music, the room again."""
    return np.concatenate(
        [
            noise(-60, 2 * MINUTE),
            noise(-45, 90 * SECOND, 1),
            sound(-30, 40 * SECOND, 5.0, 2),
            sound(-25, 30 * SECOND, 3.0, 3),
            noise(-65, MINUTE, 4),
        ]
    )


@pytest.mark.parametrize("first", [0, 1, 7, 12_345_678])
@pytest.mark.parametrize("size", [1, 7, 8, 200])
def test_blocks_of_any_size_give_the_same_floors(size, first):
    powers = evening()
    assert np.array_equal(tracked(powers, first, [size]), tracked(powers, first))


@given(
    first=st.integers(0, 1000),
    sizes=st.lists(st.integers(1, 90), min_size=1, max_size=6),
    spans=st.lists(
        st.tuples(st.integers(1, 600), st.floats(-90, 0), st.sampled_from([0.0, 1.0, 5.0])),
        min_size=1,
        max_size=6,
    ),
)
@settings(max_examples=100, deadline=None)
def test_so_they_do_of_any_sound_and_never_are_more_than_what_was_heard(first, sizes, spans):
    parts = [
        sound(level, count, spread, n) if spread else noise(level, count, n)
        for n, (count, level, spread) in enumerate(spans)
    ]
    powers = np.concatenate(parts)
    floors = tracked(powers, first, sizes)
    assert np.array_equal(floors, tracked(powers, first))
    assert np.isfinite(floors).all()
    assert (floors >= powers.min(axis=0) * (1 - 1e-12)).all()
    assert (floors <= powers.max(axis=0) * (1 + 1e-12)).all()


@pytest.mark.parametrize("first", range(BLOCK_FRAMES))
def test_there_is_a_floor_from_the_first_whole_block_on(first):
    begin = -first % BLOCK_FRAMES
    for count in range(3 * BLOCK_FRAMES):
        floors = tracked(noise(-50, count), first)
        assert len(floors) == max(count - begin - BLOCK_FRAMES + 1, 0)
    powers = noise(-50, 100)
    block = powers[begin : begin + BLOCK_FRAMES].mean(axis=0)
    np.testing.assert_allclose(tracked(powers, first)[0], block, rtol=1e-12)


def test_a_room_that_was_never_heard_quiet_has_the_least_of_what_was_heard():
    powers = sound(-30, 3 * SECOND, 5.0)
    blocks = powers[:56].reshape(7, BLOCK_FRAMES, BANDS).mean(axis=1)
    np.testing.assert_allclose(tracked(powers)[55 - 60], np.sort(blocks, axis=0)[1], rtol=1e-12)


def test_the_floor_is_that_of_the_room():
    powers = noise(-60, MINUTE)
    assert level_at(tracked(powers), powers, MINUTE - 1) == pytest.approx(-60, abs=0.5)


def test_when_a_fan_stops_the_floor_falls_at_once():
    powers = np.concatenate([noise(-40, 3 * MINUTE), noise(-60, MINUTE, 1)])
    floors = tracked(powers)
    assert level_at(floors, powers, 3 * MINUTE - 1) == pytest.approx(-40, abs=0.5)
    assert level_at(floors, powers, 3 * MINUTE + 2 * SECTION) == pytest.approx(-60, abs=0.5)


def test_it_falls_too_where_the_room_is_not_quite_steady():
    powers = np.concatenate([noise(-40, 3 * MINUTE), sound(-60, MINUTE, 2.0)])
    floors = tracked(powers)
    assert level_at(floors, powers, 3 * MINUTE + 10 * SECOND) < -58


def test_a_fan_is_a_part_of_the_room_after_a_minute_and_not_before():
    powers = np.concatenate([noise(-70, 2 * MINUTE), noise(-50, 2 * MINUTE, 1)])
    floors = tracked(powers)
    for second in range(0, 52, 4):
        assert level_at(floors, powers, 2 * MINUTE + second * SECOND) < -69
    for second in range(60, 120, 4):
        assert level_at(floors, powers, 2 * MINUTE + second * SECOND) == pytest.approx(-50, abs=0.5)


def test_what_is_steady_is_the_room_at_once_and_as_long_as_it_sounds():
    quiet, fan = noise(-70, 2 * MINUTE), noise(-50, 40 * SECOND, 1)
    fan[300:340] *= 100  # a cough
    powers = np.concatenate([quiet, fan, noise(-70, MINUTE, 2)])
    rooms = tracked(powers, of="room")
    for second in range(9, 40, 3):
        at = level_at(rooms, powers, 2 * MINUTE + second * SECOND)
        assert at == pytest.approx(-50, abs=0.5)
    stopped = 2 * MINUTE + 40 * SECOND
    assert level_at(rooms, powers, stopped + 2 * BLOCK_FRAMES) < -69
    assert np.array_equal(rooms, tracked(powers, sizes=(7, 1, 30), of="room"))


def sounding_frames(level):
    """Start noise of a level 40 s into a quiet room; return the frames of the minute that sound."""
    classifier = Classifier(load_model(Path("general")))
    rng = np.random.default_rng(3)
    samples = rng.standard_normal((100 * SECOND, FRAME_SAMPLES)) * 10 ** (-75 / 20)
    samples[40 * SECOND :] += rng.standard_normal((60 * SECOND, FRAME_SAMPLES)) * 10 ** (level / 20)
    values = DEFAULT.extractor()(samples.astype(np.float32))
    floors = FloorTracker()(DEFAULT.band_powers(values), 0)
    stamps = np.arange(len(values)) * FRAME_NANOSECONDS
    labels, _ = Labeller(classifier).push(values, floors, 0, stamps)
    return labels.frames[labels.probabilities[:, classifier.classes.index("silence")] < 1.0]


@pytest.mark.parametrize("level", [-60, -50, -40])
def test_a_fridge_that_starts_is_a_sound_for_some_seconds_and_no_longer(level):
    recorded = sounding_frames(level)
    assert 40 * SECOND - 10 < recorded.min() < 40 * SECOND + 10
    assert len(recorded) > 3 * SECOND
    assert (recorded > 48.5 * SECOND).sum() < SECOND  # of 50 s


@pytest.mark.parametrize("level", [-30, -20])
def test_a_loud_tap_or_tone_is_a_sound_for_a_minute_however_steady(level):
    recorded = sounding_frames(level)
    assert len(recorded) > 50 * SECOND


@pytest.mark.parametrize("spread", [0.7, 1.5, 3.0, 6.0])
def test_ten_minutes_of_a_shower_or_of_music_never_raise_it(spread):
    quiet = noise(-60, 2 * MINUTE)
    powers = np.concatenate([quiet, sound(-25, 10 * MINUTE, spread, 1)])
    floors = tracked(powers)
    before = floors[len(quiet) - 1 - len(powers)]
    assert np.array_equal(floors[len(quiet) - len(powers) :].max(axis=0), before)
    rooms = tracked(powers, of="room")
    assert np.array_equal(rooms[len(quiet) - len(powers) :].max(axis=0), before)


def test_neither_does_a_sound_that_is_steady_for_less_than_a_minute():
    hair_dryer = noise(-30, 45 * SECOND, 1)
    powers = np.concatenate([noise(-60, 2 * MINUTE), hair_dryer, noise(-60, MINUTE, 2)])
    assert decibels(tracked(powers)[:, -1]).max() < -58


def test_real_noise_is_steady_and_ten_minutes_of_it_become_the_room():
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((2 * MINUTE, FRAME_SAMPLES))
    samples[:MINUTE] *= 10 ** (-65 / 20)
    samples[MINUTE:] *= 10 ** (-45 / 20)
    powers = DEFAULT.band_powers(DEFAULT.extractor()(samples.astype(np.float32)))
    floors = tracked(powers)
    assert level_at(floors, powers, MINUTE + 45 * SECOND) == pytest.approx(-65, abs=0.5)
    assert level_at(floors, powers, 2 * MINUTE - 1) == pytest.approx(-45, abs=0.5)


def test_after_a_gap_it_begins_anew():
    before, after = noise(-40, 2 * MINUTE), noise(-60, MINUTE, 1)
    tracker = FloorTracker()
    tracker(before, 0)
    tracker.restart()
    anew = tracker(after, 2 * MINUTE + 3)
    assert np.array_equal(anew.powers, tracked(after, 2 * MINUTE + 3))
    assert not anew.converged


def late(powers, first, size):
    """Begin late in a sound: number of the frame where the floor has converged, and all floors."""
    tracker, floors, converged = FloorTracker(), [np.empty((0, BANDS))], None
    for place in range(0, len(powers), size):
        block = tracker(powers[place : place + size], first + place)
        floors.append(block.powers)
        if block.converged and converged is None:
            converged = place
    return converged, np.concatenate(floors)


@pytest.mark.parametrize("size", [1, 8, 50])
@pytest.mark.parametrize("first", [10_000, 10_005, 11_203])
def test_once_converged_another_past_gives_the_same_floors(size, first):
    powers = evening()
    converged, floors = late(powers, first, size)
    assert converged > MINUTE  # so much is remembered
    same = len(powers) - converged + SECOND  # those of the second before, too
    for past in (noise(-80, 997), sound(-20, 2403, 4.0), noise(-10, 5005)):
        full = tracked(np.concatenate([past, powers]), first - len(past))
        assert np.array_equal(full[-same:], floors[-same:])
        assert not np.array_equal(full[-len(powers) + 200 :], floors[-len(powers) + 200 :])


def test_without_anything_steady_it_converges_after_half_a_day(monkeypatch):
    powers = sound(-40, 5 * MINUTE, 3.0)
    assert late(powers, 0, 80)[0] is None
    monkeypatch.setattr(module, "_MEMORY_SECTIONS", 20)
    converged, floors = late(powers, 0, 80)
    assert converged is not None
    past = np.concatenate([noise(-80, 800), powers])
    same = len(powers) - converged
    assert np.array_equal(tracked(past, -800)[-same:], floors[-same:])


def test_in_digital_silence_the_floor_is_nothing():
    floors = tracked(np.zeros((MINUTE, BANDS)))
    assert not floors.any()
    assert decibels(floors).max() == pytest.approx(-70)


def test_a_window_is_quiet_if_no_band_is_the_gate_above_the_floor():
    floor, count = np.geomspace(1e-6, 1e-3, BANDS), 30
    floors = np.tile(floor, (count, 1))
    powers = np.tile(floor * 10 ** (1.9 / 10), (count + 7, 1))
    assert is_quiet(powers, floors, 8, 2.0).all()
    for band in (0, 17, BANDS - 1):
        louder = powers.copy()
        louder[20, band] *= 1.6  # for one frame of the windows that have it
        expected = np.ones(count, bool)
        expected[13:21] = False
        assert is_quiet(louder, floors, 8, 2.0).tolist() == expected.tolist()
    assert not is_quiet(powers, floors, 8, 1.8).any()


def test_what_codecs_change_is_quiet():
    powers = np.full((20, BANDS), 0.5e-7)  # -73 dBFS
    assert is_quiet(powers, np.zeros((13, BANDS)), 8, 2.0).all()
    assert not is_quiet(4 * powers, np.zeros((13, BANDS)), 8, 2.0).any()


def test_the_floor_of_a_recording_of_a_room_is_low_in_it():
    powers = noise(-50, 30 * SECOND)
    powers[100:160] *= 1000  # a door
    assert 10 * np.log10(low_power(powers)).mean() == pytest.approx(-50, abs=0.5)
    assert np.array_equal(low_power(powers[:5]), powers[:5].mean(axis=0))
