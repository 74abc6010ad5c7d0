"""`python -m hearthlog.tools.lab.feature_sets MANIFEST`: feature sets, side by side.

The same support vector machine learns from each: from means and deviations of a second, or from
the embedding of a network. All have the same clips: those as long as the longest window.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Annotated

import numpy as np
import soundfile
import typer

from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.dataset import build_dataset
from hearthlog.analyzer.training.manifest import (
    LabelledClip,
    Scenario,
    load_scenario,
    read_manifest,
)
from hearthlog.analyzer.training.train import CrossValidation, evaluate_method
from hearthlog.analyzer.training.window_methods import SvmMethod
from hearthlog.models.classifiers.rbf_machines import SVM_RBF
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import FEATURE_SETS, feature_set
from hearthlog.models.features.network import INPUTS, card_names
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.cli.terminal import print_table
from hearthlog.tools.lab.command import run

_STATISTICS = "statistics"
_START = 1_772_352_000 * NANOSECONDS
_DAY_SECONDS = 86_400
_BLOCK_FRAMES = 10  # as from a microphone
_HEAD = ("feature set", "values", "F1 by source", "F1 by collection", "CPU ms/s", "MB a day")


@dataclass(frozen=True)
class Measured:
    """What was measured of one feature set."""

    features: FeatureSet
    by_source: CrossValidation
    by_collection: CrossValidation
    cpu: float  # seconds for a second of sound
    bytes_a_day: float

    def cells(self) -> tuple[str, ...]:
        """Return the row of a table."""
        return (
            self.features.name,
            str(self.features.width),
            _score(self.by_source),
            _score(self.by_collection),
            f"{1000 * self.cpu:.2f}",
            f"{self.bytes_a_day / 1e6:.0f}",
        )


def feature_sets(
    manifest: Annotated[Path, typer.Argument(help="Of labelled clips.")],
    names: Annotated[
        list[str] | None, typer.Argument(help="All that there are by default.")
    ] = None,
    scenario: Annotated[str, typer.Option(help="As of `hearthlog train`.")] = "general",
    minutes: Annotated[float, typer.Option(min=1, help="Of sound, for the cost.")] = 20.0,
) -> None:
    """Cross-validate feature sets, and measure what they cost."""
    sets = [feature_set(name) for name in names or [*FEATURE_SETS.names(), *card_names()]]
    classes = load_scenario(scenario)
    shortest = max(one.window_seconds for one in sets)
    every = read_manifest(manifest, classes.labels)
    clips = [clip for clip in every if _seconds(clip) >= shortest]
    classes = classes.with_unknown((clip.label, clip.source_group) for clip in clips)
    frames = _some_sound(clips, minutes)
    sound = len(frames) * FRAME_SECONDS / 60
    print(f"{len(clips)} of {len(every)} clips have {shortest:g} s; {sound:.0f} minutes")
    rows = []
    for one in sets:
        rows.append(_measure(one, clips, classes, frames).cells())
        print("  ".join(rows[-1]), file=sys.stderr, flush=True)
    print_table(_HEAD, rows)


def _measure(
    features: FeatureSet, clips: Sequence[LabelledClip], scenario: Scenario, frames: Float32
) -> Measured:
    inputs = INPUTS if features.digest else _STATISTICS
    method = SvmMethod(
        features.name, features.name, inputs, SVM_RBF.name, copies=0, cost=4.0, gamma=0.5
    )
    data = build_dataset(clips, scenario, ignore_progress, features=features)
    return Measured(
        features,
        evaluate_method(data, method, "source", ignore_progress),
        evaluate_method(data, method, "collection", ignore_progress),
        _cpu(features, frames),
        _bytes_a_day(features, frames),
    )


def _cpu(features: FeatureSet, frames: Float32) -> float:
    """Return the CPU time of a second of sound, in blocks as a microphone gives them."""
    extract = features.extractor()
    extract(frames[:_BLOCK_FRAMES])
    begin = time.process_time()
    for start in range(0, len(frames), _BLOCK_FRAMES):
        extract(frames[start : start + _BLOCK_FRAMES])
    return (time.process_time() - begin) / (len(frames) * FRAME_SECONDS)


def _bytes_a_day(features: FeatureSet, frames: Float32) -> float:
    """Record some sound without a model, and return what a day of it would take."""
    with tempfile.TemporaryDirectory(prefix="hearthlog-feature-sets-") as folder:
        sound, logs = Path(folder) / "sound.flac", Path(folder) / "logs"
        soundfile.write(sound, np.clip(frames.ravel(), -1.0, 1.0), SAMPLE_RATE)
        settings = Settings(output=logs, feature_set=features.name, timezone="UTC")
        record(settings, FileSource([sound], _START), Event())
        size = sum(path.stat().st_size for path in find_logs(logs))
    return size * _DAY_SECONDS / (len(frames) * FRAME_SECONDS)


def _some_sound(clips: Sequence[LabelledClip], minutes: float) -> Float32:
    """Return frames of clips from all over the manifest."""
    order = np.random.default_rng(1).permutation(len(clips))
    frames, count = [], 0
    for place in order:
        if count * FRAME_SECONDS >= 60 * minutes:
            break
        frames.append(clip_frames(clips[place]))
        count += len(frames[-1])
    return np.concatenate(frames)[: round(60 * minutes / FRAME_SECONDS)]


def _seconds(clip: LabelledClip) -> float:
    return min(clip.end, float(soundfile.info(clip.path).duration)) - clip.start


def _score(result: CrossValidation) -> str:
    low, high = result.scores.macro_f1_interval or (np.nan, np.nan)
    return f"{result.scores.macro_f1:.3f} ({low:.3f}-{high:.3f})"


if __name__ == "__main__":
    run(feature_sets)
