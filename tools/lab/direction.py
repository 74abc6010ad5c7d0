"""`python -m hearthlog.tools.lab.direction [MANIFEST]`: how well an array tells directions.

Clips sound around it in simulated rooms. Its microphones are off by a millimetre and a decibel.
"""

import os

os.environ.update(
    dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
)  # before numpy is imported: a core's share is of one core

import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.evidence import BLOCK_FRAMES
from hearthlog.recorder.stream.directions import BlockDirections, geometry_of
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS, SAMPLE_RATE
from hearthlog.tools.home.clips import SHIPPED
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.direction_room import Placed, add_noise, room_noise, room_scene

_SOUNDS = 12  # in a scene
_LONGEST = 3.0  # seconds of a clip
_BLOCK_SECONDS = BLOCK_FRAMES * FRAME_SECONDS
_PUSHED = 12  # frames at once, as a capture process gives them
_DRAWS = 1000
_CIRCLE = np.arange(6) * np.pi / 3
ARRAYS = {
    "square of 4, 64 mm": np.array([[0.032, 0], [0, 0.032], [-0.032, 0], [0, -0.032]]),
    "circle of 6, 90 mm": 0.045 * np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=1),
    "pair, 100 mm": np.array([[0, 0.05], [0, -0.05]]),
}
ROOMS = 0.3, 0.6  # seconds
SNRS = 20, 10, 5


class Located(NamedTuple):
    """What was said of one sound.

    Attributes
    ----------
    errors : np.ndarray [shape=(m,)], float64
        Of its blocks that have a direction, in degrees.
    error : float
        Of their mean, as of a segment; NaN without any.
    blocks : float
        That it has.
    """

    errors: Float64
    error: float
    blocks: float


def direction(
    manifest: Annotated[Path, typer.Argument(help="Of clips, as for `hearthlog train`.")] = SHIPPED,
    scenes: Annotated[int, typer.Option(min=1, help="Of 12 sounds, for each room.")] = 4,
) -> None:
    """Measure the errors of directions, and what they cost."""
    clips = _clips(manifest)
    print(
        f"{len(clips)} clips; {scenes} scenes of {_SOUNDS} sounds for each room and array\n\n"
        "array               rt60  noise  snr    median           90 %   of a sound  located  "
        "wrong in pauses"
    )
    for name, places in ARRAYS.items():
        for rt60 in ROOMS:
            rng = np.random.default_rng(1)
            placed = [room_scene(_drawn(clips, rng), places, rt60, rng) for _ in range(scenes)]
            sounds = [one.sounds for one in placed]
            noises = {
                "room": [room_noise(one, rng) for one in placed],
                "hiss": [rng.normal(size=one.samples.shape) for one in placed],
            }
            for (noise, added), snr in product(noises.items(), SNRS):
                parts = [add_noise(one, own, snr) for one, own in zip(placed, added, strict=True)]
                score = _scored(parts, sounds, places)
                print(f"{name:18s} {rt60:4.1f} s  {noise:5s} {snr:2d} dB  {score}", flush=True)
    _print_cost(parts[0])


def _clips(manifest: Path) -> list[Float64]:
    clips = [clip for clip in read_manifest(manifest, LABELS) if clip.label != SILENCE]
    if len(clips) < _SOUNDS:
        raise DataError(f"{manifest}: has {len(clips)} clips of sounds; a scene needs {_SOUNDS}")
    return [
        clip_frames(clip).ravel()[: int(_LONGEST * SAMPLE_RATE)].astype(np.float64)
        for clip in clips
    ]


def _drawn(clips: Sequence[Float64], rng: np.random.Generator) -> list[Float64]:
    return [clips[row] for row in rng.choice(len(clips), _SOUNDS, replace=False)]


def _scored(parts: Sequence[Float32], sounds: Sequence[Sequence[Placed]], places: Float64) -> str:
    located: list[Located] = []
    wrong = pauses = 0.0
    for samples, truth in zip(parts, sounds, strict=True):
        ours, elsewhere, silent = _located(samples, truth, places)
        located += ours
        wrong, pauses = wrong + elsewhere, pauses + silent
    rng = np.random.default_rng(0)
    heard = [one.errors for one in located if len(one.errors)]
    draws = [
        np.median(np.concatenate([heard[row] for row in rows]))
        for rows in rng.integers(0, len(heard), (_DRAWS, len(heard)))
    ]
    low, high = np.quantile(draws, [0.025, 0.975])
    errors = np.concatenate(heard)
    means = np.array([one.error for one in located])
    share = len(errors) / sum(one.blocks for one in located)
    return (
        f"{np.median(errors):5.1f} ({low:4.1f} to {high:4.1f})  {np.quantile(errors, 0.9):6.1f}  "
        f"{np.nanmedian(means):8.1f}   {np.isfinite(means).mean():6.0%} "
        f"({share:3.0%} of its time)  {wrong / pauses:5.1%}"
    )


def _located(
    samples: Float32, truth: Sequence[Placed], places: Float64
) -> tuple[list[Located], int, float]:
    """Return what was said of each sound, and how many blocks of the pauses have a direction."""
    geometry = geometry_of(places.tolist())
    frames = len(samples) // FRAME_SAMPLES
    shaped = samples[: frames * FRAME_SAMPLES].reshape(frames, FRAME_SAMPLES, -1)
    blocks, azimuths, confidences = BlockDirections(geometry)(shaped, 0)
    middles = (blocks + BLOCK_FRAMES / 2) * FRAME_SECONDS
    located, in_sound = [], np.zeros(len(blocks), bool)
    for start, end, azimuth in truth:
        # A line of microphones takes what is behind it for what is before it.
        true = np.arctan2(np.sin(azimuth), abs(np.cos(azimuth))) if geometry.is_line else azimuth
        inside = (middles >= start) & (middles <= end)
        in_sound |= (middles >= start - _BLOCK_SECONDS) & (middles <= end + 1.0)  # with its echo
        mean = (confidences[inside] * np.exp(1j * azimuths[inside])).sum()
        error = _degrees(np.angle(mean) - true) if inside.any() else np.nan
        count = (end - start) / _BLOCK_SECONDS
        located.append(Located(_degrees(azimuths[inside] - true), float(error), count))
    length = sum(end - start + 1.0 + _BLOCK_SECONDS for start, end, _ in truth)
    silent = (frames * FRAME_SECONDS - length) / _BLOCK_SECONDS
    return located, int((~in_sound).sum()), silent


def _degrees(turn: Float64 | float) -> Float64:
    return np.abs(np.rad2deg(np.angle(np.exp(1j * np.asarray(turn, np.float64)))))


def _print_cost(samples: Float32) -> None:
    """Print the share of a core that takes as long as the sound itself."""
    for name, places in ARRAYS.items():
        count = len(places)
        frames = np.resize(samples, (1200, FRAME_SAMPLES, count)).astype(np.float32)
        finder = BlockDirections(geometry_of(places.tolist()))
        begin = time.process_time()
        for first in range(0, len(frames), _PUSHED):
            finder(frames[first : first + _PUSHED], first)
        share = (time.process_time() - begin) / (len(frames) * FRAME_SECONDS)
        print(f"{name:18s} takes {share:.2%} of a core")


if __name__ == "__main__":
    run(direction)
