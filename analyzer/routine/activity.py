"""The longest quiet span of a day, and how often it sounds in a night."""

from datetime import date, tzinfo

import numpy as np

from hearthlog.analyzer.accuracy.events import MINUTE
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour
from hearthlog.analyzer.logs.spans import NONE, Spans, common, joined, lengths, one, without
from hearthlog.schemas.frames import NANOSECONDS

_PAUSE, _STRETCH = 10 * MINUTE, 30 * NANOSECONDS


def longest_quiet(sound: Spans, coverage: Spans, day: date, zone: tzinfo) -> Spans:
    """Find the longest quiet span from 07:00 to 22:00.

    Returns
    -------
    Spans
        A single one; none if nothing was heard then.
    """
    waking = one(at_hour(day, MORNING, zone), at_hour(day, EVENING, zone))
    quiet = without(common(coverage, waking), sound)
    if not len(quiet.starts):
        return NONE
    longest = int((quiet.ends - quiet.starts).argmax())
    return Spans(*(edge[longest : longest + 1] for edge in quiet))


def stretches(sound: Spans, night: Spans) -> int:
    """Count the stretches of sound in a night, with ten quiet minutes between them.

    Returns
    -------
    int
        Number of those with at least half a minute of sound.
    """
    inside = common(sound, night)
    found = joined(*inside, _PAUSE)
    if not len(found.starts):
        return 0
    edges = np.append(found.starts, found.ends[-1:])
    return int((lengths(inside, edges) >= _STRETCH).sum())
