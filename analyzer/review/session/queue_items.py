"""The spans that a review goes through: of a queue, or of a list that `diff` made."""

from collections.abc import Iterable
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labellings import Labellings
from hearthlog.analyzer.review.queue.ranking import RANKINGS, make_queue
from hearthlog.analyzer.review.queue.review_list import ReviewSpan, queued, read_list
from hearthlog.analyzer.review.session.session import ReviewItem
from hearthlog.schemas.messages.topics import REVIEW

_TEN = 10  # which takes a person a few minutes
Limits = tuple[int | None, int | None]


def queue_items(
    queue: str, sources: Labellings, labelled: tuple[str, str], limits: Limits, count: int | None
) -> list[ReviewItem]:
    """Choose spans of a labelling for a review.

    Parameters
    ----------
    queue : str
        One of `RANKINGS`, or the name of a list (`*.csv`) that `hearthlog diff` made.
    sources : Labellings
    labelled : (str, str)
        The microphone, and the labelling: `live`, or `relabel/` and a model.
    limits : (int or None, int or None)
        Start and end in nanoseconds of UTC; None for all that there is.
    count : int or None
        How many, at most; None for ten of a ranking, all of a list.

    Returns
    -------
    list of ReviewItem
        The most useful first, or in the order of the list.

    Raises
    ------
    DataError
        If there is nothing to review, or no such list.
    LogError
        If the labelling has no segment in these limits, or its segments overlap or cannot be.
    """
    microphone, labelling = labelled
    if queue not in RANKINGS:
        if not queue.endswith(".csv"):
            raise DataError(
                f"--queue {queue[:64]}: use {', '.join(RANKINGS)}, or a list *.csv of `diff --list`"
            )
        return _items(_listed(Path(queue), microphone, limits)[:count])
    side = sources.read(microphone, labelling, *limits)
    others = [name for name in sources.names(microphone) if name not in {labelling, REVIEW}]
    if queue == "disagreeing" and not others:
        raise DataError("no other labelling to disagree with: `hearthlog relabel` makes one")
    other = sources.read(microphone, others[0], *limits) if others else None
    chosen = make_queue(
        sources,
        microphone,
        side,
        other=other,
        marks=sources.marks(microphone, *limits),
        count=count or _TEN,
        ranking=queue,
    )
    return _items(queued(chosen, microphone, labelling, "" if other is None else other.name))


def _listed(path: Path, microphone: str, limits: Limits) -> list[ReviewSpan]:
    start, end = limits
    spans = [
        span
        for span in read_list(path)
        if span.microphone == microphone
        and (start is None or span.end > start)
        and (end is None or span.start < end)
    ]
    if not spans:
        raise DataError(f"{path}: lists nothing of {microphone} in these logs")
    return spans


def _items(spans: Iterable[ReviewSpan]) -> list[ReviewItem]:
    return [ReviewItem(span.start, span.end, span.label_a, _text(span)) for span in spans]


def _text(span: ReviewSpan) -> str:
    other = f", {span.b}: {span.label_b or 'nothing'}" if span.b else ""
    return f"{span.a}: {span.label_a}{other} ({span.reason})"
