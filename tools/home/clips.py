"""The clips of a simulated home: recordings of a manifest, and synthetic sounds."""

import os
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.manifest import read_manifest
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    LAUGHING,
    MUSIC,
    OBJECTS_ACTIVITY,
    PHONE_RING,
    SHOWER,
    SILENCE,
    SPEECH,
    TAP_WATER,
    YELLING,
)
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.open_audio import audio_seconds
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.errors import SourceError
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS, SAMPLE_RATE
from hearthlog.tools.home.sounds import SimulationError, dry_sound, generator

SHIPPED = Path(__file__).parent / "clips" / "manifest.csv"

_MADE_UP_SECONDS = {
    SPEECH: 6.0,
    MUSIC: 10.0,
    PHONE_RING: 8.0,
    COUGHING: 1.5,
    CRYING: 8.0,
    YELLING: 4.0,
    LAUGHING: 4.0,
    OBJECTS_ACTIVITY: 6.0,
    FLUSHING_WATER: 11.0,
    SHOWER: 10.0,
    TAP_WATER: 8.0,
}
_MADE_UP = 8  # different synthetic sounds per label
_LONGEST_SECONDS = 60.0
_CACHE_BYTES = 64 << 20
_LOUD_DB = 15.0  # dB below the loudest frame: frames above it define the level of a clip
_CROSSFADE = SAMPLE_RATE // 10
_FADE = SAMPLE_RATE // 100
_TINY = 1e-12


@dataclass(frozen=True)
class HomeClip:
    """One sound of a simulated home."""

    name: str
    label: str
    source_group: str
    path: Path | None  # None for a synthetic sound
    frames: int
    start: float = 0.0  # start in the recording, in seconds
    seed: int = 0


class ClipLibrary:
    """Recordings of a manifest, and synthetic sounds for labels without recordings.

    The manifest is one for `hearthlog train`, with any labels; None for synthetic sounds alone.
    Raise `DataError` if it cannot be used, `SimulationError` if a clip is not audio, or is shorter
    than a frame.
    """

    def __init__(self, manifest: Path | None = SHIPPED) -> None:
        recorded = [] if manifest is None else _recorded(manifest)
        self._clips: dict[str, list[HomeClip]] = {}
        for clip in recorded:
            self._clips.setdefault(clip.label, []).append(clip)
        self.made_up = [label for label in _MADE_UP_SECONDS if label not in self._clips]
        self._clips |= {label: _made_up(label) for label in self.made_up}
        self._decoded = ArrayCache(_CACHE_BYTES)

    def of(self, label: str) -> Sequence[HomeClip]:
        """Return the clips of a label; empty if there is no such sound."""
        return self._clips.get(label, [])

    def of_groups(self, label: str, count: int, rng: np.random.Generator) -> Sequence[HomeClip]:
        """Return the clips of at most `count` source groups of a label, drawn at random."""
        groups = sorted({clip.source_group for clip in self.of(label)})
        chosen = {groups[place] for place in rng.permutation(len(groups))[:count]}
        return [clip for clip in self.of(label) if clip.source_group in chosen]

    def sound(self, clip: HomeClip, frames: int) -> Float32:
        """Return a clip, cut or repeated to a length [shape=(frames * FRAME_SAMPLES,)].

        Its loud frames, of at least one, have a mean square of 1; the ends are faded. Raise
        `SimulationError` if the recording is damaged.
        """
        samples = self._decoded(clip.name, lambda: _decode(clip))
        sound = _extended(samples, frames * FRAME_SAMPLES)
        ramp = np.linspace(0.0, 1.0, _FADE, dtype=np.float32)
        sound[:_FADE] *= ramp
        sound[-_FADE:] *= ramp[::-1]
        return sound


