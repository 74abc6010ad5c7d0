"""What is reviewed already, and is asked for no more."""

from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.labelling import Labellings
from hearthlog.analyzer.logs.spans import Spans, joined
from hearthlog.analyzer.marks.marks import RANDOM, read_review
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import is_layer


class ReviewedTime(NamedTuple):
    """The time of a microphone that a person has marked, or looked at.

    Attributes
    ----------
    random : frozenset of int
        Starts of the spans that were drawn at random, in nanoseconds of UTC.
    """

    spans: Spans
    random: frozenset[int]


def reviewed_time(sources: Labellings, microphone: str, scenario: str = "") -> ReviewedTime:
    """Read what is reviewed of a microphone, by anyone and of any labelling of one scenario.

    Parameters
    ----------
    scenario : str, optional
        Its name; empty for the sounds of the home.
    """
    times, random = [], set[int]()
    for log in sources.logs:
        if is_layer(log.path):
            continue
        try:
            review = read_review(log.path)
        except LogError as error:
            sources.lose(error)
            continue
        marks, looked_at = review.get(scenario, ((), ()))
        own = [span for span in looked_at if span.microphone == microphone]
        random |= {span.start for span in own if span.chosen == RANDOM}
        times += [(span.start, span.end) for span in own]
        times += [(mark.start, mark.end) for mark in marks if mark.microphone == microphone]
    starts, ends = np.array(times, np.int64).reshape(-1, 2).T
    return ReviewedTime(joined(starts, ends), frozenset(random))
