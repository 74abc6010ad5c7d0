"""`python -m hearthlog.tools.lab.speakers MANIFEST`: who of four that are enrolled speaks.

Four voices of a manifest are enrolled by ten seconds at each of two places in a room. Then they
converse at other places, by clips that were not enrolled, and a recorder tells who speaks. A turn
is right if most of it that is not labelled silence is labelled so. The voices of the manifest that
are not enrolled converse, too, and are to be `unknown`.
"""

import tempfile
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import soundfile
import typer
from numpy.typing import NDArray

from hearthlog.analyzer.discover.speech import is_of_two
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.marks.enrol import enrol_file
from hearthlog.analyzer.training.dataset import cut_recordings
from hearthlog.analyzer.training.speakers import others_of, speaker_recordings, speakers_scenario
from hearthlog.analyzer.training.train import DEFAULT, train_model
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.frames import FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.lab.bench.table import Row, Table
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.conversations import (
    Clips,
    Turn,
    clips_of_voices,
    converse,
    record_samples,
)

_START = 1_772_352_000 * NANOSECONDS
_ENROLLED = 4
_PLACES = 2
_SECONDS = 10  # at each of them
_LONG = 24.0  # seconds, in which so much is surely said
_STRANGERS = 60.0  # seconds
_DRAWS = 1000
_PAIRS = 60


def speakers(
    manifest: Annotated[Path, typer.Argument(help="Of speech; a voice is a source_group.")],
    draws: Annotated[int, typer.Option(min=1, help="Of four voices.")] = 3,
    seconds: Annotated[float, typer.Option(min=30, help="Of each conversation.")] = 150.0,
    seed: Annotated[int, typer.Option(help="Of what is drawn.")] = 1,
) -> None:
    """Enrol four voices, and tell how often they are known again."""
    clips = clips_of_voices(manifest)
    if len(clips) < _ENROLLED:
        raise DataError(f"{manifest}: {len(clips)} voices; it takes {_ENROLLED}")
    turns: list[_LabelledTurn] = []
    for draw in range(draws):
        with tempfile.TemporaryDirectory(prefix="hearthlog-speakers-") as folder:
            turns += _label_turns(clips, seconds, 1000 * seed + draw, Path(folder))
    title = f"speakers: {draws} draws of {_ENROLLED} of {len(clips)} voices"
    print(Table(title, [*_rows(turns), *_mixed(clips, seed)]))


class _LabelledTurn(NamedTuple):
    """A turn: whose it is, empty for somebody who is not enrolled, and who is said to speak."""

    voice: str
    label: str


def _label_turns(
    clips: Mapping[str, Clips], seconds: float, seed: int, folder: Path
) -> list[_LabelledTurn]:
    rng = np.random.default_rng(seed)
    names = sorted(rng.choice(sorted(clips), _ENROLLED, replace=False).tolist())
    unseen = {name: _enrol(name, clips[name], folder, seed, rng) for name in names}
    model = _learned(folder)
    turns = _turns(unseen, seconds, seed + 500, model, folder / "enrolled_ones", set(names))
    strangers = {name: clips[name] for name in clips if name not in unseen}
    if strangers:
        turns += _turns(strangers, _STRANGERS, seed + 600, model, folder / "strangers", set())
    return turns


def _enrol(
    name: str, clips: Clips, folder: Path, seed: int, rng: np.random.Generator
) -> list[Float32]:
    """Enrol a voice at two places; return the clips that were not enrolled."""
    order = [clips[place] for place in rng.permutation(len(clips))]
    lengths = np.cumsum([len(clip) for clip in order])
    least = _SECONDS * SAMPLE_RATE
    edges = [0]
    for place in range(1, _PLACES + 1):
        edges.append(max(edges[-1], int(np.searchsorted(lengths, place * least))) + 1)
    if edges[-1] >= len(order):
        raise DataError(f"{name}: too few clips to enrol some and to try others")
    for place, (first, last) in enumerate(pairwise(edges)):
        samples, turns = converse({name: order[first:last]}, _LONG, 10 * seed + place)
        said = [samples[int(t.start * SAMPLE_RATE) : int(t.end * SAMPLE_RATE)] for t in turns]
        path = folder / f"{name}_{place}.wav"
        soundfile.write(path, np.concatenate(said)[:least], SAMPLE_RATE)
        enrol_file(folder / "voices", name, path)
    return order[edges[-1] :]


