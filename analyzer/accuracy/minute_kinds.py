"""How many minutes are quiet, for fewer of those are drawn at random than there are."""

from collections.abc import Iterator

import numpy as np

from hearthlog.analyzer.accuracy.events import MINUTE, sounding_minutes
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.labelling import find_labellings, unified
from hearthlog.analyzer.logs.spans import joined, lengths
from hearthlog.analyzer.marks.marks import RANDOM, read_reviewed
from hearthlog.schemas.arrays import Bool
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import REVIEW_LAYER, log_of_layer
from hearthlog.schemas.messages.topics import LIVE, relabelling

_DAY = 1440 * MINUTE
_MOST = 7  # days: more would hardly change the share, and take their time


def quiet_weight(logs: HomeLogs, labelling: str, checked: Bool) -> float:
    """Tell for how many quiet minutes one checked stands, where one with sound stands for one.

    That is the weight of Horvitz and Thompson, by the last seven days of which minutes were
    checked.

    Parameters
    ----------
    checked : np.ndarray [shape=(n,)], bool
        Whether anything sounds in each checked minute.

    Returns
    -------
    float
        1 if only minutes of one kind were checked, or are there.
    """
    kinds = [sounding for day in _days(logs, labelling) for sounding in _sounding(logs, *day)]
    sounding = np.concatenate([*kinds, np.empty(0, bool)])
    loud, quiet = int(sounding.sum()), int((~sounding).sum())
    checked_loud, checked_quiet = int(checked.sum()), int((~checked).sum())
    if not (loud and quiet and checked_loud and checked_quiet):
        return 1.0
    return (quiet / checked_quiet) / (loud / checked_loud)


def _days(logs: HomeLogs, labelling: str) -> list[tuple[int, str, str]]:
    days = set()
    for layer in logs.between(layer=REVIEW_LAYER):
        try:
            spans = read_reviewed(log_of_layer(layer.path))
        except LogError:
            continue  # whoever reads the minutes says so
        own = (s for s in spans if s.chosen == RANDOM and s.corrects == labelling)
        days |= {(span.start // _DAY * _DAY, span.microphone, labelling) for span in own}
    return sorted(days)[-_MOST:]


def _sounding(logs: HomeLogs, start: int, microphone: str, labelling: str) -> Iterator[Bool]:
    """Tell which minutes of a day sound; those that are not labelled are left out."""
    paths = [entry.path for entry in logs.between(start, start + _DAY) if entry.path.exists()]
    name = labelling if labelling == LIVE else relabelling(labelling)
    edges = start + np.arange(0, _DAY + 1, MINUTE)
    try:
        labels = find_labellings(*paths).read(microphone, name, start, start + _DAY).labelling
    except (DataError, LogError):
        return
    labelled = lengths(joined(labels.starts, labels.ends), edges) > 0
    yield sounding_minutes(unified(labels), edges)[labelled]
