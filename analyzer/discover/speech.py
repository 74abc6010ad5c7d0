"""Speech of a home: spans, loudest microphone, turns of voices, and their enrolment."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.discover import (
    NO_CLUSTER,
    NamedSpans,
    Occurrences,
    places,
    read_each,
)
from hearthlog.analyzer.discover.voices import (
    ENERGY,
    VOICES,
    WINDOW_FRAMES,
    HomeVoices,
    VoiceEvidence,
    describe_speech,
    has_voices,
    no_evidence,
    recognised,
    same_voice,
    separate_voices,
    summed,
    voice_space,
    window_starts,
    with_new_voices,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs
from hearthlog.analyzer.logs.selection import array_names, checked_array_names
from hearthlog.analyzer.logs.spans import NEVER, Spans, joined, rows_at
from hearthlog.analyzer.marks.enrol import Enrolled, cut_path, enrol_log
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.analyzer.training.speakers import APART, is_voice
from hearthlog.models.classes import SILENCE, SPEECH, class_name
from hearthlog.models.features import FeatureSet
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.errors import Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, time_text
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.mcap.chunks import TopicChoice
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, microphone_of, parse_topic, topic

# Mean probability of speech in a segment of another label. Tuned on scenes of household sounds
# unseen by the model: at 0.3 no other sound becomes speech, at 0.15 twice as much speech is found.
_LIKELY = 0.3


def may_be_speech(segments: Columns) -> Bool:
    """Return which segments are not labelled speech but may be speech."""
    return ~_is_of(segments, SPEECH) & ~_is_of(segments, SILENCE)


def speech_spans(segments: Columns, labels: Columns | None = None) -> Spans:
    """Return the spans of speech.

    With frame labels, a sound with a mean speech probability of 0.3 counts as speech, whatever its
    label: reading aloud may be labelled as coughing.
    """
    starts = segments["header.stamp"]
    ends = starts + segments["duration"]
    rows = _is_of(segments, SPEECH)
    if labels is not None and len(labels):
        rows |= may_be_speech(segments) & (_speech_likelihood(labels, starts, ends) >= _LIKELY)
    return joined(starts[rows], ends[rows])


def _is_of(segments: Columns, kind: str) -> Bool:
    labels = segments["label"]
    names = {label for label in set(labels.tolist()) if class_name(label) == kind}
    return np.isin(labels.astype(str), sorted(names))


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
    return (sums[last] - sums[first]) / np.maximum(last - first, 1)


_ALIKE = 0.7  # correlation of loudness
_LATE = (0, -1, 1, -2, 2, -3, 3)  # frames: clocks and device latencies differ
_SHORT = 10  # frames, too few to compare: time alone decides
_LEAST_ENERGY = 1e-12
_TINY = 1e-12


class SpeechFrames(NamedTuple):
    """Frames of speech of one microphone in one log."""

    frames: Int64  # [shape=(n,)]; starts in frames since 1970; ascending
    loudness: Float64  # [shape=(n,)], in dB
    turn: Int64  # [shape=(n,)]; turn index of each frame, from 0; ascending

    def rows(self, rows: Bool) -> "SpeechFrames":
        """Select rows."""
        return SpeechFrames(self.frames[rows], self.loudness[rows], self.turn[rows])


def speech_frames(stamps: Int64, energy: Float32, starts: Int64) -> SpeechFrames:
    """Return frames of speech in comparable form; stamps (nanoseconds of UTC) ascend.

    `starts` are stamps of the first frame of each turn.
    """
    loudness = 10.0 * np.log10(np.maximum(energy.astype(np.float64), _LEAST_ENERGY))
    frames = (stamps + FRAME_NANOSECONDS // 2) // FRAME_NANOSECONDS
    return SpeechFrames(frames, loudness, np.searchsorted(starts, stamps, side="right") - 1)


def louder_elsewhere(speech: Sequence[SpeechFrames]) -> list[Bool]:
    """Return, for each microphone, which turns another microphone records louder.

    A turn is dropped if the other microphone has speech in most of its frames, and the loudness of
    both correlates by more than 0.7; turns below half a second need only the first condition. Of
    equally loud turns the first microphone's is kept.
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
_PAUSE = 30 * NANOSECONDS  # between conversations
_MOST_FRAMES = 6_000  # per conversation, or enrolled voice: five minutes
LEAST_SECONDS = 20.0  # of speech needed to search for voices
_LEAST_FRAMES = 10
LEAST_WINDOWS = 10  # per voice in a conversation: five seconds
_LARGE = 1e6  # limit of a plausible feature value
_BREATH = FRAME_NANOSECONDS + FRAME_NANOSECONDS // 2  # pause within a turn; stamps follow a clock


class _Turns(NamedTuple):
    """Turns of one microphone in one log."""

    starts: Int64
    ends: Int64
    voice: Int64


