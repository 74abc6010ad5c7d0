"""Borders of silence lie where the level changes, and what is too short is left out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.models.classifiers.model import Smoothing
from hearthlog.models.labels import Borders, Segmenter, SegmenterInput
from hearthlog.schemas.frames import FRAME_NANOSECONDS

pytestmark = pytest.mark.fast

SILENCE, COUGH, MUSIC = 0, 1, 2
REACH, SHORTEST = 12, 5
QUIET, LOUD = 1e-6, 1e-2


def of_runs(*runs):
    """States, or powers, from pairs of a value and a number of frames."""
    return np.concatenate([np.full(count, value) for value, count in runs])


def refined(states, powers, size=None, reach=REACH, shortest=SHORTEST):
    """All refined states, from blocks of some size."""
    borders, size = Borders(SILENCE, reach, shortest), size or len(states)
    parts = [
        borders.push(states[place : place + size], powers[place : place + size])
        for place in range(0, len(states), size)
    ]
    return np.concatenate([*parts, borders.close()])


def runs_of(states):
    starts = np.flatnonzero(np.diff(states, prepend=-1))
    return list(zip(states[starts].tolist(), np.diff(starts, append=len(states)), strict=True))


@pytest.mark.parametrize("early", range(-REACH + 1, REACH))
def test_a_border_of_silence_moves_to_the_step_in_level(early):
    powers = of_runs((QUIET, 60), (LOUD, 40), (QUIET, 60))
    states = of_runs((SILENCE, 60 - early), (COUGH, 40 + 2 * early), (SILENCE, 60 - early))
    assert runs_of(refined(states, powers)) == [(SILENCE, 60), (COUGH, 40), (SILENCE, 60)]


@pytest.mark.parametrize("late", [REACH, REACH + 1, REACH + 2, 30])
def test_it_moves_no_further_than_its_reach(late):
    powers = of_runs((QUIET, 60), (LOUD, 60))
    states = of_runs((SILENCE, 60 + late), (COUGH, 60 - late))
    expected = 60 if late < REACH else 60 + late
    assert runs_of(refined(states, powers))[0] == (SILENCE, expected)
    assert refined(states, powers, reach=0).tolist() == states.tolist()


@pytest.mark.parametrize("power", [0.0, 1e-12, 1e-6, 0.1, 1 / 3])
def test_where_the_level_does_not_change_it_stays(power):
    states = of_runs((SILENCE, 61), (COUGH, 33), (SILENCE, 57))
    assert refined(states, np.full(len(states), power)).tolist() == states.tolist()


def test_it_does_not_move_where_the_level_changes_the_other_way():
    powers = of_runs((LOUD, 55), (QUIET, 45))
    states = of_runs((SILENCE, 60), (COUGH, 40))
    assert refined(states, powers).tolist() == states.tolist()


def test_a_border_between_two_sounds_stays():
    powers = of_runs((QUIET, 60), (LOUD, 60))
    states = of_runs((COUGH, 66), (MUSIC, 54))
    assert refined(states, powers).tolist() == states.tolist()


def test_the_frame_divides_the_level_best_by_least_squares():
    rng = np.random.default_rng(0)
    for _ in range(50):
        level = rng.normal(-50, 10, 40)
        states = of_runs((SILENCE, 20), (COUGH, 20))
        moved = runs_of(refined(states, 10 ** (level / 10), shortest=1))[0][1]
        inside = level[20 - REACH : 20 + REACH]
        rising = {
            place: ((inside[:place] - inside[:place].mean()) ** 2).sum()
            + ((inside[place:] - inside[place:].mean()) ** 2).sum()
            for place in range(1, len(inside))
            if inside[place:].mean() > inside[:place].mean()
        }
        assert moved == (20 - REACH + min(rising, key=rising.get) if rising else 20)


@pytest.mark.parametrize("count", range(1, 8))
def test_a_state_that_is_too_short_gives_way_to_the_one_before(count):
    states = of_runs((MUSIC, 50), (COUGH, count), (SILENCE, 50))
    powers = np.full(len(states), LOUD)
    expected = (
        [(MUSIC, 50 + count), (SILENCE, 50)]
        if count < SHORTEST
        else [(MUSIC, 50), (COUGH, count), (SILENCE, 50)]
    )
    assert runs_of(refined(states, powers, reach=0)) == expected


def test_it_is_too_short_by_its_moved_borders():
    states = of_runs((SILENCE, 60), (COUGH, 20), (SILENCE, 60))
    for length, expected in ((4, 1), (5, 3)):
        powers = of_runs((QUIET, 70), (LOUD, length), (QUIET, 70 - length))
        assert len(runs_of(refined(states, powers))) == expected


def test_the_first_state_stays_however_short_it_is():
    states = of_runs((COUGH, 2), (SILENCE, 50))
    assert runs_of(refined(states, np.ones(52), reach=0)) == [(COUGH, 2), (SILENCE, 50)]


def test_states_that_are_each_too_short_are_all_as_the_one_before():
    states = of_runs((SILENCE, 20), (COUGH, 4), (MUSIC, 4), (COUGH, 4), (MUSIC, 20))
    found = refined(states, np.ones(len(states)), reach=0)
    assert runs_of(found) == [(SILENCE, 32), (MUSIC, 20)]


def test_a_state_is_refined_after_the_delay_and_what_comes_later_does_not_change_it():
    rng = np.random.default_rng(1)
    states = np.repeat(rng.integers(0, 3, 60), rng.integers(1, 30, 60))
    powers = 10 ** rng.uniform(-6, -1, len(states))
    delay = Borders(SILENCE, REACH, SHORTEST).delay
    assert delay == 2 * REACH + SHORTEST - 1
    full = refined(states, powers)
    for end in (1, 10, delay, delay + 1, 100, 333):
        seen = Borders(SILENCE, REACH, SHORTEST).push(states[:end], powers[:end])
        assert seen.tolist() == full[: max(end - delay, 0)].tolist()


def test_levels_may_be_known_before_states():
    rng = np.random.default_rng(2)
    states = np.repeat(rng.integers(0, 3, 40), 20)
    powers = 10 ** rng.uniform(-6, -1, len(states))
    borders, parts = Borders(SILENCE, REACH, SHORTEST), []
    parts.append(borders.push(states[:0], powers[:200]))
    parts += [
        borders.push(states[place : place + 50], powers[200 + place : 250 + place])
        for place in range(0, 600, 50)
    ]
    parts += [borders.push(states[600:], powers[:0]), borders.close()]
    assert np.concatenate(parts).tolist() == refined(states, powers).tolist()


def test_after_the_end_it_begins_anew():
    states = of_runs((MUSIC, 50), (COUGH, 2))
    borders = Borders(SILENCE, 0, SHORTEST)
    for _ in range(2):
        parts = [borders.push(states[::-1], np.ones(52)), borders.close()]
        assert runs_of(np.concatenate(parts)) == [(COUGH, 2), (MUSIC, 50)]


@given(
    runs=st.lists(
        st.tuples(st.integers(0, 2), st.integers(1, 40), st.floats(-90, 0)), min_size=1, max_size=30
    ),
    reach=st.integers(0, 15),
    shortest=st.integers(1, 9),
    sizes=st.lists(st.integers(1, 60), min_size=1, max_size=5),
    seed=st.integers(0, 5),
)
@settings(max_examples=300, deadline=None)
def test_blocks_of_any_size_give_the_same_and_no_border_moves_too_far(
    runs, reach, shortest, sizes, seed
):
    states = of_runs(*((state, count) for state, count, _ in runs))
    levels = of_runs(*((level, count) for _, count, level in runs))
    levels = np.roll(levels, seed) + np.random.default_rng(seed).normal(0, 2, len(levels))
    powers = 10 ** (levels / 10)
    full = refined(states, powers, reach=reach, shortest=shortest)
    assert len(full) == len(states)
    borders, parts, place, turn = Borders(SILENCE, reach, shortest), [], 0, 0
    while place < len(states):
        size = sizes[turn % len(sizes)]
        parts.append(borders.push(states[place : place + size], powers[place : place + size]))
        place, turn = place + size, turn + 1
        due = max(min(place, len(states)) - borders.delay, 0)
        assert sum(map(len, parts)) == due
    assert np.concatenate([*parts, borders.close()]).tolist() == full.tolist()
    moved = refined(states, powers, reach=reach, shortest=1)
    before, after = runs_of(states), runs_of(moved)
    assert [state for state, _ in after] == [state for state, _ in before]
    was, now = (np.cumsum([count for _, count in rows])[:-1] for rows in (before, after))
    assert (np.abs(now - was) <= reach).all()
    of_silence = np.array([SILENCE in pair for pair in zip(*neighbours(before), strict=True)], bool)
    assert (now == was)[~of_silence].all()
    assert all(count >= shortest for _, count in runs_of(full)[1:])


def neighbours(rows):
    names = [state for state, _ in rows]
    return names[:-1], names[1:]


def segments_of(smoothing, probabilities, powers, classes=("silence", "coughing", "music")):
    segmenter = Segmenter(classes, smoothing, np.empty((0, 0)))
    stamps = np.arange(len(powers)) * FRAME_NANOSECONDS
    frames = SegmenterInput(probabilities, powers, stamps, stamps)
    segments = segmenter.push(frames) + segmenter.close(len(powers) * FRAME_NANOSECONDS)
    rows = [
        (classes[s.label], s.start // FRAME_NANOSECONDS, s.end // FRAME_NANOSECONDS)
        for s in segments
    ]
    return rows, segments


def test_segments_have_the_borders_and_the_confidence_of_their_own_class():
    smoothing = Smoothing(method="merge", reach_seconds=0.6, shortest_seconds=0.25)
    probabilities = np.tile(np.array([0.9, 0.1, 0.0], np.float32), (100, 1))
    probabilities[45:60] = [0.2, 0.8, 0.0]
    powers = of_runs((QUIET, 50), (LOUD, 7), (QUIET, 43))
    rows, segments = segments_of(smoothing, probabilities, powers)
    assert rows == [("silence", 0, 50), ("coughing", 50, 57), ("silence", 57, 100)]
    assert segments[1].confidence == pytest.approx(0.8)
    assert segments[0].confidence == pytest.approx((45 * 0.9 + 5 * 0.2) / 50)
    assert segments[0].decided_at == (50 + 24 + 4) * FRAME_NANOSECONDS


def test_a_model_without_silence_has_borders_as_they_are():
    smoothing = Smoothing(method="merge", reach_seconds=0.6)
    probabilities = np.tile(np.array([0.9, 0.1], np.float32), (100, 1))
    probabilities[45:] = [0.2, 0.8]
    powers = of_runs((QUIET, 50), (LOUD, 50))
    rows, _ = segments_of(smoothing, probabilities, powers, ("music", "speech"))
    assert rows == [("music", 0, 45), ("speech", 45, 100)]
