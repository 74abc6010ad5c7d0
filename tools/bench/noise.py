"""`python -m hearthlog.tools.bench.noise CLIPS`: whether removing noise before the features helps.

Clips are laid into noise that began four seconds before them: of a fan and of a refrigerator, which
are made, and of recordings of no class of the scenario whose level hardly changes (rain, the sea,
engines). The room's floor is what the recorder's tracker knows when the clip begins. Classifiers
that were learned from other sources, or other collections, label the clips as they are in the
noise, and after a remover: learned as always, and learned from sound that the remover went over.
"""

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.evaluate_method import Kind, divide
from hearthlog.analyzer.training.dataset import (
    Dataset,
    Recording,
    clip_frames,
    cut_recordings,
)
from hearthlog.analyzer.training.manifest import LabelledClip, read_manifest
from hearthlog.analyzer.training.method import Learned, Method, prepare
from hearthlog.analyzer.training.rooms import RoomCopy, level_of, other_room, steady_noise
from hearthlog.analyzer.training.scenario import BUILTIN, LABELS, Scenario
from hearthlog.analyzer.training.scores import F1Difference, Scores, difference, score
from hearthlog.analyzer.training.svm_method import PAPER, ROOM
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.floor import FloorTracker, low_power
from hearthlog.models.features.window_inputs import of_segments
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.bench.noise_removers import Remover, SpectralSubtraction, Wiener

METHODS = {method.name: method for method in (ROOM, PAPER)}
REMOVERS = {
    f"{name}, {memory:g} s": Remover(gain, memory)
    for name, gain, memory in (
        ("spectral", SpectralSubtraction, 8.0),
        ("wiener", Wiener, 8.0),
    )
}
NOISES = ("fan", "refrigerator", "recorded")
RATIOS = (20.0, 10.0, 5.0)  # dB
QUIET, ALL = "quiet room", "all"
_SEED = 20_261_124
_LEAD_FRAMES = 80  # 4 s: a section of the tracker of the floor
_LEAD = _LEAD_FRAMES * FRAME_SAMPLES
_MOST_CLIPS = 1  # of a source and label
_MOST_FRAMES = 80  # of a clip
_MOST_SEGMENTS = 4
_AT_ONCE = 32  # sounds
_QUIET_DBFS = -75.0  # noise of a microphone in a quiet room
_FLOOR_ERROR_DB = 1.5  # as of the copies in other rooms
_OVERTONES = 8
_MADE, _MADE_SECONDS = 8, 20
_NOISE_SECONDS, _NOISE_SPREAD_DB = 4.0, 3.0  # least length, most deviation of the level


class Machine(NamedTuple):
    """Noise of a machine: how its spectrum falls, its tone in hertz, and how loud that is."""

    slope: float
    hertz: float
    tone: float


_MACHINES = {"fan": Machine(0.75, 92.0, 0.5), "refrigerator": Machine(0.5, 100.0, 2.0)}


class Condition(NamedTuple):
    """Noise, and how far it is below the clip in dB; without a noise a quiet room."""

    noise: str | None
    ratio: float = np.inf

    @property
    def name(self) -> str:
        """In a table."""
        return QUIET if self.noise is None else f"{self.noise} {self.ratio:g} dB"


CONDITIONS = (Condition(None), *(Condition(noise, ratio) for noise in NOISES for ratio in RATIOS))


@dataclass(frozen=True)
class Sounds:
    """What is laid into noise.

    Attributes
    ----------
    clips : sequence of LabelledClip
    frames : sequence of np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        Of each clip.
    noises : mapping of str to sequence of np.ndarray [shape=(n,)], float32
        By name, those of `NOISES`.
    level : float
        Median level of the clips that are not silence, in dBFS: noise in a clip of silence is as
        far below it as in any other clip.
    """

    clips: Sequence[LabelledClip]
    frames: Sequence[Float32]
    noises: Mapping[str, Sequence[Float32]]
    level: float


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


