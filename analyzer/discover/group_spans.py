"""When the sounds of groups were, microphone by microphone."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.discover.discover import discover
from hearthlog.analyzer.discover.groups import NO_GROUP, Groups
from hearthlog.analyzer.discover.read_sounds import read_sounds
from hearthlog.analyzer.discover.sound_spans import ALL
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import Progress, ignore_progress


class GroupSpans(NamedTuple):
    """Sounds of known groups, in the order of time.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    texts : np.ndarray [shape=(n,)] of str
        The name of the group of each, or `group 3`.
    """

    starts: Int64
    ends: Int64
    texts: NDArray[np.object_]


def group_spans(
    home: HomeLogs,
    groups: Groups,
    start: int | None = None,
    end: int | None = None,
    progress: Progress = ignore_progress,
) -> tuple[dict[str, GroupSpans], list[str]]:
    """Find the sounds of groups that are known; no group is added.

    Parameters
    ----------
    progress : callable, optional
        Told the share of the logs that is read, 0 to 1.

    Raises
    ------
    DataError
        If no log has features and labels, or the groups are of other features.
    """
    texts = np.array(
        [
            name or f"group {number}"
            for name, number in zip(groups.names, groups.numbers.tolist(), strict=True)
        ],
        object,
    )
    found = {}
    with read_sounds(home, ALL, start, end, progress, groups) as sounds:
        _, of, _ = discover(sounds, groups)
        of = np.where(of < len(texts), of, NO_GROUP)
        order = np.argsort(sounds.spans.starts, kind="stable")
        for place, name in enumerate(sounds.microphones):
            rows = order[(sounds.microphone[order] == place) & (of[order] != NO_GROUP)]
            spans = sounds.spans.starts[rows], sounds.spans.ends[rows]
            found[name] = GroupSpans(*spans, texts[of[rows]])
    return found, sounds.losses
