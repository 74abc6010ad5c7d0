"""Minutes of a home in which sounds of single things recur among others, and when each was."""

import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Event
from typing import NamedTuple

import numpy as np
import soundfile
from scipy.signal import fftconvolve

from hearthlog.analyzer.evaluation.scenes import background
from hearthlog.analyzer.logs.spans import Timed
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import NANOSECONDS, SAMPLE_RATE

OTHER = ""  # in place of the name of a sound that does not recur
_LONGEST = 8 * SAMPLE_RATE
_ROOM = int(0.35 * SAMPLE_RATE)  # samples in which its echo falls by 60 dB
_SHARE_OF_OTHERS = 0.4


class Sounded(NamedTuple):
    """When something sounded, in nanoseconds of UTC, and its name, or `OTHER`."""

    start: int
    end: int
    name: str


def record_scene(
    recurring: Mapping[str, Sequence[Float32]],
    others: Sequence[Float32],
    seconds: float,
    noise: float,
    logs: Path,
    start: int,
    seed: int,
) -> list[Sounded]:
    """Compose a scene, and record it with the starter model.

    Each time that a sound recurs it is another part of its clip, half of it at least, at another
    level, in a room of another echo.

    Parameters
    ----------
    recurring : mapping of str to sequence of np.ndarray [shape=(n,)], float32
        Samples at 16 kHz, by name: clips, one of which is drawn each time.
    others : sequence of np.ndarray [shape=(n,)], float32
        Sounds of which one is drawn each time.
    seconds : float
    noise : float
        Level of the room, in dBFS.
    logs : Path
        Folder of logs.
    start : int
        When the scene begins, in nanoseconds of UTC.
    seed : int
    """
    rng, noises = random.Random(seed), np.random.default_rng(seed)
    scene = background(seconds, noise, "pink", seed)
    truth, at = [], 2.0
    while at < seconds - (_LONGEST + _ROOM) / SAMPLE_RATE - 1:
        name = OTHER if rng.random() < _SHARE_OF_OTHERS else rng.choice(sorted(recurring))
        clips = recurring[name] if name else others
        clip = clips[0] if len(clips) == 1 else rng.choice(clips)
        take = _another_take(clip[:_LONGEST], rng, noises)
        scene[int(at * SAMPLE_RATE) :][: len(take)] += take
        end = at + len(take) / SAMPLE_RATE
        first, last = (start + int(time * NANOSECONDS) for time in (at, end))
        truth.append(Sounded(first, last, name))
        at = end + rng.uniform(0.6, 3.0)
    path = logs.parent / f"scene-{seed}.flac"
    soundfile.write(path, np.clip(scene, -1, 1), SAMPLE_RATE)
    settings = Settings(output=logs, model=starter_file(GENERAL), timezone="UTC")
    record(settings, FileSource([path], start), Event())
    path.unlink()
    return truth


def _another_take(clip: Float32, rng: random.Random, noises: np.random.Generator) -> Float32:
    length = int(len(clip) * rng.uniform(0.5, 1.0))
    first = rng.randrange(len(clip) - length + 1)
    echo = noises.normal(0, 1, _ROOM) * np.exp(-6.9 * np.arange(_ROOM) / _ROOM)
    echo *= 10 ** (rng.uniform(-12, -4) / 20) / np.sqrt(np.sum(echo**2))
    echo[0] += 1.0
    sound = fftconvolve(clip[first : first + length], echo)
    level = 10 ** (rng.uniform(-22, -8) / 20)
    return (sound / max(float(np.abs(sound).max()), 1e-9) * level).astype(np.float32)


def names_of(spans: Timed, truth: Sequence[Sounded]) -> tuple[list[str], list[int]]:
    """Tell what each of some sounds was: that with which it has most time in common.

    Returns
    -------
    names : list of str
        `OTHER` for what does not recur, or was nothing.
    rows : list of int
        Where in `truth`; -1 for nothing.
    """
    starts, ends = (np.array([each[place] for each in truth]) for place in (0, 1))
    names, rows = [], []
    for start, end in zip(spans.starts.tolist(), spans.ends.tolist(), strict=True):
        common = np.minimum(ends, end) - np.maximum(starts, start)
        best = int(common.argmax())
        is_there = common[best] > 0
        names.append(truth[best].name if is_there else OTHER)
        rows.append(best if is_there else -1)
    return names, rows
