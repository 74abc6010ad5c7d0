"""`python -m hearthlog.tools.lab.scenes MANIFEST --model FILE …`: models in long scenes.

Scenes are composed of clips of one half of the source groups (`--half`), 0.5, 2 or 6 s apart over
steady noise, as in a home that the models never heard if they have learned from the other half
(`--learn FILE` writes the manifest of that). All models hear the same scenes. Silence does not
count in the means.
"""

import csv
import hashlib
import random
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.evaluation.log_scores import LogEvaluation, evaluate_labelling
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import BUILTIN, LABELS, LabelledClip, read_manifest
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.embedding.networks import YAMNET, Embedder, find_network, load_embedder
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.events import Frames
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import nanoseconds
from hearthlog.tools.lab.command import run

_PAUSES = (0.5, 2.0, 6.0)  # seconds
_LENGTHS = (3.0, 10.0)
_BLOCK = 12_000  # frames


class Scene(NamedTuple):
    """A scene: its sound, and what is in it.

    Attributes
    ----------
    frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
    truth : Labelling
        Silence between the sounds included.
    """

    frames: Float32
    truth: Labelling


def compose_scene(
    clips: Sequence[LabelledClip], seconds: float, seed: int, *, noisy: bool = False
) -> Scene:
    """Lay clips into steady noise, as many of each label.

    Parameters
    ----------
    clips : sequence of LabelledClip
        None of silence.
    seconds : float
    seed : int
    noisy : bool
        Whether they are 12 dB fainter, in pink noise of -50 dBFS; else it is white, of -70 dBFS.
    """
    rng = random.Random(seed)
    gain = np.float32(10 ** (-12 / 20) if noisy else 1.0)
    by_label: dict[str, list[LabelledClip]] = {}
    for clip in clips:
        by_label.setdefault(clip.label, []).append(clip)
    sound = _noise(round(seconds * SAMPLE_RATE), -50.0 if noisy else -70.0, seed, pink=noisy)
    spans, time = [], 2.0
    while time < seconds - max(_LENGTHS) - max(_PAUSES):
        label = rng.choice(sorted(by_label))
        samples = clip_frames(rng.choice(by_label[label])).ravel()
        samples = samples[: round(rng.uniform(*_LENGTHS) * SAMPLE_RATE)]
        start = round(time * SAMPLE_RATE)
        sound[start : start + len(samples)] += gain * samples
        spans.append((time, time + len(samples) / SAMPLE_RATE, label))
        time = spans[-1][1] + rng.choice(_PAUSES)
    frames = np.clip(sound[: len(sound) // FRAME_SAMPLES * FRAME_SAMPLES], -1.0, 1.0)
    return Scene(frames.reshape(-1, FRAME_SAMPLES), _labelling(spans, seconds))


def label_scene(frames: Float32, classifier: Classifier, embedder: Embedder | None) -> Labelling:
    """Return the segments of a scene as a recorder would write them.

    Parameters
    ----------
    frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
    classifier : Classifier
    embedder : Embedder or None
    """
    pipeline = Pipeline("mic", classifier.feature_set, classifier, embedder=embedder)
    messages = []
    for first in range(0, len(frames), _BLOCK):
        block = frames[first : first + _BLOCK]
        stamps = (first + np.arange(len(block))) * FRAME_NANOSECONDS
        messages += pipeline.push(Frames(first, block, stamps))
    messages += pipeline.finish()
    rows = [
        message_types.decode(message.data, message_types.SEGMENT)
        for message in messages
        if message.topic == "/mic/segment"
    ]
    starts = np.array([nanoseconds(row.header.stamp) for row in rows], np.int64)
    lengths = np.array([nanoseconds(row.duration) for row in rows], np.int64)
    return Labelling(starts, starts + lengths, np.array([row.label for row in rows], object))


def half_of(source_group: str) -> int:
    """Return which half of all sources one is in, 0 or 1."""
    return hashlib.sha256(source_group.encode()).digest()[0] % 2


def _noise(count: int, level: float, seed: int, *, pink: bool) -> Float32:
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(count))
    if pink:
        spectrum /= np.sqrt(np.maximum(np.fft.rfftfreq(count, 1 / SAMPLE_RATE), 20.0))
    noise = np.fft.irfft(spectrum, count)
    scaled: Float32 = (noise / noise.std() * 10 ** (level / 20)).astype(np.float32)
    return scaled


def _labelling(spans: Sequence[tuple[float, float, str]], seconds: float) -> Labelling:
    """Fill the time between sounds with silence."""
    edges = [0.0, *(time for span in spans for time in span[:2]), seconds]
    quiet = [(a, b, SILENCE) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
    rows = sorted([*spans, *quiet])
    starts = np.array([round(start * NANOSECONDS) for start, _, _ in rows])
    ends = np.array([round(end * NANOSECONDS) for _, end, _ in rows])
    return Labelling(starts, ends, np.array([label for _, _, label in rows], object))


def _write_manifest(clips: Iterable[LabelledClip], path: Path) -> None:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["path", "label", "source_group", "source", "licence"])
        for clip in clips:
            row = clip.path.resolve(), clip.label, clip.source_group, clip.source, clip.licence
            writer.writerow(row)


def _row(scores: Sequence[LogEvaluation]) -> str:
    """Return means over scenes: F1 of frames, F1 of events, false events in an hour."""
    frames = np.mean([each.scores.macro_f1 for each in scores])
    events = np.mean([each.detections.event_based.macro_f1 or 0.0 for each in scores])
    false = np.mean(
        [
            sum(n for name, n in each.detections.false_alarms_per_day.items() if name != SILENCE)
            / 24
            for each in scores
        ]
    )
    return f"{frames:.3f}  {events:.3f}  {false:5.0f}"


def main(
    manifest: Annotated[list[Path], typer.Argument(help="Labelled clips.")],
    model: Annotated[list[Path], typer.Option(help="Models to compare.")],
    scenario: Annotated[str, typer.Option()] = "general",
    half: Annotated[int | None, typer.Option(help="Half of the sources: 0 or 1.")] = None,
    source: Annotated[list[str] | None, typer.Option(help="Only these collections.")] = None,
    seed: Annotated[list[int] | None, typer.Option(help="One for each scene.")] = None,
    seconds: Annotated[float, typer.Option(help="Of a scene.")] = 1800.0,
    noisy: Annotated[bool, typer.Option(help="12 dB fainter, in noise of -50 dBFS.")] = False,  # noqa: FBT002
    learn: Annotated[Path | None, typer.Option(help="Manifest of all else to write.")] = None,
) -> None:
    """Compose scenes, label them with each model, and print a table."""
    clips = [clip for path in manifest for clip in read_manifest(path, LABELS)]
    chosen = [
        clip
        for clip in clips
        if (half is None or half_of(clip.source_group) == half)
        and (not source or clip.source in source)
    ]
    if learn is not None:
        kept = {id(clip) for clip in chosen}
        _write_manifest((clip for clip in clips if id(clip) not in kept), learn)
    classes = BUILTIN[scenario].classes
    known = {
        label
        for name, labels in classes.items()
        if name not in {SILENCE, UNKNOWN}
        for label in labels
    }
    sounds = [clip for clip in chosen if clip.label in known]
    scenes = [compose_scene(sounds, seconds, one, noisy=noisy) for one in seed or [10, 11]]
    path = find_network(YAMNET.name)
    embedder = None if path is None else load_embedder(YAMNET.name, path)
    print(f"{len(scenes)} scenes of {seconds / 60:.0f} min, {len(sounds)} clips")
    print("frames events false/h  model")
    for file in model:
        classifier = Classifier(load_model(file))
        heard = embedder if classifier.embedding_heads is not None else None
        names = {label: name for name, labels in classes.items() for label in labels}
        scores = []
        for scene in scenes:
            labels = np.array([names.get(label, label) for label in scene.truth.labels], object)
            truth = Labelling(scene.truth.starts, scene.truth.ends, labels)
            found = label_scene(scene.frames, classifier, heard)
            scores.append(evaluate_labelling(truth, found, classifier.classes))
        print(f"{_row(scores)}  {file.stem}", flush=True)
        print(
            "  "
            + "  ".join(f"{k} {v.f1 or 0.0:.2f}" for k, v in scores[0].scores.per_class.items())
        )


if __name__ == "__main__":
    run(main)
