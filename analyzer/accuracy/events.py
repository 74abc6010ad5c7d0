"""What counts as one event, and minutes in which something like a television is on."""

import numpy as np

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import Spans, joined, lengths
from hearthlog.models.classes import COUGHING, CRYING, LAUGHING, SILENCE, YELLING
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.frames import NANOSECONDS

MINUTE = 60 * NANOSECONDS
SET_APART = (COUGHING, CRYING, LAUGHING, YELLING)  # which a television has, too
AROUND = 10  # minutes before and after one, in which a television would be heard
_PAUSE = 10 * NANOSECONDS
_ALONE = (SILENCE, COUGHING, CRYING, YELLING)  # a person who cries for long is no television
_SHARE = 0.1  # of the time
_CHANGES = 2  # in a minute


def events_of(labels: Labelling, name: str) -> Spans:
    """Return the events of a class: its spans, joined across pauses of at most ten seconds."""
    own = labels.labels == name
    return joined(labels.starts[own], labels.ends[own], _PAUSE)


def sounding_minutes(labels: Labelling, edges: Int64) -> Bool:
    """Tell in which minutes there is anything but silence.

    Parameters
    ----------
    edges : np.ndarray [shape=(n + 1,)], int64
        Of the minutes.

    Returns
    -------
    np.ndarray [shape=(n,)], bool
    """
    loud = labels.labels != SILENCE
    return lengths(joined(labels.starts[loud], labels.ends[loud]), edges) > 0


def television_minutes(labels: Labelling, edges: Int64) -> Bool:
    """Tell in which minutes something sounds like a television, a radio or company.

    That is where, in the ten minutes before and after, two sounds a minute begin, and where those
    that are neither coughing nor crying nor shouting fill a tenth of the time. Which ones they are
    does not matter, for a model may take a television for anything.

    Parameters
    ----------
    edges : np.ndarray [shape=(n + 1,)], int64
        Of successive minutes.

    Returns
    -------
    np.ndarray [shape=(n,)], bool
    """
    others = ~np.isin(labels.labels, _ALONE)
    filled = lengths(joined(labels.starts[others], labels.ends[others]), edges)
    begun = np.diff(np.searchsorted(labels.starts[labels.labels != SILENCE], edges))
    minutes = 2 * AROUND + 1
    much = _around(filled) > _SHARE * minutes * MINUTE
    television: Bool = much & (_around(begun) > _CHANGES * minutes)
    return television


def _around(amounts: Int64) -> Int64:
    """Sum up the amounts of each minute and of those around it."""
    return np.convolve(amounts, np.ones(2 * AROUND + 1, np.int64))[AROUND : AROUND + len(amounts)]


def events_by_minute(events: Spans, edges: Int64) -> Int64:
    """Count the events that begin in each minute.

    Parameters
    ----------
    edges : np.ndarray [shape=(n + 1,)], int64
        Of the minutes.

    Returns
    -------
    np.ndarray [shape=(n,)], int64
    """
    places = np.searchsorted(events.starts, edges)
    return np.diff(places)


def overlapping(events: Spans, others: Spans) -> Bool:
    """Tell which events have a part in common with one of others.

    Returns
    -------
    np.ndarray [shape=(n,)], bool
    """
    after = np.searchsorted(others.ends, events.starts, side="right")
    begins = np.append(others.starts, np.iinfo(np.int64).max)[after]
    overlaps: Bool = begins < events.ends
    return overlaps
