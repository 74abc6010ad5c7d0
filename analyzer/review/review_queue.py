"""Queue of a review: which spans of a labelling, in which order, and why."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labelling import Labellings, NamedLabelling
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, union
from hearthlog.analyzer.marks.marks import QUEUE, RANDOM
from hearthlog.analyzer.promotion.paired_labels import A_DAY, class_words, time_words
from hearthlog.analyzer.review.candidates import (
    MINUTE,
    ReviewedTime,
    changed_by,
    complete_minutes,
    draw_minutes,
    hinted_spans,
    reviewed_time,
)
from hearthlog.analyzer.review.lanes import labelling_in_words
from hearthlog.analyzer.review.ranking import DISAGREEING, RANKINGS, USEFUL, make_queue
from hearthlog.analyzer.review.review_list import (
    CHANGE,
    HINT,
    ReviewSpan,
    check_scenario,
    chosen_as,
    queued,
    random_minutes,
    read_spans,
)
from hearthlog.analyzer.review.spans import LEAST_AUDIBLE
from hearthlog.models.classes import in_words
from hearthlog.models.classifiers.model import Model
from hearthlog.models.registry import DEFAULT_FOLDER, load
from hearthlog.schemas.errors import ModelError, Progress, ignore_progress
from hearthlog.schemas.messages.topics import is_review, scenario_name


class ReviewItem(NamedTuple):
    """A span to review."""

    start: int
    end: int
    label: str
    text: str
    chosen: str = QUEUE
    is_audible: bool = True  # unless less than a quarter of a second of its sound was kept


QUEUES = (*RANKINGS, RANDOM, HINT)
_WHY = {
    "uncertainty": "unsure",
    "disagreement": "they differ",
    "novelty": "a new kind of sound",
    USEFUL: "useful to learn from",
}
_TEN = 10  # a person needs ten minutes for them
_MINUTE_EVERY = 5  # items of a queue of useful spans
_MINUTES_LEFT = 10  # labelled minutes per drawn one, or a short log would have no useful span
Limits = tuple[int | None, int | None]


def review_items(spans: Iterable[ReviewSpan], audible: Spans | None = None) -> list[ReviewItem]:
    """Return the items of a review, in span order; `audible` is the time with kept sound."""
    return [
        ReviewItem(
            span.start,
            span.end,
            span.proposed_label,
            _text(span),
            chosen_as(span),
            audible is None or cut(audible, span.start, span.end).length >= LEAST_AUDIBLE,
        )
        for span in spans
    ]


def queue_spans(  # noqa: PLR0913, PLR0917
    queue: str,
    sources: Labellings,
    labelled: tuple[str, str],
    limits: Limits,
    count: int | None,
    models: Path = DEFAULT_FOLDER,
    progress: Progress = ignore_progress,
    audible: Spans | None = None,
) -> list[ReviewSpan]:
    """Choose up to `count` spans of a labelling for a review; None is ten, or all of a list.

    `queue` is one of `QUEUES`, a list (`*.csv`) made by `hearthlog diff`, or a model whose changes
    are requested: its name in the folder of models, or its file. Every fifth item of a `useful`
    queue is a minute drawn at random, and every item of a `random` queue. Limits are nanoseconds of
    UTC; None for no limit. `progress` receives the share of the logs that is read, 0 to 1.

    Raise `DataError` if there is nothing to review, or the list or model does not exist; for a
    scenario also if random minutes or the changes of a model are requested; `ModelError` if the
    current model cannot be found or used; `LogError` if the labelling has no segment in these
    limits, or its segments overlap or are invalid.
    """
    microphone, labelling = labelled
    scenario = scenario_name(labelling)
    if queue.endswith(".csv"):
        return _listed(Path(queue), microphone, limits, scenario)[:count]
    if scenario and queue not in RANKINGS:
        raise DataError(f"--queue {queue[:64]}: of a scenario use {', '.join(RANKINGS)}, or a list")
    model = None if queue in QUEUES else _model(queue, models)
    side = sources.read(microphone, labelling, *limits)
    if model is not None:
        return changed_by(model, side, sources, microphone, count or _TEN, progress)
    done, wanted = reviewed_time(sources, microphone, scenario), count or _TEN
    if queue == HINT:
        return hinted_spans(side, sources, microphone, done.spans, wanted)
    others = [name for name in sources.names(microphone) if _is_comparable(name, labelling)]
    if queue == DISAGREEING and not others:
        raise DataError("no other labelling to disagree with: `hearthlog relabel` makes one")
    other = sources.read(microphone, others[0], *limits) if others else None
    minutes = NONE if scenario else _drawn(queue, side, done, wanted)
    drawn_at_random = random_minutes(minutes, side, microphone)
    if queue == RANDOM:
        if not drawn_at_random:
            raise DataError(f"{labelling}: no whole minute is left to draw")
        return drawn_at_random
    try:
        chosen = make_queue(
            sources,
            microphone,
            side,
            other=other,
            reviewed=union(done.spans, minutes),
            count=wanted - len(drawn_at_random),
            ranking=queue,
            models=models,
            audible=audible,
            progress=progress,
        )
    except DataError:
        if not drawn_at_random:
            raise
        return drawn_at_random
    spans = queued(chosen, microphone, labelling, other.name if other else "")
    return _mixed(spans, drawn_at_random)


def _drawn(queue: str, side: NamedLabelling, done: ReviewedTime, wanted: int) -> Spans:
    """Draw minutes at random: all items of a random queue, some of a useful one."""
    if queue not in {USEFUL, RANDOM}:
        return NONE
    there = complete_minutes(side.labelling)
    few = min(wanted // _MINUTE_EVERY, len(there.starts) // _MINUTES_LEFT)
    drawn = draw_minutes(there, wanted if queue == RANDOM else few, done.random, done.spans)
    return Spans(drawn, drawn + MINUTE)


def _is_comparable(name: str, labelling: str) -> bool:
    """Return whether another labelling is by a model with the same classes to choose from."""
    return not (
        scenario_name(labelling) or scenario_name(name) or name == labelling or is_review(name)
    )


def _model(queue: str, models: Path) -> tuple[Path, Model]:
    """Load the model whose changes are requested; return its folder, too."""
    place = Path(queue)
    folder = models if place.name == queue else place.parent
    try:
        return folder, load(folder, place.name)
    except ModelError as error:
        raise DataError(
            f"--queue {queue[:64]}: use {', '.join(QUEUES)}, a list *.csv of `diff --list`, or a "
            f"model ({error})"
        ) from error


def _listed(path: Path, microphone: str, limits: Limits, scenario: str) -> list[ReviewSpan]:
    start, end = limits
    spans = [
        span
        for span in read_spans(path)
        if span.microphone == microphone
        and (start is None or span.end > start)
        and (end is None or span.start < end)
    ]
    if not spans:
        raise DataError(f"{path}: lists nothing of {microphone} in these logs")
    check_scenario(path, spans, scenario, "--labels")
    return spans


def _mixed(spans: Sequence[ReviewSpan], minutes: Sequence[ReviewSpan]) -> list[ReviewSpan]:
    """Insert a minute after every four spans, and the remaining minutes at the end."""
    mixed, left = list[ReviewSpan](), list(minutes)
    for number, span in enumerate(spans, 1):
        mixed.append(span)
        if left and number % (_MINUTE_EVERY - 1) == 0:
            mixed.append(left.pop(0))
    return mixed + left


def _text(span: ReviewSpan) -> str:
    new, old = (labelling_in_words(name) for name in (span.b, span.a))
    if span.reason == CHANGE:
        much = "" if span.score is None else f": {time_words(span.score)}{A_DAY}"
        return f"{new} says {class_words(span.label_b)}, {old} {class_words(span.label_a)}{much}"
    if span.reason == HINT:
        return f"the network: {class_words(span.label_b)}? {old}: {class_words(span.label_a)}"
    label, other = (in_words(name).lower() for name in (span.label_a, span.label_b))
    if span.reason == RANDOM:
        return f"{old}: mostly {label}; drag over each wrong sound and press its key"
    second = f", {new}: {other or 'nothing'}" if span.b else ""
    return f"{old}: {label}{second}, {_WHY[span.reason]}"