def _learned(folder: Path) -> Path:
    recordings = list(speaker_recordings([folder / "voices"], DEFAULT.features))
    scenario = speakers_scenario(recordings)
    others = others_of(load_model(starter_file(GENERAL)), DEFAULT, scenario)
    segments = cut_recordings(recordings, scenario, DEFAULT.features)
    model = train_model(segments, scenario, ignore_progress, DEFAULT, "hmm", others)
    save_model(model, folder / "speakers.safetensors")
    return folder / "speakers.safetensors"


def _turns(
    clips: Mapping[str, Clips],
    seconds: float,
    seed: int,
    model: Path,
    folder: Path,
    enrolled: set[str],
) -> list[_LabelledTurn]:
    """Return who is said to speak in each turn of a conversation."""
    samples, turns = converse(clips, seconds, seed)
    segments = read_columns(find_logs(record_samples(samples, folder, _START, model)))[
        "/mic/segment"
    ]
    starts = (segments["header.stamp"] - _START) / NANOSECONDS
    ends = starts + segments["duration"] / NANOSECONDS
    return [
        _LabelledTurn(
            turn.voice if turn.voice in enrolled else "",
            _label(turn, starts, ends, segments["label"]),
        )
        for turn in turns
    ]


def _label(turn: Turn, starts: Float64, ends: Float64, labels: NDArray[np.object_]) -> str:
    """Return the label that most of a turn has, but for silence."""
    common = np.maximum(np.minimum(ends, turn.end) - np.maximum(starts, turn.start), 0.0)
    sums = {name: float(common[labels == name].sum()) for name in set(labels) - {SILENCE}}
    best = max(sums, key=lambda name: sums[name], default=SILENCE)
    return best if sums.get(best, 0.0) > 0.0 else SILENCE


def _rows(turns: Sequence[_LabelledTurn]) -> list[Row]:
    known = [each for each in turns if each.voice]
    other = [each for each in turns if not each.voice]
    nobody = {UNKNOWN, SILENCE}
    rows = [
        _row("turns of the enrolled told right", known, [t.label == t.voice for t in known]),
        _row("  told as somebody else", known, [t.label not in {t.voice, *nobody} for t in known]),
        _row("  told as nobody", known, [t.label in nobody for t in known]),
    ]
    if other:
        share = float(np.mean([each.label in nobody for each in other]))
        rows.append(Row("turns of others told as nobody", share, note=f"{len(other)} turns"))
    return rows


def _mixed(clips: Mapping[str, Clips], seed: int) -> list[Row]:
    """Tell how often two voices under one name are noticed, and one voice is taken for two."""
    rng = np.random.default_rng(seed)
    one, two = [], []
    for _ in range(_PAIRS):
        pair = rng.choice(sorted(clips), 2, replace=False)
        first, second = (
            np.concatenate([clips[name][place] for place in rng.permutation(len(clips[name]))])
            for name in pair
        )
        half = _SECONDS * SAMPLE_RATE
        one.append(_is_of_two(first[: 2 * half]))
        two.append(_is_of_two(np.concatenate([first[:half], second[:half]])))
    note = f"{_PAIRS} pairs"
    return [
        Row("two voices under one name noticed", float(np.mean(two)), note=note),
        Row("one voice taken for two", float(np.mean(one)), note=note),
    ]


def _is_of_two(samples: Float32) -> bool:
    frames = samples[: len(samples) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
    return is_of_two(DEFAULT.features.extractor()(frames), DEFAULT.features)


def _row(what: str, turns: Sequence[_LabelledTurn], is_so: Sequence[bool]) -> Row:
    """Make a row of a share, with its 95 % interval by drawing voices again."""
    voices = sorted({each.voice for each in turns})
    of = np.array([voices.index(each.voice) for each in turns])
    hits = np.bincount(of, np.array(is_so, float), len(voices))
    counts = np.bincount(of, minlength=len(voices))
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(voices), size=(_DRAWS, len(voices)))
    shares = hits[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.quantile(shares, (0.025, 0.975))
    note = f"{low:.2f} to {high:.2f}; {len(turns)} turns of {len(voices)} voices"
    return Row(what, float(np.mean(is_so)), note=note)


if __name__ == "__main__":
    run(speakers)
