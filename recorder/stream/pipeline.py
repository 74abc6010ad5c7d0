"""Frames in, encoded messages out: features, statistics, labels and segments. No I/O."""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import (
    MEMORY_BLOCKS,
    NO_AUXILIARY,
    NOWHERE,
    Auxiliary,
    Directions,
)
from hearthlog.models.classifiers.model import Model
from hearthlog.models.embedding import DELAY_FRAMES, NO_EMBEDDINGS
from hearthlog.models.embedding.networks import Embedder
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.floor import Floors, FloorTracker, decibels
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.recorder.events import OK, READING, WARNING, Event, Frames, Gap, Notice, SourceHealth
from hearthlog.recorder.stream import (
    LOGGED_EVERY,
    EncodedMessage,
    diagnostics,
    gap_line,
    health_line,
    notice_line,
)
from hearthlog.recorder.stream.privacy_filter import (
    EmbeddingPrivacyFilter,
    LoggedFrames,
    PrivacyFilter,
)
from hearthlog.recorder.stream.sound_watch import SoundWatch, problem_of_file
from hearthlog.recorder.stream.stages import (
    FeatureMessages,
    LabelStream,
    MicrophoneEmbeddings,
    direction_messages,
    embedding_messages,
)
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.messages.message_types import encode_gap
from hearthlog.schemas.messages.topics import LIVE, EmbeddingSource, topic

if TYPE_CHECKING:
    from hearthlog.recorder.stream.directions import ArrayGeometry

_REMEMBERED_WINDOWS = 4  # of embeddings: two seconds


