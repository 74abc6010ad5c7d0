"""Where two labellings of the same sound differ."""

import numpy as np

from hearthlog.analyzer.logs.spans import overlay
from hearthlog.analyzer.review.timeline.model import LabelledSpans, no_spans
from hearthlog.models.classes import translation


def disagreements(one: LabelledSpans, other: LabelledSpans) -> LabelledSpans:
    """Find the spans in which two labellings differ.

    Two names of one class (see `hearthlog.models.classes`) are no difference.

    Returns
    -------
    LabelledSpans
        With the labels of the other one; none where only one of the two has a label.
    """
    if not len(one) or not len(other):
        return no_spans()
    parts = overlay([one, other])
    a, b = parts.rows
    differ = (a >= 0) & (b >= 0)
    names = translation(set(other.texts), set(one.texts))
    translated = np.array([names[text] for text in other.texts], object)
    differ[differ] = one.texts[a[differ]] != translated[b[differ]]
    first = differ & (np.diff(np.where(differ, a, -1), prepend=-2) != 0)
    first |= differ & (np.diff(np.where(differ, b, -1), prepend=-2) != 0)
    places = np.flatnonzero(first)
    # A difference ends where either of the two labels ends.
    stops = np.minimum(one.ends[a[places]], other.ends[b[places]])
    ends = np.minimum(stops, parts.ends[-1])
    return LabelledSpans(parts.starts[places], ends, other.texts[b[places]])
