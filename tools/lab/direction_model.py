"""`python -m hearthlog.tools.lab.direction_model MANIFEST`: what directions add to a model.

In simulated rooms a television speaks and plays music in its corner, and a resident, who moves
about, speaks and coughs. Which speech is whose is drawn: the sound itself does not tell. Two scenes
are marked, and the adapted model labels two others, of other recordings and places.
"""

import os

os.environ.update(
    dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
)  # before numpy is imported

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from threading import Event as Flag
from typing import Annotated, NamedTuple

import numpy as np
import soundfile
import typer

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.analyzer.training.manifest import LABELS, LabelledClip, read_manifest
from hearthlog.models.classes import COUGHING, MUSIC, SILENCE, SPEECH
from hearthlog.models.classifiers.evidence import SECTORS
from hearthlog.models.classifiers.model import FORMAT, Model
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.direction_room import (
    Room,
    Scene,
    add_noise,
    convolved_with,
    draw_room,
    laid_out,
    room_noise,
)
from hearthlog.tools.lab.labelling import label_logs

TELEVISION = "television"
_SQUARE = [[0.032, 0.0], [0.0, 0.032], [-0.032, 0.0], [0.0, -0.032]]
_RT60, _SNR = 0.4, 15.0  # seconds, dB
_SHORTEST, _LONGEST = 1.0, 3.0  # seconds of a clip
_SOUNDS = 20  # in a scene
_KINDS = {TELEVISION: 0.45, SPEECH: 0.35, COUGHING: 0.2}
_MUSIC = 0.3  # of what the television plays
_NOISE = 16 * SAMPLE_RATE  # samples, which are repeated
_ECHO = NANOSECONDS // 2  # behind a sound, which is not scored
_DAY = 86_400 * NANOSECONDS
_START = 1_772_352_000 * NANOSECONDS
_DRAWS = 2000
_USED = {SPEECH, MUSIC, COUGHING}
_OF_RESIDENT = {"resident without", "resident with"}


class Sound(NamedTuple):
    """A sound of a scene, with its start and end in nanoseconds of UTC."""

    label: str
    start: int
    end: int


class Clips(NamedTuple):
    """What the television, and the resident, may be heard with: clips by label."""

    television: dict[str, list[Float64]]
    resident: dict[str, list[Float64]]


def direction_model(
    manifest: Annotated[Path, typer.Argument(help="Of clips, as for `hearthlog train`.")],
    homes: Annotated[int, typer.Option(min=2)] = 12,
) -> None:
    """Measure F1 of frames with and without directions, after the same marks."""
    clips = [clip for clip in read_manifest(manifest, LABELS) if clip.label in _USED]
    read = [(clip, _samples(clip)) for clip in clips]
    read = [(clip, samples) for clip, samples in read if len(samples) >= _SHORTEST * SAMPLE_RATE]
    scores: list[dict[tuple[str, str], float]] = []
    for number in range(homes):
        scores.append(_scores(read, np.random.default_rng([2, number])))
        print(f"home {number + 1} of {homes}", file=sys.stderr, flush=True)
    _print(scores)


def _samples(clip: LabelledClip) -> Float64:
    return clip_frames(clip).ravel()[: int(_LONGEST * SAMPLE_RATE)].astype(np.float64)


def _scores(
    clips: Sequence[tuple[LabelledClip, Float64]], rng: np.random.Generator
) -> dict[tuple[str, str], float]:
    """Return the F1 of each class in one home, by the kind of the model."""
    marked_clips, tested_clips = _divided(clips, rng)
    room = draw_room(np.array(_SQUARE), _RT60, rng)
    corner = room.anywhere(rng)
    with tempfile.TemporaryDirectory(prefix="hearthlog") as folder:
        logs = Path(folder) / "marked"
        marked = [_recorded(logs, day, room, corner, marked_clips, rng) for day in range(2)]
        models = _models(logs, marked)
        unmarked = Path(folder) / "others"
        tried = [_recorded(unmarked, day, room, corner, tested_clips, rng) for day in range(2, 4)]
        labelled = label_logs(list(models.values()), [log for log, _ in tried])
        truth = [sound for _, sounds in tried for sound in sounds]
        return {
            (kind, name): score
            for kind, labelling in zip(models, labelled, strict=True)
            for name, score in _f1(labelling, truth, of_resident=kind in _OF_RESIDENT).items()
        }


def _divided(
    clips: Sequence[tuple[LabelledClip, Float64]], rng: np.random.Generator
) -> tuple[Clips, Clips]:
    """Divide clips in four, so that no source is in two parts."""
    groups = sorted({clip.source_group for clip, _ in clips})
    part_of = dict(zip(groups, rng.permutation(len(groups)) % 4, strict=True))
    parts: list[dict[str, list[Float64]]] = [{name: [] for name in _USED} for _ in range(4)]
    for clip, samples in clips:
        parts[part_of[clip.source_group]][clip.label].append(samples)
    if not all(of_label for part in parts for of_label in part.values()):
        raise DataError(f"there are too few sources of {', '.join(sorted(_USED))}")
    return Clips(parts[0], parts[1]), Clips(parts[2], parts[3])