_NO_TURNS = _Turns(*(np.empty(0, np.int64) for _ in _Turns._fields))


@dataclass(frozen=True)
class HomeSpeech(Occurrences):
    """Turns of a home: speech without a pause, of the microphone that records it loudest.

    `without` counts logs without segments, or with speech but without the features for voices.
    """

    voice: Int64  # [shape=(n,)]; row of the conversation voice
    voices: VoiceEvidence  # of the voices of conversations

    @property
    def seconds(self) -> float:
        """Total duration of speech."""
        return float((self.ends - self.starts).sum()) / NANOSECONDS

    def longest(self, rows: Int64) -> Int64:
        """Sort turns by length, longest first."""
        return rows[np.argsort(-(self.ends - self.starts)[rows], kind="stable")]


def read_speech(
    home: HomeLogs,
    start: int | None = None,
    end: int | None = None,
    progress: Progress = ignore_progress,
) -> HomeSpeech:
    """Read the speech of a home from the recorder's segments, log by log.

    `progress` receives the share of the logs read, 0 to 1.
    """
    reader = _Reader(start, end)
    read_each(home.between(start, end), reader.read, reader.losses, progress)
    return reader.speech(home.losses)


class _Reader:
    def __init__(self, start: int | None, end: int | None) -> None:
        self.losses: list[str] = []
        self._span = start, end
        self._parts: list[tuple[Path, str, _Turns]] = []
        self._recent: list[tuple[Path, str, _Turns, SpeechFrames]] = []  # overlap in time
        self._recent_end = 0
        self._voices = [no_evidence()]
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
        doubtful = [
            topic(name, "label") for name, each in named.items() if may_be_speech(each).any()
        ]
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
        inside = starts + segments["duration"] > (-NEVER if start is None else start)
        inside &= starts < (NEVER if end is None else end)
        return segments.take(np.flatnonzero(inside))

    def _add(
        self, log: Path, microphone: str, features: Columns, names: Sequence[str], speech: Spans
    ) -> None:
        stamps, values = features["header.stamp"], features["values"]
        order = np.argsort(stamps, kind="stable")  # a clock may have been set back
        order = order[rows_at(speech, stamps[order]) >= 0]
        order = order[_can_be(values[order], names)]
        conversations = [order[rows] for rows in _conversations(stamps[order])]
        found = [_NO_TURNS]
        for rows in conversations:
            starts, ends, voice, evidence = speech_voices(stamps[rows], values[rows], names)
            found.append(_Turns(starts, ends, voice + self._count))
            self._voices.append(evidence)
            self._count += len(evidence.counts)
        turns = _Turns(*map(np.concatenate, zip(*found, strict=True)))
        kept = np.concatenate([order[:0], *conversations])
        energy = values[kept, list(names).index(ENERGY)]
        frames = speech_frames(stamps[kept], energy, turns.starts)
        self._recent.append((log, microphone, turns, frames))
        self._recent_end = int(turns.starts.max(initial=self._recent_end))

    def _settle(self) -> None:
        """Drop turns that another microphone records louder, as far as logs were read."""
        is_louder = louder_elsewhere([frames for *_, frames in self._recent])
        for (log, microphone, turns, _), louder in zip(self._recent, is_louder, strict=True):
            kept = _Turns(*(each[~louder] for each in turns))
            self._parts.append((log, microphone, kept))
        self._recent = []

    def speech(self, losses: Sequence[str]) -> HomeSpeech:
        self._settle()
        turns = [_NO_TURNS, *(turns for *_, turns in self._parts)]
        starts, ends, voice = map(np.concatenate, zip(*turns, strict=True))
        rows, voice = np.unique(voice, return_inverse=True)
        return HomeSpeech(
            *places(self._parts),
            starts,
            ends,
            [*losses, *self.losses],
            self._without,
            voice,
            VoiceEvidence(*map(np.concatenate, zip(*self._voices, strict=True))).rows(rows),
        )


def _columns(
    log: Path, topics: TopicChoice, start: int | None = None, end: int | None = None
) -> dict[str, Columns]:
    return read_columns([log], topics, start, end, fields=_FIELDS) if topics else {}


def _is_segments(name: str) -> bool:
    parts = parse_topic(name)
    return parts is not None and (parts.labelling, parts.kind) == (LIVE, "segment")


def voices_of(values: Float32, names: Sequence[str]) -> tuple[Int64, VoiceEvidence]:
    """Separate the voices in the speech features [shape=(frames, f)] of a conversation.

    Return the voice of each window, from 0, and the evidence of each voice.
    """
    points = voice_space().points(describe_speech(values, names))
    of = separate_voices(points, LEAST_WINDOWS)
    return of, summed(points, of, int(of.max()) + 1)


