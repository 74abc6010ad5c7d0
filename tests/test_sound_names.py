"""Sounds that the network names: what is read, when they begin and end, and the table."""

import math

import numpy as np
import pytest

from hearthlog.models.classes import CLASS_NAME, find_class
from hearthlog.models.embedding import Embeddings, Projection, read_projection
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.sound_names import (
    SoundName,
    audioset_names,
    named_sounds,
    read_names,
    write_names,
)

YAMNET_PROJECTION = read_projection(YAMNET.projection)
PROJECTION = Projection(
    mean=np.zeros(1, np.float32),
    components=np.zeros((1, 1), np.float32),
    steps=np.array([0.25, 0.5, 0.5], np.float32),
    lows=np.array([-31.75, -5.0, -5.0], np.float32),
    groups={"bell": [0], "cough": [1]},
)
BELL = SoundName("doorbell", "Doorbell", "bell", 2.0, 1, threshold=2.0)
RAIN = SoundName("rain", "Rain", "bell", 60.0, 3, threshold=2.0)
COUGH = SoundName("coughing", "Coughing", "cough", 1.0, 1, threshold=-4.5)


def windows(logits, frames=None):
    frames = 10 * np.arange(len(logits)) if frames is None else np.array(frames)
    values = np.zeros((len(logits), 3), np.int8)
    values[:, 1], values[:, 2] = np.array(logits) * 2, -10
    return Embeddings(frames.astype(np.int64), frames.astype(np.int64), values)


def spans(sounds):
    return [(sound.first, sound.end, sound.logit) for sound in sounds]


def test_a_name_without_a_group_in_the_projection_is_refused():
    with pytest.raises(ValueError, match="siren"):
        named_sounds(windows([3]), PROJECTION, [BELL._replace(group="siren")])


def test_a_sound_is_as_long_as_the_middles_of_its_windows():
    assert spans(named_sounds(windows([-5, -5, 3, -5]), PROJECTION, [BELL])) == [(25, 35, 3.0)]


def test_a_sound_goes_on_a_little_below_the_threshold_but_does_not_begin_there():
    sounds = named_sounds(windows([1, 1, 2, 1, 0.5, 0, 0]), PROJECTION, [BELL])
    assert spans(sounds) == [(25, 45, 2.0)]


def test_sounds_a_second_apart_are_one_and_those_further_apart_are_not():
    one = named_sounds(windows([2, -5, 3]), PROJECTION, [BELL])
    two = named_sounds(windows([2, -5, -5, 3]), PROJECTION, [BELL])
    assert spans(one) == [(5, 35, 3.0)]
    assert spans(two) == [(5, 15, 2.0), (35, 45, 3.0)]


def test_windows_that_were_not_computed_are_windows_in_which_there_was_nothing():
    sounds = named_sounds(windows([2, 3], [0, 40]), PROJECTION, [BELL])
    assert spans(sounds) == [(5, 15, 2.0), (45, 55, 3.0)]


def test_a_sound_that_is_too_short_is_not_told():
    assert named_sounds(windows([3, 1, 3]), PROJECTION, [RAIN]) == []
    assert spans(named_sounds(windows([3, 1, 3, 3]), PROJECTION, [RAIN])) == [(5, 45, 3.0)]


def test_what_is_at_the_low_end_never_goes_on():
    values = windows([0, 0, 0, 0])
    values.values[0, 2] = -9
    assert spans(named_sounds(values, PROJECTION, [COUGH])) == [(5, 15, -4.5)]


def test_the_table_names_groups_of_the_projection():
    names = audioset_names()
    assert {name.group for name in names} <= set(YAMNET_PROJECTION.names)
    assert len({name.name for name in names}) == len(names)
    assert all(CLASS_NAME.fullmatch(name.name) for name in names)
    assert all(name.words and name.seconds > 0 and name.windows >= 1 for name in names)


def test_a_class_that_hearthlog_knows_is_called_as_it_calls_it():
    for name in audioset_names():
        row = find_class(name.name)
        if row is not None:
            assert (row.name, row.words) == (name.name, name.words)


def test_an_event_was_measured():
    for name in audioset_names():
        if name.is_event:
            assert name.precision >= 0.8
            assert name.false_an_hour <= 1
            assert name.clips >= 4
        assert name.threshold > -4


def test_a_table_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "names.csv"
    names = [BELL._replace(is_event=True, precision=0.9, clips=3), COUGH]
    write_names(names, path)
    again = read_names(path)
    assert again[0][:-2] == names[0][:-2]
    assert again[1][:9] == COUGH[:9]
    assert math.isnan(again[0].recall)
