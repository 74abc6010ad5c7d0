"""Which segments a model has learned from: it keeps a digest of each."""

import hashlib

import numpy as np

from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Bool, Float32, Indices, Int64

_DIGEST_BYTES = 8


def segment_digests(windows: Float32) -> Int64:
    """Return the digests of segments, without those of digital silence, which are all alike.

    Parameters
    ----------
    windows : np.ndarray [shape=(n, window_frames, d)], float32
        Features of the segments.

    Returns
    -------
    np.ndarray [shape=(m,)], int64
        Sorted, each once.
    """
    return np.unique(_digests(windows)[_told_apart(windows)])


def learned_digests(model: Model) -> Int64:
    """Return the digests of what a model has learned from; older models have kept the segments.

    Returns
    -------
    np.ndarray [shape=(m,)], int64
    """
    if len(model.training_digests):
        return model.training_digests
    return segment_digests(model.training_windows)


def learned_groups(model: Model, data: Dataset) -> Indices:
    """Return the source groups of which a model has learned from a segment.

    Returns
    -------
    np.ndarray [shape=(g,)], intp
        Numbers of the groups.
    """
    learned = np.isin(_digests(data.windows), learned_digests(model))
    return np.unique(data.group[learned & _told_apart(data.windows)])


def _digests(windows: Float32) -> Int64:
    with np.errstate(over="ignore"):
        rows = windows.astype("<f2")  # the last bits of features differ between machines
    whole = b"".join(
        hashlib.blake2b(row.tobytes(), digest_size=_DIGEST_BYTES).digest() for row in rows
    )
    return np.frombuffer(whole, "<i8").astype(np.int64)


def _told_apart(windows: Float32) -> Bool:
    """Tell in which segments the features change."""
    changing: Bool = (windows != windows[:, :1]).any(axis=(1, 2))
    return changing
