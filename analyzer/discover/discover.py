"""Which sounds of a home are alike, by groups that are known, and by new ones."""

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.discover.groups import (
    LEAST,
    NO_GROUP,
    Groups,
    add_groups,
    identified,
    make_space,
)
from hearthlog.analyzer.discover.read_sounds import HomeSounds
from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.arrays import Float64, Int64

_MOST = 20_000  # sounds among which groups are looked for
_AT_ONCE = 10_000


def discover(
    sounds: HomeSounds, groups: Groups | None, least: int = LEAST
) -> tuple[Groups, Int64, Float64]:
    """Group sounds: those of the groups that are known, and the others by new groups.

    Parameters
    ----------
    sounds : HomeSounds
    groups : Groups or None
        Those of an earlier time, which are not changed; None if there are none.
    least : int, optional
        Sounds of a new group, at least. Of more than 20,000 sounds so many are drawn, always the
        same ones, and groups are looked for among these.

    Returns
    -------
    groups : Groups
        With the new ones.
    of : np.ndarray [shape=(n,)], int64
        The row of the group of each sound; `NO_GROUP` for one that is of none.
    points : np.ndarray [shape=(n, d)], float64
        Where the sounds lie.

    Raises
    ------
    DataError
        If the groups are of other features, or there are too few sounds to group.
    """
    count = len(sounds.descriptors)
    if groups is not None and groups.features != sounds.features:
        raise DataError(
            f"the groups are of {len(groups.features)} features, the logs have "
            f"{len(sounds.features)} others; name another file with --groups"
        )
    is_new, drawn = groups is None, _drawn(sounds)
    if groups is None:
        if count < 2 * least:
            raise DataError(f"too few sounds to group: {count}, and it takes {2 * least}")
        groups = make_space(sounds.features, sounds.descriptors[drawn])
    points = np.concatenate(
        [
            groups.points(sounds.descriptors[first : first + _AT_ONCE])
            for first in range(0, max(count, 1), _AT_ONCE)
        ]
    )
    of = groups.find(points)
    groups = add_groups(groups, points[drawn], of[drawn], least)
    groups = identified(groups) if is_new else groups
    rest = of == NO_GROUP
    of[rest] = groups.find(points[rest])
    return groups, of, points


def _drawn(sounds: HomeSounds) -> Int64:
    """Draw sounds by a hash of their times, and order them by these."""
    starts = sounds.spans.starts
    rows = np.arange(len(starts))
    if len(rows) > _MOST:
        rows = np.argsort(_hashed(starts.astype(np.uint64)), kind="stable")[:_MOST]
    return rows[np.lexsort((sounds.microphone[rows], starts[rows]))]


def _hashed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix the bits of numbers: the finalizer of SplitMix64 (Steele et al., OOPSLA 2014)."""
    numbers = (numbers ^ (numbers >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    numbers = (numbers ^ (numbers >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return numbers ^ (numbers >> np.uint64(31))
