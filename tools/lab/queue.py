"""`python -m hearthlog.tools.lab.queue`: what a review's queue teaches, and what chance does.

In one scene a person corrects the first spans of the queue, or as many random ones; the model is
learned again, and scored on another scene of the same home.
"""

import csv
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Event as Flag
from typing import Annotated, NamedTuple

import numpy as np
import soundfile
import typer

from hearthlog.analyzer.evaluation import indexed_events
from hearthlog.analyzer.evaluation.scenes import Colour, background, compose
from hearthlog.analyzer.logs.labelling import Labelling, find_labellings
from hearthlog.analyzer.logs.sound_vectors import EMBEDDING_FIELDS, embeddings_of
from hearthlog.analyzer.logs.spans import NONE, rows_at
from hearthlog.analyzer.review.ranking import USEFUL, make_queue
from hearthlog.analyzer.review.review_queue import ReviewItem
from hearthlog.analyzer.review.spans import judgeable_spans
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.analyzer.training.manifest import BUILTIN, LabelledClip, read_manifest
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES, Int8
from hearthlog.models.features.floor import FloorTracker, is_quiet
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.messages.topics import LIVE, EmbeddingSource, topic
from hearthlog.tools.home.clips import SHIPPED
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.home.person import Person

_SCENARIO = BUILTIN["general"]
_START = 1_772_323_200 * NANOSECONDS
_SPAN_COUNTS = (20, 60)
_EVERY = 8  # windows
_FIELDS = ("header.stamp", "frame", "values")
_FEWEST_RUNS = 12
_GAIN = 0.03
_STARTER = starter_file(GENERAL)
_QUEUE, _CHANCE = "queue", "random"


class Room(NamedTuple):
    """Steady noise, and how loud the sounds are in it."""

    floor: float  # dBFS
    colour: Colour
    gain: float  # dB


ROOMS = (Room(-70.0, "white", 0.0), Room(-60.0, "pink", -6.0), Room(-58.0, "brown", 4.0))


class Outcome(NamedTuple):
    """What came of some spans in one run."""

    run: str
    spans: int
    chosen: str  # `queue` or `random`
    seconds: float  # of sound that was asked
    macro_f1: float  # by frame, of another scene
    silence_f1: float


class Recorded(NamedTuple):
    """The logs of a scene, and what is true of it, in nanoseconds of UTC."""

    logs: Path
    truth: Labelling


class EvaluationSet(NamedTuple):
    """Windows of a scene."""

    inputs: Float32
    quiet: Bool
    embedded: Int8  # what the network of the model hears there; without one nothing
    is_embedded: Bool
    true: "np.ndarray[tuple[int], np.dtype[np.object_]]"


class Conditions(NamedTuple):
    """What is measured with.

    Attributes
    ----------
    model : Path
        File of a model of scenario `general`.
    manifest : Path
        Clips that it has not learned from.
    minutes : float
        Length of a scene.
    draws : int
        How many times random spans are drawn.
    """

    model: Path
    manifest: Path
    minutes: float
    draws: int


def queue(
    *,
    model: Annotated[Path, typer.Option(help="Which labels.")] = _STARTER,
    manifest: Annotated[
        Path, typer.Option(help="Clips that it has not learned from, of which homes are composed.")
    ] = SHIPPED,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Table of outcomes; what is there is kept.")
    ] = Path("queue.csv"),
    seed: Annotated[int, typer.Option(help="Of the first home.")] = 0,
    homes: Annotated[int, typer.Option(help="In each of three rooms, both ways.")] = 1,
    minutes: Annotated[float, typer.Option(help="Length of a scene.")] = 20.0,
    draws: Annotated[int, typer.Option(help="Of random spans.")] = 3,
) -> None:
    """Measure what a model gains by the spans that a review asks for."""
    conditions = Conditions(model, manifest, minutes, draws)
    for number in range(seed, seed + homes):
        for room in range(len(ROOMS)):
            for outcome in outcomes(conditions, room, number):
                _append(output, outcome)
    print(table_of(list(_read(output))))


