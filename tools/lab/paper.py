"""The figures of the paper, and what its method and ours reach on its folds and on honest ones.

Run by `python -m hearthlog.tools.lab.paper`.

The paper is "A ROS framework for audio-based activity recognition" (Giannakopoulos and others,
PETRA 2016). It says the F1 of two scenarios (section 5), and neither of which average nor by which
folds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.dataset import Dataset, Recording, build_dataset, clip_recordings
from hearthlog.analyzer.training.manifest import (
    BUILTIN,
    LABELS,
    LabelledClip,
    Scenario,
    SkippedClip,
    left_out_lines,
)
from hearthlog.analyzer.training.method import Method
from hearthlog.analyzer.training.train import (
    DEFAULT,
    KINDS,
    CrossValidation,
    Kind,
    check_varied,
    divide,
    evaluate_method,
)
from hearthlog.analyzer.training.window_methods import PAPER
from hearthlog.schemas.errors import Progress, ignore_progress, shortened
from hearthlog.tools.cli.options import Clips, Json, labelled_clips
from hearthlog.tools.cli.tables import between, share
from hearthlog.tools.cli.terminal import (
    NAME_WIDTH,
    end_with_warnings,
    number,
    print_json,
    print_table,
    share_done,
)
from hearthlog.tools.lab.command import run

PAPER_F1 = {"bathroom": 0.89, "general": 0.81}
METHODS: tuple[Method, ...] = (PAPER, DEFAULT)
_MOSTLY = 0.7  # share of a class that is of one collection
_THIN = 20  # sources
_SCORES = ("precision", "recall", "F1", "95 %")
_WHY = """\
why they differ
- Folds by segment are the paper's: its published code draws the windows to test on at random, of
  windows that begin 50 ms apart. Seconds of one recording are alike, so what is tested is half
  known. The figure says how well recordings are told apart that were learned from.
- Folds by source keep the seconds of a recording, or of a speaker, on one side. The figure is of
  new sounds, by microphones and in rooms that were learned from.
- Folds by collection leave out all that a collection recorded, as a home is of which nothing was
  learned. The classes of a collection share a signature (microphone, room, codec), and a class that
  is mostly of one collection is hardly learned without it.
- Macro F1 is the mean over classes: a class of few sources counts as much as any other. The code of
  the paper prints this mean as F1. The share right (micro F1) counts segments.
- The 95 % are of other draws of sources. They do not know how other collections would be.
- paper learns from the mean and deviation of 21 features over a second, with an RBF support vector
  machine. room, the default, learns from 33 features above the floor of the room, and from copies
  in other rooms; here without the class unknown, which the paper has not.
- The 45 minutes of sound of the paper are not published. These clips are others."""


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
    left_out : sequence of SkippedClip
        Clips that could not be read.
    """

    scenario: str
    paper_f1: float
    sound: Mapping[str, ClassSound]
    sources: int
    collections: int
    results: Mapping[tuple[str, Kind], CrossValidation]
    skipped: Mapping[str, int]
    left_out: Sequence[SkippedClip]


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


def main(
    *,
    data: Clips,
    scenario: Annotated[
        Literal["bathroom", "general"] | None,
        typer.Option(help="Only this one.", show_default="both"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Put the figures of the paper beside those of its method and of ours, on these clips."""
    left_out: list[SkippedClip] = []
    clips = labelled_clips([data], LABELS, left_out)
    scenarios = [scenario] if scenario else list(PAPER_F1)
    with share_done(f"learning from {number(len(clips), 'clip')}", announce=True) as progress:
        found = reproduce(clips, scenarios, progress)
    left_out += dict.fromkeys(clip for one in found for clip in one.left_out)
    if as_json:
        print_json({one.scenario: _as_json(one) for one in found})
    else:
        for one in found:
            print_reproduction(one)
        print(_WHY)
    end_with_warnings(left_out_lines(left_out))


def print_reproduction(found: Reproduction) -> None:
    """Print what the paper reports of a scenario, and how its method and ours do on each class."""
    segments = sum(one.segments for one in found.sound.values())
    print(
        f"{found.scenario}: {segments} segments of 1 s from {number(found.sources, 'source')} in "
        f"{number(found.collections, 'collection')}\n"
    )
    methods = list(dict.fromkeys(method for method, _ in found.results))
    kinds = list(dict.fromkeys(kind for _, kind in found.results))
    rows = [("the paper reports", f"{found.paper_f1:.2f}", *("" for _ in kinds[1:]))]
    for method in methods:
        results = [found.results[method, kind] for kind in kinds]
        rows += [
            (f"{method}: macro F1", *(share(one.scores.macro_f1) for one in results)),
            ("  95 %", *(between(one.scores.macro_f1_interval) for one in results)),
            ("  share right", *(share(share_right(one.scores.confusion)) for one in results)),
        ]
    print_table(("folds by", *kinds), rows)
    print()
    rows = [
        (
            shortened(name, NAME_WIDTH),
            *map(str, (one.segments, one.sources, one.collections)),
            share(one.largest),
        )
        for name, one in found.sound.items()
    ]
    print_table(("class", "segments", "sources", "collections", "largest"), rows)
    print()
    heads = [(f"{method}: {_SCORES[0]}", *_SCORES[1:]) for method in methods]
    rows = [
        (
            shortened(name, NAME_WIDTH) if kind == kinds[0] else "",
            kind,
            *(cell for method in methods for cell in _cells(found.results[method, kind], name)),
        )
        for name in found.sound
        for kind in kinds
    ]
    print_table(("class", "folds by", *(cell for head in heads for cell in head)), rows, words=2)
    print(f"\n{_thin_text(found)}\n")


def _cells(result: CrossValidation, name: str) -> tuple[str, ...]:
    one = result.scores.per_class[name]
    return (*map(share, (one.precision, one.recall, one.f1)), between(one.f1_interval))


def _thin_text(found: Reproduction) -> str:
    """Say which classes the figures know little of."""
    few = [name for name, one in found.sound.items() if one.sources < _THIN]
    one_sided = [name for name, one in found.sound.items() if one.largest > _MOSTLY]
    return (
        f"fewer than {_THIN} sources: {', '.join(few) or 'none'}\n"
        f"more than {_MOSTLY:.0%} from one collection, which folds by collection leave out: "
        f"{', '.join(one_sided) or 'none'}"
    )


def _as_json(found: Reproduction) -> dict[str, Any]:
    results: dict[str, dict[str, Any]] = {}
    for (method, kind), one in found.results.items():
        results.setdefault(method, {})[kind] = {
            "folds": one.folds,
            "share_right": share_right(one.scores.confusion),
            **asdict(one.scores),
        }
    return {
        "paper_f1": found.paper_f1,
        "sources": found.sources,
        "collections": found.collections,
        "sound": {name: one._asdict() for name, one in found.sound.items()},
        "methods": results,
        "skipped": dict(found.skipped),
    }


if __name__ == "__main__":
    run(main)
