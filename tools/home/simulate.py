"""A simulated home as files: training clips, a day of sound, logs without sound, and truth."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import soundfile

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.model import SIMULATED
from hearthlog.schemas.arrays import Float64, Int16, Int64
from hearthlog.schemas.errors import Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_SECONDS, SAMPLE_RATE
from hearthlog.tools.home.clips import SHIPPED, ClipLibrary
from hearthlog.tools.home.composition import AudibleSound, Composition, Rooms
from hearthlog.tools.home.routine import DAY_FRAMES, LIVING_ROOM, PlannedSound, plan_short_day
from hearthlog.tools.home.sounds import LABELS, SimulationError, generator, synthesize

BLOCK_FRAMES = 200  # as from `FileSource`, after a health report


def write_sound(
    composition: Composition,
    path: Path,
    first: int,
    frames: int,
    progress: Progress = ignore_progress,
) -> None:
    """Write part of a composition as a FLAC file, 16 kHz mono.

    Raise `OSError` if the file exists or cannot be written. Raise `LibsndfileError` if it
    cannot be encoded.
    """
    with (
        path.open("xb") as file,
        soundfile.SoundFile(file, "w", SAMPLE_RATE, 1, "PCM_16", format="FLAC") as audio,
    ):
        for number, samples in blocks_of(composition, first, frames):
            audio.write(samples.ravel())
            progress((number - first + len(samples)) / frames)


def blocks_of(composition: Composition, first: int, frames: int) -> Iterator[tuple[int, Int16]]:
    """Compose frames block by block: the number of the first one, and samples."""
    for number in range(first, first + frames, BLOCK_FRAMES):
        yield number, composition.samples(number, min(BLOCK_FRAMES, first + frames - number))


LabelledSpan = tuple[float, float, str]  # start and end in seconds, and the label

_AUDIBLE_DB = 0.0  # dB over the steady noise
_PLANNED = ("start", "end", "label", "from", "room", "activity", "clip", "source_group", "made_up")
_RECEIVED = ("level_dbfs", "heard_seconds")
_TINY = 1e-30


class TrueEvent(NamedTuple):
    """A planned sound at the level received by the microphone."""

    plan: PlannedSound
    level: float  # level of its loudest frame as received, in dBFS
    audible_frames: int


class Truth(NamedTuple):
    """The true labels and sounds of a composition."""

    # without gaps. A frame has the label of its loudest audible sound, else silence; a sound is
    # audible if it is at least as loud as all steady noise
    spans: list[LabelledSpan]
    events: list[TrueEvent]


def truth_of(composition: Composition) -> Truth:
    """Compute the truth of a composition, without composing its sound."""
    events: list[TrueEvent] = []
    runs: list[tuple[int, int, str]] = []
    held: list[tuple[int, AudibleSound]] = []  # sounds that continue into the next day
    for first in range(0, composition.plan.frames, DAY_FRAMES):
        count = min(DAY_FRAMES, composition.plan.frames - first)
        begun = enumerate(composition.audible(first, count), start=len(events))
        here = [*held, *begun]
        for _, sound in here[len(held) :]:
            level = float(10.0 * np.log10(sound.power.max() + _TINY))
            events.append(TrueEvent(sound.plan, level, 0))
        loudest = _loudest(here, composition.floor_power(first, count), first)
        for number, frames in zip(*np.unique(loudest, return_counts=True), strict=True):
            if number >= 0:
                event = events[number]
                events[number] = event._replace(audible_frames=event.audible_frames + int(frames))
        labels = [SILENCE, *(event.plan.clip.label for event in events)]
        for begin, end, number in _runs(loudest):
            runs.append((first + begin, first + end, labels[number + 1]))
        held = [one for one in here if one[1].plan.start + len(one[1].power) > first + count]
    return Truth(_spans(runs), events)


def write_truth(truth: Truth, spans: Path, events: Path) -> None:
    """Write a label track for Audacity, and a table of the sounds; raise `OSError` on failure."""
    with spans.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{start:.6f}\t{end:.6f}\t{label}\n" for start, end, label in truth.spans)
    with events.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*_PLANNED, *_RECEIVED))
        writer.writerows(_row(event) for event in truth.events)


def _row(event: TrueEvent) -> tuple[object, ...]:
    plan = event.plan
    return (
        f"{plan.start * FRAME_SECONDS:.2f}",
        f"{plan.end * FRAME_SECONDS:.2f}",
        plan.clip.label,
        plan.origin,
        plan.room,
        plan.activity,
        plan.clip.name,
        plan.clip.source_group,
        "yes" if plan.clip.path is None else "no",
        f"{event.level:.1f}",
        f"{event.audible_frames * FRAME_SECONDS:.2f}",
    )


def _loudest(sounds: list[tuple[int, AudibleSound]], floor: Float64, first: int) -> Int64:
    """Return the index of the loudest audible sound in each frame; -1 for none."""
    power = floor * 10.0 ** (_AUDIBLE_DB / 10.0)
    loudest = np.full(len(floor), -1)
    for number, sound in sounds:
        begin = sound.plan.start - first
        here = slice(max(begin, 0), min(begin + len(sound.power), len(floor)))
        its = sound.power[here.start - begin : here.stop - begin]
        louder = its > power[here]
        power[here][louder] = its[louder]
        loudest[here][louder] = number
    return loudest


def _runs(values: Int64) -> Iterator[tuple[int, int, int]]:
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    for begin, end in pairwise(edges):
        yield begin, end, int(values[begin])


def _spans(runs: list[tuple[int, int, str]]) -> list[LabelledSpan]:
    """Merge adjacent spans of one label."""
    spans: list[LabelledSpan] = []
    for begin, end, label in runs:
        start = begin * FRAME_SECONDS
        if spans and spans[-1][2] == label:
            start = spans.pop()[0]
        spans.append((start, end * FRAME_SECONDS, label))
    return spans


_CLIP_SECONDS = (3.0, 5.0)


def write_training_set(folder: Path, clips_per_class: int, seed: int) -> Path:
    """Write clips of 3 to 5 s of every sound, and a manifest of them, `manifest.csv`; return it.

    It has path (relative to the folder), label, source_group (one per clip), source, licence,
    seconds. The same arguments give the same bytes. Raise `SimulationError` if the folder is not
    empty or cannot be written, there is less than one clip per class, or the seed is negative.
    """
    if clips_per_class < 1:
        raise SimulationError(f"a training set has at least 1 clip a class, not {clips_per_class}")
    rng = generator(seed)
    manifest = folder / "manifest.csv"
    with reported(folder):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise SimulationError(f"{folder}: is not empty; name a new folder")
        rows = []
        for label in LABELS:
            (folder / label).mkdir()
            for number in range(clips_per_class):
                name = f"{label}_{number + 1:03d}"
                clip = synthesize(label, rng.uniform(*_CLIP_SECONDS), int(rng.integers(2**32)))
                path = f"{label}/{name}.flac"
                soundfile.write(folder / path, clip, SAMPLE_RATE, "PCM_16", format="FLAC")
                seconds = f"{len(clip) / SAMPLE_RATE:.3f}"
                rows.append((path, label, f"simulated_{name}", SIMULATED, "CC0", seconds))
        with manifest.open("x", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("path", "label", "source_group", "source", "licence", "seconds"))
            writer.writerows(rows)
    return manifest


def write_day(path: Path, minutes: float, seed: int, manifest: Path | None = SHIPPED) -> Truth:
    """Write a day of a person living alone, compressed into some minutes, as FLAC, 16 kHz mono.

    The true labels are written next to the audio, as a label track for Audacity (`.txt`), and the
    sounds one by one as a table (`.csv`). The same arguments give the same bytes. Without manifest,
    all sounds are synthetic.

    Raise `SimulationError` if one of the files exists or cannot be written, if the name does not
    end in `.flac`, if `minutes` is less than a frame or above 1440, or the seed is negative;
    `DataError` if the manifest cannot be used.
    """
    spans, events = path.with_suffix(".txt"), path.with_suffix(".csv")
    if path.suffix != ".flac":
        raise SimulationError(f"{path}: a day is a FLAC file; give it a name that ends in .flac")
    library = ClipLibrary(manifest)
    plan = plan_short_day(minutes, library, seed)
    with reported(path):
        if existing := [file for file in (path, spans, events) if file.exists()]:
            raise SimulationError(f"{existing[0]}: exists already; name another file")
        path.parent.mkdir(parents=True, exist_ok=True)
        composition = Composition(plan, library, Rooms(LIVING_ROOM, seed))
        write_sound(composition, path, 0, plan.frames)
        truth = truth_of(composition)
        write_truth(truth, spans, events)
    return truth


@contextmanager
def reported(path: Path) -> Iterator[None]:
    """Convert errors of the file system and of the encoder to one line."""
    try:
        yield
    except OSError as error:
        raise SimulationError(f"{path}: cannot be written ({error.strerror})") from error
    except soundfile.LibsndfileError as error:
        raise SimulationError(f"{path}: cannot be written ({error.error_string})") from error