class Pipeline:
    """All processing of one microphone's sound.

    `private` has classes whose features are logged coarsely, as in `PrivacyFilter`; with any, all
    messages are delayed by up to two seconds, so that log time never runs backwards. Without
    `array` there are no directions. `last_frames` are those of the last push, after the infrasound
    filter.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        microphone: str,
        features: FeatureSet,
        classifier: Classifier | None = None,
        statistics_every: int = LOGGED_EVERY,
        secondary: Mapping[str, Classifier] | None = None,
        private: Sequence[str] = (),
        array: "ArrayGeometry | None" = None,
        embedder: Embedder | None = None,
        embedding: EmbeddingSource | None = None,
    ) -> None:
        self.microphone = microphone
        self.feature_set = features
        self.last_frames: Frames | None = None
        self.last_reports: list[SourceHealth] = []
        live = {} if classifier is None else {LIVE: classifier}
        self.embedding = embedding if embedder is None else embedder.source
        self._embeddings = None if embedder is None else MicrophoneEmbeddings(embedder, features)
        self._recent_embeddings = NO_EMBEDDINGS
        self._streams = {
            labelling: LabelStream(microphone, labelling, one, self.embedding)
            for labelling, one in (live | dict(secondary or {})).items()
        }
        window, width = features.window_frames, features.width
        self._infrasound = InfrasoundFilter()
        self._features = features.extractor()
        self._feature_messages = FeatureMessages(microphone, window, width, statistics_every)
        self.most_ahead = 0 if self.embedding is None else DELAY_FRAMES
        self._privacy_filter = (
            PrivacyFilter(private, width, window, self.most_ahead) if private else None
        )
        self._embedding_filter = EmbeddingPrivacyFilter()
        self._held: list[EncodedMessage] = []
        self._recent: Float32 | None = None  # features of the last frames, one fewer than a window
        self._floor = None if features.band_powers is None else FloorTracker()
        self._recent_floors: Float64 | None = None  # of the last window
        self._last_floor: Float64 = np.empty(0)  # of the last frame; empty without one
        self._recent_stamps = np.empty(0, np.int64)  # of the last window
        self._watch = SoundWatch()
        self._directions = None if array is None else array.direction_finder()
        self._recent_directions = NOWHERE  # of the last second, or more
        self._end = 0
        self._level = OK

    @property
    def _live(self) -> LabelStream | None:
        return self._streams.get(LIVE)

    @property
    def classes(self) -> tuple[str, ...] | None:
        """The classes of the model in use; None without a model."""
        return None if self._live is None else self._live.classes

    @property
    def segments_converged(self) -> bool:
        """Whether sound before the first frame would no longer change the segments to come."""
        streams = self._streams.values()
        return bool(streams) and all(stream.segments_converged for stream in streams)

    @property
    def last_labels(self) -> FrameLabels | None:
        """Labels of the frames of the last push; None if they have none."""
        return None if self._live is None else self._live.last

    def push(self, event: Event) -> list[EncodedMessage]:
        """Convert an event of a source to messages."""
        if isinstance(event, Frames):
            samples = event.filtered
            if samples is None:
                samples = self._infrasound(event.samples)
            self.last_frames = replace(event, samples=samples)
            features = self._features(samples)
            floors = self._track_floor(features, event.first)
            directions, health = self._watch_frames(event, samples, floors)
            embeddings = NO_EMBEDDINGS
            if self._embeddings is not None:
                embeddings = self._embeddings.push(
                    samples, features, floors, event.first, event.stamps
                )
            auxiliary = Auxiliary(directions, embeddings)
            return self._push_frames(features, floors, event.first, event.stamps, auxiliary, health)
        if isinstance(event, Gap):
            return self.release(self._push_gap(event))
        return self.release(self._push_health(event))

    def push_features(
        self,
        features: Float32,
        first: int,
        stamps: Int64,
        auxiliary: Auxiliary = NO_AUXILIARY,
    ) -> list[EncodedMessage]:
        """Convert features [shape=(n, d)] of frames to messages.

        `stamps` [shape=(n,)] are their starts in nanoseconds of UTC.
        """
        floors = self._track_floor(features, first)
        if floors is not None:
            self._add_floor(floors.powers[:, -1])
        return self._push_frames(features, floors, first, stamps, auxiliary)

    def _watch_frames(
        self, frames: Frames, samples: Float32, floors: Floors | None
    ) -> tuple[Directions, list[EncodedMessage]]:
        """Check the sound, filtered as `samples`; return its directions and health messages."""
        powers = np.empty(0) if floors is None else floors.powers[:, -1]
        unknown = len(samples) - len(powers)  # frames, before the first that has a floor
        directions, messages, start = NOWHERE, list[EncodedMessage](), 0
        self.last_reports = []
        ends = np.searchsorted(frames.stamps, [report.stamp for report in frames.reports]).tolist()
        for end, report in zip([*ends, len(samples)], [*frames.reports, None], strict=True):
            if end > start:
                part = frames.part(start, end)
                if self._directions is not None:
                    directions = directions.followed_by(self._directions(part))
                is_filtered = samples is not frames.samples
                self._watch.add_samples(
                    part.samples, samples[start:end] if is_filtered else part.samples
                )
                self._add_floor(powers[max(start - unknown, 0) : max(end - unknown, 0)])
                start = end
            if report is not None:
                self.last_reports.append(self.judged(report))
                messages += self._health_messages(self.last_reports[-1])
        return directions, messages

    def _add_floor(self, powers: Float64) -> None:
        self._watch.add_floor(powers)
        if len(powers):
            self._last_floor = powers[-1:]

    def _push_frames(  # noqa: PLR0913, PLR0917
        self,
        features: Float32,
        floors: Floors | None,
        first: int,
        stamps: Int64,
        auxiliary: Auxiliary,
        health: Sequence[EncodedMessage] = (),
    ) -> list[EncodedMessage]:
        labels = [
            message
            for stream in self._streams.values()
            if self._privacy_filter is None or not stream.by_names
            for message in stream.push(features, floors, first, stamps, auxiliary)
        ]
        logged = features, first, stamps
        if self._privacy_filter is not None:
            self._embedding_filter.push(auxiliary.embeddings)
            messages = self._filtered(self._privacy_filter.push(*logged, self.last_labels))
        else:
            times = stamps[auxiliary.embeddings.last_frames - first]
            messages = self._feature_messages(*logged)
            messages += embedding_messages(self.microphone, auxiliary.embeddings, times)
        messages = [*health, *messages, *self._located(auxiliary, first, stamps), *labels]
        messages.sort(key=attrgetter("log_time"))
        self._remember(features, stamps)
        return self.release(messages)

    def _filtered(self, frames: LoggedFrames) -> list[EncodedMessage]:
        """Encode frames that may be logged, and the embeddings that end with them.

        Streams that label by names get only these embeddings: possible speech has none, so no name.
        """
        embeddings = self._embedding_filter.release(frames)
        times = frames.stamps[embeddings.last_frames - frames.first]
        messages = self._feature_messages(frames.features, frames.first, frames.stamps)
        messages += embedding_messages(self.microphone, embeddings, times)
        sound = frames.features, None, frames.first, frames.stamps
        for stream in self._streams.values():
            if stream.by_names and len(frames.stamps):
                messages += stream.push(*sound, Auxiliary(embeddings=embeddings))
        return messages

    def _located(self, auxiliary: Auxiliary, first: int, stamps: Int64) -> list[EncodedMessage]:
        """Encode the directions of frames; keep the last directions and embeddings."""
        directions, embeddings = auxiliary
        latest = self._recent_embeddings.followed_by(embeddings)
        self._recent_embeddings = latest.rows(slice(-_REMEMBERED_WINDOWS, None))
        if not len(directions.frames):
            return []
        recent = self._recent_directions.followed_by(directions)
        self._recent_directions = recent.rows(slice(-MEMORY_BLOCKS, None))
        times = stamps[directions.last_frames - first]
        return direction_messages(self.microphone, directions, times)

    def _remember(self, features: Float32, stamps: Int64) -> None:
        before = features[:0] if self._recent is None else self._recent
        window = self.feature_set.window_frames
        self._recent = np.concatenate([before, features])[1 - window :]
        recent = np.concatenate([self._recent_stamps, stamps])
        self._recent_stamps = recent[-self.feature_set.window_frames :]
        self._end = int(stamps[-1]) + FRAME_NANOSECONDS

    def release(self, messages: Sequence[EncodedMessage]) -> list[EncodedMessage]:
        """Return the messages that may be logged: all, or those before the features still held.

        Both are in the order of log time; given messages are not before the last event.
        """
        if self._privacy_filter is None:
            return list(messages)
        self._held = sorted([*self._held, *messages], key=attrgetter("log_time"))
        ready = bisect_left(self._held, self._privacy_filter.start, key=attrgetter("log_time"))
        messages, self._held = self._held[:ready], self._held[ready:]
        return messages

    def flush(self) -> list[EncodedMessage]:
        """Return all held messages, before the log ends."""
        return self.release(self._close_filter())

    def _close_filter(self) -> list[EncodedMessage]:
        """Return the messages of the held features."""
        return [] if self._privacy_filter is None else self._filtered(self._privacy_filter.close())

    def finish(self) -> list[EncodedMessage]:
        """End the open segment at the end of the sound."""
        return self.release([*self._close_filter(), *self._close(self._end)])

    def change_model(
        self,
        model: Model | None,
        classifier: Classifier | None,
        frame: int,
        stamp: int,
        labelling: str = LIVE,
    ) -> tuple[list[EncodedMessage], list[EncodedMessage]]:
        """Switch to a model for the same feature set, or to none; everything else continues.

        `frame` is the number of the next frame, `stamp` its start in nanoseconds of UTC.
        """
        held = self.flush()
        earlier = self._streams.pop(labelling, None)
        closing = [] if earlier is None else earlier.close(stamp)
        if classifier is not None:
            stream = LabelStream(self.microphone, labelling, classifier, self.embedding)
            self._streams[labelling] = stream
            unlabelled = 0 if earlier is None else frame - earlier.labeller.timing.delay
            self._follow(stream, frame, unlabelled)
        opening = self.notice_messages("model", stamp, _from_frame(labelling, model, frame))
        if classifier is not None and (lacking := classifier.lacking_embeddings(self.embedding)):
            opening += self.notice_messages("model", stamp, Notice(WARNING, lacking))
        if unknown := self.unknown_private():
            names = ", ".join(map(repr, unknown))
            text = (
                f"features are logged coarsely: the model does not know {names}, which is private"
            )
            opening += self.notice_messages("model", stamp, Notice(WARNING, text))
        return [*held, *closing], opening

    def unknown_private(self) -> list[str]:
        """Return the private classes that the model in use lacks."""
        return [] if self._privacy_filter is None else self._privacy_filter.unknown(self.classes)

    def _follow(self, stream: LabelStream, frame: int, unlabelled: int) -> None:
        """Start a stream at a frame with the remembered history of the frames before."""
        recent, floors = self._recent, self._recent_floors
        if recent is None:
            return
        stamps = self._recent_stamps[len(self._recent_stamps) - len(recent) :]
        if floors is not None:
            floors = floors[max(len(floors) - len(recent), 0) :]
        auxiliary = Auxiliary(self._recent_directions, self._recent_embeddings)
        stream.labeller.follow(recent, floors, stamps, frame, unlabelled, auxiliary)

    def notice_messages(self, subject: str, stamp: int, notice: Notice) -> list[EncodedMessage]:
        """Convert a notice at a time in nanoseconds of UTC to messages."""
        subject = f"{self.microphone} {subject}"
        return self.release(
            [
                diagnostics(subject, SourceHealth(stamp, *notice), self.microphone),
                notice_line(self.microphone, stamp, notice),
            ]
        )

    def judged(self, health: SourceHealth) -> SourceHealth:
        """Return the health of the source, or the fault of its sound."""
        problem = self._watch.problem()
        if not problem and self._directions is not None:
            problem = self._directions.problem()
        if health.level == OK and problem:
            problem = problem_of_file(problem) if health.summary == READING else problem
            return replace(health, level=WARNING, summary=problem)
        return health

    def _push_gap(self, gap: Gap) -> list[EncodedMessage]:
        held = self._close_filter()
        stages = self._infrasound, self._features, self._embedding_filter, self._feature_messages
        for stage in (*stages, self._floor, self._directions, self._embeddings):
            if stage is not None:
                stage.restart()
        self._recent = None
        self._recent_floors = None
        self._last_floor = np.empty(0)
        self._recent_directions = NOWHERE
        self._recent_embeddings = NO_EMBEDDINGS
        data = encode_gap(self.microphone, gap.start, gap.end, gap.reason, gap.frames_lost)
        return [
            *held,
            *self._close(self._end),
            EncodedMessage(gap.end, topic(self.microphone, "gap"), data),
            gap_line(self.microphone, gap),
        ]

    def _track_floor(self, features: Float32, first: int) -> Floors | None:
        """Return the noise floor at the last of these frames, as far as it is known."""
        if self._floor is None or self.feature_set.band_powers is None:
            return None
        floors = self._floor(self.feature_set.band_powers(features), first)
        recent = [floors.powers]
        if self._recent_floors is not None:
            recent.insert(0, self._recent_floors)
        self._recent_floors = np.concatenate(recent)[-self.feature_set.window_frames :]
        return floors

    def _close(self, end: int) -> list[EncodedMessage]:
        """End the segments at `end`; the next frame starts a new stream."""
        messages = [message for stream in self._streams.values() for message in stream.close(end)]
        return sorted(messages, key=attrgetter("log_time"))

    def _push_health(self, health: SourceHealth) -> list[EncodedMessage]:
        health = self.judged(health)
        # A report later than the sound means that the sound has ended: remaining messages of the
        # sound are older, and come first.
        ended = health.stamp > self._end
        closing = [*self._close_filter(), *self._close(self._end)] if ended else []
        return [*closing, *self._health_messages(health)]

    def _health_messages(self, health: SourceHealth) -> list[EncodedMessage]:
        values = dict(health.values)
        if len(self._last_floor):
            values["floor_dbfs"] = f"{decibels(self._last_floor)[0]:.1f}"
        with_floor = replace(health, values=values)
        messages = [diagnostics(self.microphone, with_floor, self.microphone)]
        if health.level != self._level:
            self._level = health.level
            messages.append(health_line(self.microphone, health))
        return messages


def _from_frame(labelling: str, model: Model | None, frame: int) -> Notice:
    what = "model" if labelling == LIVE else labelling
    who = f"no {what}" if model is None else f"{what} {model.name} ({model.sha256[:12]})"
    return Notice(OK, f"{who} from frame {frame} on")
