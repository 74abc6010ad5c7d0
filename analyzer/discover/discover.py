"""Which sounds of a home are alike, by groups that are known, and by new ones."""

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.discover.groups import (
    LEAST,
    NO_GROUP,
    Groups,
    add_groups,
    identified,
    new_groups,
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
    groups : Groups or None
        Those of an earlier time, which are not changed; None if there are none.
    least : int, optional
        Sounds of a new group, at least. Of more than 20,000 sounds so many are drawn, always the
        same ones, and groups are looked for among these.

    Returns
    -------
    of : np.ndarray [shape=(n,)], int64
        The row of the group of each sound; `NO_GROUP` for one that is of none.
    points : np.ndarray [shape=(n, d)], float64
        Where the sounds lie by their features.

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
        described = sounds.descriptors[drawn], sounds.embedding, sounds.embeddings[drawn]
        groups = new_groups(sounds.features, *described)
    points, embedded = _points(sounds, groups)
    heard, of = groups.are_comparable(sounds.embeddings), np.full(count, NO_GROUP)
    for own, by_embedding in ((heard, True), (~heard, False)):
        inside = drawn[own[drawn]]
        where = embedded if by_embedding else points
        of[own] = groups.space(embedded=by_embedding).find(where[own])
        groups = add_groups(
            groups,
            points[inside],
            of[inside],
            least,
            embedded[inside] if by_embedding else None,
        )
        rest = own & (of == NO_GROUP)
        of[rest] = groups.space(embedded=by_embedding).find(where[rest])
    return identified(groups) if is_new else groups, of, points


def unembedded_note(sounds: HomeSounds, groups: Groups) -> str:
    """Return a note on sounds that were grouped by features alone; empty if there are none."""
    others = sorted({space.network for space in sounds.other_embeddings})
    if groups.embedding is None:
        others = sorted({*others, sounds.embedding.network} if sounds.embedding else others)
        return (
            f"these groups are by features alone, and logs have embeddings of {', '.join(others)}: "
            "another file with --groups groups by both"
            if others
            else ""
        )
    if not sounds.without_embedding:
        return ""
    theirs = f" (but of {', '.join(others)}, or of another projection)" if others else ""
    return (
        f"{sounds.without_embedding} of {len(sounds.logs)} logs are without embeddings of "
        f"{groups.embedding.network} as the groups are by{theirs}: their sounds are known by their "
        "features alone"
    )


def _points(sounds: HomeSounds, groups: Groups) -> tuple[Float64, Float64]:
    """Return where sounds lie by their features, and with their embeddings; NaN without."""
    points = np.empty((len(sounds.descriptors), len(groups.axes)))
    space = groups.embedded
    embedded = np.full((len(points), 0 if space is None else len(space.axes)), np.nan)
    for first in range(0, len(points), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        descriptors, embeddings = sounds.descriptors[part], sounds.embeddings[part]
        points[part] = groups.points(descriptors)
        if space is not None and groups.are_comparable(embeddings).any():
            embedded[part] = space.points(np.concatenate([descriptors, embeddings], axis=1))
    return points, embedded


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
