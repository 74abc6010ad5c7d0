"""What a recorder heard, given to a pipeline again, and what comes out of it to a new log."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event as Flag

from hearthlog.analyzer.logs.recorder_info import RecorderInfo, features_of
from hearthlog.analyzer.replay.comparison import ReplayComparison
from hearthlog.analyzer.replay.description import describe
from hearthlog.analyzer.replay.recorded import Features, RecordedBatch
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.events import Frames, Gap, SourceHealth
from hearthlog.recorder.log import LogDescription, RollingLog
from hearthlog.recorder.pipeline import EncodedMessage, Pipeline
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SECONDS
from hearthlog.schemas.messages.topics import topic
from hearthlog.schemas.times import NANOSECONDS

_PACED_FRAMES = 10  # 0.5 s
_MOST_FRAMES = 4096
_LOST = "the log that was replayed does not have it"


@dataclass(frozen=True)
class ReplayOptions:
    """How logs are replayed.

    Attributes
    ----------
    kind : str
        What the sound is taken from: "features", or "audio" for clips.
    model : callable
        Tells which model to use for the sound of a recorder; None for no labels.
    output : Path or None
        A folder for the new log; None for no log.
    start_offset : float
        Seconds from the first message.
    duration : float or None
        Seconds; None for all.
    rate : float or None
        Multiple of real time; None for as fast as it goes.
    loop : bool
        Begin anew at the end, until stopped.
    """

    kind: str = "features"
    model: Callable[[RecorderInfo], Model | None] = lambda _: None
    output: Path | None = None
    start_offset: float = 0.0
    duration: float | None = None
    rate: float | None = None
    loop: bool = False


@dataclass
class Replay:
    """What came of a replay.

    Attributes
    ----------
    sources : list of Path
        What was replayed.
    logs : list of Path
        What was written.
    frames, labels, segments, gaps : int
    compared : ReplayComparison
        With the recorded labels and segments.
    missing : list of int
        Times (nanoseconds of UTC) before which the logs lack sound that the recorder heard: the
        labels of the first second there, and the segment that was open, cannot be as recorded.
    unfinished : list of Path
        Logs that were replayed up to where they end.
    interrupted : bool
        It was stopped before the end.
    """

    sources: list[Path]
    logs: list[Path] = field(default_factory=list)
    frames: int = 0
    labels: int = 0
    segments: int = 0
    gaps: int = 0
    compared: ReplayComparison = field(default_factory=ReplayComparison)
    missing: list[int] = field(default_factory=list)
    unfinished: list[Path] = field(default_factory=list)
    interrupted: bool = False

    @property
    def seconds(self) -> float:
        """Seconds of sound that were replayed."""
        return self.frames * FRAME_SECONDS


class Player:
    """Gives what recorders heard to pipelines, one after the other.

    Parameters
    ----------
    wanted : ReplayOptions
    start : int
        Log time before which nothing comes out.
    result : Replay
        Where what comes out is counted.
    stop : threading.Event
    progress : callable
        Told the time (nanoseconds of UTC) up to which frames were replayed.

    Attributes
    ----------
    converged : bool
        What comes out from here on does not depend on how far before the first frame was.
    missing_before : bool
        Frames that were heard before the first one are not there.
    """

    def __init__(
        self,
        wanted: ReplayOptions,
        start: int,
        result: Replay,
        stop: Flag,
        progress: Callable[[int], None],
    ) -> None:
        self.converged = self.missing_before = False
        self._wanted = wanted
        self._start = start
        self._result = result
        self._stop = stop
        self._progress = progress
        self._pace = _Pace(wanted.rate)
        self._origin: RecorderInfo | None = None  # of the first log of this start of a recorder
        self._opened: Path | None = None
        self._log: RollingLog | None = None
        self._next = 0  # number of the frame that follows
        self._after_gap = False  # any later one may follow
        self._arrived = False
        self._end: int | None = None  # of the last frame of this recorder
        self._records: list[EncodedMessage] = []  # to be compared

    def open(self, origin: RecorderInfo) -> None:
        """Go on with another log; where it is of another start of a recorder, begin anew."""
        if origin.path == self._opened:
            return
        self._opened = origin.path
        if self._origin is not None and self._goes_on(origin):
            self._change_model(origin)
        elif self._origin is None or _is_new(origin, self._origin, self._next):
            self._close()
            self._begin(origin)

    def push(self, event: Features | Frames | Gap | SourceHealth) -> bool:
        """Replay an event; return whether to go on."""
        if isinstance(event, Features):
            self._follow(event)
        if isinstance(event, Features | Frames):
            return self._push_frames(event)
        if isinstance(event, Gap):
            self.converged = self._after_gap = True
        self._emit(self._pipeline.push(event))
        return True

    def arrive(self) -> None:
        """Note that what was pushed so far only led to the start."""
        if self.missing_before and not self.converged:
            self._result.missing.append(self._start)
        self._arrived = True

    def compare(self, piece: RecordedBatch) -> None:
        """Compare what came out since the last time with what was recorded."""
        if self._origin is None or not self._arrived:
            return
        replayed, self._records = self._records, []
        kind = topic(self._pipeline.microphone, "label")
        labels = [record for record in replayed if record.topic == kind]
        segments = [record for record in replayed if record.topic != kind]
        end = self._end or 0
        self._result.compared.add_labels(piece.labels, labels, end)
        self._result.compared.add_segments(piece.segments, segments, end)

    def finish(self, *, cut: bool) -> None:
        """Complete the log; if the sound was cut here, the last segment is not as recorded."""
        self._close()
        if not cut and self._wanted.kind == "features":
            self.compare(RecordedBatch([], [], []))
        self._result.compared.finish(cut=cut)

    def _begin(self, origin: RecorderInfo) -> None:
        model = self._wanted.model(origin)
        asked = origin.configuration
        classifier = None if model is None else Classifier(model)
        features = self._features(origin, classifier)
        self._pipeline = Pipeline(origin.microphone, features, classifier, asked.statistics_every)
        if self._wanted.output is not None:
            about = self._describe(origin, model)
            seconds = asked.flush_seconds, asked.sync_seconds
            self._log = RollingLog(about, asked.max_bag_duration, *seconds)
        self._sha256 = None if model is None else model.sha256
        self._origin = origin
        self._next, self._end, self._after_gap = 0, None, False

    def _features(self, origin: RecorderInfo, classifier: Classifier | None) -> FeatureSet:
        """Return the feature set to go on with; clips can be given to any."""
        if self._wanted.kind != "features":
            return DEFAULT if classifier is None else classifier.feature_set
        features = features_of(origin)
        if classifier is not None and classifier.feature_set != features:
            raise LogError(
                f"{origin.path}: has features of set {features.name}; the model is for "
                f"{classifier.feature_set.name}"
            )
        return features

    def _goes_on(self, origin: RecorderInfo) -> bool:
        """Tell whether a log is of the same start of a recorder, but of another model."""
        assert self._origin is not None
        if origin.first_frame is None or origin.model_sha256 == self._origin.model_sha256:
            return False
        first = origin.first_frame[0]
        follows = first == self._next or (self._after_gap and first > self._next)
        return self._next > 0 and follows and _without_model(origin) == _without_model(self._origin)

    def _change_model(self, origin: RecorderInfo) -> None:
        """Let the model speak that the recorder went on with, if it is another one here too."""
        self._origin = origin
        model = self._wanted.model(origin)
        sha256 = None if model is None else model.sha256
        if sha256 == self._sha256:
            return
        assert origin.first_frame is not None
        classifier = None if model is None else Classifier(model)
        self._features(origin, classifier)
        closing, opening = self._pipeline.change_model(model, classifier, *origin.first_frame)
        self._emit(closing)
        if self._log is not None:
            self._log.begin_anew(self._describe(origin, model), [])
        self._sha256 = sha256
        self._emit(opening)

    def _describe(self, origin: RecorderInfo, model: Model | None) -> LogDescription:
        assert self._wanted.output is not None
        kind = "clips" if self._wanted.kind == "audio" else self._wanted.kind
        replayed = {"replay_of": _name(self._result.sources), "replay_from": kind}
        features = self._pipeline.feature_set
        return describe(origin, features, model, self._wanted.output, replayed)

    def _follow(self, event: Features) -> None:
        """See whether frames follow the last ones, and if not, do what the recorder did."""
        if self._after_gap:
            self._after_gap = False
            return
        if event.first < self._next:
            assert self._origin is not None
            self._close()
            self._begin(self._origin)
        if self._end is None:
            self.converged |= event.first == 0
            self.missing_before |= event.first > 0
        elif event.first > self._next:
            self.converged = True
            lost = event.first - self._next
            gap = Gap(self._end, int(event.stamps[0]), _LOST, lost)
            self._emit(self._pipeline.push(gap))
        if event.first > self._next and event.stamps[0] >= self._start:
            self._result.missing.append(int(event.stamps[0]))

    def _push_frames(self, event: Features | Frames) -> bool:
        size = _MOST_FRAMES if self._wanted.rate is None else _PACED_FRAMES
        for begin in range(0, len(event.stamps), size):
            block = slice(begin, begin + size)
            first, stamps = event.first + begin, event.stamps[block]
            end = int(stamps[-1]) + FRAME_NANOSECONDS
            if end > self._start:
                self._pace.wait(int(stamps[0]), end, self._stop)
            if self._stop.is_set():
                self._result.interrupted = True
                return False
            if isinstance(event, Features):
                records = self._pipeline.push_features(event.values[block], first, stamps)
            else:
                records = self._pipeline.push(Frames(first, event.samples[block], stamps))
            self._next, self._end = first + len(stamps), end
            self._result.frames += int((stamps >= self._start).sum())
            self._emit(records)
            if end > self._start:
                self._progress(end)
        if self._sha256 is None:
            self.converged |= len(event.stamps) >= self._pipeline.feature_set.window_frames
        return True

    def _emit(self, records: list[EncodedMessage]) -> None:
        records = self._count(records)
        if self._log is not None and records:
            self._log.write(records)

    def _count(self, records: list[EncodedMessage]) -> list[EncodedMessage]:
        """Leave out what is from before the start, and count the rest."""
        microphone = self._pipeline.microphone
        label, segment, gap = (topic(microphone, kind) for kind in ("label", "segment", "gap"))
        counts = Counter(record.topic for record in records)
        if self._wanted.kind == "features":
            self.converged |= self._pipeline.segments_converged
        if records and records[0].log_time < self._start:
            records = [record for record in records if record.log_time >= self._start]
            counts = Counter(record.topic for record in records)
        self._result.labels += counts[label]
        self._result.segments += counts[segment]
        self._result.gaps += counts[gap]
        if self._wanted.kind == "features":
            self._records += [record for record in records if record.topic in {label, segment}]
        return records

    def _close(self) -> None:
        if self._origin is None:
            return
        records = self._count(self._pipeline.finish())
        if self._log is not None:
            self._log.finish(records)
            self._result.logs += self._log.finished
            self._log = None


class _Pace:
    """Waits until the time of a sound has come."""

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._last: int | None = None
        self._anchor = 0.0, 0  # a time of the clock, and the time of the sound then

    def wait(self, start: int, end: int, stop: Flag) -> None:
        """Wait until the end of some frames, or until stopped."""
        if self._rate is None:
            return
        if self._last is None or start < self._last:  # the clock was set back
            self._anchor = time.monotonic(), start
        self._last = start
        began, first = self._anchor
        due = began + (end - first) / NANOSECONDS / self._rate
        while (left := due - time.monotonic()) > 0 and not stop.wait(min(left, 1.0)):
            pass


def _is_new(origin: RecorderInfo, last: RecorderInfo, following: int) -> bool:
    """Tell whether a log is of another start of a recorder than the last one."""
    if origin.first_frame is not None and origin.first_frame[0] < following:
        return True
    return origin.metadata != last.metadata or origin.model_sha256 != last.model_sha256


def _without_model(origin: RecorderInfo) -> dict[str, str]:
    return {key: value for key, value in origin.metadata.items() if not key.startswith("model")}


def _name(paths: Sequence[Path]) -> str:
    """Name logs in a few words: every new log repeats them."""
    if len(paths) == 1:
        return paths[0].name
    return f"{paths[0].name} … {paths[-1].name} ({len(paths)} logs)"
