"""Speech of a home: spans, loudest microphone, and voice turns."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.discover.voices import (
    ENERGY,
    WINDOW_FRAMES,
    VoiceEvidence,
    describe_speech,
    has_voices,
    summed,
    tell_apart,
    voice_space,
    window_starts,
)
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs
from hearthlog.analyzer.logs.selection import array_names, checked_array_names
from hearthlog.analyzer.logs.spans import Spans, joined, rows_at
from hearthlog.models.classes import SILENCE, SPEECH, class_name
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.mcap.chunks import TopicChoice
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, microphone_of, parse_topic, topic

# Mean probability of speech in a segment of another label. Tuned on scenes of household sounds
# unseen by the model: at 0.3 no other sound becomes speech, at 0.15 twice as much speech is found.
_LIKELY = 0.3


def is_doubtful(segments: Columns) -> Bool:
    """Return which segments are not labelled speech but may be speech."""
    return ~_is_of(segments, SPEECH) & ~_is_of(segments, SILENCE)


def speech_spans(segments: Columns, labels: Columns | None = None) -> Spans:
    """Return the spans of speech.

    Parameters
    ----------
    labels : Columns, optional
        Frame labels. A sound with a mean speech probability of 0.3 counts as speech, whatever
        its label: reading aloud may be labelled as coughing.
    """
    starts = segments["header.stamp"]
    ends = starts + segments["duration"]
    rows = _is_of(segments, SPEECH)
    if labels is not None and len(labels):
        rows |= is_doubtful(segments) & (_speech_likelihood(labels, starts, ends) >= _LIKELY)
    return joined(starts[rows], ends[rows])


def _is_of(segments: Columns, kind: str) -> Bool:
    labels = segments["label"]
    names = {label for label in set(labels.tolist()) if class_name(label) == kind}
    found: Bool = np.isin(labels.astype(str), sorted(names))
    return found


def _speech_likelihood(labels: Columns, starts: Int64, ends: Int64) -> Float64:
    """Return the mean probability of speech in spans; 0 without labels."""
    names = array_names(labels.metadata, "probabilities")
    own = [place for place, name in enumerate(names) if class_name(name) == SPEECH]
    probabilities = labels["probabilities"]
    if not own or probabilities.shape[1:] != (len(names),):
        return np.zeros(len(starts))
    order = np.argsort(labels["header.stamp"], kind="stable")  # a clock may have been set back
    stamps = labels["header.stamp"][order]
    values = np.nan_to_num(probabilities[order][:, own].sum(axis=1, dtype=np.float64))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    first, last = np.searchsorted(stamps, starts), np.searchsorted(stamps, ends)
    means: Float64 = (sums[last] - sums[first]) / np.maximum(last - first, 1)
    return means


_ALIKE = 0.7  # correlation of loudness
_LATE = (0, -1, 1, -2, 2, -3, 3)  # frames: clocks and device latencies differ
_SHORT = 10  # frames, too few to compare: time alone decides
_LEAST_ENERGY = 1e-12
_TINY = 1e-12


class SpeechFrames(NamedTuple):
    """Frames of speech of one microphone in one log.

    Attributes
    ----------
    frames : np.ndarray [shape=(n,)], int64
        Start of each frame, in frames since 1970; ascending.
    loudness : np.ndarray [shape=(n,)], float64
        In dB.
    turn : np.ndarray [shape=(n,)], int64
        Turn index of each frame, from 0; ascending.
    """

    frames: Int64
    loudness: Float64
    turn: Int64

    def rows(self, rows: Bool) -> "SpeechFrames":
        """Select rows."""
        return SpeechFrames(self.frames[rows], self.loudness[rows], self.turn[rows])


def speech_frames(stamps: Int64, energy: Float32, starts: Int64) -> SpeechFrames:
    """Return frames of speech in comparable form.

    Parameters
    ----------
    stamps : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC, ascending.
    energy : np.ndarray [shape=(n,)], float32
    starts : np.ndarray [shape=(turns,)], int64
        Stamps of the first frame of each turn.
    """
    loudness = 10.0 * np.log10(np.maximum(energy.astype(np.float64), _LEAST_ENERGY))
    frames = (stamps + FRAME_NANOSECONDS // 2) // FRAME_NANOSECONDS
    return SpeechFrames(frames, loudness, np.searchsorted(starts, stamps, side="right") - 1)


def louder_elsewhere(speech: Sequence[SpeechFrames]) -> list[Bool]:
    """Return which turns another microphone records louder.

    A turn is dropped if the other microphone has speech in most of its frames, and the loudness
    of both correlates by more than 0.7; turns below half a second need only the first condition.
    Of equally loud turns the first microphone's is kept.

    Returns
    -------
    list of np.ndarray [shape=(turns,)], bool
        One per microphone.
    """
    kept = list(speech)
    louder: list[Bool] = []
    for place, own in enumerate(speech):
        counts = np.bincount(own.turn)
        is_louder = np.zeros(len(counts), np.bool_)
        for before, other in enumerate(kept):
            if before != place and _is_of_one_time(own, other):
                is_louder |= _is_louder(own, counts, other, or_as_loud=before < place)
        louder.append(is_louder)
        # dropped turns must not drop others, or no microphone would keep the speech
        kept[place] = own.rows(~is_louder[own.turn])
    return louder


def _is_of_one_time(own: SpeechFrames, other: SpeechFrames) -> bool:
    """Return whether frames may overlap in time; most logs of a home do not."""
    if not (len(own.frames) and len(other.frames)):
        return False
    early, late = min(_LATE), max(_LATE)
    return bool(
        own.frames[0] + early <= other.frames[-1] and other.frames[0] <= own.frames[-1] + late
    )


def _is_louder(own: SpeechFrames, counts: Int64, other: SpeechFrames, *, or_as_loud: bool) -> Bool:
    best, is_louder = np.full(len(counts), _ALIKE), np.zeros(len(counts), np.bool_)
    for late in _LATE:
        times = own.frames + late
        rows = np.minimum(np.searchsorted(other.frames, times), len(other.frames) - 1)
        both = other.frames[rows] == times
        turn, x, y = own.turn[both], own.loudness[both], other.loudness[rows[both]]
        common = np.bincount(turn, minlength=len(counts))
        per_frame = np.maximum(common, 1)
        mean_x, mean_y = (np.bincount(turn, z, len(counts)) / per_frame for z in (x, y))
        x, y = x - mean_x[turn], y - mean_y[turn]
        xy, xx, yy = (np.bincount(turn, z, len(counts)) for z in (x * y, x * x, y * y))
        alike = xy / np.sqrt(np.maximum(xx * yy, _TINY))
        alike[counts < _SHORT] = 1.0
        better = (2 * common > counts) & (alike > best)
        is_louder[better] = (mean_y >= mean_x if or_as_loud else mean_y > mean_x)[better]
        best[better] = alike[better]
    return is_louder


_FIELDS = {"header.stamp", "values", "duration", "label", "probabilities"}
_NEVER = 1 << 62
_PAUSE = 30 * NANOSECONDS  # between conversations
_MOST_FRAMES = 6_000  # per conversation: five minutes
_LEAST_FRAMES = 10
LEAST_WINDOWS = 10  # per voice in a conversation: five seconds
_LARGE = 1e6  # limit of a plausible feature value
_BREATH = FRAME_NANOSECONDS + FRAME_NANOSECONDS // 2  # pause within a turn; stamps follow a clock


class Turns(NamedTuple):
    """Turns (speech without a pause), in the order of logs, and by time within a log.

    Speech recorded by several microphones belongs to the loudest.

    Attributes
    ----------
    starts, ends : np.ndarray [shape=(n,)], int64
        In nanoseconds of UTC.
    log, microphone : np.ndarray [shape=(n,)], int64
        Indices into the lists of `HomeSpeech`.
    voice : np.ndarray [shape=(n,)], int64
        Row of the conversation voice.
    """

    starts: Int64
    ends: Int64
    log: Int64
    microphone: Int64
    voice: Int64


@dataclass(frozen=True)
class HomeSpeech:
    """Speech of a home.

    Attributes
    ----------
    without : int
        Number of logs without segments, or with speech but without the features for voices.
    """

    logs: list[Path]
    microphones: list[str]
    turns: Turns
    voices: VoiceEvidence
    losses: list[str]
    without: int

    @property
    def seconds(self) -> float:
        """Total duration of speech."""
        return float((self.turns.ends - self.turns.starts).sum()) / NANOSECONDS


def read_speech(
    home: HomeLogs,
    start: int | None = None,
    end: int | None = None,
    progress: Progress = ignore_progress,
) -> HomeSpeech:
    """Read the speech of a home from the recorder's segments, log by log.

    Parameters
    ----------
    progress : callable, optional
        Receives the share of the logs read, 0 to 1.
    """
    reader = _Reader(start, end)
    entries = home.between(start or 0, end or _NEVER)
    for number, entry in enumerate(entries, 1):
        try:
            reader.read(entry)
        except LogError as error:
            reader.losses.append(str(error))
        progress(number / len(entries))
    return reader.speech(home.losses)


class _Reader:
    def __init__(self, start: int | None, end: int | None) -> None:
        self.losses: list[str] = []
        self._span = start, end
        self._logs: list[Path] = []
        self._microphones: list[str] = []
        self._turns = [Turns(*(np.empty(0, np.int64) for _ in Turns._fields))]
        self._recent: list[tuple[Turns, SpeechFrames]] = []  # logs that overlap in time
        self._recent_end = 0
        dimensions = len(voice_space().spread)
        self._voices = [VoiceEvidence(np.empty(0), np.empty((0, dimensions)))]
        self._count = self._without = 0

    def read(self, entry: HomeLog) -> None:
        if entry.start >= self._recent_end:
            self._settle()
        log = entry.path
        segments = _columns(log, _is_segments)
        spoken = self._spoken(log, segments)
        is_used = bool(segments) and not spoken
        topics = [topic(name, "features") for name in spoken]
        for features in _columns(log, topics, *self._span).values():
            if features.type != message_types.FEATURES:
                continue
            names = checked_array_names(log, features, "values")
            if has_voices(names):
                is_used = True
                microphone = microphone_of(features.topic)
                self._add(log, microphone, features, names, spoken[microphone])
        self._without += not is_used

    def _spoken(self, log: Path, segments: dict[str, Columns]) -> dict[str, Spans]:
        """Return the spans of speech of each microphone."""
        named = {microphone_of(name): self._inside(each) for name, each in segments.items()}
        doubtful = [topic(name, "label") for name, each in named.items() if is_doubtful(each).any()]
        labels = _columns(log, doubtful)
        spans = {
            name: speech_spans(each, labels.get(topic(name, "label")))
            for name, each in named.items()
        }
        return {name: each for name, each in spans.items() if len(each.starts)}

    def _inside(self, segments: Columns) -> Columns:
        """Return the segments that overlap the requested time.

        Segments are logged later than they begin, so log times cannot select them.
        """
        start, end = self._span
        starts = segments["header.stamp"]
        inside = np.ones(len(starts), np.bool_)
        if start is not None:
            inside &= starts + segments["duration"] > start
        if end is not None:
            inside &= starts < end
        return segments.take(np.flatnonzero(inside))

    def _add(
        self, log: Path, microphone: str, features: Columns, names: Sequence[str], speech: Spans
    ) -> None:
        if log not in self._logs:
            self._logs.append(log)
        if microphone not in self._microphones:
            self._microphones.append(microphone)
        place = len(self._logs) - 1, self._microphones.index(microphone)
        stamps, values = features["header.stamp"], features["values"]
        order = np.argsort(stamps, kind="stable")  # a clock may have been set back
        order = order[rows_at(speech, stamps[order]) >= 0]
        order = order[_can_be(values[order], names)]
        stamps, values = stamps[order], values[order]
        conversations = [*_conversations(stamps)]
        if not conversations:
            return
        turns_of_each = [
            self._tell_apart(stamps[rows], values[rows], names) for rows in conversations
        ]
        starts, ends, voice = (np.concatenate(each) for each in zip(*turns_of_each, strict=True))
        in_log, of_microphone = (np.full(len(starts), each) for each in place)
        kept = np.concatenate([np.arange(rows.start, rows.stop) for rows in conversations])
        energy = values[kept, list(names).index(ENERGY)]
        turns = Turns(starts, ends, in_log, of_microphone, voice)
        self._recent.append((turns, speech_frames(stamps[kept], energy, starts)))
        self._recent_end = max(self._recent_end, int(starts[-1]))

    def _tell_apart(
        self, stamps: Int64, values: Float32, names: Sequence[str]
    ) -> tuple[Int64, Int64, Int64]:
        of, points = voices_of(values, names)
        count = int(of.max()) + 1
        starts, ends, voice = _turns(stamps, _of_frames(of, len(stamps)))
        self._voices.append(summed(points, of, count))
        self._count += count
        return starts, ends, voice + self._count - count

    def _settle(self) -> None:
        """Drop turns that another microphone records louder, as far as logs were read."""
        if self._recent:
            turns, speech = zip(*self._recent, strict=True)
            for own, louder in zip(turns, louder_elsewhere(speech), strict=True):
                self._turns.append(Turns(*(each[~louder] for each in own)))
        self._recent = []

    def speech(self, losses: Sequence[str]) -> HomeSpeech:
        self._settle()
        turns = Turns(*(np.concatenate(each) for each in zip(*self._turns, strict=True)))
        voices = VoiceEvidence(*(np.concatenate(each) for each in zip(*self._voices, strict=True)))
        rows, voice = np.unique(turns.voice, return_inverse=True)
        return HomeSpeech(
            self._logs,
            self._microphones,
            turns._replace(voice=voice),
            voices.rows(rows),
            [*losses, *self.losses],
            self._without,
        )


def _columns(
    log: Path, topics: TopicChoice, start: int | None = None, end: int | None = None
) -> dict[str, Columns]:
    return read_columns([log], topics, start, end, fields=_FIELDS) if topics else {}


def _is_segments(name: str) -> bool:
    parts = parse_topic(name)
    return parts is not None and (parts.labelling, parts.kind) == (LIVE, "segment")


def voices_of(values: Float32, names: Sequence[str]) -> tuple[Int64, Float64]:
    """Separate the voices in the features of a conversation.

    Parameters
    ----------
    values : np.ndarray [shape=(frames, f)], float32
        Features of speech.

    Returns
    -------
    of : np.ndarray [shape=(n,)], int64
        Voice of each window, from 0.
    points : np.ndarray [shape=(n, d)], float64
        Points of the windows in the voice space.
    """
    space = voice_space()
    points = space.points(describe_speech(values, names))
    return tell_apart(points, space.spread, LEAST_WINDOWS), points


def speech_voices(
    stamps: Int64, values: Float32, names: Sequence[str]
) -> tuple[Int64, Int64, Int64]:
    """Return the turns of a conversation: starts, ends and voices.

    Parameters
    ----------
    stamps : np.ndarray [shape=(frames,)], int64
        Of frames of speech, in nanoseconds, ascending.
    values : np.ndarray [shape=(frames, f)], float32
    """
    of, _ = voices_of(values, names)
    return _turns(stamps, _of_frames(of, len(stamps)))


def _can_be(values: Float32, names: Sequence[str]) -> Bool:
    """Return which frames have plausible features; damaged logs may hold others."""
    energy = values[:, list(names).index(ENERGY)]
    possible: Bool = (np.abs(values) <= _LARGE).all(axis=1) & (energy >= 0.0)
    return possible


def _conversations(stamps: Int64) -> Iterator[slice]:
    """Yield the rows of conversations; long conversations are cut."""
    breaks = np.flatnonzero(np.diff(stamps) > _PAUSE) + 1
    for first, last in zip([0, *breaks], [*breaks, len(stamps)], strict=True):
        parts = -(-(last - first) // _MOST_FRAMES)
        edges = np.linspace(first, last, parts + 1).astype(int)
        for start, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if end - start >= _LEAST_FRAMES:
                yield slice(start, end)


def _of_frames(of: Int64, frames: int) -> Int64:
    """Return the voice of each frame, from the window with the nearest middle."""
    middles = window_starts(frames) + WINDOW_FRAMES / 2
    return of[np.searchsorted((middles[1:] + middles[:-1]) / 2, np.arange(frames))]


def _turns(stamps: Int64, voice: Int64) -> tuple[Int64, Int64, Int64]:
    is_new = (np.diff(stamps) > _BREATH) | (np.diff(voice) != 0)
    first = np.concatenate([[0], np.flatnonzero(is_new) + 1])
    last = np.append(first[1:], len(stamps)) - 1
    return stamps[first], stamps[last] + FRAME_NANOSECONDS, voice[first]
