"""A model on labelled clips as other rooms and other microphones would give them.

Run by `python -m hearthlog.tools.lab.robustness`.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import delayed

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.model_scores import fitted, segment_probabilities
from hearthlog.analyzer.evaluation.plots import new_figure, plot_names, save_figure
from hearthlog.analyzer.training.clips import (
    RoomCopy,
    band_limits,
    captured,
    clip_frames,
    filtered,
    in_noise,
    level_of,
    octaves_of,
    reverberated,
)
from hearthlog.analyzer.training.dataset import (
    Recording,
    clip_recordings,
    cut_recordings,
    learned_groups,
)
from hearthlog.analyzer.training.manifest import (
    LabelledClip,
    Scenario,
    SkippedClip,
    example_of,
    left_out_lines,
)
from hearthlog.analyzer.training.scores import F1Difference, Scores, difference, score
from hearthlog.analyzer.workers import in_parallel
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet, of_segments
from hearthlog.models.features.floor import low_power
from hearthlog.schemas.arrays import Float32, Float64, Indices
from hearthlog.schemas.errors import Progress, ignore_progress
from hearthlog.tools.cli.evaluate import ModelFile, learned_lines, read_model_and_clips
from hearthlog.tools.cli.options import Clips, Json, OwnScenario, Plot, check_output
from hearthlog.tools.cli.tables import between, print_skipped, share
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    number,
    print_json,
    print_table,
    share_done,
)
from hearthlog.tools.lab.command import run

_SEED = 20_261_123
_CLIPS_AT_ONCE = 16
_DIRECT_DB = 3.0  # direct sound above the reverberation


class Condition(NamedTuple):
    """What is done to clips, in this order.

    Attributes
    ----------
    name : str
    gain : float
        In dB.
    reverberation : float or None
        Seconds until a reverberant room has fallen by 60 dB; None for no room.
    limits : (float, float) or None
        What the microphone hears, in hertz; None for all.
    tilt : float
        Of the response of the microphone, in dB an octave.
    noise : float or None
        By how much steady noise is below the clip, in dB; None for no noise.
    """

    name: str
    gain: float = 0.0
    reverberation: float | None = None
    limits: tuple[float, float] | None = None
    tilt: float = 0.0
    noise: float | None = None

    def response(self, frequencies: Float64) -> Float64:
        """Return the response of the microphone.

        Parameters
        ----------
        frequencies : np.ndarray [shape=(n,)], float64
            In hertz.

        Returns
        -------
        np.ndarray [shape=(n,)], float64
            In dB.
        """
        decibels = self.tilt * octaves_of(frequencies)
        if self.limits is not None:
            decibels += band_limits(frequencies, *self.limits)
        return decibels


_TELEPHONE = (300.0, 3400.0)
CONDITIONS = (
    *(Condition(f"{gain:+g} dB", gain=gain) for gain in (-20.0, -10.0, 10.0)),
    *(Condition(f"noise {noise:g} dB below", noise=noise) for noise in (30.0, 20.0, 10.0, 5.0)),
    *(Condition(f"room, RT60 {time:g} s", reverberation=time) for time in (0.2, 0.4, 0.6)),
    Condition("300-3400 Hz", limits=_TELEPHONE),
    *(Condition(f"{tilt:+g} dB/octave", tilt=tilt) for tilt in (-3.0, 3.0)),
    Condition("0.4 s, 300-3400 Hz, 15 dB", reverberation=0.4, limits=_TELEPHONE, noise=15.0),
)


class Changed(NamedTuple):
    """How good a model is in a condition.

    Attributes
    ----------
    scores : Scores
        Of segments of a second.
    difference : F1Difference
        Macro F1 less that of the unchanged clips.
    """

    scores: Scores
    difference: F1Difference


@dataclass(frozen=True)
class Robustness:
    """How good a model is on clips as they are, and changed.

    Attributes
    ----------
    unchanged : Scores
        Those of `evaluate_model`.
    changed : mapping of str to Changed
        By the name of the condition.
    skipped : mapping of str to int
        Why clips gave no segment, and how many.
    sources_learned : int
        Sources of which the model has learned from a segment.
    left_out : sequence of SkippedClip
        Clips that could not be read, which `skipped` counts too.
    """

    unchanged: Scores
    changed: Mapping[str, Changed]
    skipped: Mapping[str, int]
    sources_learned: int
    left_out: Sequence[SkippedClip]


def robustness(
    model: Model,
    clips: Sequence[LabelledClip],
    scenario: Scenario,
    progress: Progress,
    conditions: Sequence[Condition] = CONDITIONS,
) -> Robustness:
    """Run a model on the same segments of clips in several conditions.

    Parameters
    ----------
    model : Model
    clips : sequence of LabelledClip
    scenario : Scenario
        With the classes of the model, in any order.
    progress : callable
        Told the share of the clips that is done, 0 to 1.
    conditions : sequence of Condition
        With different names.

    Raises
    ------
    DataError
        If the classes of the model are not those of the scenario, no clip has a segment, or the
        model takes embeddings.
    """
    if model.description.embedding is not None:
        raise DataError(
            f"{model.name}: changed clips are heard by features alone, and this model takes what "
            "a network hears: `hearthlog evaluate scenes` tries it in noise (--floor, --gain)"
        )
    scenario = fitted(scenario, model)
    done = groups = learned = 0
    targets: list[Indices] = []
    group_numbers: list[Indices] = []
    predictions: list[Indices] = []
    skipped: Counter[str] = Counter()
    left_out: list[SkippedClip] = []
    batches = list(_batches(clips))
    results = in_parallel(delayed(_judge)(one, model, scenario, conditions) for one in batches)
    for batch, judged in zip(batches, results, strict=True):
        targets.append(judged.target)
        predictions.append(judged.predicted)
        group_numbers.append(judged.group + groups)
        groups += len(batch)
        skipped.update(judged.skipped)
        left_out += judged.left_out
        learned += judged.sources_learned
        done += len(batch)
        progress(done / len(clips))
    target, group = np.concatenate(targets), np.concatenate(group_numbers)
    if not len(target):
        reasons = "; ".join(f"{count}: {reason}" for reason, count in skipped.items())
        raise DataError(f"no clip has a segment to test on ({reasons[:300]}{example_of(left_out)})")
    first, *others = np.concatenate(predictions, axis=1)
    classes = tuple(scenario.classes)
    sure = np.eye(len(classes))
    return Robustness(
        unchanged=score(target, first, group, classes),
        changed={
            condition.name: Changed(
                score(target, predicted, group, classes),
                difference(target, sure[first], sure[predicted], group, classes),
            )
            for condition, predicted in zip(conditions, others, strict=True)
        },
        skipped=dict(sorted(skipped.items())),
        sources_learned=learned,
        left_out=left_out,
    )


class _Judged(NamedTuple):
    """The segments of some clips, and what a model says of them."""

    target: Indices
    group: Indices
    predicted: Indices  # shape (1 + conditions, n)
    skipped: Mapping[str, int]
    sources_learned: int
    left_out: Sequence[SkippedClip]


def _batches(clips: Sequence[LabelledClip]) -> Iterator[list[tuple[int, LabelledClip]]]:
    """Divide numbered clips; those of a source group stay together, for it has a limit."""
    groups: dict[str, list[tuple[int, LabelledClip]]] = {}
    for place, clip in enumerate(clips):
        groups.setdefault(clip.source_group, []).append((place, clip))
    batch: list[tuple[int, LabelledClip]] = []
    for group in groups.values():
        batch += group
        if len(batch) >= _CLIPS_AT_ONCE:
            yield batch
            batch = []
    if batch:
        yield batch


def _judge(
    numbered: Sequence[tuple[int, LabelledClip]],
    model: Model,
    scenario: Scenario,
    conditions: Sequence[Condition],
) -> _Judged:
    """Cut clips into segments, and run a model on them in all conditions."""
    classifier = Classifier(model)
    features = classifier.feature_set
    clips = [clip for _, clip in numbered]
    recordings = clip_recordings(clips, scenario, ignore_progress, features)
    changed = (
        _changed(recording, number, clip, conditions, features)
        for recording, (number, clip) in zip(recordings, numbered, strict=True)
    )
    data = cut_recordings(changed, scenario, features)
    versions = [(data.windows, data.floor)] if len(data) else []
    versions += zip(data.copies, data.copy_floor, strict=True)
    predicted = np.empty((1 + len(conditions), len(data)), np.intp)
    for place, (windows, floor) in enumerate(versions):
        inputs = of_segments(classifier.inputs, windows, floor)
        predicted[place] = segment_probabilities(classifier, inputs).argmax(axis=1)
    learned = len(learned_groups(model, data))
    return _Judged(data.target, data.group, predicted, data.skipped, learned, data.left_out)


def _changed(
    recording: Recording,
    number: int,
    clip: LabelledClip,
    conditions: Sequence[Condition],
    features: FeatureSet,
) -> Recording:
    """Give a recording the copies of all conditions, if it has a segment at all."""
    if len(recording.features) < features.window_frames:
        return recording
    frames, silence = clip_frames(clip), class_name(clip.label) == SILENCE
    seeds = ([_SEED, number, place] for place in range(len(conditions)))
    copies = [
        _copy(frames, condition, features, np.random.default_rng(seed), silence=silence)
        for condition, seed in zip(conditions, seeds, strict=True)
    ]
    return recording._replace(copies=copies)


def _copy(
    frames: Float32,
    condition: Condition,
    features: FeatureSet,
    rng: np.random.Generator,
    *,
    silence: bool,
) -> RoomCopy:
    """Compute the features of a sound in a condition, and the floor that a tracker would know."""
    sound = frames.ravel().astype(np.float64) * 10.0 ** (condition.gain / 20.0)
    if condition.reverberation is not None:
        sound = reverberated(sound, condition.reverberation, _DIRECT_DB, rng)
    if condition.limits is not None or condition.tilt:
        sound = filtered(sound, condition.response)
    if condition.noise is not None and features.band_powers is not None:
        level = level_of(sound) - condition.noise
        return in_noise(sound, level, features, rng, silence=silence)
    copy = captured(sound, features)
    if silence and features.band_powers is not None:
        return RoomCopy(copy, low_power(features.band_powers(copy)))
    return RoomCopy(copy, np.zeros(features.bands))


def main(
    model: ModelFile,
    *,
    data: Clips,
    scenario: OwnScenario = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Score a model on labelled clips in noise, in other rooms and by other microphones.

    Exit status 3: the model has learned from some of the clips, or some cannot be read.
    """
    check_output("--plot", plot, ".png", "a picture")
    loaded, clips, classes, left_out = read_model_and_clips(model, data, scenario)
    with share_done(f"listening to {number(len(clips), 'clip')}", announce=True) as report:
        found = robustness(loaded, clips, classes, report)
    if plot is not None:
        save_robustness(plot, f"{loaded.name} on changed clips of {data}", found)
    if as_json:
        print_json(
            {"model": str(model), "sha256": loaded.sha256, "scenario": classes.name}
            | {"unchanged": asdict(found.unchanged)}
            | {
                "changed": {
                    name: asdict(one.scores) | {"difference": asdict(one.difference)}
                    for name, one in found.changed.items()
                },
                "skipped": dict(found.skipped),
                "sources_learned": found.sources_learned,
            }
        )
    else:
        print(
            f"model {loaded.name}, scenario {classes.name}: {found.unchanged.segments} segments of "
            f"1 s from {found.unchanged.groups} sources\n"
        )
        print_robustness(found)
        print_skipped(found.skipped, "clips")
    warnings = left_out_lines([*left_out, *found.left_out])
    end_with_warnings([*warnings, *learned_lines(found.sources_learned, found.unchanged.groups)])


