"""What there is to say of each voice, and when each speaks."""

from dataclasses import dataclass
from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.discover.home_voices import Voices
from hearthlog.analyzer.discover.read_speech import HomeSpeech
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import NANOSECONDS

_HOURS = 24
_SHOWN = 3


class VoiceTurn(NamedTuple):
    """A turn of a voice; times in nanoseconds of UTC."""

    log: Path
    microphone: str
    start: int
    end: int


@dataclass(frozen=True)
class VoiceSummary:
    """A voice.

    Attributes
    ----------
    name : str
        That a person gave; empty where nobody did.
    days : int
        On how many days, at home.
    hours : list of int
        How many of its turns began in each hour of the day, at home.
    """

    number: int
    name: str
    minutes: float
    turns: int
    days: int
    hours: list[int]
    examples: list[VoiceTurn]


class SpokenSpans(NamedTuple):
    """Turns of the voices of one microphone, in the order of time.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    texts : np.ndarray [shape=(n,)] of str
        The name of the voice, or `voice 3`; `no voice` for what is of none.
    """

    starts: Int64
    ends: Int64
    texts: NDArray[np.object_]


def summarise(speech: HomeSpeech, voices: Voices, of: Int64, zone: tzinfo) -> list[VoiceSummary]:
    """Summarise the voices that speak, that with most speech first.

    Parameters
    ----------
    of : np.ndarray [shape=(n,)], int64
        As `find_voices` returns it.
    """
    found = []
    for row in range(len(voices.numbers)):
        rows = np.flatnonzero(of[speech.turns.voice] == row)
        if len(rows):
            found.append(_summary(speech, voices, row, rows, zone))
    return sorted(found, key=lambda each: (-each.minutes, each.number))


def _summary(
    speech: HomeSpeech, voices: Voices, row: int, rows: Int64, zone: tzinfo
) -> VoiceSummary:
    turns = speech.turns
    moments = [local_time(start, zone) for start in turns.starts[rows].tolist()]
    seconds = (turns.ends - turns.starts)[rows] / NANOSECONDS
    hours = np.bincount([moment.hour for moment in moments], minlength=_HOURS)
    return VoiceSummary(
        int(voices.numbers[row]),
        voices.names[row],
        float(seconds.sum()) / 60.0,
        len(rows),
        len({moment.date() for moment in moments}),
        hours.tolist(),
        [turn_at(speech, each) for each in longest(speech, rows)[:_SHOWN].tolist()],
    )


def longest(speech: HomeSpeech, rows: Int64) -> Int64:
    """Order turns by their lengths, the longest first."""
    lengths = (speech.turns.ends - speech.turns.starts)[rows]
    return rows[np.argsort(-lengths, kind="stable")]


def turn_at(speech: HomeSpeech, row: int) -> VoiceTurn:
    """Return a turn."""
    turns = speech.turns
    return VoiceTurn(
        speech.logs[turns.log[row]],
        speech.microphones[turns.microphone[row]],
        int(turns.starts[row]),
        int(turns.ends[row]),
    )


def spoken_spans(speech: HomeSpeech, voices: Voices, of: Int64) -> dict[str, SpokenSpans]:
    """Return when which voice speaks, by microphone.

    Parameters
    ----------
    of : np.ndarray [shape=(n,)], int64
        As `find_voices` returns it.
    """
    named = zip(voices.names, voices.numbers.tolist(), strict=True)
    texts = np.array([*(name or f"voice {number}" for name, number in named), "no voice"], object)
    turns = speech.turns
    order = np.argsort(turns.starts, kind="stable")
    spans = {}
    for place, microphone in enumerate(speech.microphones):
        rows = order[turns.microphone[order] == place]
        spans[microphone] = SpokenSpans(
            turns.starts[rows], turns.ends[rows], texts[of[turns.voice[rows]]]
        )
    return spans
