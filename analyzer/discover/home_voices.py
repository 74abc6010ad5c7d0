"""Voices of a home: matching across conversations, voices file, summaries and enrolment."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from datetime import tzinfo
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from hearthlog.analyzer.discover.groups import read_arrays, write_arrays
from hearthlog.analyzer.discover.speech import HomeSpeech, voices_of
from hearthlog.analyzer.discover.voices import (
    HOP_FRAMES,
    WINDOW_FRAMES,
    VoiceEvidence,
    has_voices,
    merged_voices,
    same_voice,
    summed,
    voice_space,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.marks.enrol import Enrolled, cut_path, enrol_log
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.analyzer.training.speakers import APART, is_voice
from hearthlog.models.classes import CLASS_NAME
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS, time_text

NO_VOICE = -1
MOST_VOICES = 1_000  # per file
LEAST_SECONDS = 20.0  # of speech needed to search for voices
_LEAST_WINDOWS = 20  # per voice: ten seconds
_MOST = 2_000  # conversation voices among which home voices are searched


@dataclass(frozen=True)
class HomeVoices:
    """Voices of a home.

    Attributes
    ----------
    numbers : np.ndarray [shape=(g,)], int64
        Voice numbers, never reused.
    names : list of str
        Assigned by a person; empty for unnamed voices.
    """

    numbers: Int64
    evidence: VoiceEvidence
    names: list[str] = field(default_factory=list)
    id: str = ""


def find_voices(speech: HomeSpeech, known: HomeVoices | None) -> tuple[HomeVoices, Int64]:
    """Find the voices of a home in its conversations.

    Parameters
    ----------
    known : HomeVoices or None
        Voices of an earlier run, which stay unchanged; None for the first run.

    Returns
    -------
    of : np.ndarray [shape=(n,)], int64
        Home voice row of each conversation voice; `NO_VOICE` if none matches.

    Raises
    ------
    DataError
        If there are no earlier voices and too little speech to separate voices.
    """
    if known is None and speech.seconds < LEAST_SECONDS:
        raise DataError(
            f"{speech.seconds:.0f} s of speech are too few to tell voices apart: it takes "
            f"{LEAST_SECONDS:.0f} s"
        )
    spread = voice_space().spread
    voices = known or HomeVoices(
        np.empty(0, np.int64), VoiceEvidence(np.empty(0), np.empty((0, len(spread))))
    )
    while True:
        of = _recognised(speech.voices, voices.evidence, spread)
        added = _with_new(voices, speech.voices.rows(of == NO_VOICE), spread)
        if len(added.numbers) == len(voices.numbers):
            break
        voices = added
    return (voices if voices.id else _identified(voices)), of


def seconds_of(counts: Float64) -> Float64:
    """Return the duration of a number of windows in seconds."""
    return counts * (HOP_FRAMES * FRAME_SECONDS)


def _recognised(evidence: VoiceEvidence, known: VoiceEvidence, spread: Float64) -> Int64:
    """Return the likeliest existing voice of each row, if one voice is likelier than two."""
    best = np.zeros(len(evidence.counts))
    of = np.full(len(best), NO_VOICE)
    for row in range(len(known.counts)):
        ratio = same_voice(known.rows(np.array([row])), evidence, spread)
        better = ratio > best
        best[better], of[better] = ratio[better], row
    return of


def _with_new(voices: HomeVoices, rest: VoiceEvidence, spread: Float64) -> HomeVoices:
    """Add voices from unmatched evidence, if a voice speaks long enough."""
    largest = np.sort(np.argsort(-rest.counts, kind="stable")[:_MOST])
    rest = rest.rows(largest)
    if not len(rest.counts):
        return voices
    of = merged_voices(rest, spread)
    own = (of == np.arange(of.max() + 1)[:, np.newaxis]).astype(np.float64)
    found = VoiceEvidence(own @ rest.counts, own @ rest.sums)
    order = np.argsort(-found.counts, kind="stable")
    order = order[found.counts[order] >= _LEAST_WINDOWS][: MOST_VOICES - len(voices.numbers)]
    new = found.rows(order)
    first = voices.numbers.max(initial=0) + 1
    return replace(
        voices,
        numbers=np.append(voices.numbers, np.arange(first, first + len(order))),
        evidence=VoiceEvidence(
            np.append(voices.evidence.counts, new.counts),
            np.concatenate([voices.evidence.sums, new.sums]),
        ),
        names=[*voices.names, *[""] * len(order)],
    )


def _identified(voices: HomeVoices) -> HomeVoices:
    digest = hashlib.sha256(b"".join(each.tobytes() for each in voices.evidence)).hexdigest()
    return replace(voices, id=digest[:8])


VOICES = "voices.safetensors"  # in a folder of logs
_KEY = "hearthlog_voices"
_FORMAT: Final = 1
_LARGEST = 4 << 20  # bytes
_LEAST_NUMBER, _MOST_NUMBER = 1, (1 << 31) - 1
_LARGE = 1e9  # of counts and sums
_ARRAYS = {"numbers": np.int64, "counts": np.float64, "sums": np.float64}

_Name = Annotated[str, StringConstraints(pattern=rf"^({CLASS_NAME.pattern})?$")]


class _Head(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: Annotated[int, Field(ge=1, le=_FORMAT)]
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{8}$")]
    names: Annotated[list[_Name], Field(max_length=MOST_VOICES)]


def save_voices(voices: HomeVoices, path: Path) -> None:
    """Write the voices file, replacing an existing one.

    Raise `DataError` if the voice features are too large for the file to be read again. Raise
    `LogError` if the file cannot be written.
    """
    head = _Head(format=_FORMAT, id=voices.id, names=voices.names)
    arrays = {"numbers": voices.numbers, **voices.evidence._asdict()}
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    if not _fits(head, arrays):
        raise DataError(
            f"{path}: not written, for some speech has features that no sound has; leave out logs "
            "that hearthlog did not record"
        )
    write_arrays(path, _KEY, arrays, head)


def load_voices(path: Path) -> HomeVoices | None:
    """Read the voices file; None if it does not exist.

    Raise `DataError` if it is not a voices file, or damaged.
    """
    if not path.exists():
        return None
    arrays, head = read_arrays(path, "voices", _KEY, _LARGEST, _Head)
    if not _fits(head, arrays):
        raise DataError(f"{path}: is damaged; move it away to begin anew")
    return HomeVoices(
        arrays["numbers"], VoiceEvidence(arrays["counts"], arrays["sums"]), head.names, head.id
    )


def _fits(head: _Head, arrays: dict[str, NDArray[Any]]) -> bool:
    count, dimensions = len(head.names), len(voice_space().spread)
    shapes = {"numbers": (count,), "counts": (count,), "sums": (count, dimensions)}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        return False
    numbers, counts, sums = (arrays[name] for name in _ARRAYS)
    return (
        all(arrays[name].dtype == kind for name, kind in _ARRAYS.items())
        and len(np.unique(numbers)) == count
        and bool(((numbers >= _LEAST_NUMBER) & (numbers <= _MOST_NUMBER)).all())
        and bool(((counts >= 1.0) & (counts <= _LARGE)).all())
        and bool((np.abs(sums) <= _LARGE).all())
    )


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
    """Summary of a voice.

    Attributes
    ----------
    name : str
        Assigned by a person; empty if unnamed.
    days : int
        Number of local days with this voice.
    hours : list of int
        Number of turns that began in each local hour of the day.
    """

    number: int
    name: str
    minutes: float
    turns: int
    days: int
    hours: list[int]
    examples: list[VoiceTurn]


class SpokenSpans(NamedTuple):
    """Voice turns of one microphone, in time order.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    texts : np.ndarray [shape=(n,)] of str
        Name of the voice, or `voice 3`; `no voice` for unmatched turns.
    """

    starts: Int64
    ends: Int64
    texts: NDArray[np.object_]


def summarise(
    speech: HomeSpeech, voices: HomeVoices, of: Int64, zone: tzinfo
) -> list[VoiceSummary]:
    """Summarise the voices that speak, most speech first.

    Parameters
    ----------
    of : np.ndarray [shape=(n,)], int64
        Result of `find_voices`.
    """
    found = []
    for row in range(len(voices.numbers)):
        rows = np.flatnonzero(of[speech.turns.voice] == row)
        if len(rows):
            found.append(_summary(speech, voices, row, rows, zone))
    return sorted(found, key=lambda each: (-each.minutes, each.number))


def _summary(
    speech: HomeSpeech, voices: HomeVoices, row: int, rows: Int64, zone: tzinfo
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
    """Sort turns by length, longest first."""
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


def spoken_spans(speech: HomeSpeech, voices: HomeVoices, of: Int64) -> dict[str, SpokenSpans]:
    """Return the voice turns of each microphone.

    Parameters
    ----------
    of : np.ndarray [shape=(n,)], int64
        Result of `find_voices`.
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


