"""Public API to train and compare models."""

import warnings
from pathlib import Path

from hearthlog.analyzer.evaluation.model_scores import Comparison, compare_models
from hearthlog.analyzer.training.clips import model_embedder
from hearthlog.analyzer.training.dataset import UNREADABLE, build_dataset, clip_recordings
from hearthlog.analyzer.training.manifest import (
    SkippedClip,
    left_out_lines,
    load_scenario,
    read_manifest,
    scenario_of,
)
from hearthlog.analyzer.training.train import (
    clip_embedder,
    default_method,
    method_named,
    train_model,
)
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.errors import ignore_progress

__all__ = ["Comparison", "compare", "train"]


def train(
    manifest: Path | str, scenario: str, method: str | None = None, smoothing: str = "hmm"
) -> Model:
    """Train a model on labelled clips, and evaluate it on held-out sources.

    Parameters
    ----------
    manifest : Path or str
        CSV file with the columns `path`, `label` and `source_group`.
    scenario : str
        Classes to distinguish: `bathroom`, `general`, or a TOML file.
    method : str, optional
        `embedding`, `room`, `room21` (the same with the 21 features of auros21), `bands`, `paper`,
        or a method of another distribution. By default `embedding` if its network is available,
        else `room`.
    smoothing : str
        How labels become segments: `hmm` or `merge`.

    Returns
    -------
    Model
        Its `description.metrics` are cross-validated by source group.

    Raises
    ------
    DataError
        If the manifest, the scenario or the method cannot be used.

    Warns
    -----
    UserWarning
        If clips are skipped: unreadable clips, and unusable lines of the manifest.

    Examples
    --------
    >>> model = hearthlog.train("clips/manifest.csv", "bathroom", method="paper")
    >>> model.classes
    ('silence', 'flushing_water', 'shower', 'tap_water', 'other')
    >>> model.description.metrics.macro_f1 > 0.5
    True
    """
    chosen = load_scenario(scenario)
    way = default_method() if method is None else method_named(method)
    left_out: list[SkippedClip] = []
    clips = read_manifest(Path(manifest), chosen.labels, left_out)
    chosen = chosen.with_unknown((clip.label, clip.source_group) for clip in clips)
    data = build_dataset(
        clips,
        chosen,
        ignore_progress,
        features=way.features,
        rooms=way.rooms,
        embedder=clip_embedder(way),
    )
    for line in left_out_lines([*left_out, *data.left_out]):
        warnings.warn(line, stacklevel=2)
    return train_model(data, chosen, ignore_progress, way, smoothing)


def compare(a: Model, b: Model, manifest: Path | str) -> Comparison:
    """Compare two models on labelled clips that neither was trained on.

    Parameters
    ----------
    a, b : Model
        Models with the same classes and the same feature set.
    manifest : Path or str
        As in `train`.

    Returns
    -------
    Comparison
        `difference.macro_f1` is the value of b minus the value of a; `clear` is whether the
        difference is significant.

    Raises
    ------
    DataError
        If the models cannot be compared, or the clips cannot be used.

    Warns
    -----
    UserWarning
        As in `train`.

    Examples
    --------
    >>> model = hearthlog.load_model("home.safetensors")
    >>> hearthlog.compare(model, model, "clips/manifest.csv").clear
    False
    """
    scenario = scenario_of(a)
    left_out: list[SkippedClip] = []
    clips = read_manifest(Path(manifest), scenario.labels, left_out)
    features = feature_set(a.description.feature_set)
    network = model_embedder(a) or model_embedder(b)
    recordings = list(clip_recordings(clips, scenario, ignore_progress, features, embedder=network))
    left_out += [SkippedClip(UNREADABLE, each.fault) for each in recordings if each.fault]
    for line in left_out_lines(left_out):
        warnings.warn(line, stacklevel=2)
    return compare_models(a, b, recordings, scenario)