def outcomes(conditions: Conditions, room: int, seed: int) -> Iterator[Outcome]:
    """Ask in each of two scenes of a home, and score on the other one.

    Parameters
    ----------
    conditions : Conditions
    room : int
        Place in `ROOMS`.
    seed : int
        Another one is another home.

    Yields
    ------
    Outcome
        As each is measured.
    """
    base = load_model(conditions.model)
    name = f"{conditions.model.stem} {conditions.manifest}"
    with tempfile.TemporaryDirectory(prefix="hearthlog-queue-") as folder:
        places = [Path(folder) / str(way) for way in (0, 1)]
        scenes = [
            recorded(place, conditions, ROOMS[room], 2 * seed + way)
            for way, place in enumerate(places)
        ]
        for way in (0, 1):
            scene, other = scenes[way], read_evaluation_set(scenes[1 - way], base)
            run = f"{name} {room} {seed} {way}"
            for count in _SPAN_COUNTS:
                spans = by_queue(scene.logs, count)
                yield Outcome(run, count, _QUEUE, *_learned(spans, scene, other, base))
                for draw in range(conditions.draws):
                    spans = by_chance(scene.logs, count, [seed, room, way, draw])
                    yield Outcome(run, count, _CHANCE, *_learned(spans, scene, other, base))


def table_of(results: Sequence[Outcome]) -> Table:
    """Compare the queue with chance, run by run.

    Parameters
    ----------
    results : sequence of Outcome
        At least one of each kind in every run.
    """
    rows = []
    for count in _SPAN_COUNTS:
        some = [one for one in results if one.spans == count]
        runs = sorted({one.run for one in some})
        by = {
            (run, kind): np.array([o.macro_f1 for o in some if (o.run, o.chosen) == (run, kind)])
            for run in runs
            for kind in (_QUEUE, _CHANCE)
        }
        own = np.array([by[run, _QUEUE].mean() for run in runs])
        chance = np.array([by[run, _CHANCE].mean() for run in runs])
        lowest = np.array([by[run, _CHANCE].min() for run in runs])
        seconds = [np.mean([o.seconds for o in some if o.chosen == k]) for k in (_QUEUE, _CHANCE)]
        quiet = min(one.silence_f1 for one in some if one.chosen == _QUEUE)
        rows += [
            Row(f"{count} spans: macro F1", float(own.mean()), note=f"of sd {own.std():.3f}"),
            Row("  over random spans", float((own - chance).mean()), target=Target(_GAIN)),
            Row("  runs, of which better", float((own > chance).sum()), note=f"of {len(runs)}"),
            Row(
                "  under the lowest random",
                float((own < lowest).sum()),
                target=Target(0, at_most=True),
            ),
            Row("  sound asked for", float(seconds[0]), "s", note=f"{seconds[1]:.0f} s at random"),
            Row("  lowest F1 of silence", quiet),
        ]
    return Table("the first spans of the queue, learned, on another scene of the home", rows)


def recorded(folder: Path, conditions: Conditions, room: Room, seed: int) -> Recorded:
    """Compose a scene, and record it with a model.

    Parameters
    ----------
    folder : Path
        New.
    conditions : Conditions
    room : Room
    seed : int
        Another one is another scene.
    """
    clips: dict[str, list[LabelledClip]] = {}
    for clip in read_manifest(conditions.manifest, _SCENARIO.labels):
        if _SCENARIO.find(clip.label) not in {None, SILENCE}:
            clips.setdefault(clip.label, []).append(clip)
    noise = background(60.0 * conditions.minutes, room.floor, room.colour, seed)
    scene = compose(clips, _sound, noise, seed, room.gain)
    folder.mkdir()
    wav = folder / "scene.wav"
    soundfile.write(wav, scene.samples, SAMPLE_RATE, "PCM_16")
    settings = Settings(output=folder / "logs", model=conditions.model, timezone="UTC")
    record(settings, FileSource([wav], _START), Flag())
    times = np.array([span[:2] for span in scene.truth])
    starts, ends = _START + np.rint(times * NANOSECONDS).astype(np.int64).T
    labels = [_SCENARIO.find(span.label) or UNKNOWN for span in scene.truth]
    return Recorded(folder / "logs", Labelling(starts, ends, np.array(labels, object)))


def _sound(clip: LabelledClip) -> Float32:
    return np.concatenate([*read_audio(clip.path, clip.start, clip.end)])


def by_queue(logs: Path, count: int) -> list[ReviewItem]:
    """Return the first useful spans of logs.

    Parameters
    ----------
    logs : Path
        Folder.
    count : int
    """
    sources = find_labellings(logs)
    side = sources.read(sources.microphone(None), LIVE)
    chosen = make_queue(
        sources,
        sources.microphone(None),
        side,
        other=None,
        reviewed=NONE,
        count=count,
        ranking=USEFUL,
    ).spans
    return _items(chosen.starts, chosen.ends)


def by_chance(logs: Path, count: int, seed: Sequence[int]) -> list[ReviewItem]:
    """Draw from the spans that a queue of the same logs is made of.

    Parameters
    ----------
    logs : Path
        Folder.
    count : int
    seed : sequence of int
    """
    sources = find_labellings(logs)
    side = sources.read(sources.microphone(None), LIVE)
    spans = judgeable_spans(indexed_events(side.labelling, side.classes))
    rows = np.random.default_rng(seed).permutation(len(spans))[:count]
    return _items(spans.starts[rows], spans.ends[rows])


