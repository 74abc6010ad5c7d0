"""Spans in which another model would say something else than the one that labels now."""

from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.event_scores import Events, events_of
from hearthlog.analyzer.gate.paired_labels import ChangedTime, find_changed_time
from hearthlog.analyzer.gate.promotion_check import find_champion, other_features
from hearthlog.analyzer.gate.recent_time import recent_logs
from hearthlog.analyzer.logs.labelling import Labellings, NamedLabelling
from hearthlog.analyzer.logs.spans import overlay
from hearthlog.analyzer.review.queue.judgeable_spans import (
    JudgeableSpans,
    judgeable_spans,
    without,
)
from hearthlog.analyzer.review.queue.ranking import spread
from hearthlog.analyzer.review.queue.review_list import CHANGE, ReviewSpan
from hearthlog.analyzer.review.queue.reviewed_time import reviewed_time
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import Progress, ignore_progress
from hearthlog.schemas.messages.topics import LIVE, labelling_topic, relabelling


def changed_by(  # noqa: PLR0913, PLR0917
    model: tuple[Path, Model],
    side: NamedLabelling,
    sources: Labellings,
    microphone: str,
    count: int,
    progress: Progress = ignore_progress,
) -> list[ReviewSpan]:
    """Choose spans in which a model says something else than the one that labels now.

    Parameters
    ----------
    side : NamedLabelling
        The labelling to be reviewed. Where it says something else than the model that labels now,
        as of older logs it may, nothing is asked.
    count : int
        How many, at most.
    progress : callable, optional
        Is told the share of the sound that is done, 0 to 1.

    Returns
    -------
    list of ReviewSpan
        Those of the largest changes first, spread over changes and days, of each the longest first.
        The score is minutes a day, if a day is recorded.

    Raises
    ------
    DataError
        If the model cannot be compared, or changes nothing that a person could judge.
    ModelError
        As `find_champion`, and if a feature set is not installed.
    """
    folder, after = model
    topic = labelling_topic(microphone, LIVE, "segment")
    paths = [log.path for log in sources.with_topic(topic)]
    before = _champion(folder, after, paths)
    changed = find_changed_time(before, after, recent_logs(paths), microphone, progress)
    sources.losses.extend(loss for loss in changed.losses if loss not in sources.losses)
    left = without(_where(changed, side), reviewed_time(sources, microphone).spans)
    spans = judgeable_spans(left)
    if not len(spans):
        raise DataError(
            f"{after.name}: no span is left in which it says something else than {before.name}"
        )
    return _listed(spans, changed, side.name, microphone, after.name, count)


def _champion(folder: Path, model: Model, paths: list[Path]) -> Model:
    champion = find_champion(folder, paths, model)
    if champion is None:
        raise DataError(f"{model.name}: no model labels here yet, so there is nothing to change")
    if champion.sha256 == model.sha256:
        raise DataError(f"{model.name} labels here already: name a model that would change that")
    if other := other_features(champion, model):
        raise DataError(f"{model.name}: {other}")
    return champion


def _where(changed: ChangedTime, side: NamedLabelling) -> Events:
    """Return the changed time in which a labelling says what the first model does."""
    classes, labels = changed.changes.classes, side.called_as(changed.changes.classes)
    every = list(dict.fromkeys([*classes, *labels.classes]))
    said = events_of(labels.labelling, every)
    parts = overlay([changed.spans, said]).in_all()
    pairs = changed.spans.labels[parts.rows[0]]
    same = pairs // len(classes) == said.labels[parts.rows[1]]
    return Events(parts.starts[same], parts.ends[same], pairs[same])


def _listed(  # noqa: PLR0913, PLR0917
    spans: JudgeableSpans,
    changed: ChangedTime,
    a: str,
    microphone: str,
    model: str,
    count: int,
) -> list[ReviewSpan]:
    """List the spans to be asked, at most one of what changes without a break."""
    classes, changes = changed.changes.classes, changed.changes
    _, first = np.unique(spans.sources, return_index=True)
    ordered = first[np.argsort(spans.starts[first] - spans.ends[first], kind="stable")]
    longest = spans.take(ordered)
    minutes = changes.minutes.reshape(-1)[longest.labels]
    rows = spread(minutes, longest, count)
    chosen, score = longest.take(rows), minutes[rows].round(1).tolist()
    columns = (column.tolist() for column in (chosen.starts, chosen.ends, chosen.labels))
    return [
        ReviewSpan(
            microphone,
            start,
            end,
            a,
            classes[pair // len(classes)],
            relabelling(model),
            classes[pair % len(classes)],
            much if changes.each else None,
            CHANGE,
        )
        for start, end, pair, much in zip(*columns, score, strict=True)
    ]
