"""What to review next, so that a person's time buys the most."""

from dataclasses import dataclass

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.difference import DAY
from hearthlog.analyzer.evaluation.event_scores import events_of
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.labellings import LABEL_FIELDS, Labellings, NamedLabelling
from hearthlog.analyzer.review.queue.judgeable_spans import (
    JudgeableSpans,
    judgeable_spans,
    other_labels,
    without,
)
from hearthlog.analyzer.review.queue.uncertainty import ModelUncertainty
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import iterate_columns
from hearthlog.schemas.messages.topics import labelling_topic
from hearthlog.schemas.progress import Progress, ignore_progress

# Of two that differ one may be right, and what is new may be labelled well.
_WEIGHTS = np.array([[1.0], [0.5], [0.5]])
RANDOM = "random"
_ALONE = {"uncertain": 0, "disagreeing": 1, "novel": 2}  # rows of what is weighed
RANKINGS = (*_ALONE, RANDOM)


@dataclass(frozen=True)
class ReviewQueue:
    """Windows to be reviewed, the most useful first.

    Attributes
    ----------
    windows : JudgeableSpans
    labels, others : list of str
        What the labelling says, and what the other one says; that is empty where it says nothing.
    uncertainty, disagreement, novelty : np.ndarray [shape=(n,)], float64
        0 to 1.
    candidates : int
        Windows that there were to choose from.
    sure : bool
        False if the logs do not say how sure the model was.
    """

    windows: JudgeableSpans
    labels: list[str]
    others: list[str]
    uncertainty: Float64
    disagreement: Float64
    novelty: Float64
    candidates: int
    sure: bool

    @property
    def weighted(self) -> Float64:
        """What the parts of the score weigh, shape (3, n)."""
        return _WEIGHTS * np.stack([self.uncertainty, self.disagreement, self.novelty])

    @property
    def scores(self) -> Float64:
        """By what the windows are ranked, before they are spread over days and classes."""
        return self.weighted.sum(axis=0)


def make_queue(  # noqa: PLR0913
    sources: Labellings,
    microphone: str,
    side: NamedLabelling,
    *,
    other: NamedLabelling | None,
    marks: Labelling | None,
    count: int,
    ranking: str | None = None,
    progress: Progress = ignore_progress,
) -> ReviewQueue:
    """Choose spans whose labels are likely to be wrong, of many days and classes.

    Parameters
    ----------
    sources : Labellings
    microphone : str
    side : NamedLabelling
        The labelling to be reviewed.
    other : NamedLabelling or None
        Another one, to see where they disagree; another name for a class is no disagreement.
    marks : Labelling or None
        What was reviewed already: it is left out.
    count : int
        Of spans.
    ranking : str, optional
        One of `RANKINGS`: by what alone they are chosen.
    progress : callable, optional
        Is called with the share that is done.

    Raises
    ------
    DataError
        If nothing is left to review, or nothing says what to review first.
    """
    other = other and other.called_as(side.classes)
    classes = list(dict.fromkeys([*side.classes, *(other.classes if other else ())]))
    segments = events_of(side.labelling, classes)
    if marks is not None:
        segments = without(segments, marks.starts, marks.ends)
    windows = judgeable_spans(segments)
    if not len(windows):
        raise DataError(f"{side.name}: nothing is left to review")
    doubt = ModelUncertainty(windows, classes)
    _add_frames(doubt, sources, labelling_topic(microphone, side.name, "label"), windows, progress)
    if other is None and not (doubt.uncertainty.known or doubt.novelty.known):
        raise DataError(
            f"{side.name}: the logs do not say how sure the model was (no labels with "
            "probabilities); name a second labelling to compare it with"
        )
    labels, differing = np.full(len(windows), -1), np.zeros(len(windows))
    if other is not None:
        labels, differing = other_labels(windows, events_of(other.labelling, classes))
    parts = doubt.uncertainty.values(), differing, doubt.novelty.values()
    scores = _scores(np.stack(parts), ranking)
    if not scores.any():
        raise DataError(f"{side.name}: no span is {ranking}")
    rows = _best_of_each(scores, windows.sources)
    if ranking is not None:
        rows = rows[scores[rows] > 0.0]
    rows = rows[_spread(scores[rows], windows.taken(rows), count)]
    return ReviewQueue(
        windows.taken(rows),
        [classes[i] for i in windows.labels[rows].tolist()],
        [classes[i] if i >= 0 else "" for i in labels[rows].tolist()],
        uncertainty=parts[0][rows],
        disagreement=parts[1][rows],
        novelty=parts[2][rows],
        candidates=len(windows),
        sure=doubt.uncertainty.known,
    )


def _scores(parts: Float64, ranking: str | None) -> Float64:
    """Weigh what speaks for each window; at random the same windows come each time."""
    if ranking == RANDOM:
        return np.random.default_rng(0).random(parts.shape[1:])
    weights = _WEIGHTS if ranking is None else np.eye(len(parts))[:, [_ALONE[ranking]]]
    scored: Float64 = (weights * parts).sum(axis=0)
    return scored


def _add_frames(
    doubt: ModelUncertainty,
    sources: Labellings,
    topic: str,
    windows: JudgeableSpans,
    progress: Progress,
) -> None:
    start, end = int(windows.starts[0]), int(windows.ends[-1])
    logs = sources.with_topic(topic, start, end)
    for i, log in enumerate(logs):
        try:
            for batch in iterate_columns([log.path], {topic}, start, end, LABEL_FIELDS):
                for frames in batch:
                    doubt.add(frames)
        except LogError as error:
            sources.lose(error)
        progress((i + 1) / len(logs))


def _best_of_each(scores: Float64, sources: Int64) -> Int64:
    """Find the best window of each stretch, of equal ones the first."""
    order = np.lexsort((-scores, sources))
    return order[np.flatnonzero(np.diff(sources[order], prepend=-1))]


def _spread(scores: Float64, windows: JudgeableSpans, count: int) -> Int64:
    """Choose the best, of many days and classes rather than of one.

    Each time it is the one of the highest score divided by the square root of one more than were
    chosen of its class, and by that of one more than were chosen of its day.
    """
    _, day = np.unique(windows.starts // DAY, return_inverse=True)
    label = windows.labels
    order = np.lexsort((-scores, label, day))  # only the best of a day and class can be next
    group = (day * (label.max() + 1) + label)[order]
    head = np.flatnonzero(np.diff(group, prepend=-1))
    stop = np.append(head[1:], len(order))
    day, label = day[order[head]], label[order[head]]
    of_day, of_label = np.ones(day.max() + 1), np.ones(label.max() + 1)
    chosen = []
    for _ in range(min(count, len(order))):
        best = np.where(head < stop, scores[order[np.minimum(head, stop - 1)]], -np.inf)
        at = int(np.argmax(best / np.sqrt(of_day[day] * of_label[label])))
        chosen.append(int(order[head[at]]))
        head[at] += 1
        of_day[day[at]] += 1.0
        of_label[label[at]] += 1.0
    return np.array(chosen, np.int64)