def read_sounds(manifest: Path, scenario: Scenario) -> Sounds:
    """Read clips of a scenario, and those of no class in it that are noise.

    Raises
    ------
    DataError
        If the manifest cannot be read, or no recording is long and steady enough to be noise.
    """
    listed = read_manifest(manifest, LABELS)
    clips = _some_of_each_source([clip for clip in listed if scenario.find(clip.label)])
    frames = [clip_frames(clip)[:_MOST_FRAMES] for clip in clips]
    others = BUILTIN["bathroom"], BUILTIN["general"]
    rest = (clip for clip in listed if not any(one.find(clip.label) for one in others))
    recorded = [sound for clip in rest if is_steady(sound := clip_frames(clip).ravel())]
    if not recorded:
        raise DataError(
            f"{manifest}: no recording of another label than those of the scenarios is longer than "
            f"{_NOISE_SECONDS:g} s and as steady as noise"
        )
    levels = [
        level_of(one.ravel().astype(np.float64))
        for clip, one in zip(clips, frames, strict=True)
        if len(one) and class_name(clip.label) != SILENCE
    ]
    rng = np.random.default_rng(_SEED)
    noises = {name: [made_noise(name, rng) for _ in range(_MADE)] for name in _MACHINES}
    return Sounds(clips, frames, noises | {"recorded": recorded}, float(np.median(levels)))


def _some_of_each_source(clips: Sequence[LabelledClip]) -> list[LabelledClip]:
    """Choose the first clips of each source and label: so many are enough, and take hours else."""
    counts: Counter[tuple[str, str]] = Counter()
    chosen = []
    for clip in clips:
        counts[clip.source_group, clip.label] += 1
        if counts[clip.source_group, clip.label] <= _MOST_CLIPS:
            chosen.append(clip)
    return chosen