class ArrayCache:
    """The most recently used arrays, up to `limit` bytes; the last one even if it is larger."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._size = 0
        self._arrays: OrderedDict[object, Float32] = OrderedDict()

    def __call__(self, key: object, make: Callable[[], Float32]) -> Float32:
        """Return the array of a key."""
        if key in self._arrays:
            self._arrays.move_to_end(key)
            return self._arrays[key]
        made = self._arrays[key] = make()
        self._size += made.nbytes
        while self._size > self._limit and len(self._arrays) > 1:
            _, dropped = self._arrays.popitem(last=False)
            self._size -= dropped.nbytes
        return made


class _AnyLabel(Collection[str]):
    """Accepts every label in the manifest of a home; unused labels do no harm."""

    def __contains__(self, _label: object) -> bool:
        return True

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 1


def _recorded(manifest: Path) -> list[HomeClip]:
    clips = []
    for row in read_manifest(manifest, _AnyLabel()):
        name = Path(os.path.relpath(row.path, manifest.parent)).as_posix()
        name += f"@{row.start:g}" if row.start else ""
        try:
            seconds = min(audio_seconds(row.path), row.end) - row.start
        except SourceError as error:
            raise SimulationError(f"{error}; take it out of {manifest}") from error
        frames = int(min(seconds, _LONGEST_SECONDS) / FRAME_SECONDS)
        if frames < 1:
            raise SimulationError(f"{row.path}: shorter than a frame; take it out of {manifest}")
        clips.append(HomeClip(name, row.label, row.source_group, row.path, frames, row.start))
    if not any(clip.label != SILENCE for clip in clips):
        raise DataError(f"{manifest}: lists no sound but silence")
    return clips


def _made_up(label: str) -> list[HomeClip]:
    frames = round(_MADE_UP_SECONDS[label] / FRAME_SECONDS)
    names = [f"made_up/{label}_{number}" for number in range(1, _MADE_UP + 1)]
    return [HomeClip(name, label, name, None, frames, seed=seed) for seed, name in enumerate(names)]


def _decode(clip: HomeClip) -> Float32:
    """Read or synthesise a clip, with a mean square of 1 in its loud frames."""
    if clip.path is None:
        place = list(_MADE_UP_SECONDS).index(clip.label)
        made = dry_sound(clip.label, clip.frames * FRAME_SAMPLES, generator(clip.seed, place))
        return _normalised(made)
    faults: list[str] = []
    blocks = [np.empty(0, np.float32)]
    try:
        end = clip.start + clip.frames * FRAME_SECONDS
        blocks += read_audio(clip.path, clip.start, end, incomplete=faults.append)
    except SourceError as error:
        faults.append(str(error))
    sound = np.zeros(clip.frames * FRAME_SAMPLES)
    read = np.concatenate(blocks)[: len(sound)]
    if not faults and not len(read):
        faults.append(f"{clip.path}: holds no audio at {clip.start:g} s")
    if not faults and not np.isfinite(read).all():
        faults.append(f"{clip.path}: samples are not finite (NaN or infinity)")
    if faults:
        raise SimulationError(f"{faults[0]}; take it out of the manifest")
    sound[: len(read)] = read
    return _normalised(sound)


def _normalised(sound: Float64) -> Float32:
    sound = sound - sound.mean()
    power = frame_powers(sound)
    loud = power[power >= power.max() * 10.0 ** (-_LOUD_DB / 10.0)]
    return (sound / np.sqrt(loud.mean() + _TINY)).astype(np.float32)


def frame_powers(sound: Float64 | Float32) -> Float64:
    """Return the mean square of each frame [shape=(n,)] of a sound [shape=(n * FRAME_SAMPLES,)]."""
    frames = sound.reshape(-1, FRAME_SAMPLES)
    power: Float64 = np.einsum("ij,ij->i", frames, frames, dtype=np.float64) / FRAME_SAMPLES
    return power


def _extended(samples: Float32, length: int) -> Float32:
    """Cut a sound, or repeat it with crossfades."""
    if len(samples) >= length:
        return samples[:length].copy()
    fade = min(_CROSSFADE, len(samples) // 2)
    rising = np.sqrt(np.linspace(0.0, 1.0, fade, dtype=np.float32))
    sound = np.zeros(length, np.float32)
    for start in range(0, length, len(samples) - fade):
        piece = samples.copy()
        if start:
            piece[:fade] *= rising
        piece[len(piece) - fade :] *= rising[::-1]
        sound[start : start + len(piece)] += piece[: length - start]
    return sound
