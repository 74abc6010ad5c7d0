"""When another model says something else than the one that labels now."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hearthlog.analyzer.evaluation.event_scores import Events
from hearthlog.analyzer.gate.changes import Changes
from hearthlog.analyzer.gate.home_sample import (
    changes_of_sample,
    known_sounds,
    label_parts,
    learned_by,
    unlearned_sample,
)
from hearthlog.analyzer.gate.recent_time import RecentLog
from hearthlog.analyzer.gate.two_models import LabelledFrames, TwoModels, joined_frames
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS


@dataclass(frozen=True, eq=False)
class ChangedTime:
    """Where two models differ, in the sample that a model is judged by.

    Attributes
    ----------
    spans : Events
        In the order of time; the label is the row of the first model's class in `changes` times
        their number, and the column of the second one's.
    """

    spans: Events
    changes: Changes
    losses: list[str]


def find_changed_time(
    before: Model,
    after: Model,
    logs: Sequence[RecentLog],
    microphone: str,
    progress: Progress = ignore_progress,
) -> ChangedTime:
    """Run two models over the sample of the recent time of a home, as `gather_evidence` does.

    Parameters
    ----------
    progress : callable, optional
        Is told the share of the sound that is done, 0 to 1.

    Raises
    ------
    ModelError
        If the feature set of the models, or a kind of classifier, is not installed.
    """
    losses: list[str] = []
    learned = learned_by(before, after, known_sounds(logs, losses))
    models = TwoModels(before, after)
    parts = [
        one._replace(part=one.part._replace(microphone=microphone))
        for one in unlearned_sample(logs, learned)
    ]
    frames = joined_frames(list(label_parts(models, parts, losses, progress)))
    changes = changes_of_sample(models.classes, frames, logs)
    return ChangedTime(_differing(frames, len(models.classes)), changes, losses)


def _differing(frames: LabelledFrames, classes: int) -> Events:
    """Join successive frames that change in the same way."""
    order = np.argsort(frames.stamps)
    stamps, before, after = (column[order] for column in frames[:3])
    pairs = before * classes + after
    broken = np.diff(stamps, prepend=-FRAME_NANOSECONDS) > 1.5 * FRAME_NANOSECONDS
    first = np.flatnonzero(broken | (np.diff(pairs, prepend=-1) != 0))
    last = np.append(first[1:], len(stamps))[: len(first)] - 1
    spans = Events(stamps[first], stamps[last] + FRAME_NANOSECONDS, pairs[first])
    return spans.taken(before[first] != after[first])
