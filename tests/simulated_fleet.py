"""A fleet of homes that all have copies of the same few logs, a log a day."""

import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import log_path

_FIRST_DAY = datetime(2026, 3, 1, 7, tzinfo=UTC)


def write_fleet(logs: list[Path], folder: Path, homes: int, days: int) -> Path:
    """Name some logs in turn as those of the days of each home.

    All homes have the same logs, so what is made of them is the same, too. Copies are links to the
    same file where that is possible.
    """
    for number in range(homes * days):
        home, day = divmod(number, days)
        start = int((_FIRST_DAY + timedelta(days=day)).timestamp()) * NANOSECONDS
        path = log_path(folder / f"home-{home:03}", "home", start)
        path.parent.mkdir(parents=True)
        try:
            os.link(logs[day % len(logs)], path)
        except OSError:
            shutil.copy2(logs[day % len(logs)], path)
    return folder
