"""`python -m hearthlog.tools.lab.guard MANIFEST … --model FILE`: the speech that would be kept.

Clips of sources that the model has not learned from are heard one after another in a room: near,
20 dB fainter, 20 dB fainter with reverberation, over running water and over music. Counted is which
of their loud frames `keep_audio = "always"` keeps; of other sounds that is what the guard costs.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.scenes import background
from hearthlog.analyzer.logs.text_files import csv_records, read_text
from hearthlog.analyzer.training.clips import clip_frames, reverberated
from hearthlog.analyzer.training.manifest import LABELS, SIZE_LIMIT, LabelledClip, read_manifest
from hearthlog.models.classes import MUSIC, SILENCE, SPEECH
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.embedding.networks import YAMNET, Embedder, find_network, load_embedder
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.events import Frames
from hearthlog.recorder.log.clips import ClipFinder
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.lab.command import run

_NEAR_DBFS = -18.0  # of the loudest frame
_FAINTER = -20.0  # dB
_ABOVE_MASKER = 10.0  # dB, of the mean of the loud frames
_FLOOR_DBFS = -66.0  # of the room, pink
_LOUD_DBFS, _LOUD_BELOW = -60.0, 25.0  # a frame above that, and so far below its clip's loudest
_SETTLING, _PAUSE = 200, 40  # frames before the first clip, and on either side of one
_REVERBERATION_SECONDS, _DIRECT_DB = 0.5, -3.0
_WATER = {"tap_water", "shower"}
_BLOCK_FRAMES = 400
_FEWEST = 100  # loud frames of a collection that is named
_SEED = 0
_MODEL = starter_file(GENERAL)
_LEARNED = _MODEL.with_name("sources.csv")


class Way(NamedTuple):
    """How clips are heard.

    Attributes
    ----------
    name : str
    gain : float
        In dB.
    reverberant : bool
    over : frozenset of str
        Labels of what sounds at the same time; empty for nothing.
    """

    name: str
    gain: float = 0.0
    reverberant: bool = False
    over: frozenset[str] = frozenset()


NEAR, FAR = Way("near"), Way("20 dB fainter", _FAINTER)
WAYS = (
    NEAR,
    FAR,
    Way("20 dB fainter, reverberant", _FAINTER, reverberant=True),
    Way("over water, 10 dB below", over=frozenset(_WATER)),
    Way("over music, 10 dB below", over=frozenset({MUSIC})),
)


class Piece(NamedTuple):
    """Successive frames of what a microphone hears.

    Attributes
    ----------
    frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
    loud : np.ndarray [shape=(n,)], bool
        Which are loud ones of the clip.
    """

    frames: Float32
    loud: Bool


class Kept(NamedTuple):
    """How much of clips is kept.

    Attributes
    ----------
    loud, kept : np.ndarray [shape=(n,)], int64
        Loud frames of each clip, and how many of them are kept.
    """

    loud: Int64
    kept: Int64

    @property
    def share(self) -> float:
        """Percentage of the loud frames."""
        return 100.0 * float(self.kept.sum() / max(self.loud.sum(), 1))


def measure(
    clips: Sequence[LabelledClip],
    way: Way,
    maskers: Sequence[Float64],
    classifier: Classifier,
    embedder: Embedder | None = None,
) -> Kept:
    """Hear clips one after another, and count what is kept of them.

    Parameters
    ----------
    clips : sequence of LabelledClip
    way : Way
    maskers : sequence of np.ndarray [shape=(n,)], float64
        Sounds of which one is heard with each clip; none, if it is heard alone.
    classifier : Classifier
        Has a class `speech`.
    embedder : Embedder, optional
        Of a classifier that takes embeddings.

    Raises
    ------
    SourceError
        If a clip cannot be read.
    """
    rng = np.random.default_rng(_SEED)
    pieces = [_settling(rng), *(clip_at_microphone(clip, way, maskers, rng) for clip in clips)]
    kept = _kept([piece.frames for piece in pieces], classifier, embedder)
    counts = []
    start = 0
    for piece in pieces:
        part = kept[start : start + len(piece.loud)]
        counts.append((piece.loud.sum(), part[piece.loud].sum()))
        start += len(piece.loud)
    loud, of_them = np.array(counts[1:]).T
    return Kept(loud, of_them)


def _settling(rng: np.random.Generator) -> Piece:
    nothing = np.zeros(_SETTLING * FRAME_SAMPLES)
    return Piece(_at_microphone(nothing, rng), np.zeros(_SETTLING, bool))


def clip_at_microphone(
    clip: LabelledClip, way: Way, maskers: Sequence[Float64], rng: np.random.Generator
) -> Piece:
    """Make what is heard of a clip: between two seconds of the room, or of the masker.

    Parameters
    ----------
    clip : LabelledClip
        Of at least one frame.
    way : Way
    maskers : sequence of np.ndarray [shape=(n,)], float64
        As of `measure`.
    rng : np.random.Generator

    Raises
    ------
    SourceError
        If the clip cannot be read.
    """
    sound = clip_frames(clip).ravel().astype(np.float64)
    if way.reverberant:
        sound = np.append(sound, np.zeros(SAMPLE_RATE // 2))
        sound = sound[: len(sound) // FRAME_SAMPLES * FRAME_SAMPLES]
        sound = reverberated(sound, _REVERBERATION_SECONDS, _DIRECT_DB, rng)
    sound *= 10.0 ** ((_NEAR_DBFS + way.gain - _levels(sound).max()) / 20.0)
    pause = np.zeros(_PAUSE * FRAME_SAMPLES)
    sound = np.concatenate([pause, sound, pause])
    levels = _levels(sound)
    loud = (levels > _LOUD_DBFS) & (levels > levels.max() - _LOUD_BELOW)
    if maskers:
        masker = _looped(maskers[int(rng.integers(len(maskers)))], len(sound), rng)
        below = np.square(sound.reshape(-1, FRAME_SAMPLES)[loud]).mean()
        sound += masker * np.sqrt(below / np.square(masker).mean()) * 10 ** (-_ABOVE_MASKER / 20)
    return Piece(_at_microphone(sound, rng), loud)


def _levels(sound: Float64) -> Float64:
    power = np.square(sound.reshape(-1, FRAME_SAMPLES)).mean(axis=1)
    levels: Float64 = 10.0 * np.log10(power + 1e-12)
    return levels


def _looped(masker: Float64, count: int, rng: np.random.Generator) -> Float64:
    return np.resize(np.roll(masker, -int(rng.integers(len(masker)))), count)


def _at_microphone(sound: Float64, rng: np.random.Generator) -> Float32:
    """Return the frames of a sound in the noise of the room, as a microphone gives them."""
    seconds, seed = (len(sound) + 1) / SAMPLE_RATE, int(rng.integers(1 << 31))
    heard = sound + background(seconds, _FLOOR_DBFS, "pink", seed)[: len(sound)]
    pcm = np.clip(np.rint(heard * 32768.0), -32768, 32767)
    return (pcm / 32768.0).astype(np.float32).reshape(-1, FRAME_SAMPLES)


def _kept(pieces: Iterable[Float32], classifier: Classifier, embedder: Embedder | None) -> Bool:
    """Tell which frames of a sound the recorder would keep."""
    features = classifier.feature_set
    pipeline = Pipeline("mic", features, classifier, embedder=embedder)
    finder = ClipFinder(
        "always", [SPEECH], 0, features.window_frames, most_ahead=pipeline.most_ahead
    )
    stamps: list[Int64] = []
    first = 0
    for piece in pieces:
        for start in range(0, len(piece), _BLOCK_FRAMES):
            frames = piece[start : start + _BLOCK_FRAMES]
            times = (first + np.arange(len(frames))) * FRAME_NANOSECONDS
            pipeline.push(Frames(first, frames, times))
            assert pipeline.last_frames is not None
            sounds = finder.push(pipeline.last_frames, pipeline.last_labels)
            stamps += [sound.stamps for sound in sounds]
            first += len(frames)
    stamps += [sound.stamps for sound in finder.close()]
    kept = np.zeros(first, bool)
    kept[np.concatenate([np.empty(0, np.int64), *stamps]) // FRAME_NANOSECONDS] = True
    return kept


def guard(
    manifests: Annotated[list[Path], typer.Argument(help="Of clips, as for `hearthlog train`.")],
    model: Annotated[Path, typer.Option(help="That says what is speech.")] = _MODEL,
    learned: Annotated[
        Path,
        typer.Option("--data", help="What the model has learned from; those sources are left out."),
    ] = _LEARNED,
) -> None:
    """Measure how much of speech, and of other sounds, `keep_audio = "always"` keeps."""
    classifier = Classifier(load_model(model))
    if SPEECH not in classifier.classes:
        raise DataError(f"{model}: has no class {SPEECH!r}")
    embedder = None
    if classifier.embedding_heads is not None:
        path = find_network(YAMNET.name)
        embedder = None if path is None else load_embedder(YAMNET.name, path)
        print(f"with {YAMNET.name}" if path else f"without {YAMNET.name}, which is not there")
    clips = unheard(manifests, learned)
    speech = [clip for clip in clips if clip.label == SPEECH]
    print(f"speech, {len(speech)} clips        sources  loud frames   kept  most of a collection")
    for way in WAYS:
        maskers = maskers_of(clips, way.over)
        if not speech or (way.over and not maskers):
            raise DataError(f"no clips of {' or '.join(way.over or [SPEECH])} from other sources")
        kept = measure(speech, way, maskers, classifier, embedder)
        print(
            f"{way.name:28s} {_sources(speech):7d} {kept.loud.sum():12d} {kept.share:5.2f}%", end=""
        )
        print("  {} {:.2f}%".format(*_worst(speech, kept)), flush=True)
    print(f"\n{'other sounds':28s} {'sources':>7s} {'near':>12s} {FAR.name:>14s}")
    for label in sorted({clip.label for clip in clips} - {SPEECH, SILENCE}):
        chosen = [clip for clip in clips if clip.label == label]
        near, far = (measure(chosen, way, [], classifier, embedder).share for way in (NEAR, FAR))
        print(f"{label:28s} {_sources(chosen):7d} {near:11.0f}% {far:13.0f}%", flush=True)


def unheard(manifests: Sequence[Path], learned: Path) -> list[LabelledClip]:
    """Read the clips whose sources the model has not learned from.

    Parameters
    ----------
    manifests : sequence of Path
    learned : Path
        Manifest of what it has learned from; only its column `source_group` is read.

    Raises
    ------
    DataError
        If a manifest cannot be used.
    """
    lines = csv_records(learned, read_text(learned, "manifest", SIZE_LIMIT))
    _, header = next(lines, (1, []))
    if "source_group" not in header:
        raise DataError(f"{learned}:1: no column source_group in the first line")
    place = header.index("source_group")
    heard = {record[place] for _, record in lines if len(record) > place}
    clips = [clip for path in manifests for clip in read_manifest(path, LABELS)]
    return [clip for clip in clips if clip.source_group not in heard]


def maskers_of(clips: Sequence[LabelledClip], labels: frozenset[str]) -> list[Float64]:
    """Join the clips of each source to one long sound.

    Parameters
    ----------
    clips : sequence of LabelledClip
    labels : frozenset of str
        Of the clips to take.
    """
    sources: dict[str, list[Float32]] = {}
    for clip in clips:
        if clip.label in labels:
            sources.setdefault(clip.source_group, []).append(clip_frames(clip).ravel())
    return [np.concatenate(parts).astype(np.float64) for parts in sources.values()]


def _sources(clips: Sequence[LabelledClip]) -> int:
    return len({(clip.source, clip.source_group) for clip in clips})


def _worst(clips: Sequence[LabelledClip], kept: Kept) -> tuple[str, float]:
    """Name the collection of which most is kept, of those with enough to say."""
    loud: Counter[str] = Counter()
    of_them: Counter[str] = Counter()
    for clip, frames, some in zip(clips, *kept, strict=True):
        loud[clip.source] += int(frames)
        of_them[clip.source] += int(some)
    shares = [(100.0 * of_them[name] / loud[name], name) for name in loud if loud[name] >= _FEWEST]
    share, name = max(shares, default=(kept.share, "all"))
    return name, share


if __name__ == "__main__":
    run(guard)