_QUIET = 10 ** (-30 / 10)  # of the loud frames
_MOST_FRAMES = 6_000  # per voice
_SURELY = 2.0  # log likelihood ratio of two voices over one


def check_voices(recordings: Iterable[Recording], features: FeatureSet) -> None:
    """Check that each enrolled recording set holds one voice.

    Raise `DataError` if one person's recordings contain two voices.
    """
    if not has_voices(features.feature_names):
        return
    by_name: dict[str, list[Recording]] = {}
    for one in recordings:
        if is_voice(one.label):
            by_name.setdefault(one.label, []).append(one)
    for name, own in by_name.items():
        if is_of_two(np.concatenate([_loud(one.features, features) for one in own]), features):
            times = ", ".join(sorted(time_text(one.span[0])[:19] for one in own if one.span))
            raise DataError(
                f"{name}: two voices are heard in what is enrolled ({times}); delete what is of "
                "another person, or enrol the other voice under a name of its own"
            )


def is_of_two(values: Float32, features: FeatureSet) -> bool:
    """Return whether speech contains two voices; False for less than a window."""
    if len(values) < WINDOW_FRAMES:
        return False
    of, points = voices_of(values[:_MOST_FRAMES], features.feature_names)
    voices = summed(points, of, int(of.max()) + 1)
    for row in range(1, len(voices.counts)):
        rest = voices.rows(np.arange(row))
        ratio = same_voice(voices.rows(np.array([row])), rest, voice_space().spread)
        if ratio.min() < -_SURELY:
            return True
    return False


def _loud(values: Float32, features: FeatureSet) -> Float32:
    power = features.power(values)
    return values[power > np.percentile(power, 90) * _QUIET]


_LEAST = 2 * NANOSECONDS  # per turn
_ENOUGH = 60 * NANOSECONDS


def enrol_voice(home: Path, label: str, speech: HomeSpeech, rows: Int64) -> list[Enrolled]:
    """Enrol one minute of a voice's longest turns in a training set of voices.

    The turns are spread over as many separate times as possible. Existing recordings count.

    Parameters
    ----------
    rows : np.ndarray [shape=(n,)], int64
        Turns of the voice.

    Raises
    ------
    DataError
        If no turn of the voice lasts two seconds.
    LogError
        If a log is damaged, or nothing can be written.
    """
    lengths = (speech.turns.ends - speech.turns.starts)[rows]
    enrolled: dict[Path, Enrolled] = {}
    left = _ENOUGH
    for row in _of_all_times(speech, rows[lengths >= _LEAST]).tolist():
        turn = turn_at(speech, row)
        path = cut_path(home, label, turn.start)
        if path in enrolled:  # already enrolled from another microphone
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
