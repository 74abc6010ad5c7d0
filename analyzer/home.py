"""A home's own sound to learn from: what was marked in its logs, and what was enrolled."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analyzer.dataset import Recording
from analyzer.review import Mark, read_marks
from models.inputs import WINDOW_FRAMES
from schemas.columns import Columns, read_columns
from schemas.files import find_logs
from schemas.messages import NANOSECONDS
from schemas.topics import topic

HOME_WEIGHT = 5.0  # of a segment of the home, where others count 1
HOME = "this home"

Int64 = NDArray[np.int64]


def home_recordings(folder: Path) -> Iterator[Recording]:
    """Read the features of everything that is marked in the logs of a folder.

    A mark shorter than a second is taken with what is around it. All marks of a day are of one
    source.

    Parameters
    ----------
    folder : Path
        Of logs, with review layers beside them.

    Raises
    ------
    LogError
        If a log or a layer is damaged.
    """
    for log in find_logs(folder):
        marks = read_marks(log)
        if not marks:
            continue
        topics = {topic(mark.microphone, "features") for mark in marks}
        columns = read_columns([log], topics, fields={"header.stamp", "frame", "values"})
        for mark in marks:
            heard = columns.get(topic(mark.microphone, "features"))
            if heard is not None and len(heard):
                yield from _recordings(heard, mark)


def _recordings(heard: Columns, mark: Mark) -> Iterator[Recording]:
    """Return what was heard during a mark; in pieces where there are gaps in it."""
    stamps, frames = heard["header.stamp"], heard["frame"].astype(np.int64)
    first, last = np.searchsorted(stamps, [mark.start, mark.end]).tolist()
    missing = max(WINDOW_FRAMES - (last - first), 0)
    first = max(first - missing // 2, 0)
    last = min(max(last + missing - missing // 2, first + WINDOW_FRAMES), len(stamps))
    day = np.datetime64(mark.start // NANOSECONDS, "s").astype("datetime64[D]")
    breaks = np.flatnonzero(np.diff(frames[first:last]) != 1) + 1
    for piece in np.split(heard["values"][first:last], breaks):
        yield Recording(mark.label, f"{HOME} {day}", HOME, "", piece, HOME_WEIGHT)
