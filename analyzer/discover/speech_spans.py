"""When somebody speaks, by the labels of a log."""

import numpy as np

from hearthlog.analyzer.logs.selection import array_names
from hearthlog.analyzer.logs.spans import Spans, joined
from hearthlog.models.classes import SILENCE, SPEECH, class_name
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.logs.columns import Columns

# Mean probability of speech in a segment of another label. Chosen by scenes of household sounds and
# a model that had not heard them: at 0.3 no other sound becomes speech, at 0.15 twice as many do.
_LIKELY = 0.3


def is_doubtful(segments: Columns) -> Bool:
    """Tell which segments are of a sound that is not labelled speech, and may be."""
    return ~_is_of(segments, SPEECH) & ~_is_of(segments, SILENCE)


def speech_spans(segments: Columns, labels: Columns | None = None) -> Spans:
    """Return when somebody speaks.

    Parameters
    ----------
    labels : Columns, optional
        Of the frames. A sound to which they give a probability of speech of 0.3, in the mean, is
        speech as well, whatever it is called: somebody who reads may pass for one who coughs.
    """
    starts = segments["header.stamp"]
    ends = starts + segments["duration"]
    rows = _is_of(segments, SPEECH)
    if labels is not None and len(labels):
        rows |= is_doubtful(segments) & (_speech_likelihood(labels, starts, ends) >= _LIKELY)
    return joined(starts[rows], ends[rows])


def _is_of(segments: Columns, kind: str) -> Bool:
    labels = segments["label"]
    names = {label for label in set(labels.tolist()) if class_name(label) == kind}
    found: Bool = np.isin(labels.astype(str), sorted(names))
    return found


def _speech_likelihood(labels: Columns, starts: Int64, ends: Int64) -> Float64:
    """Return the mean probability of speech in spans; 0 where labels have none."""
    names = array_names(labels.metadata, "probabilities")
    own = [place for place, name in enumerate(names) if class_name(name) == SPEECH]
    probabilities = labels["probabilities"]
    if not own or probabilities.shape[1:] != (len(names),):
        return np.zeros(len(starts))
    order = np.argsort(labels["header.stamp"], kind="stable")  # a clock may have been set back
    stamps = labels["header.stamp"][order]
    values = np.nan_to_num(probabilities[order][:, own].sum(axis=1, dtype=np.float64))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    first, last = np.searchsorted(stamps, starts), np.searchsorted(stamps, ends)
    means: Float64 = (sums[last] - sums[first]) / np.maximum(last - first, 1)
    return means