def is_steady(sound: Float32) -> bool:
    """Tell whether a sound is four seconds of a level that stays within some decibels.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float32
    """
    if len(sound) < _NOISE_SECONDS * SAMPLE_RATE:
        return False
    count = len(sound) * 5 // (2 * SAMPLE_RATE)  # blocks of 0.4 s
    blocks = np.square(sound[: count * SAMPLE_RATE * 2 // 5]).reshape(count, -1).mean(axis=1)
    return bool(np.std(10.0 * np.log10(blocks + 1e-12)) < _NOISE_SPREAD_DB and blocks.min() > 1e-7)


def made_noise(name: str, rng: np.random.Generator) -> Float32:
    """Make the steady noise of a machine: that of its air, and a tone with overtones.

    Parameters
    ----------
    name : str
        `fan` or `refrigerator`.
    rng : np.random.Generator

    Returns
    -------
    np.ndarray [shape=(n,)], float32
    """
    machine = _MACHINES[name]
    time = np.arange(_MADE_SECONDS * SAMPLE_RATE) / SAMPLE_RATE
    spectrum = np.fft.rfft(rng.standard_normal(len(time)))
    frequencies = np.maximum(np.fft.rfftfreq(len(time), 1.0 / SAMPLE_RATE), 20.0)
    noise = np.fft.irfft(spectrum / frequencies**machine.slope, len(time))
    noise /= noise.std()
    for number in range(1, _OVERTONES + 1):
        phase = 2.0 * np.pi * (machine.hertz * number * time + rng.random())
        noise += machine.tone / number * np.sin(phase)
    return noise.astype(np.float32)


def noise_of(
    pieces: Sequence[Float32], count: int, level: float, rng: np.random.Generator
) -> Float64:
    """Draw a noise, from any place on and as often as it takes.

    Parameters
    ----------
    pieces : sequence of np.ndarray [shape=(n,)], float32
        One of them is drawn.
    count : int
        Number of samples.
    level : float
        In dBFS.
    rng : np.random.Generator

    Returns
    -------
    np.ndarray [shape=(count,)], float64
    """
    piece = pieces[int(rng.integers(len(pieces)))]
    noise = np.resize(np.roll(piece, rng.integers(len(piece))), count).astype(np.float64)
    scaled: Float64 = noise * (10.0 ** (level / 20.0) / np.sqrt(np.mean(np.square(noise))))
    return scaled


def in_condition(sounds: Sounds, number: int, condition: Condition, count: int) -> Float32:
    """Lay a clip into noise that began before it; what is after the clip is noise.

    Parameters
    ----------
    sounds : Sounds
    number : int
        Of the clip.
    condition : Condition
    count : int
        Number of samples behind the time before the clip.

    Returns
    -------
    np.ndarray [shape=(_LEAD + count,)], float32
        As a microphone of 16 bits captures it.
    """
    place = CONDITIONS.index(condition)
    rng = np.random.default_rng([_SEED, number, place])
    clip = sounds.frames[number].ravel().astype(np.float64)
    silence = class_name(sounds.clips[number].label) == SILENCE
    noise = rng.standard_normal(_LEAD + count) * 10.0 ** (_QUIET_DBFS / 20.0)
    if condition.noise is not None:
        level = (sounds.level if silence else level_of(clip)) - condition.ratio
        noise += noise_of(sounds.noises[condition.noise], len(noise), level, rng)
    return captured_in(clip, noise, silence=silence)


def in_lesson(sounds: Sounds, number: int, place: int, count: int) -> Float32:
    """Lay a clip into noise as it is learned from: first as it is, then in other rooms.

    Parameters
    ----------
    sounds : Sounds
    number, place : int
        Of the clip, and of its copy; the first is the clip as it is.
    count : int
        Number of samples behind the time before the clip.

    Returns
    -------
    np.ndarray [shape=(_LEAD + count,)], float32
    """
    rng = np.random.default_rng([_SEED, number, len(CONDITIONS) + place])
    frames = sounds.frames[number]
    silence = class_name(sounds.clips[number].label) == SILENCE
    clip, level = frames.ravel().astype(np.float64), _QUIET_DBFS
    if place:
        clip, level = other_room(frames, rng, silence=silence)
    return captured_in(clip, steady_noise(_LEAD + count, level, rng), silence=silence)


def captured_in(clip: Float64, noise: Float64, *, silence: bool) -> Float32:
    """Add a clip to noise that began before it.

    Parameters
    ----------
    clip : np.ndarray [shape=(m,)], float64
    noise : np.ndarray [shape=(_LEAD + n,)], float64
        With n >= m.
    silence : bool
        Whether the clip is of nothing but a room: then that is heard before it, too.

    Returns
    -------
    np.ndarray [shape=(_LEAD + n,)], float32
    """
    sound = noise.copy()
    sound[_LEAD : _LEAD + len(clip)] += clip
    if silence:
        sound[:_LEAD] += np.resize(clip[::-1], _LEAD)[::-1]
    return (np.clip(np.rint(sound * 32767.0), -32768, 32767) / 32768.0).astype(np.float32)


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
        for place in range(lessons + len(CONDITIONS)):
            lesson = place if place < lessons else None
            if lesson is None:
                condition = CONDITIONS[place - lessons]
                laid = np.stack([in_condition(sounds, n, condition, count) for n in batch])
            else:
                laid = np.stack([in_lesson(sounds, n, place, count) for n in batch])
            for name, remover in removers.items():
                kept = laid if remover is None else remover(laid)
                for number, sound in zip(batch, kept, strict=True):
                    copy = _version(sounds, number, sound, features, lesson)
                    copies[name][number].append(copy)
    return copies


def _version(
    sounds: Sounds, number: int, sound: Float32, features: FeatureSet, lesson: int | None
) -> RoomCopy:
    """Compute the features of a clip, and the floor of a lesson or the one that was tracked."""
    length = _LEAD_FRAMES + len(sounds.frames[number])
    values = features.extractor()(sound[: length * FRAME_SAMPLES].reshape(length, FRAME_SAMPLES))
    floor = np.zeros(features.bands)
    if features.band_powers is not None:
        silence = class_name(sounds.clips[number].label) == SILENCE
        floor = _floor(features.band_powers(values), number, lesson, silence=silence)
    return RoomCopy(values[_LEAD_FRAMES:], floor)


def _floor(powers: Float64, number: int, lesson: int | None, *, silence: bool) -> Float64:
    """Return the floor of the room as a recorder, or as training knows it."""
    if lesson is None:
        return FloorTracker()(powers[:_LEAD_FRAMES], 0).powers[-1]
    before, clip = powers[_LEAD_FRAMES // 4 : _LEAD_FRAMES], powers[_LEAD_FRAMES:]
    floor = low_power(clip) if silence else before.mean(axis=0)
    if lesson == 0:
        return floor if silence else np.zeros_like(floor)
    rng = np.random.default_rng([_SEED, number, lesson])
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
    clean, noisy = outcomes[QUIET].before.macro_f1, outcomes[name].before.macro_f1
    return outcomes[name].change.macro_f1 / max(clean - noisy, 1e-9)


def lines_of(outcomes: Mapping[str, Outcome]) -> Iterator[str]:
    """Return a line for each condition.

    Parameters
    ----------
    outcomes : mapping of str to Outcome
        As of `outcomes_of`.
    """
    for name, one in outcomes.items():
        low, high = one.change.interval or (np.nan, np.nan)
        back = "" if name == QUIET else f"{won_back(outcomes, name):6.0%}"
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
    try:
        typer.run(main)
    except HearthlogError as error:
        sys.exit(f"hearthlog bench: {error}")
