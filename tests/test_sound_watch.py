"""What is wrong with a microphone that goes on listening is noticed, and nothing else is."""

import numpy as np
import pytest

from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.recorder.stream import sound_watch
from hearthlog.recorder.stream.sound_watch import (
    CLIPS,
    FAINT,
    HUMS,
    OFFSET,
    STUCK,
    SoundWatch,
)
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

pytestmark = pytest.mark.fast

MINUTE = 60 * SAMPLE_RATE
RNG = np.random.default_rng(4)


def listen(watch, samples, block=12):
    frames = samples.astype(np.float32).reshape(-1, FRAME_SAMPLES)
    for first in range(0, len(frames), block):
        watch.add_samples(frames[first : first + block])


def noise(seconds, level):
    return RNG.normal(0, level, seconds * SAMPLE_RATE)


def mains(seconds, frequency, level):
    time = np.arange(seconds * SAMPLE_RATE) / SAMPLE_RATE
    return sum(level / n * np.sin(2 * np.pi * n * frequency * time) for n in (1, 2, 3))


@pytest.mark.parametrize("value", [7 / 32768, -0.5])
def test_one_value_for_ten_seconds_is_noticed_until_the_sound_moves_again(value):
    watch = SoundWatch()
    listen(watch, noise(5, 0.01))
    listen(watch, np.full(9 * SAMPLE_RATE, value))
    assert watch.problem() == ""
    listen(watch, np.full(2 * SAMPLE_RATE, value))
    assert watch.problem() == STUCK
    listen(watch, noise(1, 0.01))
    assert watch.problem() == ""


@pytest.mark.parametrize(
    ("sound", "problem"),
    [
        (RNG.integers(-1, 2, 30 * SAMPLE_RATE), STUCK),
        (np.rint(RNG.normal(0, 0.7, 30 * SAMPLE_RATE)), OFFSET),
    ],
)
def test_a_microphone_with_an_offset_is_dead_only_if_it_gives_no_noise_but_its_own(sound, problem):
    watch, infrasound = SoundWatch(), InfrasoundFilter()
    frames = ((655 + sound) / 32768).astype(np.float32).reshape(-1, FRAME_SAMPLES)
    watch.add_samples(frames, infrasound(frames))
    assert watch.problem() == problem


@pytest.mark.parametrize(("clipped", "problem"), [(3, ""), (4, CLIPS)])
@pytest.mark.parametrize("rest", [0.0, 0.05])
def test_four_samples_of_a_frame_at_full_scale_are_clipped_however_faint_the_rest_is(
    clipped, problem, rest
):
    watch = SoundWatch()
    frames = noise(2, rest).reshape(-1, FRAME_SAMPLES)
    frames[::2, :clipped] = -1.0
    frames[1::2, -clipped:] = 1.0
    listen(watch, frames)
    assert watch.problem() == problem


@pytest.mark.filterwarnings("error")
def test_a_sample_of_any_size_is_clipped_without_a_warning_of_numpy():
    watch = SoundWatch()
    frames = noise(2, 0.05).reshape(-1, FRAME_SAMPLES)
    frames[:, ::100] = 3e38
    listen(watch, InfrasoundFilter()(frames.astype(np.float32)))
    assert watch.problem() == CLIPS


@pytest.mark.parametrize("frequency", [50, 60, 50.1])
def test_mains_for_half_an_hour_are_a_hum(frequency):
    watch = SoundWatch()
    minute = mains(60, frequency, 0.02) + noise(60, 0.002)
    for _ in range(29):
        listen(watch, minute)
    assert watch.problem() == ""
    for _ in range(3):
        listen(watch, minute)
    assert watch.problem() == HUMS.format(round(frequency))
    for _ in range(2):
        listen(watch, noise(60, 0.02))
    assert watch.problem() == ""


@pytest.mark.parametrize("sound", [mains(60, 50, 0.001), mains(60, 55, 0.02), noise(60, 0.02)])
def test_a_faint_hum_a_tone_and_noise_are_none(sound):
    watch = SoundWatch()
    for _ in range(32):
        listen(watch, sound)
    assert watch.problem() == ""


def test_a_day_that_is_30_decibels_fainter_is_noticed_and_a_silent_night_is_not(monkeypatch):
    monkeypatch.setattr(sound_watch, "_DAY_MINUTES", 4)
    watch = SoundWatch()
    for _ in range(3):
        listen(watch, np.concatenate([noise(60, 0.1), noise(180, 0.0002)]))
        assert watch.problem() == ""
    for _ in range(2):
        listen(watch, np.concatenate([noise(60, 0.002), noise(180, 0.0002)]))
        assert watch.problem() == FAINT
    listen(watch, np.concatenate([noise(60, 0.1), noise(180, 0.0002)]))
    assert watch.problem() == ""


@pytest.mark.parametrize("level", [1e19, 1e30, 3e38])
def test_samples_far_beyond_full_scale_clip_and_make_no_later_day_faint(level, recwarn):
    watch = SoundWatch()
    listen(watch, np.full(MINUTE, level) * np.resize([1, -1], MINUTE))
    assert watch.problem() == CLIPS
    assert not recwarn.list
    assert watch._level._minutes == [1.0]
