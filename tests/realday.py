"""A day of a home, made of real recordings of household sounds and recorded as it would be."""

import multiprocessing
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from threading import Event as Flag

import numpy as np
import soundfile
from lossy_source import LossySource

from hearthlog.analyzer.training.dataset import build_dataset
from hearthlog.analyzer.training.manifest import LabelledClip, Scenario, read_manifest
from hearthlog.analyzer.training.train import train_model
from hearthlog.analyzer.training.window_methods import PAPER
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile import save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.frames import SAMPLE_RATE

ZONE = "Europe/Vienna"
START = 1_772_319_600_000_000_000  # the midnight there at which 2026-03-01 begins
HOUR = 3600 * 1_000_000_000
CLASSES = (
    "silence",
    "speech",
    "music",
    "phone_ring",
    "coughing",
    "crying",
    "laughing",
    "objects_activity",
    "flushing_water",
    "shower",
    "tap_water",
)
_PIECE = 100  # seconds of a file
_CLIPS = 6  # of each class that the model learns from
_LOST = 60  # blocks of 10 s after which nothing is heard, in the second half
_LOST_FRAMES = 12_000
_PLAN = (  # until which hour, what; the rest of the day is silent
    (1.2, "silence"),
    (1.26, "coughing"),
    (3.6, "silence"),
    (3.7, "coughing"),
    (6.9, "silence"),
    (6.96, "flushing_water"),
    (7.02, "tap_water"),
    (7.3, "shower"),
    (8.2, "objects_activity"),
    (8.8, "music"),
    (9.2, "silence"),
    (9.25, "phone_ring"),
    (9.7, "speech"),
    (11.7, "silence"),
    (12.6, "objects_activity"),
    (12.7, "tap_water"),
    (14.8, "silence"),
    (14.86, "coughing"),
    (15.3, "silence"),
    (15.35, "phone_ring"),
    (15.8, "speech"),
    (16.9, "music"),
    (17.1, "crying"),
    (18.2, "silence"),
    (19.0, "objects_activity"),
    (19.9, "speech"),
    (20.1, "laughing"),
    (20.8, "speech"),
    (21.4, "music"),
    (21.48, "flushing_water"),
    (21.6, "tap_water"),
    (24.0, "silence"),
)


def write_real_day(household: Path, folder: Path) -> Path:
    """Learn from some of the recordings, and record a day of the others; return the logs.

    After ten minutes of the afternoon nothing is heard for ten minutes.
    """
    clips = defaultdict(list)
    scenario = Scenario("home", {name: (name,) for name in CLASSES})
    for clip in read_manifest(household / "manifest.csv", scenario.labels):
        clips[clip.label].append(clip)
    learnt = [clip for name in CLASSES for clip in _spread(clips[name], _CLIPS)]
    data = build_dataset(learnt, scenario, lambda *_: None, features=PAPER.features)
    model = folder / "home.safetensors"
    save_model(_surer(train_model(data, scenario, lambda *_: None, PAPER)), model)
    pieces = {name: _write_piece(folder / f"{name}.wav", clips[name]) for name in CLASSES}
    halves = [
        (folder, model, [pieces[name] for name in names], half)
        for half, names in enumerate(_halves())
    ]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.starmap(_record, halves)
    return folder / "logs"


def _surer(model: Model) -> Model:
    """Make a model sure of itself, so that one class fills a picture of probabilities."""
    description = model.description
    smoothing = description.smoothing
    surer = {
        "inverse_temperature": 4.0 * description.inverse_temperature,
        "smoothing": smoothing.model_copy(update={"weight": smoothing.weight / 4.0}),
    }
    return replace(model, description=description.model_copy(update=surer))


def _halves() -> tuple[list[str], list[str]]:
    """Say what is heard in each piece before noon and after it."""
    count = 12 * 3600 // _PIECE
    hours = np.arange(2 * count) * _PIECE / 3600
    places = np.searchsorted([until for until, _ in _PLAN], hours, side="right")
    names = [_PLAN[place][1] for place in places]
    return names[:count], names[count : 2 * count - _LOST_FRAMES // 20 // _PIECE]


def _record(folder: Path, model: Path, paths: list[Path], half: int) -> None:
    settings = Settings(
        output=folder / "logs",
        model=model,
        timezone=ZONE,
        statistics_every=200,
        sync_seconds=3600.0,
    )
    source = FileSource(paths, START + half * 12 * HOUR)
    record(
        settings,
        LossySource(source, {_LOST: _LOST_FRAMES} if half else {}),
        Flag(),
    )


def _write_piece(path: Path, clips: list[LabelledClip]) -> Path:
    """Chain recordings, those last that the model has learnt from."""
    learnt = set(_spread(clips, _CLIPS))
    parts, left = [], _PIECE * SAMPLE_RATE
    ordered = sorted(clips, key=lambda clip: clip in learnt)
    while left > 0:
        for clip in ordered:
            samples = np.concatenate(list(read_audio(clip.path)))[:left]
            parts.append(samples)
            left -= len(samples)
            if left <= 0:
                break
    soundfile.write(path, np.concatenate(parts), SAMPLE_RATE, subtype="PCM_16")
    return path


def _spread(clips: list[LabelledClip], count: int) -> list[LabelledClip]:
    return clips[:: max(len(clips) // count, 1)][:count]
