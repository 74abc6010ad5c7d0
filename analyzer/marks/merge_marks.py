"""Labels of a file that are no marks yet."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence

from hearthlog.analyzer.logs.coverage import ROUNDING
from hearthlog.analyzer.marks.marks import Mark


def new_marks(marks: Iterable[Mark], existing: Sequence[Mark]) -> list[Mark]:
    """Return the marks that are not among existing ones, up to 1 ms of rounding of their times.

    A mark without reviewer, time or labelling equals one that has them: so a file that has no
    place for them does not make marks anonymous, nor one with rounded times move them.
    """
    ordered = sorted(existing)
    keys = [mark[:2] for mark in ordered]
    return [mark for mark in marks if not _exists(mark, ordered, keys)]


def _exists(mark: Mark, ordered: Sequence[Mark], keys: Sequence[tuple[str, int]]) -> bool:
    first = bisect_left(keys, (mark.microphone, mark.start - ROUNDING))
    last = bisect_left(keys, (mark.microphone, mark.start + ROUNDING + 1))
    return any(
        old.label == mark.label
        and abs(old.end - mark.end) <= ROUNDING
        and all(new in {"", 0, own} for new, own in zip(mark[4:], old[4:], strict=True))
        for old in ordered[first:last]
    )
