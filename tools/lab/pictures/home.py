"""The simulated home of the pictures: days of logs with some reviewed spans, and an evening."""

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from threading import Event as Flag
from typing import NamedTuple
from zoneinfo import ZoneInfo

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.analyzer.review.ranking import USEFUL
from hearthlog.models.registry import DEFAULT_FOLDER
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import LIVING_ROOM
from hearthlog.tools.home.simulate import truth_of, write_sound
from hearthlog.tools.lab.home.days import Habits, plan_days
from hearthlog.tools.lab.home.person import Person, true_labelling
from hearthlog.tools.lab.home.recording import record_composition

SEED = 41
ZONE = ZoneInfo("Europe/Vienna")
_DAYS = 3
_REVIEW_MINUTES = 12.0


def at(text: str) -> int:
    """Return a local time of the home in nanoseconds of UTC."""
    return round(datetime.fromisoformat(text).replace(tzinfo=ZONE).timestamp()) * NANOSECONDS


START, NOW = at("2026-03-01T00:00"), at("2026-03-03T10:12")
EVENING = at("2026-03-01T18:02:10"), at("2026-03-01T20:05:00")
DAY = at("2026-03-02T00:00"), at("2026-03-03T00:00")


class Home(NamedTuple):
    """Folders of logs: of all days until now, and of an evening with kept sound."""

    logs: Path
    evening: Path


def compose_home(folder: Path) -> Home:
    """Compose the home into a new folder; the same bytes every time."""
    model, library = starter_file(GENERAL), ClipLibrary()
    plan = plan_days(_DAYS, library, Habits(SEED, local_time(START, ZONE).weekday()))
    plan = replace(plan, frames=(NOW - START) // FRAME_NANOSECONDS)
    composition = Composition(plan, library, Rooms(LIVING_ROOM, SEED))
    home = Home(folder / "logs", folder / "evening")
    settings = Settings(output=home.logs, model=model, timezone=ZONE.key)
    record_composition(composition, settings, START)
    person = Person(true_labelling(truth_of(composition).spans, START), models=DEFAULT_FOLDER)
    for queue in (USEFUL, RANDOM):
        person.review(home.logs, _REVIEW_MINUTES, NOW, DAY, queue)
    sound = folder / "evening.flac"
    first, last = ((edge - START) // FRAME_NANOSECONDS for edge in EVENING)
    write_sound(composition, sound, first, last - first)
    settings = Settings(output=home.evening, model=model, timezone=ZONE.key, keep_audio="unsure")
    record_files(settings, FileSource([sound], EVENING[0]), Flag())
    return home
