"""A voice that was found in logs becomes one that is enrolled."""

from pathlib import Path

import numpy as np

from hearthlog.analyzer.discover.read_speech import HomeSpeech
from hearthlog.analyzer.discover.voice_summary import longest, turn_at
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.marks.enrol import Enrolled, cut_path, enrol_log
from hearthlog.analyzer.training.speakers import APART
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

_LEAST = 2 * NANOSECONDS  # of a turn
_ENOUGH = 60 * NANOSECONDS


def enrol_voice(home: Path, label: str, speech: HomeSpeech, rows: Int64) -> list[Enrolled]:
    """Enrol the longest turns of a voice, a minute of them, in a training set of voices.

    They are of as many times as there are. What is there already counts.

    Parameters
    ----------
    rows : np.ndarray [shape=(n,)], int64
        Its turns.

    Raises
    ------
    DataError
        If it never speaks for two seconds.
    LogError
        If a log is damaged, or nothing can be written.
    """
    lengths = (speech.turns.ends - speech.turns.starts)[rows]
    enrolled: dict[Path, Enrolled] = {}
    left = _ENOUGH
    for row in _of_all_times(speech, rows[lengths >= _LEAST]).tolist():
        turn = turn_at(speech, row)
        path = cut_path(home, label, turn.start)
        if path in enrolled:  # another microphone heard it, too
            continue
        if left < _LEAST:
            break
        end = min(turn.end, turn.start + left)
        if path.exists():
            enrolled[path] = Enrolled(path, (end - turn.start) / NANOSECONDS)
        else:
            enrolled[path] = enrol_log(home, label, turn.log, turn.start, end, turn.microphone)
        left -= end - turn.start
    if not enrolled:
        raise DataError(f"{label} never speaks for two seconds without a pause; enrol a file")
    return list(enrolled.values())


def _of_all_times(speech: HomeSpeech, rows: Int64) -> Int64:
    """Order turns: the longest of each time, the second longest of each, and so on."""
    rows = longest(speech, rows)
    starts = speech.turns.starts[rows]
    order = np.argsort(starts, kind="stable")
    time = np.empty(len(rows), np.int64)
    time[order] = np.cumsum(np.diff(starts[order], prepend=starts[order][:1]) >= APART)
    by_time = np.argsort(time, kind="stable")
    first = np.searchsorted(time[by_time], time[by_time])
    place = np.empty(len(rows), np.int64)
    place[by_time] = np.arange(len(rows)) - first
    return rows[np.argsort(place, kind="stable")]
