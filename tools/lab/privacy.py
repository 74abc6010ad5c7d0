"""`python -m hearthlog.tools.lab.privacy MANIFEST`: how much of speech can be made of a log.

Speech is synthesised from its features: as they are logged, in longer frames, and every 10 ms for a
control that must be intelligible. A recogniser, PocketSphinx, hears it. Beside that, digits are
guessed from the features themselves, and from the embeddings where there is a network, by what is
learned from other speakers; and speakers by what is learned from their other digits.
"""

import csv
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LABELS, LabelledClip, read_manifest
from hearthlog.models.classes import SPEECH
from hearthlog.models.embedding import WINDOW_FRAMES
from hearthlog.models.embedding.networks import (
    YAMNET,
    Embedder,
    EmbeddingStream,
    find_network,
    load_embedder,
)
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.auros21 import AUROS21, ENERGY, FLUX
from hearthlog.models.features.home33 import HOME33
from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.recogniser import DIGITS, Recogniser, intelligibility, word_errors
from hearthlog.tools.lab.vocoder import Logged, logged, sound_of

_RATES = (10, 50, 100, 250, 500, 1000)  # ms from frame to frame; the first is the control
_LONGEST, _SHORTEST = 8.0, 3.0  # seconds of a sentence
_PAUSE_SECONDS, _PAUSE_DBFS = 1.0, -60.0  # around a digit
_GATE_FRAMES = 8  # behind a sound, in which a recorder still finds it above the floor
_PARTS = 8  # of a digit
_TINY = 1e-7


class Spoken(NamedTuple):
    """Speech whose words are known.

    Attributes
    ----------
    sound : np.ndarray [shape=(n,)], float64
        Samples at 16 kHz.
    text : str
    speaker : str
    """

    sound: Float64
    text: str
    speaker: str