def speech_voices(
    stamps: Int64, values: Float32, names: Sequence[str]
) -> tuple[Int64, Int64, Int64, VoiceEvidence]:
    """Return the turns of a conversation: starts, ends and voices; and the voices.

    Stamps of frames of speech (ns) ascend; values have shape (frames, f).
    """
    of, voices = voices_of(values, names)
    return *_turns(stamps, _of_frames(of, len(stamps))), voices


def _can_be(values: Float32, names: Sequence[str]) -> Bool:
    """Return which frames have plausible features; damaged logs may hold others."""
    energy = values[:, list(names).index(ENERGY)]
    return (np.abs(values) <= _LARGE).all(axis=1) & (energy >= 0.0)


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


def find_voices(speech: HomeSpeech, earlier: HomeVoices | None) -> tuple[HomeVoices, Int64]:
    """Find the voices of a home in its conversations.

    Voices of an earlier run stay unchanged; None for the first run. Return also the home voice row
    of each conversation voice; `NO_CLUSTER` if none matches. Raise `DataError` if there are no
    earlier voices and too little speech to separate voices.
    """
    if earlier is None and speech.seconds < LEAST_SECONDS:
        raise DataError(
            f"{speech.seconds:.0f} s of speech are too few to tell voices apart: it takes "
            f"{LEAST_SECONDS:.0f} s"
        )
    voices = earlier or HomeVoices(np.empty(0, np.int64), no_evidence())
    while True:
        of = recognised(speech.voices, voices.evidence)
        added = with_new_voices(voices, speech.voices.rows(of == NO_CLUSTER))
        if len(added.numbers) == len(voices.numbers):
            break
        voices = added
    return (voices if voices.id else voices.identified(voices.evidence)), of


def spoken_spans(speech: HomeSpeech, voices: HomeVoices, of: Int64) -> dict[str, NamedSpans]:
    """Return the voice turns of each microphone; turns that match no voice are `no voice`.

    `of` is from `find_voices`.
    """
    texts = [*voices.texts(VOICES), "no voice"]
    own = of[speech.voice]
    return speech.spans(np.where(own == NO_CLUSTER, len(voices.numbers), own), texts)


_QUIET = 10 ** (-30 / 10)  # of the loud frames
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
    _, voices = voices_of(values[:_MOST_FRAMES], features.feature_names)
    for row in range(1, len(voices.counts)):
        rest = voices.rows(np.arange(row))
        ratio = same_voice(voices.rows(np.array([row])), rest)
        if ratio.min() < -_SURELY:
            return True
    return False


def _loud(values: Float32, features: FeatureSet) -> Float32:
    power = features.power(values)
    return values[power > np.percentile(power, 90) * _QUIET]


_LEAST_TURN = 2 * NANOSECONDS  # to enrol
_ENOUGH = 60 * NANOSECONDS


def enrol_voice(home: Path, label: str, speech: HomeSpeech, rows: Int64) -> list[Enrolled]:
    """Enrol one minute of a voice's longest turns, given by row, in a training set of voices.

    The turns are spread over as many separate times as possible. Existing recordings count. Raise
    `DataError` if no turn of the voice lasts two seconds; `LogError` if a log is damaged, or
    nothing can be written.
    """
    lengths = (speech.ends - speech.starts)[rows]
    enrolled: dict[Path, Enrolled] = {}
    left = _ENOUGH
    for row in _of_all_times(speech, rows[lengths >= _LEAST_TURN]).tolist():
        start = int(speech.starts[row])
        path = cut_path(home, label, start)
        if path in enrolled:  # already enrolled from another microphone
            continue
        if left < _LEAST_TURN:
            break
        end = min(int(speech.ends[row]), start + left)
        if path.exists():
            enrolled[path] = Enrolled(path, (end - start) / NANOSECONDS)
        else:
            log = speech.logs[speech.log[row]]
            microphone = speech.microphones[speech.microphone[row]]
            enrolled[path] = enrol_log(home, label, log, start, end, microphone)
        left -= end - start
    if not enrolled:
        raise DataError(f"{label} never speaks for two seconds without a pause; enrol a file")
    return list(enrolled.values())


def _of_all_times(speech: HomeSpeech, rows: Int64) -> Int64:
    """Order turns: the longest of each time, the second longest of each, and so on."""
    rows = speech.longest(rows)
    starts = speech.starts[rows]
    order = np.argsort(starts, kind="stable")
    time = np.empty(len(rows), np.int64)
    time[order] = np.cumsum(np.diff(starts[order], prepend=starts[order][:1]) >= APART)
    by_time = np.argsort(time, kind="stable")
    first = np.searchsorted(time[by_time], time[by_time])
    place = np.empty(len(rows), np.int64)
    place[by_time] = np.arange(len(rows)) - first
    return rows[np.argsort(place, kind="stable")]
