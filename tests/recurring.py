"""Sounds that recur, each of one thing, among others; and when each of them was."""

import random
from pathlib import Path
from threading import Event

import numpy as np
import soundfile

from hearthlog.analyzer.evaluation.scenes import background
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.times import NANOSECONDS

RATE = 16_000
CLIPS = Path(__file__).parent / "data" / "household"
RECURRING = {
    "rooster": "other_negative/other_negative_013.flac",
    "dog": "other_negative/other_negative_014.flac",
    "chainsaw": "other_negative/other_negative_016.flac",
    "clock": "objects_activity/objects_activity_027.flac",
}


def record_recurring(folder, start, seed, seconds=720):
    """Record some minutes, beginning at a time in ns; return when what recurs was.

    Each time it is another part of the clip, at another level, in a room of another colour. Every
    other sound is a cough or a cry, and never the same one.
    """
    rng, noises = random.Random(seed), np.random.default_rng(seed)
    scene, truth, at = background(seconds, -65.0, "pink", seed), [], 2.0
    others = [*CLIPS.glob("coughing/*"), *CLIPS.glob("crying/*")]
    while at < seconds - 8:
        name = rng.choice(sorted(RECURRING))
        samples, _ = soundfile.read(CLIPS / RECURRING[name], dtype="float32")
        if rng.random() < 0.3:
            name = "other"
            samples, _ = soundfile.read(rng.choice(sorted(others)), dtype="float32")
        sound = _another_take(samples[: 4 * RATE], rng, noises)
        scene[int(at * RATE) :][: len(sound)] += sound
        end = at + len(sound) / RATE
        truth.append((start + int(at * NANOSECONDS), start + int(end * NANOSECONDS), name))
        at = end + rng.uniform(0.7, 2.5)
    path = folder.parent / f"recurring-{seed}.flac"
    soundfile.write(path, np.clip(scene, -1, 1), RATE)
    settings = Settings(output=folder, model=starter_file(GENERAL), timezone="UTC")
    record(settings, FileSource([path], start), Event())
    return truth


def _another_take(samples, rng, noises):
    length = int(len(samples) * rng.uniform(0.75, 1.0))
    first = rng.randrange(len(samples) - length + 1)
    room = noises.normal(0, 0.15, 48) * np.exp(-np.arange(48) / 10)
    room[0] = 1.0
    sound = np.convolve(samples[first : first + length], room)
    return (sound / np.abs(sound).max() * 10 ** (rng.uniform(-22, -8) / 20)).astype(np.float32)


def names_of(spans, truth):
    """Name what each of some sounds was: that with which it has most time in common."""
    starts, ends = (np.array([each[place] for each in truth]) for place in (0, 1))
    names = []
    for start, end in zip(spans.starts.tolist(), spans.ends.tolist(), strict=True):
        common = np.minimum(ends, end) - np.maximum(starts, start)
        best = int(common.argmax())
        names.append(truth[best][2] if common[best] > 0 else "other")
    return np.array(names)