def privacy(
    manifest: Annotated[
        Path, typer.Argument(help="Of clips, as for `hearthlog train`; may have a column text.")
    ],
    most: Annotated[int, typer.Option(min=1, help="Sentences, of as many speakers.")] = 12,
) -> None:
    """Measure how well speech is understood that is made of the features of a log.

    Where the manifest does not say what is said, it is what the recogniser hears in the original.
    """
    clips = [clip for clip in read_manifest(manifest, LABELS) if clip.label == SPEECH]
    texts = _texts(manifest)
    digits = [_spoken(clip, texts) for clip in clips if texts.get(clip.path) in DIGITS]
    sentences = _sentences([clip for clip in clips if texts.get(clip.path) not in DIGITS], texts)
    sentences = sentences[:: -(-len(sentences) // most) or 1]
    if not digits or not sentences:
        raise DataError(f"{manifest}: needs digits, with a column text, and sentences")
    digit_words, words = Recogniser(digits=True), Recogniser(digits=False)
    sentences = [each._replace(text=each.text or words.recognise(each.sound)) for each in sentences]
    count = sum(len(each.text.split()) for each in sentences)
    print(
        f"{len(digits)} digits of {_speakers(digits)} speakers, {len(sentences)} sentences of "
        f"{_speakers(sentences)} with {count} words\n\n"
        f"{'features':10s} {'frame':>7s}  {'heard':10s} {'ESTOI':>5s} {'digits':>7s} {'words':>7s}"
    )

    _print_guesses(digits)

    def score(make: Callable[[Float64], Float64]) -> str:
        made = [make(each.sound) for each in sentences]
        heard = [words.recognise(sound) for sound in made]
        wrong = word_errors([each.text for each in sentences], heard)
        estoi = intelligibility([each.sound for each in sentences], made)
        of_digits = [digit_words.recognise(make(each.sound)) for each in digits]
        digits_wrong = word_errors([each.text for each in digits], of_digits)
        return f"{estoi:5.2f} {digits_wrong:6.0%} {wrong:7.0%}"

    print(f"{'original':30s} {score(lambda sound: sound)}", flush=True)
    for rate in _RATES:
        for features in (AUROS21, HOME33):
            name = f"{features.name:10s} {rate:4d} ms"
            for way, voiced in (("noise", False), ("pulses", True)):
                rng = np.random.default_rng(0)

                def make(sound: Float64) -> Float64:
                    values = logged(sound, features, rate)  # noqa: B023  called at once
                    return sound_of(values, len(sound), rng, voiced=voiced)  # noqa: B023

                print(f"{name}  {way:10s} {score(make)}", flush=True)
            wrong = guessed(digits, partial(_row, features=features, rate=rate))
            print(f"{name}  {'itself':10s} {'':5s} {wrong:6.0%}", flush=True)


def _texts(manifest: Path) -> dict[Path, str]:
    with manifest.open(encoding="utf-8", newline="") as rows:
        return {
            manifest.parent / row["path"]: row.get("text") or "" for row in csv.DictReader(rows)
        }


def _spoken(clip: LabelledClip, texts: dict[Path, str]) -> Spoken:
    sound = clip_frames(clip).ravel().astype(np.float64)
    return Spoken(sound, texts.get(clip.path, ""), clip.source_group)


def _sentences(clips: Sequence[LabelledClip], texts: dict[Path, str]) -> list[Spoken]:
    """Read a long clip of each speaker; it is cut where nobody knows what it says."""
    sentences: dict[str, Spoken] = {}
    for clip in clips:
        if clip.source_group in sentences:
            continue
        spoken = _spoken(clip, texts)
        if not spoken.text:
            spoken = spoken._replace(sound=spoken.sound[: int(_LONGEST * SAMPLE_RATE)])
        if len(spoken.sound) >= _SHORTEST * SAMPLE_RATE:
            sentences[clip.source_group] = spoken
    return list(sentences.values())


def _speakers(spoken: Sequence[Spoken]) -> int:
    return len({each.speaker for each in spoken})


def _print_guesses(digits: Sequence[Spoken]) -> None:
    """Print which digits, and which speakers, are guessed wrongly from what is logged."""
    of_features = partial(_row, features=HOME33, rate=50)
    ways: dict[str, Callable[[Float64, np.random.Generator], Float64]] = {"home33": of_features}
    path = find_network(YAMNET.name)
    if path is not None:
        of_windows = partial(_windows, embedder=load_embedder(YAMNET.name, path))

        def both(sound: Float64, rng: np.random.Generator) -> Float64:
            return np.concatenate([of_features(sound, rng), of_windows(sound, rng)])

        ways |= {"embedding": of_windows, "both": both}
    print(f"{'guessed from':14s} {'digits':>7s} {'speakers':>9s}")
    for name, describe in ways.items():
        speakers = guessed(digits, describe, who=True)
        print(f"{name:14s} {guessed(digits, describe):7.0%} {speakers:9.0%}", flush=True)
    print()


def guessed(
    digits: Sequence[Spoken],
    describe: Callable[[Float64, np.random.Generator], Float64],
    *,
    who: bool = False,
) -> float:
    """Return the share of digits that are guessed wrongly by who knows other speakers.

    It is known when a digit begins and ends, but not how its frames lie in it.

    Parameters
    ----------
    digits : sequence of Spoken
        Of at least two speakers.
    describe : callable
        Returns what a log has of a digit, as a row of numbers.
    who : bool
        Guess the speaker, knowing the speakers' other digits.
    """
    rng = np.random.default_rng(0)
    rows = np.stack([describe(each.sound, rng) for each in digits])
    texts = np.array([each.text for each in digits])
    speakers = np.array([each.speaker for each in digits])
    targets, groups = (speakers, texts) if who else (texts, speakers)
    wrong = 0
    for group in np.unique(groups):
        own = groups == group
        model = make_pipeline(StandardScaler(), SVC(C=5.0)).fit(rows[~own], targets[~own])
        wrong += int((model.predict(rows[own]) != targets[own]).sum())
    return wrong / len(digits)


def _in_room(sound: Float64, rng: np.random.Generator) -> tuple[Float64, int]:
    """Lay a digit into the noise of a quiet room; return also where it begins."""
    before = int(rng.uniform(_PAUSE_SECONDS, 2 * _PAUSE_SECONDS) * SAMPLE_RATE)
    room = rng.standard_normal(before + len(sound) + SAMPLE_RATE) * 10 ** (_PAUSE_DBFS / 20)
    room[before : before + len(sound)] += sound * (0.3 / max(np.abs(sound).max(), _TINY))
    return room, before


def _windows(sound: Float64, rng: np.random.Generator, embedder: Embedder) -> Float64:
    """Describe a digit by the embeddings around it, and by where it lies in them."""
    room, before = _in_room(sound, rng)
    count = len(room) // FRAME_SAMPLES
    frames = room[: count * FRAME_SAMPLES].reshape(count, FRAME_SAMPLES).astype(np.float32)
    stream, stamps = EmbeddingStream(embedder), np.arange(count) * FRAME_NANOSECONDS
    loud = np.zeros(count, bool)
    loud[before // FRAME_SAMPLES : (before + len(sound)) // FRAME_SAMPLES + _GATE_FRAMES] = True
    windows = stream.push(frames, loud, 0, stamps)
    middle = (before + len(sound) / 2) / FRAME_SAMPLES
    first = int(np.searchsorted(windows.frames + WINDOW_FRAMES / 2, middle)) - 1
    first = min(max(first, 0), len(windows.frames) - 2)
    values = embedder.projection.values(windows.values[first : first + 2]).ravel()
    offset = middle - windows.frames[first]
    return np.concatenate([values, [offset, len(sound) / SAMPLE_RATE]])


def _row(sound: Float64, rng: np.random.Generator, features: FeatureSet, rate: int) -> Float64:
    """Describe a digit by the features of eight moments in it, and by its length."""
    room, before = _in_room(sound, rng)
    times, values = _logarithmic(logged(room, features, rate))
    moments = (before + np.linspace(0.0, 1.0, _PARTS) * len(sound)) / SAMPLE_RATE
    parts = [np.interp(moments, times, column) for column in values.T]
    return np.append(np.concatenate(parts), len(sound) / SAMPLE_RATE)


def _logarithmic(features: Logged) -> Logged:
    values = features.values.copy()
    for column in (ENERGY, FLUX):
        values[:, column] = np.log(np.maximum(values[:, column], 0.0) + _TINY)
    return features._replace(values=values)


if __name__ == "__main__":
    run(privacy)
