"""How right the recorder's labels were, class by class, around the time that a timeline shows."""

from collections.abc import Mapping

from hearthlog.analyzer.accuracy.checked_minutes import (
    ClassCheck,
    checked_minutes,
    read_reviewed_labels,
)
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.analyzer.review.timeline.model import Timeline
from hearthlog.models.classes import in_words
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE

Checked = Mapping[tuple[str, str], ClassCheck]  # by microphone, and class in words
_AROUND = 28 * 86_400 * NANOSECONDS


def checked_classes(timeline: Timeline, logs: HomeLogs) -> Checked:
    """Count sounds of the recorder in minutes that were drawn at random, and those that are right.

    Parameters
    ----------
    logs : HomeLogs
        Of its home; minutes up to four weeks before and after the timeline count.

    Returns
    -------
    mapping
        From microphone and class in words; classes without a sound in these minutes are left out.
    """
    start, end = timeline.grid.start - _AROUND, timeline.grid.end + _AROUND
    near = read_reviewed_labels(logs, LIVE, start, end, [], {RANDOM})
    reviewed = [one for one in near if start <= one.span.start < end]
    checked: dict[tuple[str, str], ClassCheck] = {}
    for microphone in timeline.microphones:
        minutes = checked_minutes(one for one in reviewed if one.span.microphone == microphone)
        checks = ((name, minutes.check(name)) for name in minutes.labelled)
        checked |= {(microphone, in_words(name)): one for name, one in checks if one.labelled}
    return checked
