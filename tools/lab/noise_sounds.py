"""Clips laid into noise that began before them, as `hearthlog.tools.lab.noise` compares them.

The noise is of a fan and of a refrigerator, which are made, and of recordings of no class of a
scenario whose level hardly changes (rain, the sea, engines).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.clips import clip_frames, level_of, other_room, steady_noise
from hearthlog.analyzer.training.manifest import (
    BUILTIN,
    LABELS,
    LabelledClip,
    Scenario,
    read_manifest,
)
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

NOISES = ("fan", "refrigerator", "recorded")
RATIOS = (20.0, 10.0, 5.0)  # dB
QUIET = "quiet room"
SEED = 20_261_124
LEAD_FRAMES = 80  # 4 s: a section of the tracker of the floor
_LEAD = LEAD_FRAMES * FRAME_SAMPLES
_MOST_CLIPS = 1  # of a source and label
_MOST_FRAMES = 80  # of a clip
_QUIET_DBFS = -75.0  # noise of a microphone in a quiet room
_OVERTONES = 8
_MADE, _MADE_SECONDS = 8, 20
_NOISE_SECONDS, _NOISE_SPREAD_DB = 4.0, 3.0  # least length, most deviation of the level
_BLOCK = SAMPLE_RATE * 2 // 5  # in which the level is measured
_LEAST_POWER = 1e-7  # of a block that is not digital silence


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

    def is_silence(self, number: int) -> bool:
        """Tell whether a clip is of nothing but a room."""
        return class_name(self.clips[number].label) == SILENCE


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
    rng = np.random.default_rng(SEED)
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
    powers = np.square(sound[: len(sound) // _BLOCK * _BLOCK]).reshape(-1, _BLOCK).mean(axis=1)
    spread = np.std(10.0 * np.log10(powers + 1e-12))
    return bool(spread < _NOISE_SPREAD_DB and powers.min() > _LEAST_POWER)


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
    np.ndarray [shape=(4 s + count,)], float32
        As a microphone of 16 bits captures it.
    """
    rng = np.random.default_rng([SEED, number, CONDITIONS.index(condition)])
    clip, silence = sounds.frames[number].ravel().astype(np.float64), sounds.is_silence(number)
    noise = rng.standard_normal(_LEAD + count) * 10.0 ** (_QUIET_DBFS / 20.0)
    if condition.noise is not None:
        level = (sounds.level if silence else level_of(clip)) - condition.ratio
        noise += noise_of(sounds.noises[condition.noise], len(noise), level, rng)
    return _captured_in(clip, noise, silence=silence)


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
    np.ndarray [shape=(4 s + count,)], float32
    """
    rng = np.random.default_rng([SEED, number, len(CONDITIONS) + place])
    frames = sounds.frames[number]
    silence = sounds.is_silence(number)
    clip, level = frames.ravel().astype(np.float64), _QUIET_DBFS
    if place:
        clip, level = other_room(frames, rng, silence=silence)
    return _captured_in(clip, steady_noise(_LEAD + count, level, rng), silence=silence)


def _captured_in(clip: Float64, noise: Float64, *, silence: bool) -> Float32:
    """Add a clip to noise that began before it; a room is heard before it, too."""
    sound = noise.copy()
    sound[_LEAD : _LEAD + len(clip)] += clip
    if silence:
        sound[:_LEAD] += np.resize(clip[::-1], _LEAD)[::-1]
    return (np.clip(np.rint(sound * 32767.0), -32768, 32767) / 32768.0).astype(np.float32)
