"""A queue as lines of text, at most 100 characters wide."""

from collections.abc import Iterator

from hearthlog.analyzer.evaluation.difference_table import NAME_WIDTH as _NAME
from hearthlog.analyzer.evaluation.difference_table import span_text
from hearthlog.analyzer.evaluation.table import shown
from hearthlog.analyzer.review.queue.ranking import ReviewQueue


def queue_table(queue: ReviewQueue) -> Iterator[str]:
    """Yield a line for each span."""
    yield (
        f"{'start':24} {'seconds':>7}  {'label':{_NAME}} {'other label':{_NAME}} {'score':>5} "
        f"{'unsure':>6} {'differ':>6} {'novel':>6}"
    )
    rows = zip(
        queue.windows.starts.tolist(),
        queue.windows.ends.tolist(),
        queue.labels,
        queue.others,
        queue.scores.tolist(),
        queue.uncertainty.tolist(),
        queue.disagreement.tolist(),
        queue.novelty.tolist(),
        strict=True,
    )
    for start, end, label, other, score, *parts in rows:
        yield (
            f"{span_text(start, end)}  {shown(label):{_NAME}} {shown(other):{_NAME}} {score:5.2f} "
            + " ".join(f"{part:6.2f}" for part in parts)
        )