def _recorded(
    logs: Path, day: int, room: Room, corner: Float64, clips: Clips, rng: np.random.Generator
) -> tuple[Path, list[Sound]]:
    """Record a scene as an array would; return also what is true."""
    kinds = rng.choice(list(_KINDS), _SOUNDS, p=list(_KINDS.values()))
    sources = [corner if kind == TELEVISION else room.anywhere(rng) for kind in kinds]
    chosen = [_clip(kind, clips, rng) for kind in kinds]
    echoes = room.echoes(corner)
    echoed = [
        convolved_with(echoes if source is corner else room.echoes(source), clip)
        for source, clip in zip(sources, chosen, strict=True)
    ]
    scene = laid_out(room, sources, chosen, echoed)
    noise = room_noise(Scene(scene.samples[:_NOISE], [], room.microphones), rng)
    samples = add_noise(scene, np.resize(noise, scene.samples.shape), _SNR)
    start = _START + day * _DAY
    log = _log_of(samples, logs, start)
    times = [
        (start + round(s * NANOSECONDS), start + round(e * NANOSECONDS)) for s, e, _ in scene.sounds
    ]
    return log, [Sound(str(kind), *span) for kind, span in zip(kinds, times, strict=True)]


def _clip(kind: str, clips: Clips, rng: np.random.Generator) -> Float64:
    of_label = (
        clips.resident[kind]
        if kind != TELEVISION
        else (clips.television[MUSIC if rng.random() < _MUSIC else SPEECH])
    )
    return of_label[rng.integers(len(of_label))]


def _log_of(samples: Float32, logs: Path, start: int) -> Path:
    settings = Settings(
        output=logs, microphone=[MicrophoneSettings(array=_SQUARE)], model=starter_file(GENERAL)
    )
    with tempfile.NamedTemporaryFile(suffix=".wav") as file:
        soundfile.write(file, samples, SAMPLE_RATE, subtype="PCM_16", format="WAV")
        source = FileSource([Path(file.name)], start, channels=samples.shape[1])
        (log,) = record(settings, source, Flag()).logs
    return log


def _models(logs: Path, marked: Sequence[tuple[Path, Sequence[Sound]]]) -> dict[str, Model]:
    """Return what the home teaches, with directions and without."""
    base = load_model(starter_file(GENERAL))
    for log, sounds in marked:
        marks = [Mark("mic", start, end, label) for label, start, end in sounds]
        pauses = [
            Mark("mic", one.end + _ECHO, next_.start, SILENCE)
            for one, next_ in islice(pairwise(sounds), 0, None, 4)
        ]
        write_marks(log, [mark for mark in marks if mark.label != TELEVISION] + pauses)
    of_resident = adapt_model(base, read_home_training_set([logs], base).segments)
    for log, sounds in marked:
        write_marks(
            log, [Mark("mic", s, e, label) for label, s, e in sounds if label == TELEVISION]
        )
    home = adapt_model(base, read_home_training_set([logs], base).segments)
    # Ninety degrees: what came from ahead comes from the left.
    turned = np.roll(home.direction_weights, SECTORS // 4, axis=2)
    return {
        "without": _without(home),
        "with": home,
        "turned": replace(home, direction_weights=turned),
        "resident without": _without(of_resident),
        "resident with": of_resident,
    }


def _without(model: Model) -> Model:
    description = model.description.model_copy(
        update={"format": FORMAT, "direction_microphones": []}
    )
    return replace(model, description=description, direction_weights=np.empty((0, 0, 0)))


def _f1(labelling: Labelling, truth: Sequence[Sound], *, of_resident: bool) -> dict[str, float]:
    """Return the F1 of frames of each class; of a resident's model where no television is on."""
    scores = {}
    pieces = [_frames(labelling, same) for same in _by_day(truth)]
    true, labelled = (np.concatenate(column) for column in zip(*pieces, strict=True))
    if of_resident:
        true, labelled = true[true != TELEVISION], labelled[true != TELEVISION]
    for name in (TELEVISION, SPEECH, COUGHING, SILENCE):
        total = np.count_nonzero(true == name) + np.count_nonzero(labelled == name)
        if total and not (of_resident and name == TELEVISION):
            scores[name] = float(2 * np.count_nonzero((true == name) & (labelled == name)) / total)
    return scores


def _by_day(truth: Sequence[Sound]) -> list[list[Sound]]:
    days = sorted({one.start // _DAY for one in truth})
    return [[one for one in truth if one.start // _DAY == day] for day in days]


def _frames(labelling: Labelling, sounds: Sequence[Sound]) -> tuple[np.ndarray, np.ndarray]:
    """Return what is true, and what is said, of the frames of a scene, without echoes."""
    times: Int64 = np.arange(sounds[0].start - NANOSECONDS, sounds[-1].end, FRAME_NANOSECONDS)
    true = np.full(len(times), SILENCE, object)
    scored: Bool = np.ones(len(times), bool)
    for label, start, end in sounds:
        true[(times >= start) & (times < end)] = label
        scored &= ~((times >= end) & (times < end + _ECHO))
    rows = np.maximum(np.searchsorted(labelling.starts, times, "right") - 1, 0)
    inside = (labelling.starts[rows] <= times) & (times < labelling.ends[rows])
    labelled = np.where(inside, labelling.labels[rows], "")
    return true[scored], labelled[scored]


def _print(scores: Sequence[dict[tuple[str, str], float]]) -> None:
    rng = np.random.default_rng(0)
    draws = rng.integers(0, len(scores), (_DRAWS, len(scores)))
    print(f"F1 of frames, mean of {len(scores)} homes (95 %), and the difference to without")
    for kind, name in scores[0]:
        own = np.array([one[kind, name] for one in scores])
        base = "resident without" if kind in _OF_RESIDENT else "without"
        change = own - np.array([one[base, name] for one in scores])
        line = f"{kind:17s} {name:11s} {_interval(own, draws, '.2f')}"
        print(line if kind == base else f"{line}   {_interval(change, draws, '+.2f')}")


def _interval(values: Float64, draws: Int64, form: str) -> str:
    low, high = np.quantile(values[draws].mean(axis=1), [0.025, 0.975])
    return f"{values.mean():{form}} ({low:{form}} to {high:{form}})"


if __name__ == "__main__":
    run(direction_model)
