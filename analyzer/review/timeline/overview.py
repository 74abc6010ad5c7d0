"""Labellings at the resolution of a screen, and where two of them differ."""

import numpy as np

from hearthlog.analyzer.logs.spans import overlay
from hearthlog.analyzer.review.timeline.grid import Grid, time_shares
from hearthlog.analyzer.review.timeline.model import LabelledSpans, LabellingTimeline, no_spans
from hearthlog.models.classes import SILENCE, class_name, translation
from hearthlog.schemas.arrays import Float64

BLOCKS = 420  # of a lane: the viewer draws what is narrower than four pixels in grey
_QUIET_WEIGHT = 0.25  # so that a few minutes of a night in which someone coughs are seen


def overview(labelling: LabellingTimeline, grid: Grid) -> LabelledSpans:
    """Reduce a labelling to blocks of equal length, each with the label that covers most of it.

    Silence counts a quarter. Without segments it is the label with the highest mean probability.

    Parameters
    ----------
    labelling : LabellingTimeline
    grid : Grid
        Its start and end count; there are `BLOCKS` blocks between.

    Returns
    -------
    LabelledSpans
        Successive blocks with the same label are joined; blocks without a label are left out.
    """
    coarse = Grid(grid.start, grid.end, BLOCKS)
    names, shares = _shares(labelling, coarse)
    if not names:
        return no_spans()
    weights = np.array([_QUIET_WEIGHT if class_name(name) == SILENCE else 1.0 for name in names])
    best = (shares * weights).argmax(axis=1)
    best = np.where(shares.sum(axis=1) > 0.0, best, -1)
    first = np.flatnonzero(np.diff(best, prepend=-2))
    edges = coarse.edges
    ends = edges[np.append(first[1:], coarse.count)]
    labelled = best[first] >= 0
    texts = np.array([*names, None], object)[best[first]]
    return LabelledSpans(edges[first][labelled], ends[labelled], texts[labelled])


def _shares(labelling: LabellingTimeline, grid: Grid) -> tuple[list[str], Float64]:
    """Return the labels, and their shares of each block: of its time, or of its probability."""
    spans = labelling.spans
    if len(spans):
        names, labels = np.unique(spans.texts.astype(str), return_inverse=True)
        return names.tolist(), time_shares(spans.starts, spans.ends, labels, len(names), grid)
    if labelling.probabilities is None:
        return [], np.empty((grid.count, 0))
    values = np.nan_to_num(labelling.probabilities.values)
    parts = np.linspace(0, len(values), grid.count + 1).astype(np.int64)[:-1]
    return list(labelling.probabilities.names), np.add.reduceat(values, parts, axis=0)


def disagreements(one: LabelledSpans, other: LabelledSpans) -> LabelledSpans:
    """Find the spans in which two labellings differ.

    Two names of one class (see `hearthlog.models.classes`) are no difference.

    Parameters
    ----------
    one, other : LabelledSpans
        In the order of time, one label at a time.

    Returns
    -------
    LabelledSpans
        With the text `<label> / <other label>`; none where only one of the two has a label.
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
    texts = [
        f"{x} / {y}" for x, y in zip(one.texts[a[places]], other.texts[b[places]], strict=True)
    ]
    return LabelledSpans(
        parts.starts[places], np.minimum(stops, parts.ends[-1]), np.array(texts, object)
    )
