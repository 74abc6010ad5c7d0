"""A simulated home: made-up clips to train from, and a day to recognise."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import soundfile

from hearthlog.models.classifiers.description import SIMULATED
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.home.clips import SHIPPED, ClipLibrary
from hearthlog.tools.home.composition import Composition
from hearthlog.tools.home.plan import LIVING_ROOM
from hearthlog.tools.home.record import write_sound
from hearthlog.tools.home.rooms import Rooms
from hearthlog.tools.home.short_day import plan_short_day
from hearthlog.tools.home.sounds import LABELS, SimulationError, generator, synthesize
from hearthlog.tools.home.truth import Truth, truth_of, write_truth

_CLIP_SECONDS = (3.0, 5.0)


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
    """Write a day in the life of a person living alone, compressed into some minutes.

    The true labels are written beside the audio, as a label track for Audacity (`.txt`), and the
    sounds one by one as a table (`.csv`).

    Parameters
    ----------
    path : Path
        A new FLAC file, 16 kHz mono; written block by block.
    minutes : float
        At least a frame, at most 1440.
    seed : int
        Not negative. The same arguments give the same bytes.
    manifest : Path or None
        Of the clips; None for made-up sounds alone.

    Raises
    ------
    SimulationError
        If one of the files exists or cannot be written, if the name does not end in `.flac`, or if
        `minutes` or `seed` lies beyond its limits.
    DataError
        If the manifest cannot be used.
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
    """Turn errors of the file system and of the encoder into one line."""
    try:
        yield
    except OSError as error:
        raise SimulationError(f"{path}: cannot be written ({error.strerror})") from error
    except soundfile.LibsndfileError as error:
        raise SimulationError(f"{path}: cannot be written ({error.error_string})") from error
