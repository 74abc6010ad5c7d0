"""Conversations composed of clips of single voices, and who speaks when in them."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Event
from typing import NamedTuple

import numpy as np
import soundfile
from scipy.signal import fftconvolve

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.scenes import background
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import SAMPLE_RATE

NOISE = -55.0  # level of the room, dBFS
_LEVEL = -26.0
_LEVELS = 5.0  # dB, by which a voice is louder or softer
_TURN = (1.0, 6.0)  # seconds
_END = 8.0  # seconds, in which no turn begins
_PAUSE = 0.5  # seconds, a mean
_SHORTEST_PAUSE = 0.15
_OVERLAPPED = 0.12  # of the turns
_OVERLAP = (0.3, 1.0)  # seconds
_AGAIN = 0.15  # how much seldomer somebody goes on than another answers
_ECHO = int(0.35 * SAMPLE_RATE)  # samples in which the echo falls by 60 dB
_ECHO_LEVEL = (0.006, 0.02)
_QUIET = 1e-3  # of the power of the loudest twentieth of a second
_SMOOTHED = SAMPLE_RATE // 20

Clips = Sequence[Float32]


class Turn(NamedTuple):
    """When a voice speaks, in seconds."""

    start: float
    end: float
    voice: str


def clips_of_voices(manifest: Path) -> dict[str, list[Float32]]:
    """Read the clips of each source group of a manifest, without the quiet at their ends.

    Raises
    ------
    DataError
        If the manifest has no such columns.
    """
    with manifest.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    if not rows or not {"path", "source_group"} <= rows[0].keys():
        raise DataError(f"{manifest}: needs columns path, source_group, and clips")
    clips: dict[str, list[Float32]] = {}
    for row in rows:
        samples = np.concatenate([*read_audio(manifest.parent / row["path"])])
        clips.setdefault(row["source_group"], []).append(_trimmed(samples))
    return clips


def _trimmed(samples: Float32) -> Float32:
    power = np.convolve(samples**2, np.ones(_SMOOTHED) / _SMOOTHED, "same")
    loud = np.flatnonzero(power > power.max() * _QUIET)
    return samples[loud[0] : loud[-1] + 1] if len(loud) else samples


def converse(
    voices: Mapping[str, Clips], seconds: float, seed: int, noise: float = NOISE
) -> tuple[Float32, list[Turn]]:
    """Compose a conversation in a room, each voice at its own place and level.

    Turns are of one to six seconds, an eighth of them begins before the one before has ended. A
    voice says its clips one after the other; when all are said they begin anew.

    Parameters
    ----------
    voices : mapping of str to sequence of np.ndarray [shape=(n,)], float32
        Samples at 16 kHz.
    seconds : float
    seed : int
    noise : float
        Level of the room, in dBFS.
    """
    rng = np.random.default_rng(seed)
    scene: Float64 = background(seconds, noise, "pink", seed).astype(np.float64)
    names = sorted(voices)
    speakers = {name: _Speaker(voices[name], rng) for name in names}
    shares = rng.dirichlet(np.full(len(names), 4.0))
    turns: list[Turn] = []
    at, last = 1.0, ""
    while at < seconds - _END:
        odds = np.where(np.array(names) == last, _AGAIN, 1.0) * shares
        name = last if len(names) == 1 and last else str(rng.choice(names, p=odds / odds.sum()))
        said, length = speakers[name].turn(rng)
        place = int(at * SAMPLE_RATE)
        scene[place : place + len(said)] += said[: len(scene) - place]
        turns.append(Turn(at, at + length, name))
        if rng.random() < _OVERLAPPED and length > 2.0:
            pause = -rng.uniform(*_OVERLAP)
        else:
            pause = rng.exponential(_PAUSE) + _SHORTEST_PAUSE
        at, last = max(at + length + pause, at + 0.3), name
    return np.clip(scene, -1.0, 1.0).astype(np.float32), turns


class _Speaker:
    """A voice at its place in the room."""

    def __init__(self, clips: Clips, rng: np.random.Generator) -> None:
        self._clips = [clips[place] for place in rng.permutation(len(clips))]
        self._next = 0
        self._rest = np.empty(0, np.float32)
        self._echo = echo(rng)
        self._level = _LEVEL + rng.uniform(-_LEVELS, _LEVELS)

    def turn(self, rng: np.random.Generator) -> tuple[Float64, float]:
        """Return a turn with its echo, and its length in seconds without."""
        wanted = int(rng.uniform(*_TURN) * SAMPLE_RATE)
        said: list[Float32] = []
        while wanted > 0:
            if len(self._rest) < SAMPLE_RATE // 2:
                self._rest = self._clips[self._next % len(self._clips)]
                self._next += 1
            said.append(self._rest[:wanted])
            self._rest = self._rest[wanted:]
            wanted -= len(said[-1])
            if rng.random() < 0.5:
                break
        samples = np.concatenate(said).astype(np.float64)
        samples *= 10.0 ** (self._level / 20.0) / np.sqrt(np.mean(samples**2) + 1e-12)
        return fftconvolve(samples, self._echo), len(samples) / SAMPLE_RATE


def echo(rng: np.random.Generator) -> Float64:
    """Draw how a place in a room answers: noise that falls by 60 dB in 0.35 s."""
    fall = 10.0 ** (-3.0 * np.arange(_ECHO) / _ECHO)
    answer: Float64 = rng.standard_normal(_ECHO) * fall * rng.uniform(*_ECHO_LEVEL)
    answer[0] = 1.0
    return answer


def record_samples(samples: Float32, folder: Path, start: int, model: Path) -> Path:
    """Record samples with a model; return the folder of logs.

    Parameters
    ----------
    samples : np.ndarray [shape=(n,)], float32
    folder : Path
        The logs go to its folder `logs`.
    start : int
        When they begin, in nanoseconds of UTC.
    model : Path
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{start}.flac"
    soundfile.write(path, samples, SAMPLE_RATE)
    settings = Settings(output=folder / "logs", model=model, timezone="UTC")
    record(settings, FileSource([path], start), Event())
    path.unlink()
    return folder / "logs"
