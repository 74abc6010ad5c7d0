"""Two voices in conversations, recorded with the starter model."""

from functools import cache
from pathlib import Path

from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools import home
from hearthlog.tools.lab.conversations import clips_of_voices, converse, record_samples

START = 1_772_352_000 * NANOSECONDS
DAY = 86_400 * NANOSECONDS
CLIPS = Path(home.__file__).parent / "clips"
THEO, ALLISON = "fsdd_theo", "voice_allison_smith"


@cache
def two_spoken_days(base):
    """Logs of a minute on each of two days, and when who spoke."""
    folder = base / "spoken"
    folder.mkdir()
    voices = two_voices(folder)
    days = [record_conversation(voices, folder, START + day * DAY, day) for day in range(2)]
    return days[0][0], [turns for _, turns in days]


def two_voices(tmp_path):
    """The clips of two people, by name."""
    table = (CLIPS / "manifest.csv").read_text().splitlines()
    rows = [table[0], *(f"{CLIPS}/{row}" for row in table if THEO in row or ALLISON in row)]
    manifest = tmp_path / "voices.csv"
    manifest.write_text("\n".join(rows))
    return clips_of_voices(manifest)


def record_conversation(voices, folder, start, seed, seconds=60):
    """Record a conversation, beginning at a time in ns; return the logs and the turns."""
    samples, turns = converse(voices, seconds, seed)
    return record_samples(samples, folder, start, starter_file(GENERAL)), turns
