"""The recent time of a home that two models are compared on, and its frames by both."""

from collections.abc import Iterator, Sequence

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.gate.changes import A_DAY, Changes, changes_of_frames
from hearthlog.analyzer.gate.recent_time import (
    RecentLog,
    WeightedPart,
    choose,
    learned_time,
    minutes_a_day,
    recorded_minutes,
    sounding_time,
    unlearned_time,
)
from hearthlog.analyzer.gate.reference import Sound, reference, spans_of
from hearthlog.analyzer.gate.two_models import NO_FRAMES, LabelledFrames, TwoModels
from hearthlog.analyzer.logs.spans import Spans, joined
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import LogError, Progress

KnownSounds = list[tuple[RecentLog, list[Sound]]]


def known_sounds(logs: Sequence[RecentLog], losses: list[str]) -> KnownSounds:
    """Read the sounds of each log whose labels are known."""
    known, paths = [], [log.path for log in logs]
    for place, log in enumerate(logs, 1):
        try:
            known.append((log, reference(log.path, paths[place:])))
        except (DataError, LogError) as error:
            losses.append(str(error))
    return known


def learned_by(before: Model, after: Model, known: KnownSounds) -> Spans:
    """Return the time that one of two models has learned from."""
    chosen = [(s.start, s.end) for _, sounds in known for s in sounds if not s.random]
    marked = spans_of(chosen)
    both = [learned_time(model, marked) for model in (before, after)]
    starts, ends = (np.concatenate(edges) for edges in zip(*both, strict=True))
    return joined(starts, ends)


def unlearned_sample(logs: Sequence[RecentLog], learned: Spans) -> list[WeightedPart]:
    """Choose parts of the time that no model has learned from."""
    return choose(unlearned_time(logs, learned), sounding_time(logs))


def label_parts(
    models: TwoModels, parts: Sequence[WeightedPart], losses: list[str], progress: Progress
) -> Iterator[LabelledFrames]:
    """Label one part after the other; of one that cannot be read there are no frames.

    Parameters
    ----------
    progress : callable
        Is told the share of the parts that is done, 0 to 1.
    """
    for i, (part, weight) in enumerate(parts):
        try:
            frames = models.label(part, weight)
        except LogError as error:
            losses.append(str(error))
            frames = NO_FRAMES
        progress((i + 1) / len(parts))
        yield frames


def changes_of_sample(
    classes: Sequence[str], frames: LabelledFrames, logs: Sequence[RecentLog], sure: float = 0.0
) -> Changes:
    """Count what changes in a mean day, or in all if less than a day is recorded.

    Parameters
    ----------
    sure : float, optional
        Probability: only frames count of which the first model is as sure.
    """
    share = frames.weight / max(frames.weight.sum(), 1.0)
    day = minutes_a_day(logs)
    minutes = share * (recorded_minutes(logs) if day is None else day)
    counted = minutes * (frames.confidence >= sure)
    each = "" if day is None else A_DAY
    return changes_of_frames(classes, frames.before, frames.after, counted, each)
