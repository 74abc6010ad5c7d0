"""A voice that was found in logs becomes one that is enrolled."""

from pathlib import Path

from hearthlog.analyzer.discover.read_speech import HomeSpeech
from hearthlog.analyzer.discover.voice_summary import longest, turn_at
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.marks.enrol import Enrolled, enrol_log
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.times import NANOSECONDS

_LEAST = 2 * NANOSECONDS  # of a turn
_ENOUGH = 60 * NANOSECONDS


def enrol_voice(home: Path, label: str, speech: HomeSpeech, rows: Int64) -> list[Enrolled]:
    """Enrol the longest turns of a voice, a minute of them, in a training set of voices.

    Parameters
    ----------
    home : Path
        Folder of the training set.
    label : str
        Name of the voice.
    speech : HomeSpeech
    rows : np.ndarray [shape=(n,)], int64
        Its turns.

    Raises
    ------
    DataError
        If it never speaks for two seconds.
    LogError
        If a log is damaged, or nothing can be written.
    """
    enrolled: list[Enrolled] = []
    left = _ENOUGH
    for row in longest(speech, rows).tolist():
        turn = turn_at(speech, row)
        if left < _LEAST or turn.end - turn.start < _LEAST:
            break
        end = min(turn.end, turn.start + left)
        enrolled.append(enrol_log(home, label, turn.log, turn.start, end))
        left -= end - turn.start
    if not enrolled:
        raise DataError(f"{label} never speaks for two seconds without a pause; enrol a file")
    return enrolled
