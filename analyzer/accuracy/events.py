"""What counts as one event, and minutes in which something like a television is on."""

import numpy as np

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import Spans, joined, lengths
from hearthlog.models.classes import COUGHING, CRYING, LAUGHING, MUSIC, SILENCE, SPEECH, YELLING
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.times import NANOSECONDS

MINUTE = 60 * NANOSECONDS
SET_APART = (COUGHING, CRYING, LAUGHING, YELLING)  # which a television has, too
AROUND = 10  # minutes before and after one, in which a television would be heard
_PAUSE = 10 * NANOSECONDS
_OF_TELEVISION = (SPEECH, MUSIC, LAUGHING)
_SHARE = 0.2  # of the time


def events_of(labels: Labelling, name: str) -> Spans:
    """Return the events of a class: its spans, joined where at most ten seconds are between them.

    Parameters
    ----------
    labels : Labelling
        In nanoseconds of UTC.
    name : str
        Of the class.
    """
    own = labels.labels == name
    return joined(labels.starts[own], labels.ends[own], _PAUSE)


def sounding_minutes(labels: Labelling, edges: Int64) -> Bool:
    """Tell in which minutes there is anything but silence.

    Parameters
    ----------
    labels : Labelling
        In nanoseconds of UTC.
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

    That is where talking, music and laughing fill a fifth of the ten minutes before and after.

    Parameters
    ----------
    labels : Labelling
        In nanoseconds of UTC.
    edges : np.ndarray [shape=(n + 1,)], int64
        Of successive minutes.

    Returns
    -------
    np.ndarray [shape=(n,)], bool
    """
    own = np.isin(labels.labels, _OF_TELEVISION)
    filled = lengths(joined(labels.starts[own], labels.ends[own]), edges)
    around = np.convolve(filled, np.ones(2 * AROUND + 1), "full")[AROUND : AROUND + len(filled)]
    return around > _SHARE * (2 * AROUND + 1) * MINUTE


def events_by_minute(events: Spans, edges: Int64) -> Int64:
    """Count the events that begin in each minute.

    Parameters
    ----------
    events : Spans
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

    Parameters
    ----------
    events, others : Spans

    Returns
    -------
    np.ndarray [shape=(n,)], bool
    """
    after = np.searchsorted(others.ends, events.starts, side="right")
    begins = np.append(others.starts, np.iinfo(np.int64).max)[after]
    overlaps: Bool = begins < events.ends
    return overlaps