def print_robustness(found: Robustness) -> None:
    """Print how good a model is in each condition."""
    scores = found.unchanged
    rows = [("unchanged", share(scores.macro_f1), between(scores.macro_f1_interval), "", "")]
    for name, (scores, against) in found.changed.items():
        change = against.interval
        rows.append(
            (
                name,
                share(scores.macro_f1),
                between(scores.macro_f1_interval),
                f"{against.macro_f1:+.3f}",
                "-" if change is None else f"{change[0]:+.3f} to {change[1]:+.3f}",
            )
        )
    print_table(("clips", "macro F1", "95 %", "change", "95 %"), rows)


def save_robustness(path: Path, title: str, found: Robustness) -> None:
    """Draw a map of F1 by class and condition.

    Parameters
    ----------
    path : Path
        Of a PNG file, which must not exist.
    title : str
    found : Robustness

    Raises
    ------
    LogError
        If the file exists, or cannot be written.
    """
    every = {"unchanged": found.unchanged} | {k: v.scores for k, v in found.changed.items()}
    classes = [name for name, one in found.unchanged.per_class.items() if one.support]
    f1 = np.array([[one.macro_f1 for one in every.values()]])
    rows = [[one.per_class[name].f1 or 0.0 for one in every.values()] for name in classes]
    f1 = np.concatenate([np.array(rows), f1])
    figure = new_figure((2.5 + 0.62 * len(every), 2.5 + 0.4 * len(f1)), title)
    axes = figure.subplots()
    axes.imshow(f1, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for (row, column), value in np.ndenumerate(f1):
        shade = "white" if value > 0.5 else "black"
        axes.text(column, row, f"{100 * value:.0f}", ha="center", va="center", color=shade)
    axes.axhline(len(classes) - 0.5, color="black", linewidth=1)
    axes.set_xticks(range(len(every)), every, rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(f1)), [*plot_names(classes), "macro"])
    axes.set_title("F1 of segments of a second, %", fontsize=10)
    save_figure(figure, path)


if __name__ == "__main__":
    run(main)
