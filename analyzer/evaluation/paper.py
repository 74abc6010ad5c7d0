"""The figures of the paper, and what its method and ours reach on its folds and on honest ones.

The paper is "A ROS framework for audio-based activity recognition" (Giannakopoulos and others,
PETRA 2016). It says the F1 of two scenarios (section 5), and neither of which average nor by which
folds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.evaluate_method import (
    KINDS,
    CrossValidation,
    Kind,
    divide,
    evaluate_method,
)
from hearthlog.analyzer.training.dataset import Dataset, Recording, build_dataset, clip_recordings
from hearthlog.analyzer.training.installed import DEFAULT
from hearthlog.analyzer.training.manifest import LabelledClip, LeftOut
from hearthlog.analyzer.training.method import Method
from hearthlog.analyzer.training.scenario import BUILTIN, Scenario
from hearthlog.analyzer.training.svm_method import PAPER
from hearthlog.analyzer.training.train import check_varied
from hearthlog.schemas.progress import Progress, ignore_progress

PAPER_F1 = {"bathroom": 0.89, "general": 0.81}
METHODS: tuple[Method, ...] = (PAPER, DEFAULT)


class ClassSound(NamedTuple):
    """Where the segments of a class come from.

    Attributes
    ----------
    segments, sources, collections : int
    largest : float
        Share of its segments that is of one collection.
    """

    segments: int
    sources: int
    collections: int
    largest: float


@dataclass(frozen=True)
class Reproduction:
    """A scenario of the paper, learned by its method and by ours.

    Attributes
    ----------
    scenario : str
    paper_f1 : float
        F1 that the paper reports, of sounds that it does not publish.
    sound : mapping of str to ClassSound
        By class.
    sources, collections : int
    results : mapping of (str, Kind) to CrossValidation
        By method and by what is never on both sides of a fold.
    skipped : mapping of str to int
        Number of clips that gave no segment, by the reason.
    left_out : sequence of LeftOut
        Clips that could not be read.
    """

    scenario: str
    paper_f1: float
    sound: Mapping[str, ClassSound]
    sources: int
    collections: int
    results: Mapping[tuple[str, Kind], CrossValidation]
    skipped: Mapping[str, int]
    left_out: Sequence[LeftOut]


def reproduce(
    clips: Sequence[LabelledClip], scenarios: Sequence[str], progress: Progress
) -> list[Reproduction]:
    """Cross-validate the method of the paper and the default one, by all kinds of folds.

    All are tried on the same segments of a second. There is no class `unknown`: the paper has none.

    Parameters
    ----------
    clips : sequence of LabelledClip
    scenarios : sequence of str
        Of `PAPER_F1`.
    progress : callable
        Told the share of the work that is done, 0 to 1.

    Raises
    ------
    DataError
        If a class has no segments, if the segments cannot be divided into folds of all kinds, as
        `divide` says, or if all of them are alike.
    """
    chosen = [BUILTIN[name] for name in scenarios]
    results: dict[str, dict[tuple[str, Kind], CrossValidation]] = {name: {} for name in scenarios}
    first: list[Dataset] = []
    steps = _steps(progress, len(METHODS) * (1 + len(chosen) * len(KINDS)))
    for method in METHODS:
        recordings = list(
            clip_recordings(clips, _together(chosen), next(steps), method.features, method.rooms)
        )
        data = [_segments(recordings, scenario, method) for scenario in chosen]
        first = first or data
        for one, scenario in zip(data, chosen, strict=True):
            for kind in KINDS:
                result = evaluate_method(one, method, kind, next(steps))
                results[scenario.name][method.name, kind] = result
    return [_reproduction(name, first[n], results[name]) for n, name in enumerate(scenarios)]


def share_right(confusion: Sequence[Sequence[int]]) -> float:
    """Return the share of segments that have their true class, which is the micro F1.

    Parameters
    ----------
    confusion : sequence of sequence of int
        At least one segment.
    """
    counts = np.array(confusion)
    return float(np.trace(counts) / counts.sum())


def _together(scenarios: Sequence[Scenario]) -> Scenario:
    """Return a scenario with the labels of all, so that each clip is read once."""
    labels = sorted(set().union(*(scenario.class_of for scenario in scenarios)))
    return Scenario("all", {label: (label,) for label in labels})


def _segments(recordings: Sequence[Recording], scenario: Scenario, method: Method) -> Dataset:
    """Cut recordings into segments, and refuse at once what no fold can be made of."""
    try:
        data = build_dataset((), scenario, ignore_progress, recordings, method.features)
        check_varied(data)
        for kind in KINDS:
            divide(data, kind)
    except DataError as error:
        raise DataError(f"scenario {scenario.name}: {error}") from error
    return data


def _reproduction(
    name: str, data: Dataset, results: Mapping[tuple[str, Kind], CrossValidation]
) -> Reproduction:
    return Reproduction(
        scenario=name,
        paper_f1=PAPER_F1[name],
        sound={one: _sound_of(data, number) for number, one in enumerate(data.classes)},
        sources=len(np.unique(data.group)),
        collections=len(np.unique(data.collection)),
        results=results,
        skipped=data.skipped,
        left_out=data.left_out,
    )


def _sound_of(data: Dataset, number: int) -> ClassSound:
    own = data.target == number
    counts = np.bincount(data.collection[own])
    return ClassSound(
        segments=int(own.sum()),
        sources=len(np.unique(data.group[own])),
        collections=int(np.count_nonzero(counts)),
        largest=float(counts.max() / own.sum()),
    )


def _steps(progress: Progress, count: int) -> Iterator[Progress]:
    """Return what reports the progress of each of equal steps."""

    def step(number: int) -> Progress:
        return lambda share: progress((number + share) / count)

    return map(step, range(count))
