"""Probabilities are as right as they say, where nothing was learned from what they are about."""

from dataclasses import replace

import numpy as np
import pytest
from blobs import blobs

from hearthlog.analyzer.training.calibration import (
    LOST_TO_UNKNOWN,
    calibrate_elsewhere,
    collection_folds,
    home_temperature,
    inverse_temperature,
    nested_probabilities,
    scores_elsewhere,
    softmax,
    unknown_bias,
)
from hearthlog.analyzer.training.scores import calibration_error

pytestmark = pytest.mark.fast


def decided(count, sharpness, seed=0, classes=4):
    """Decision values that are right as often as their softmax, times a sharpness, says."""
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 2.0, (count, classes))
    target = np.array([rng.choice(classes, p=row) for row in softmax(values)])
    return values / sharpness, target


@pytest.mark.parametrize("sharpness", [0.2, 1.0, 5.0])
def test_the_temperature_is_the_one_with_which_probabilities_hold(sharpness):
    decisions, target = decided(4000, sharpness)
    inverse = inverse_temperature(decisions, target)
    assert inverse == pytest.approx(sharpness, rel=0.1)
    assert calibration_error(softmax(inverse * decisions), target) < 0.03


def test_a_calibration_error_is_not_fitted_on_what_it_scores():
    sure, true = decided(1000, 4.0)
    unsure, other = decided(1000, 0.25, seed=1)
    decisions, target = np.concatenate([sure, unsure]), np.concatenate([true, other])
    first, second = np.arange(1000), np.arange(1000, 2000)
    folds = [(second, first), (first, second)]
    probabilities = nested_probabilities(decisions, target, folds)
    np.testing.assert_allclose(
        probabilities[first], softmax(inverse_temperature(unsure, other) * sure)
    )
    fitted = softmax(inverse_temperature(decisions, target) * decisions)
    assert calibration_error(probabilities, target) > calibration_error(fitted, target) + 0.1


def test_few_segments_of_a_home_move_the_temperature_a_little_and_many_decide_it():
    moved = []
    for count in (10, 100, 3000):
        decisions, target = decided(count, 4.0)
        moved.append(home_temperature(decisions, target, 0.5))
    assert 0.5 < moved[0] < moved[1] < moved[2]
    assert moved[2] == pytest.approx(4.0, rel=0.15)


def test_unknown_takes_as_many_of_the_known_as_it_may():
    rng = np.random.default_rng(0)
    decisions, target = rng.normal(0.0, 1.0, (4000, 4)), rng.integers(0, 4, 4000)
    classes = ("silence", "speech", "unknown", "music")
    bias = unknown_bias(decisions, target, classes)
    assert bias[[0, 1, 3]].tolist() == [0.0, 0.0, 0.0]
    known = target != 2
    lost = ((decisions + bias).argmax(axis=1) == 2)[known].mean()
    assert lost == pytest.approx(LOST_TO_UNKNOWN, abs=0.005)


def test_without_unknown_nothing_is_biased():
    assert unknown_bias(np.eye(3), np.arange(3), ("a", "b", "c")).tolist() == [0.0] * 3


def of_collections(count, sizes):
    data, _ = blobs(3, count)
    collection = np.repeat(np.arange(len(sizes)), sizes)
    return replace(data, collection=np.random.default_rng(0).permutation(collection))


def test_collections_are_left_out_one_by_one_and_small_ones_together():
    data = of_collections(60, [70, 60, 30, 10, 10])
    folds = collection_folds(data)
    left_out = [set(data.collection[unseen].tolist()) for _, unseen in folds]
    assert left_out == [{0}, {1}, {2}, {3, 4}]
    for seen, unseen in folds:
        assert not set(data.collection[seen]) & set(data.collection[unseen])
        assert len(seen) + len(unseen) == len(data)


def test_two_collections_tell_nothing_of_a_third():
    assert collection_folds(of_collections(30, [45, 45])) == []


def test_collections_tell_nothing_if_they_share_fewer_than_half_of_the_classes():
    data = of_collections(60, [60, 60, 60])
    data = replace(data, collection=np.where(data.target == 0, data.collection, data.target - 1))
    assert collection_folds(data) == []


def test_a_class_that_other_collections_hardly_have_is_left_out():
    data = of_collections(60, [60, 60, 60])
    rare = data.target == 2
    data = replace(data, collection=np.where(rare, 0, data.collection))
    decisions, target = decided(len(data), 2.0, classes=3)
    data = replace(data, target=np.where(rare, 2, np.minimum(target, 1)))
    _, elsewhere = calibrate_elsewhere(decisions, data, collection_folds(data))
    assert elsewhere.segments == (~rare).sum()
    assert elsewhere.collections == 3


def test_sounds_of_no_class_do_not_tell_how_sure_the_classes_are():
    data = of_collections(60, [60, 60, 60])
    data = replace(data, classes=("speech", "music", "unknown"))
    decisions, target = decided(len(data), 2.0, classes=3)
    data = replace(data, target=target)
    unknown = target == 2
    wrong = np.where(unknown[:, np.newaxis], [[9.0, 0.0, 0.0]], decisions)
    inverse, right = calibrate_elsewhere(decisions, data, collection_folds(data))
    other_inverse, other = calibrate_elsewhere(wrong, data, collection_folds(data))
    assert (inverse, right.right) == (other_inverse, other.right)
    assert right.expected_calibration_error == other.expected_calibration_error
    assert right.segments == (~unknown).sum()
    assert right.calibration_errors.keys() == {"speech", "music"}
    assert other.macro_f1 < right.macro_f1 - 0.2


def test_each_class_has_a_calibration_error_of_its_own():
    data = of_collections(60, [60, 60, 60])
    target, taught = data.target, np.ones(len(data), bool)
    right = np.eye(3)[target]
    wrong = np.where((target == 1)[:, np.newaxis], np.roll(right, 1, axis=1), right)
    probabilities = 0.7 * wrong + 0.1  # sure by 0.8
    elsewhere = scores_elsewhere(probabilities, data, taught)
    errors = list(elsewhere.calibration_errors.values())
    half = (target == 2).sum() / np.isin(target, (1, 2)).sum()
    assert errors == pytest.approx([0.2, 0.8 - half])  # nothing is labelled as the second class
