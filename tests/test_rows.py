"""Rows encoded together are, byte for byte, what the typestore makes of each message."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import encode_rows
from hearthlog.schemas.messages.message_types import encode, header, message

pytestmark = pytest.mark.fast

NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)


def common(stamps, name, frames):
    return {
        "header.stamp": stamps,
        "header.frame_id": name,
        "frame": frames,
    }


@settings(deadline=None)
@given(NAMES, st.integers(0, 40), st.integers(0, 25), st.integers(0, 2**32))
def test_features(name, count, width, seed):
    rng = np.random.default_rng(seed)
    stamps, frames = rng.integers(0, 2**60, count), rng.integers(0, 2**63, count)
    values = rng.standard_normal((count, width)).astype(np.float32)
    rows = encode_rows(
        message_types.FEATURES, common(stamps, name, frames) | {"values": values}, count
    )
    assert rows == [
        encode(
            message(
                message_types.FEATURES,
                header=header(int(stamps[i]), name),
                frame=int(frames[i]),
                values=values[i],
            )
        )
        for i in range(count)
    ]


@settings(deadline=None)
@given(NAMES, st.lists(NAMES, max_size=30), st.integers(0, 2**32))
def test_labels_whose_strings_have_different_lengths(name, labels, seed):
    rng = np.random.default_rng(seed)
    count = len(labels)
    stamps, frames = rng.integers(0, 2**60, count), np.arange(count)
    probabilities = rng.random((count, 9)).astype(np.float32)
    columns = common(stamps, name, frames) | {
        "label": labels,
        "confidence": probabilities[:, 0],
        "novelty": np.full(count, np.nan, np.float32),
        "probabilities": probabilities,
    }
    assert encode_rows(message_types.LABEL, columns, count) == [
        encode(
            message(
                message_types.LABEL,
                header=header(int(stamps[i]), name),
                frame=i,
                label=labels[i],
                confidence=probabilities[i, 0],
                novelty=np.nan,
                probabilities=probabilities[i],
            )
        )
        for i in range(count)
    ]


@pytest.mark.parametrize("length", [0, 1, 2, 3, 4, 5])
def test_alignment_after_strings_of_every_length(length):
    columns = common(np.array([5]), "x" * length, np.array([7])) | {
        "mean": np.ones((1, 3), np.float32),
        "std": np.zeros((1, 2), np.float32),
    }
    decoded = message_types.decode(
        encode_rows(message_types.STATISTICS, columns, 1)[0], message_types.STATISTICS
    )
    assert (decoded.frame, decoded.header.frame_id) == (7, "x" * length)
    assert decoded.mean.tolist() == [1, 1, 1]
