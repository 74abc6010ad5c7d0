"""What stands already: labels that say nothing new leave older marks as they are."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence

from hearthlog.analyzer.logs.coverage import ROUNDING
from hearthlog.analyzer.marks.marks import Mark


def new_marks(marks: Iterable[Mark], standing: Sequence[Mark]) -> list[Mark]:
    """List the marks that are not among older ones, up to rounding.

    A file that cannot say who made a mark must not make one anonymous, nor one with rounded times
    move it.

    Parameters
    ----------
    marks : iterable of Mark
        What they do not say of reviewer, time and labelling may be anything.
    standing : sequence of Mark
        The older ones, those of a microphone in the order of time.
    """
    ordered = sorted(standing)
    keys = [mark[:2] for mark in ordered]
    return [mark for mark in marks if not _stands(mark, ordered, keys)]


def _stands(mark: Mark, ordered: Sequence[Mark], keys: Sequence[tuple[str, int]]) -> bool:
    first = bisect_left(keys, (mark.microphone, mark.start - ROUNDING))
    last = bisect_left(keys, (mark.microphone, mark.start + ROUNDING + 1))
    return any(
        old.label == mark.label
        and abs(old.end - mark.end) <= ROUNDING
        and all(new in {"", 0, said} for new, said in zip(mark[4:], old[4:], strict=True))
        for old in ordered[first:last]
    )
