"""Hours of sound that benchmarks are measured on: dense, quiet, and of a night."""

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.lab.bench.hours import DENSE, KINDS, NIGHT, QUIET, lay_out

LOUD = 8000
HOUR = 3600 * SAMPLE_RATE


def recording(seconds, level=LOUD):
    return np.full(round(seconds * SAMPLE_RATE), level, np.int16)


@pytest.mark.parametrize(("kind", "share"), [(DENSE, 1.0), (QUIET, 0.5), (NIGHT, 0.01)])
def test_kinds_differ_in_the_share_of_the_time_in_which_something_sounds(kind, share):
    sound = lay_out([recording(3), recording(700), recording(11)], kind, HOUR)
    assert sound.shape == (HOUR,)
    loud = sound > LOUD / 2
    assert loud.mean() == pytest.approx(share, abs=1e-6)
    assert (np.abs(sound[~loud]) < 200).all()
    assert sound[~loud].any() == (kind != DENSE)


def test_dense_sound_is_all_recordings_in_their_order_and_then_again():
    recordings = [recording(2, 1000), recording(1, 2000)]
    sound = lay_out(recordings, DENSE, 5 * SAMPLE_RATE)
    assert sound[::SAMPLE_RATE].tolist() == [1000, 1000, 2000, 1000, 1000]


@pytest.mark.parametrize(("kind", "sounds"), [(QUIET, 90), (NIGHT, 2)])
def test_a_long_recording_is_many_sounds_with_pauses_between_them(kind, sounds):
    loud = lay_out([recording(3600)], kind, HOUR) > LOUD / 2
    assert np.count_nonzero(loud[1:] & ~loud[:-1]) == sounds


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_recordings_give_the_same_sound(kind):
    recordings = [recording(n, 100 * n) for n in range(1, 9)]
    first, second = (lay_out(recordings, kind, 60 * SAMPLE_RATE) for _ in range(2))
    assert np.array_equal(first, second)


def test_loud_sounds_do_not_wrap_around():
    highest = recording(10, 32767)
    assert lay_out([highest], QUIET, 20 * SAMPLE_RATE).min() > -200
