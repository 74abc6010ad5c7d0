"""Review queue: spans ranked by uncertainty, disagreement, novelty and coverage."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import DAY, indexed_events
from hearthlog.analyzer.logs.labelling import LABEL_FIELDS, Labellings, NamedLabelling
from hearthlog.analyzer.logs.spans import NONE, Spans
from hearthlog.analyzer.review.spans import (
    LEAST_AUDIBLE,
    JudgeableSpans,
    ModelUncertainty,
    SpanSounds,
    audible_time,
    border_pieces,
    cut_to_audible,
    judgeable_spans,
    labelling_model,
    other_labels,
    remove_reviewed,
    span_sounds,
)
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.registry import DEFAULT_FOLDER
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import iterate_columns
from hearthlog.schemas.messages.topics import labelling_topic, scenario_name

MOST_CANDIDATES = 3000  # maximum spans whose pairs are all compared
_SEED = 20_261_123


def sample(weights: Float64, most: int = MOST_CANDIDATES) -> tuple[Indices, Float64]:
    """Choose representative rows: with probability proportional to weight, spread over their order.

    Weights [shape=(n,)] are not negative; the same weights give the same rows. Return rows
    [shape=(m,)], ascending, all rows with a weight if these are at most `most`, and the share of
    the sum of all weights that each row represents.
    """
    rows = np.flatnonzero(weights > 0.0)
    if len(rows) <= most:
        return rows, weights[rows]
    sums = np.cumsum(weights[rows])
    step = float(sums[-1]) / most
    places = (np.arange(most) + np.random.default_rng(_SEED).random(most)) * step
    hit, times = np.unique(np.searchsorted(sums, places), return_counts=True)
    return rows[hit], times * np.float64(step)


# The coverage of a set of spans is a facility location function; its greedy maximum has at
# least 1 - 1 / e of the possible maximum (Nemhauser, Wolsey and Fisher, "An analysis of
# approximations for maximizing submodular set functions", 1978).
def cover(points: Float64, gamma: float, weights: Float64, eligible: Bool, count: int) -> Indices:
    """Choose up to `count` points that are similar to most of the weight of all points.

    Each step adds the eligible point with the largest gain in the sum of weight times similarity to
    the nearest chosen point; the rows are in this order, without points of no gain. The similarity
    of x and y is exp(-gamma |x - y|^2). Points have shape (n, width); one that is not finite is
    similar to none. Weights are not negative.
    """
    similar = _similarities(points, gamma)
    nearest = np.zeros(len(points), np.float32)
    weight, left = weights.astype(np.float32), eligible.copy()
    chosen = []
    for _ in range(min(count, int(eligible.sum()))):
        gains = np.where(left, np.maximum(similar - nearest, 0.0) @ weight, 0.0)
        best = int(gains.argmax())
        if gains[best] <= 0.0:
            break
        chosen.append(best)
        left[best] = False
        nearest = np.maximum(nearest, similar[best])
    return np.array(chosen, np.intp)


def _similarities(points: Float64, gamma: float) -> Float32:
    finite = np.isfinite(points.sum(axis=1))
    there = np.where(finite[:, np.newaxis], points, 0.0).astype(np.float32)
    squares = np.vecdot(there, there)
    distances = squares[:, np.newaxis] + squares - 2.0 * (there @ there.T)
    similar = np.exp(np.float32(-gamma) * np.maximum(distances, 0.0))
    similar[~finite], similar[:, ~finite] = 0.0, 0.0
    np.fill_diagonal(similar, 1.0)
    return similar


# Where two labellings differ one may be right, and novel sounds may be labelled correctly.
_WEIGHTS = np.array([[1.0], [0.5], [0.5]])
_MOSTLY = 0.5
USEFUL, UNCERTAIN, DISAGREEING = "useful", "uncertain", "disagreeing"
_ALONE = {UNCERTAIN: 0, DISAGREEING: 1, "novel": 2}  # rows of `weighted`
RANKINGS = (USEFUL, *_ALONE)
_LONG_ENOUGH = 3 * NANOSECONDS // 2  # enough for complete windows of one sound
_LONGEST_WEIGHED = 3 * NANOSECONDS


@dataclass(frozen=True)
class ReviewQueue:
    """Spans to review, the best first."""

    spans: JudgeableSpans
    labels: list[str]  # main label of each span in the labelling
    others: list[str]  # likewise in the other labelling; empty without one
    uncertainty: Float64  # [shape=(n,)], 0 to 1
    disagreement: Float64  # [shape=(n,)], 0 to 1
    novelty: Float64  # [shape=(n,)], 0 to 1
    candidates: int
    has_uncertainty: bool  # False if the logs have no probabilities
    ranking: str | None

    @property
    def reasons(self) -> Int64:
        """The row of `weighted` for which each span was chosen; shape (n,)."""
        if self.ranking in _ALONE:
            return np.full(len(self.spans), _ALONE[self.ranking])
        return np.argmax(self.weighted, axis=0)

    @property
    def weighted(self) -> Float64:
        """Weighted parts of the scores: uncertainty, disagreement and novelty; shape (3, n)."""
        return _WEIGHTS * np.stack([self.uncertainty, self.disagreement, self.novelty])

    @property
    def scores(self) -> Float64:
        """Scores before spans are spread over days and classes; shape (n,)."""
        return self.weighted.sum(axis=0)


def make_queue(  # noqa: PLR0913
    sources: Labellings,
    microphone: str,
    side: NamedLabelling,
    *,
    other: NamedLabelling | None,
    reviewed: Spans,
    count: int,
    ranking: str | None = None,
    models: Path = DEFAULT_FOLDER,
    audible: Spans | None = None,
    progress: Progress = ignore_progress,
) -> ReviewQueue:
    """Choose the spans that teach a model most, or whose labels are probably wrong.

    Parameters
    ----------
    other : NamedLabelling or None
        Another labelling, to find disagreements; two names of one class are no disagreement.
    count : int
        Maximum number of spans.
    ranking : str, optional
        One of `RANKINGS`, to rank by it alone; by default by the weighted sum of uncertainty,
        disagreement and novelty, without `border_pieces`. Mostly silent spans are not `uncertain`,
        since there is nothing to judge. The most `useful` spans sound like most of the sounds that
        the model is uncertain of, with rare classes preferred.
    audible : Spans, optional
        Time with kept sound: `useful` spans with some of it go first, and are cut to it.
    progress : callable, optional
        Called with the share of the logs that is read, 0 to 1.

    Returns
    -------
    ReviewQueue
        At most one span of each segment, except for `useful` spans.

    Raises
    ------
    DataError
        If nothing is left to review, there is nothing to rank by, or there are more than five
        million spans.
    """
    other = other and other.called_as(side.classes)
    classes = list(dict.fromkeys([*side.classes, *(other.classes if other else ())]))
    segments = indexed_events(side.labelling, classes)
    segments = remove_reviewed(segments, reviewed)
    spans = judgeable_spans(segments)
    if audible is not None and ranking == USEFUL:
        spans = cut_to_audible(spans, audible, _LONG_ENOUGH)
    if not len(spans):
        raise DataError(f"{side.name}: nothing is left to review")
    means = ModelUncertainty(spans, classes)
    steps = 2.0 if ranking == USEFUL else 1.0

    def report(share: float) -> None:
        progress(share / steps)

    _add_frames(means, sources, labelling_topic(microphone, side.name, "label"), spans, report)
    has_values = means.uncertainty.exist or means.novelty.exist
    if other is None and ranking != USEFUL and not has_values:
        raise DataError(
            f"{side.name}: its labels have no probabilities; name a second labelling to compare "
            "it with"
        )
    labels, differing = np.full(len(spans), -1), np.zeros(len(spans))
    if other is not None:
        labels, differing = other_labels(spans, indexed_events(other.labelling, classes))
    parts = means.uncertainty.values(), differing, means.novelty.values()
    if ranking == USEFUL:
        logs = sources.with_topic(labelling_topic(microphone, side.name, "segment"))
        model = labelling_model(logs, microphone, models, scenario_name(side.name))

        def sounds(some: JudgeableSpans) -> SpanSounds:
            return span_sounds(
                some, sources, microphone, model, lambda share: progress((1.0 + share) / 2.0)
            )

        rows = _useful(spans, parts[0], count, sounds, audible)
    else:
        silent = np.array([class_name(name) == SILENCE for name in classes])
        scored = np.where(border_pieces(spans, silent), 0.0, np.stack(parts))
        rows = _ranked(scored, ranking, spans, means.silence.values(), count)
        if not len(rows):
            raise DataError(f"{side.name}: no span is {ranking}")
    return ReviewQueue(
        spans.take(rows),
        [classes[i] for i in spans.labels[rows].tolist()],
        [classes[i] if i >= 0 else "" for i in labels[rows].tolist()],
        uncertainty=parts[0][rows],
        disagreement=parts[1][rows],
        novelty=parts[2][rows],
        candidates=len(spans),
        has_uncertainty=means.uncertainty.exist,
        ranking=ranking,
    )


def _useful(
    spans: JudgeableSpans,
    uncertain: Float64,
    count: int,
    sounds: Callable[[JudgeableSpans], SpanSounds],
    audible: Spans | None,
) -> Int64:
    """Choose spans similar to most of a model's uncertain sounds, with rare classes preferred.

    Those that are mostly audible go first, then those that are partly, and silent ones last.
    """
    kept = audible_time(spans, NONE if audible is None else audible)
    # Sampled apart, or of many spans few that can be heard would be left.
    weights, is_audible = worth(spans, uncertain), kept >= LEAST_AUDIBLE
    first, of_first = sample(np.where(is_audible, weights, 0.0), MOST_CANDIDATES // 2)
    other, of_other = sample(np.where(is_audible, 0.0, weights), MOST_CANDIDATES - len(first))
    order = np.argsort(np.concatenate([first, other]))
    rows = np.concatenate([first, other])[order]
    shares = np.concatenate([of_first, of_other])[order]
    some = spans.take(rows)
    points, gamma = sounds(some)
    length = some.ends - some.starts
    eligible = length >= _LONG_ENOUGH
    if not eligible.any():
        eligible[:] = True
    rank = is_audible[rows] * (1 + (kept[rows] > _MOSTLY * length))
    chosen = np.empty(0, np.intp)
    for best in (2, 1, 0):
        more = cover(points, gamma, shares, eligible & (rank == best), count - len(chosen))
        chosen = np.concatenate([chosen, more])
    return rows[chosen]


def worth(spans: JudgeableSpans, uncertain: Float64) -> Float64:
    """Weigh spans by their length and by the model's uncertainty [shape=(n,)], 0 to 1.

    The total weight of a class is proportional to the square root of its duration, so that rare
    classes are included, and frequent ones more often. If all uncertainties are 0, all spans count
    as equally uncertain.
    """
    seconds = np.minimum(spans.ends - spans.starts, _LONGEST_WEIGHED) / NANOSECONDS
    of_class = np.bincount(spans.labels, seconds)[spans.labels]
    return seconds * (uncertain if uncertain.any() else 1.0) / np.sqrt(of_class)


def _ranked(
    parts: Float64, ranking: str | None, spans: JudgeableSpans, silence: Float64, count: int
) -> Int64:
    """Choose the spans with the highest scores; none if all are 0."""
    weights = _WEIGHTS if ranking is None else np.eye(len(parts))[:, [_ALONE[ranking]]]
    scores: Float64 = (weights * parts).sum(axis=0)
    if ranking == UNCERTAIN:
        scores[silence >= _MOSTLY] = 0.0
    if not scores.any():
        return np.empty(0, np.int64)
    rows = _best_of_each(scores, spans.sources)
    if ranking is not None:
        rows = rows[scores[rows] > 0.0]
    return rows[spread(scores[rows], spans.take(rows), count)]


def _add_frames(
    means: ModelUncertainty,
    sources: Labellings,
    topic: str,
    spans: JudgeableSpans,
    progress: Progress,
) -> None:
    start, end = int(spans.starts[0]), int(spans.ends[-1])
    logs = sources.with_topic(topic, start, end)
    for i, log in enumerate(logs):
        try:
            for batch in iterate_columns([log.path], {topic}, start, end, LABEL_FIELDS):
                for frames in batch:
                    means.add(frames)
        except LogError as error:
            sources.lose(error)
        progress((i + 1) / len(logs))


def _best_of_each(scores: Float64, sources: Int64) -> Int64:
    """Return the row of the best span of each source, the first of equal ones."""
    order = np.lexsort((-scores, sources))
    return order[np.flatnonzero(np.diff(sources[order], prepend=-1))]


def spread(scores: Float64, spans: JudgeableSpans, count: int) -> Int64:
    """Choose the rows of up to `count` best spans, spread over days and classes.

    Each step adds the span with the highest score / sqrt((1 + c) (1 + d)), where c and d are the
    numbers of spans of its class and of its day chosen already; the first of equal ones. Rows are
    in the order of choice; spans, at least one, are in any order.
    """
    _, day = np.unique(spans.starts // DAY, return_inverse=True)
    label = spans.labels
    order = np.lexsort((-scores, label, day))  # only the best span of a day and class can be next
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
