"""A simulated home: clips to train from, and a day to recognise."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import soundfile

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.description import SIMULATED
from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.home.sounds import (
    LABELS,
    RoomTone,
    SimulationError,
    dry_sound,
    generator,
    synthesize,
)

_CLIP_SECONDS = (3.0, 5.0)
_BLOCK_SAMPLES = 10 * SAMPLE_RATE
_MAX_MINUTES = 1440.0
_MIN_SILENCE = 1.0  # before a sound, in seconds

_EVENT_SECONDS = {
    "speech": (10.0, 40.0),
    "music": (30.0, 60.0),
    "phone_ring": (4.0, 12.0),
    "coughing": (0.5, 3.0),
    "crying": (6.0, 15.0),
    "yelling": (2.0, 8.0),
    "laughing": (2.0, 7.0),
    "objects_activity": (4.0, 20.0),
    "flushing_water": (8.0, 14.0),
    "shower": (30.0, 60.0),
    "tap_water": (4.0, 15.0),
}
# Parts of the day: their seconds in a day of 24 minutes, and what is heard in them.
_DAY = (
    (110, "coughing"),  # night
    (110, "flushing_water tap_water shower"),  # getting up
    (100, "objects_activity tap_water coughing objects_activity objects_activity"),  # breakfast
    (80, "phone_ring speech"),
    (150, "music objects_activity music"),
    (130, "objects_activity tap_water objects_activity coughing objects_activity tap_water"),
    (110, "coughing flushing_water"),  # afternoon nap
    (190, "speech laughing speech laughing music laughing speech"),  # television
    (130, "objects_activity tap_water objects_activity coughing objects_activity"),  # supper
    (80, "phone_ring speech laughing"),
    (110, "yelling crying yelling crying crying speech"),  # a bad moment
    (70, "flushing_water tap_water coughing"),  # going to bed
    (70, "coughing"),  # night
)

PlannedSound = tuple[int, int, str]  # first sample, sample after the last, label
LabelledSpan = tuple[float, float, str]  # the same in seconds


def write_training_set(folder: Path, clips_per_class: int, seed: int) -> Path:
    """Write clips of 3 to 5 s of every sound, and a manifest of them.

    Parameters
    ----------
    folder : Path
        Must be new or empty.
    clips_per_class : int
        From 1.
    seed : int
        Not negative. The same arguments give the same bytes.

    Returns
    -------
    Path
        `manifest.csv` in the folder: path (relative to the folder), label, source_group (one a
        clip), source, licence, seconds.

    Raises
    ------
    SimulationError
        If the folder holds something or cannot be written, or if one of the numbers is too low.
    """
    if clips_per_class < 1:
        raise SimulationError(f"a training set has at least 1 clip a class, not {clips_per_class}")
    rng = generator(seed)
    manifest = folder / "manifest.csv"
    with _reported(folder):
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


def write_day(path: Path, minutes: float, seed: int) -> list[LabelledSpan]:
    """Write a day in the life of a person living alone, compressed into some minutes.

    The sounds come in a plausible order and have their natural lengths; a shorter day has less
    silence between them, and then fewer of them (10 minutes hold about three quarters of what 24
    do). The true labels are written beside the audio, as a label track for Audacity (`.txt`).

    Parameters
    ----------
    path : Path
        A new FLAC file, 16 kHz mono; written block by block.
    minutes : float
        More than 0, at most 1440.
    seed : int
        Not negative. The same arguments give the same bytes.

    Returns
    -------
    list of (start_seconds, end_seconds, label)
        The sounds, silence included, without gaps between them.

    Raises
    ------
    SimulationError
        If one of the files exists or cannot be written, if the name does not end in `.flac`, or if
        `minutes` or `seed` lies beyond its limits.
    """
    labels = path.with_suffix(".txt")
    if path.suffix != ".flac":
        raise SimulationError(f"{path}: a day is a FLAC file; give it a name that ends in .flac")
    events = _plan_day(minutes, seed)
    with _reported(path):
        if existing := [file for file in (path, labels) if file.exists()]:
            raise SimulationError(f"{existing[0]}: exists already; name another file")
        path.parent.mkdir(parents=True, exist_ok=True)
        with soundfile.SoundFile(path, "x", SAMPLE_RATE, 1, "PCM_16", format="FLAC") as audio:
            for block in _perform(events, seed):
                audio.write(block)
        truth = [(start / SAMPLE_RATE, end / SAMPLE_RATE, label) for start, end, label in events]
        lines = [f"{start:.6f}\t{end:.6f}\t{label}\n" for start, end, label in truth]
        labels.write_text("".join(lines), encoding="utf-8", newline="\n")
    return truth


def _plan_day(minutes: float, seed: int) -> list[PlannedSound]:
    total = round(minutes * 60.0 * SAMPLE_RATE) if 0 < minutes <= _MAX_MINUTES else 0
    if total < 1:
        raise SimulationError(f"a day lasts more than 0 and at most 1440 minutes, not {minutes}")
    rng = generator(seed)
    share = total / SAMPLE_RATE / sum(seconds for seconds, _ in _DAY)
    events: list[PlannedSound] = []
    part_start = 0.0
    for seconds, sounds in _DAY:
        for start, length, label in _plan_part(rng, seconds * share, sounds.split()):
            first = round((part_start + start) * SAMPLE_RATE)
            events.append((_end(events), first, SILENCE))
            events.append((first, first + round(length * SAMPLE_RATE), label))
        part_start += seconds * share
    return [*events, (_end(events), total, SILENCE)]


def _end(events: list[PlannedSound]) -> int:
    return events[-1][1] if events else 0


def _plan_part(
    rng: np.random.Generator, seconds: float, labels: list[str]
) -> list[tuple[float, float, str]]:
    """Place the sounds that fit, in their order, with random silences between them."""
    chosen, left = [], seconds - _MIN_SILENCE
    for label in labels:
        length = rng.uniform(*_EVENT_SECONDS[label])
        if length + _MIN_SILENCE <= left:
            chosen.append((length, label))
            left -= length + _MIN_SILENCE
    silences = _MIN_SILENCE + max(left, 0.0) * rng.dirichlet(np.full(len(chosen) + 1, 2.0))
    ends = np.cumsum(silences[:-1] + [length for length, _ in chosen])
    return [
        (end - length, length, label) for end, (length, label) in zip(ends, chosen, strict=True)
    ]


def _perform(events: list[PlannedSound], seed: int) -> Iterator[Float64]:
    """Yield the samples, one sound or at most 10 s of silence at a time."""
    # From 1: a seed (s, 0) gives the numbers of the seed s, which planned the day.
    room = RoomTone(generator(seed, 1))
    for number, (start, end, label) in enumerate(events, start=2):
        if label == SILENCE:
            for block in range(start, end, _BLOCK_SAMPLES):
                yield room(min(_BLOCK_SAMPLES, end - block))
        else:
            sound = dry_sound(label, end - start, generator(seed, number))
            yield sound + room(end - start)


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Turn errors of the file system and of the encoder into one line."""
    try:
        yield
    except OSError as error:
        raise SimulationError(f"{path}: cannot be written ({error.strerror})") from error
    except soundfile.LibsndfileError as error:
        raise SimulationError(f"{path}: cannot be written ({error.error_string})") from error
