"""A model says from which time of the home it has learned, in few words."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hearthlog.analyzer.training.train import merged_spans
from hearthlog.models.classifiers.model import MOST_SPANS

pytestmark = pytest.mark.fast
SECOND = 10**9
TIMES = st.tuples(st.integers(0, 10**6), st.integers(1, 1000))


def array(spans):
    return np.array(spans, np.int64).reshape(-1, 2)


def test_spans_less_than_a_minute_apart_are_one():
    spans = [[210, 220], [0, 10], [69, 80], [5, 7], [140, 150]]
    assert merged_spans(array(spans) * SECOND) == [
        [0, 80 * SECOND],
        [140 * SECOND, 150 * SECOND],
        [210 * SECOND, 220 * SECOND],
    ]


@given(st.lists(TIMES, max_size=30))
def test_every_span_lies_in_one_of_the_merged_ones(spans):
    spans = array([(start, start + length) for start, length in spans]) * SECOND
    merged = array(merged_spans(spans))
    assert (np.diff(merged.ravel()) > 0).all()
    assert (merged[1:, 0] - merged[:-1, 1] >= 60 * SECOND).all()
    for start, end in spans:
        assert ((merged[:, 0] <= start) & (end <= merged[:, 1])).sum() == 1


def test_of_too_many_the_nearest_are_joined():
    starts = np.cumsum(np.arange(100, 100 + 2 * MOST_SPANS)) * SECOND
    spans = np.stack([starts, starts + SECOND], axis=1)
    merged = array(merged_spans(spans))
    assert len(merged) == MOST_SPANS
    np.testing.assert_array_equal(merged[1:], spans[-MOST_SPANS + 1 :])
    assert merged[0].tolist() == [starts[0], spans[-MOST_SPANS, 1]]
