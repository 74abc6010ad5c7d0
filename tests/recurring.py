"""Sounds that recur, each of one thing, among coughs and cries."""

from functools import cache
from pathlib import Path

import numpy as np
import soundfile

from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.lab import recurring_scene

START = 1_772_352_000 * NANOSECONDS
DAY = 86_400 * NANOSECONDS
CLIPS = Path(__file__).parent / "data" / "household"
RECURRING = {
    "rooster": "other_negative/other_negative_013.flac",
    "dog": "other_negative/other_negative_014.flac",
    "chainsaw": "other_negative/other_negative_016.flac",
    "clock": "objects_activity/objects_activity_027.flac",
}
_LONGEST = 4 * 16_000


@cache
def two_recurring_days(base):
    """Logs of some minutes on each of two days, and when what recurs was."""
    folder = base / "recurring" / "logs"
    folder.parent.mkdir()
    return folder, [record_recurring(folder, START + day * DAY, seed=day) for day in range(2)]


def record_recurring(folder, start, seed, seconds=720):
    """Record some minutes, beginning at a time in ns; return when each sound was."""
    kinds = {name: [_samples(CLIPS / path)] for name, path in RECURRING.items()}
    others = [*CLIPS.glob("coughing/*"), *CLIPS.glob("crying/*")]
    clips = [_samples(path) for path in sorted(others)]
    return recurring_scene.record_scene(kinds, clips, seconds, -60.0, folder, start, seed)


def _samples(path):
    return soundfile.read(path, dtype="float32")[0][:_LONGEST]


def names_of(spans, truth):
    """Name what each of some sounds was."""
    return np.array(recurring_scene.names_of(spans, truth)[0])