def _items(starts: Int64, ends: Int64) -> list[ReviewItem]:
    times = zip(starts.tolist(), ends.tolist(), strict=True)
    return [ReviewItem(start, end, "", "") for start, end in times]


def _learned(
    items: Sequence[ReviewItem], scene: Recorded, other: EvaluationSet, base: Model
) -> tuple[float, float, float]:
    """Correct spans and learn again; return seconds, macro F1 and F1 of silence."""
    for layer in scene.logs.rglob("*.review.mcap"):
        layer.unlink()
    Person(scene.truth).go_through(items, scene.logs, _START + 86_400 * NANOSECONDS)
    segments = read_home_training_set([scene.logs], base)[0]
    scores = _scores(adapt_model(base, segments), other)
    seconds = sum(item.end - item.start for item in items) / NANOSECONDS
    known = [score for name, score in scores.items() if name != UNKNOWN]
    return seconds, float(np.mean(known)), scores[SILENCE]


def read_evaluation_set(scene: Recorded, model: Model) -> EvaluationSet:
    """Return every eighth window of a scene, and what is true in its middle.

    Parameters
    ----------
    scene : Recorded
    model : Model
        Whose inputs they are.
    """
    classifier = Classifier(model)
    features, window = classifier.feature_set, classifier.inputs.window_frames
    assert features.band_powers is not None
    name = topic("mic", "features")
    recorded = read_columns([*scene.logs.rglob("*.mcap")], {name}, fields=_FIELDS)[name]
    powers = features.band_powers(recorded["values"])
    floors = FloorTracker()(powers, int(recorded["frame"][0])).powers
    inputs = classifier.inputs.stream()(recorded["values"][-len(floors) :], floors)
    count = len(inputs)
    quiet = is_quiet(powers[-count - window + 1 :], floors[-count:], window, classifier.gate)
    middles = recorded["header.stamp"][-count:] - (window // 2) * FRAME_NANOSECONDS
    some = slice(None, None, _EVERY)
    true = scene.truth.labels[rows_at(scene.truth, middles[some])]
    return EvaluationSet(inputs[some], quiet[some], *_embedded(scene, model, middles[some]), true)


def _embedded(scene: Recorded, model: Model, middles: Int64) -> tuple[Int8, Bool]:
    """Return the embedding around each moment, if it is one that a model takes."""
    name, space = topic("mic", "embedding"), model.description.embedding_space
    fields = EMBEDDING_FIELDS
    columns = read_columns([*scene.logs.rglob("*.mcap")], {name}, fields=fields).get(name)
    source = None if columns is None else EmbeddingSource.from_metadata(columns.metadata)
    if columns is None or source is None or source.space != space:
        return np.empty((len(middles), 0), np.int8), np.zeros(len(middles), bool)
    embeddings = embeddings_of(columns)
    starts = embeddings.stamps + (WINDOW_FRAMES - HOP_FRAMES) // 2 * FRAME_NANOSECONDS
    row = np.maximum(np.searchsorted(starts, middles, "right") - 1, 0)
    return embeddings.values[row], middles - starts[row] < HOP_FRAMES * FRAME_NANOSECONDS


def _scores(model: Model, data: EvaluationSet) -> dict[str, float]:
    """Return the F1 of each class that is there."""
    classes = np.array(model.classes, object)
    labels = np.full(len(data.inputs), SILENCE, object)
    loud = ~data.quiet
    classifier, by_heads = Classifier(model), None
    if classifier.embedding_heads is not None:
        by_heads = classifier.embedding_heads.log_probabilities(data.embedded[loud])
        by_heads[~data.is_embedded[loud]] = np.nan
    probabilities, _ = classifier.classify(data.inputs[loud], None, by_heads)
    labels[loud] = classes[probabilities.argmax(axis=1)]
    return {
        name: 2.0 * float(((labels == name) & (data.true == name)).sum())
        / float((labels == name).sum() + (data.true == name).sum())
        for name in sorted(set(data.true))
    }  # fmt: skip


def _append(path: Path, outcome: Outcome) -> None:
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(Outcome._fields)
        writer.writerow(outcome)


def _read(path: Path) -> Iterator[Outcome]:
    with path.open(newline="") as file:
        for row in list(csv.reader(file))[1:]:
            run, spans, chosen, *numbers = row
            yield Outcome(run, int(spans), chosen, *map(float, numbers))


if __name__ == "__main__":
    run(queue)
