"""`python -m hearthlog.tools.lab.voice_space MANIFEST -o FILE`: where voices lie apart, anew.

The voices are the source groups of the manifest. Each is heard as it is and in three other rooms by
other microphones, so that a microphone is not taken for a voice.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from safetensors.numpy import save_file
from scipy.linalg import eigh

from hearthlog.analyzer.discover.voices import VoiceSpace, describe_speech
from hearthlog.analyzer.training.clips import clip_frames, in_room
from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.tools.lab.command import run

_DIMENSIONS = 20
_ROOMS = 3
_ENERGY = 0  # its place in the features
_QUIET = 10 ** (-30 / 10)  # of the loud frames
_RIDGE = 1e-3
_SEED = 5


def voice_space(
    manifest: Annotated[Path, typer.Argument(help="Of speech; a voice is a source_group.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="File of the space.")],
) -> None:
    """Learn from voices where voices lie apart."""
    voices, described = [], []
    for voice, values in _voice_features(manifest):
        loud = np.percentile(values[:, _ENERGY], 90) * _QUIET
        windows = describe_speech(values[values[:, _ENERGY] > loud], DEFAULT.feature_names)
        described.append(windows)
        voices.append(np.full(len(windows), voice))
    space = learned_space(np.concatenate(described), np.concatenate(voices))
    arrays = {name: array.astype(np.float32) for name, array in space._asdict().items()}
    save_file(arrays, output, {"learned_from": manifest.stem, "licence": "CC BY 4.0"})
    print(f"{output}: of {len(np.unique(np.concatenate(voices)))} voices")


def _voice_features(manifest: Path) -> Iterator[tuple[int, Float32]]:
    numbers: dict[str, int] = {}
    rng = np.random.default_rng(_SEED)
    for clip in read_manifest(manifest, LABELS):
        number = numbers.setdefault(clip.source_group, len(numbers))
        frames = clip_frames(clip)
        yield number, DEFAULT.extractor()(frames)
        for _ in range(_ROOMS):
            yield number, in_room(frames, DEFAULT, rng, silence=False).features


def learned_space(described: Float64, voices: Int64) -> VoiceSpace:
    """Learn the directions in which voices differ most, beside how much each of them varies.

    Parameters
    ----------
    described : np.ndarray [shape=(n, width)], float64
        Windows of speech.
    voices : np.ndarray [shape=(n,)], int64
        Whose each is.
    """
    numbers, of = np.unique(voices, return_inverse=True)
    means = np.stack([described[of == row].mean(axis=0) for row in range(len(numbers))])
    within = np.cov(described - means[of], rowvar=False, bias=True)
    within += _RIDGE * np.diag(np.diag(within))
    between = np.cov(means, rowvar=False, bias=True)
    spread, directions = eigh(between, within)
    largest = np.argsort(-spread)[:_DIMENSIONS]
    return VoiceSpace(described.mean(axis=0), directions[:, largest].T, spread[largest])


if __name__ == "__main__":
    run(voice_space)
