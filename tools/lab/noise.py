"""`python -m hearthlog.tools.lab.noise CLIPS`: whether removing noise before the features helps.

Clips are laid into noise that began four seconds before them (`noise_sounds`). The room's floor is
what the recorder's tracker knows when the clip begins. Classifiers that were learned from other
sources, or other collections, label the clips as they are in the noise, and after a remover:
learned as always, and learned from sound that the remover went over.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.training.clips import RoomCopy
from hearthlog.analyzer.training.dataset import Dataset, Recording, cut_recordings
from hearthlog.analyzer.training.manifest import BUILTIN, Scenario
from hearthlog.analyzer.training.method import Learned, Method, prepare
from hearthlog.analyzer.training.scores import F1Difference, Scores, difference, score
from hearthlog.analyzer.training.train import Kind, divide
from hearthlog.analyzer.training.window_methods import PAPER, ROOM
from hearthlog.models.features import FeatureSet, of_segments
from hearthlog.models.features.floor import FloorTracker, low_power
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.noise_removers import Remover, SpectralSubtraction, Wiener
from hearthlog.tools.lab.noise_sounds import (
    CONDITIONS,
    LEAD_FRAMES,
    QUIET,
    RATIOS,
    SEED,
    Condition,
    Sounds,
    in_condition,
    in_lesson,
    read_sounds,
)

METHODS = {method.name: method for method in (ROOM, PAPER)}
REMOVERS = {
    "spectral, 8 s": Remover(SpectralSubtraction, 8.0),
    "wiener, 8 s": Remover(Wiener, 8.0),
}
ALL = "all"  # noises of a level, together
_MOST_SEGMENTS = 4
_AT_ONCE = 32  # sounds
_FLOOR_ERROR_DB = 1.5  # as of the copies in other rooms

Way = int | Condition  # a lesson, of which the first is the clip as it is, or what is tried


class Outcome(NamedTuple):
    """What removing noise changes, in one condition.

    Attributes
    ----------
    before : Scores
        Without a remover.
    after : Scores
    change : F1Difference
    """

    before: Scores
    after: Scores
    change: F1Difference


def versions(
    sounds: Sounds, removers: Mapping[str, Remover | None], features: FeatureSet, lessons: int
) -> dict[str, list[list[RoomCopy]]]:
    """Compute the features of each clip, as it is learned from and in all conditions.

    Parameters
    ----------
    sounds : Sounds
    removers : mapping of str to Remover, or None
        That go over the sound before.
    features : FeatureSet
        A set with bands.
    lessons : int
        Number of versions to learn from.

    Returns
    -------
    dict of str to list of list of RoomCopy
        By remover and clip, the versions to learn from and then those of `CONDITIONS`; none for a
        clip shorter than a window.
    """
    lengths = np.array([len(one) for one in sounds.frames])
    order = np.argsort(lengths, kind="stable")
    order = order[lengths[order] >= features.window_frames]
    copies: dict[str, list[list[RoomCopy]]] = {name: [[] for _ in lengths] for name in removers}
    for start in range(0, len(order), _AT_ONCE):
        batch = order[start : start + _AT_ONCE].tolist()
        count = int(lengths[batch].max()) * FRAME_SAMPLES
        for way in (*range(lessons), *CONDITIONS):
            laid = np.stack([_laid(sounds, number, way, count) for number in batch])
            for name, remover in removers.items():
                kept = laid if remover is None else remover(laid)
                for number, sound in zip(batch, kept, strict=True):
                    copies[name][number].append(_version(sounds, number, sound, features, way))
    return copies


def _laid(sounds: Sounds, number: int, way: Way, count: int) -> Float32:
    if isinstance(way, Condition):
        return in_condition(sounds, number, way, count)
    return in_lesson(sounds, number, way, count)


def _version(
    sounds: Sounds, number: int, sound: Float32, features: FeatureSet, way: Way
) -> RoomCopy:
    """Compute the features of a clip, and the floor of a lesson or the one that was tracked."""
    length = LEAD_FRAMES + len(sounds.frames[number])
    values = features.extractor()(sound[: length * FRAME_SAMPLES].reshape(length, FRAME_SAMPLES))
    floor = np.zeros(features.bands)
    if features.band_powers is not None:
        silence = sounds.is_silence(number)
        floor = _floor(features.band_powers(values), number, way, silence=silence)
    return RoomCopy(values[LEAD_FRAMES:], floor)


def _floor(powers: Float64, number: int, way: Way, *, silence: bool) -> Float64:
    """Return the floor of the room as a recorder, or as training knows it."""
    before, clip = powers[:LEAD_FRAMES], powers[LEAD_FRAMES:]
    if isinstance(way, Condition):
        return FloorTracker()(before, 0).powers[-1]
    floor = low_power(clip) if silence else before[LEAD_FRAMES // 4 :].mean(axis=0)
    if way == 0:
        return floor if silence else np.zeros_like(floor)
    rng = np.random.default_rng([SEED, number, way])
    error: Float64 = 10.0 ** (rng.normal(0.0, _FLOOR_ERROR_DB, len(floor)) / 10.0)
    return floor * error


def segments_of(
    sounds: Sounds, scenario: Scenario, method: Method, copies: Sequence[Sequence[RoomCopy]]
) -> tuple[Dataset, list[Dataset]]:
    """Cut clips into segments, the same ones whatever the remover.

    Parameters
    ----------
    sounds : Sounds
    scenario : Scenario
    method : Method
    copies : sequence of sequence of RoomCopy
        Of each clip, as of `versions`.

    Returns
    -------
    lessons : Dataset
        To learn from.
    heard : list of Dataset
        The same segments in each of `CONDITIONS`.
    """
    features, lessons = method.features, 1 + method.rooms
    recordings = [
        Recording(
            *(clip.label, clip.source_group, clip.source, clip.licence),
            features=features.extractor()(frames),
            copies=versions,
            most=_MOST_SEGMENTS,
        )
        for clip, frames, versions in zip(sounds.clips, sounds.frames, copies, strict=True)
    ]
    data = cut_recordings(recordings, scenario, features)
    pairs = list(zip(data.copies, data.copy_floor, strict=True))
    heard = [replace(data, windows=w, floor=f, copies=data.copies[:0]) for w, f in pairs[lessons:]]
    learned = replace(
        data,
        windows=data.copies[0],
        floor=data.copy_floor[0],
        copies=data.copies[1:lessons],
        copy_floor=data.copy_floor[1:lessons],
    )
    return learned, heard


def learned_by_fold(data: Dataset, method: Method, kind: Kind) -> list[tuple[Learned, Indices]]:
    """Learn from all but a fold, for each fold.

    Returns
    -------
    list of (Learned, np.ndarray [shape=(m,)])
        With the segments of the fold.
    """
    examples = prepare(method, data)
    return [(method.fit(examples, seen), unseen) for seen, unseen in divide(data, kind)]


def predicted(learned: Sequence[tuple[Learned, Indices]], data: Dataset, method: Method) -> Indices:
    """Return the classes of segments, each by the classifier that was not learned from it.

    Parameters
    ----------
    learned : sequence of (Learned, np.ndarray [shape=(m,)])
        As of `learned_by_fold`.
    data : Dataset
        The segments as they are heard.
    method : Method
    """
    inputs = of_segments(method.features.inputs[method.inputs], data.windows, data.floor)
    classes = np.empty(len(data), np.intp)
    for machine, unseen in learned:
        windows = inputs[unseen]
        decisions = machine.decide(windows.reshape(-1, windows.shape[-1]), len(data.classes))
        means = decisions.reshape(*windows.shape[:2], -1).mean(axis=1)
        classes[unseen] = means.argmax(axis=1)
    return classes


def compare(
    sounds: Sounds,
    scenario: Scenario,
    method: Method,
    removers: Mapping[str, Remover],
    kinds: Sequence[Kind],
) -> Iterator[tuple[Kind, str, str, dict[str, Outcome]]]:
    """Compare what a method says with and without removers.

    Parameters
    ----------
    sounds : Sounds
    scenario : Scenario
    method : Method
    removers : mapping of str to Remover
    kinds : sequence of str
        What is never on both sides of a fold.

    Yields
    ------
    kind : str
    remover : str
    learned : str
        `as always`, or `with it` where the remover went over what was learned from, too.
    outcomes : dict of str to Outcome
        As of `outcomes_of`.
    """
    features, lessons_each = method.features, 1 + method.rooms
    copies = versions(sounds, {"none": None, **removers}, features, lessons_each)
    lessons, plain = segments_of(sounds, scenario, method, copies["none"])
    always = {kind: learned_by_fold(lessons, method, kind) for kind in kinds}
    before = {k: [predicted(always[k], one, method) for one in plain] for k in kinds}
    for name in removers:
        lessons, heard = segments_of(sounds, scenario, method, copies[name])
        for kind in kinds:
            ways = {"as always": always[kind], "with it": learned_by_fold(lessons, method, kind)}
            for way, learned in ways.items():
                after = [predicted(learned, one, method) for one in heard]
                yield kind, name, way, outcomes_of(lessons, before[kind], after)


def outcomes_of(
    data: Dataset, before: Sequence[Indices], after: Sequence[Indices]
) -> dict[str, Outcome]:
    """Score segments in each condition, and in all noises of a level together.

    Parameters
    ----------
    data : Dataset
    before, after : sequence of np.ndarray [shape=(n,)], intp
        Classes of its segments in each of `CONDITIONS`, without a remover and with it.

    Returns
    -------
    dict of str to Outcome
        By the name of the condition.
    """
    places = {condition.name: [place] for place, condition in enumerate(CONDITIONS)}
    for ratio in RATIOS:
        alike = [place for place, one in enumerate(CONDITIONS) if one.ratio == ratio]
        places |= {Condition(ALL, ratio).name: alike} if alike else {}
    return {
        name: _outcome(data, [before[n] for n in numbers], [after[n] for n in numbers])
        for name, numbers in places.items()
    }


def _outcome(data: Dataset, before: Sequence[Indices], after: Sequence[Indices]) -> Outcome:
    sure, times, classes = np.eye(len(data.classes)), len(before), data.classes
    target, group = np.tile(data.target, times), np.tile(data.group, times)
    first, second = np.concatenate(before), np.concatenate(after)
    return Outcome(
        score(target, first, group, classes),
        score(target, second, group, classes),
        difference(target, sure[first], sure[second], group, classes),
    )


def won_back(outcomes: Mapping[str, Outcome], name: str) -> float:
    """Return the share of what noise cost in macro F1 that a remover wins back.

    Parameters
    ----------
    outcomes : mapping of str to Outcome
        As of `outcomes_of`.
    name : str
        Of the condition.
    """
    cost = outcomes[QUIET].before.macro_f1 - outcomes[name].before.macro_f1
    return outcomes[name].change.macro_f1 / cost if cost > 0.0 else np.nan


def lines_of(outcomes: Mapping[str, Outcome]) -> Iterator[str]:
    """Return a line for each condition.

    Parameters
    ----------
    outcomes : mapping of str to Outcome
        As of `outcomes_of`.
    """
    for name, one in outcomes.items():
        low, high = one.change.interval or (np.nan, np.nan)
        share = won_back(outcomes, name)
        back = "" if np.isnan(share) else f"{share:6.0%}"
        yield (
            f"  {name:20} {one.before.macro_f1:.3f} {one.after.macro_f1:.3f}  "
            f"{one.change.macro_f1:+.3f} ({low:+.3f} to {high:+.3f}) {back}"
        )


def main(
    clips: Annotated[Path, typer.Argument(help="Manifest of labelled clips.")],
    scenario: Annotated[Literal["bathroom", "general"], typer.Option()] = "general",
    method: Annotated[Literal["room", "paper"], typer.Option()] = "room",
    folds: Annotated[
        Literal["source", "collection"] | None, typer.Option(show_default="both")
    ] = None,
) -> None:
    """Print macro F1 without and with a remover, the change, and the share that is won back."""
    chosen = BUILTIN[scenario]
    sounds = read_sounds(clips, chosen)
    noises = len(sounds.noises["recorded"])
    print(f"{scenario}: {len(sounds.clips)} clips, {noises} recorded noises")
    kinds: list[Kind] = [folds] if folds else ["source", "collection"]
    for kind, remover, way, outcomes in compare(sounds, chosen, METHODS[method], REMOVERS, kinds):
        print(f"\n{method}, folds by {kind}, {remover}, learned {way}: without, with, change")
        print(*lines_of(outcomes), sep="\n", flush=True)


if __name__ == "__main__":
    run(main)
