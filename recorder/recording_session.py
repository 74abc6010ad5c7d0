"""Recording session: the streams of its microphones, their log, clips and health."""

from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

from hearthlog.models.classifiers.network_names import is_by_names
from hearthlog.models.embedding.networks import Embedder
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import DEFAULT, feature_set
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.recorder.config import Settings
from hearthlog.recorder.disk_keeper import DiskKeeper
from hearthlog.recorder.events import (
    LISTENING,
    OK,
    READING,
    WARNING,
    Event,
    Frames,
    Gap,
    Notice,
    SoundSource,
    SourceHealth,
    event_time,
)
from hearthlog.recorder.host import HealthJournal, MachineWatch, announce
from hearthlog.recorder.labelling.labelling_models import LabellingModels, ModelChange
from hearthlog.recorder.log.clips import ClipRecorder
from hearthlog.recorder.log.description import LogDescription, describe_log, join_descriptions
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.log.recovery import LogFinisher, RecoveredLog
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.stream import EncodedMessage, diagnostics, stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import ConfigurationError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.messages.message_types import ON_PURPOSE
from hearthlog.schemas.messages.topics import LIVE


class MicrophoneStream:
    """One microphone of a recording.

    Raise `ModelError` if the configured feature set is not installed. Raise `ConfigurationError` if
    a model is for another feature set than the configured one, or lacks a private class.
    """

    def __init__(
        self,
        settings: Settings,
        microphone: str,
        source: SoundSource,
        models: LabellingModels,
        embedder: Embedder | None = None,
    ) -> None:
        self._settings = settings
        self._source = source
        self.device = source.device
        self._next_frame = 0
        self._end = 0  # of the last frame, in nanoseconds of UTC
        self._drops = False  # frames, while the log accepts none
        self.models = models
        self.pipeline = Pipeline(
            microphone,
            _configured_features(settings, models),
            models.classifier,
            settings.statistics_every,
            {name: loaded.classifier for name, loaded in models.secondary().items()},
            settings.privacy,
            settings.settings_of(microphone).geometry,
            embedder,
        )
        if unknown := self.pipeline.unknown_private():
            classes = self.pipeline.classes
            what = f"this one has the classes {', '.join(classes)}" if classes else "there is none"
            raise ConfigurationError(
                f"privacy needs a model with the class {', '.join(map(repr, unknown))} ({what}); "
                "use such a model, or set privacy = [] to log the features of everything"
            )

    def accepted(self, event: Event, *, log_is_full: bool) -> list[Event]:
        """Return the events to record now; frames dropped by a full log become a gap later."""
        if isinstance(event, Frames):
            return self._accepted_frames(event, log_is_full=log_is_full)
        if log_is_full or (self._drops and isinstance(event, Gap)):
            return []
        return [event]

    def _accepted_frames(self, frames: Frames, *, log_is_full: bool) -> list[Event]:
        start = int(frames.stamps[0])
        if log_is_full:
            if not self._end:  # nothing was recorded yet
                self._next_frame, self._end = frames.first, start
            self._drops = True
            return []
        events: list[Event] = [frames]
        if self._drops:
            lost = frames.first - self._next_frame
            events.insert(0, Gap(self._end, start, "the disk took no more", lost))
            self._drops = False
        self._next_frame = frames.first + len(frames.stamps)
        self._end = int(frames.stamps[-1]) + FRAME_NANOSECONDS
        return events

    def device_changes(self) -> bool:
        """Update the device from the source; return whether it changed."""
        before, self.device = self.device, self._source.device
        return before != self.device

    def change_models(
        self, changes: list[ModelChange], frames: Frames | None, now: int
    ) -> tuple[list[EncodedMessage], list[EncodedMessage]]:
        """Switch models at the next frames, or at `now`, in nanoseconds of UTC, without frames.

        Return the last messages of the earlier models' log, and the first of the new models' log.
        """
        number, stamp = self._next_frame, self._end or now
        if frames is not None:
            number, stamp = frames.first, int(frames.stamps[0])
        closing: list[EncodedMessage] = []
        opening: list[EncodedMessage] = []
        for labelling, model, classifier in changes:
            last, first = self.pipeline.change_model(model, classifier, number, stamp, labelling)
            closing, opening = [*closing, *last], [*opening, *first]
        return closing, opening

    def describe(self) -> LogDescription:
        """Describe the logs of this microphone."""
        features, models = self.pipeline.feature_set, self.models
        info = stream_info(self.pipeline.microphone, self.device, features, models.model)
        secondary = {name: loaded.model for name, loaded in models.secondary().items()}
        return describe_log(
            self._settings, info, features, models.model, secondary, self.pipeline.embedding
        )


def _configured_features(settings: Settings, models: LabellingModels) -> FeatureSet:
    """Return the configured feature set; disable secondary models for another one."""
    features = _features_of_model(settings, models)
    for labelling, (model, classifier) in models.secondary().items():
        if classifier.feature_set != features:
            reason = (
                f"model {model.name} is for feature set {classifier.feature_set.name}, and what is "
                f"recorded is {features.name}; all models must be for the same one: train this one "
                f"for {features.name}"
            )
            models.leave_out(labelling, reason)
    return features


def _features_of_model(settings: Settings, models: LabellingModels) -> FeatureSet:
    if models.classifier is None:
        return feature_set(settings.feature_set or DEFAULT.name)
    name = models.classifier.feature_set.name
    if settings.feature_set not in {"", name}:
        raise ConfigurationError(
            f"the model is for feature set {name}, not {settings.feature_set!r} as feature_set "
            "says; leave that out, or take another model"
        )
    return models.classifier.feature_set


NOT_RUNNING = "the recorder was not running"
_NOT_LOST = (NOT_RUNNING, *ON_PURPOSE)  # prefixes of the reasons of a gap


@dataclass
class RecordingSummary:
    """Summary of a recording."""

    logs: list[Path]  # finished ones
    recovered: Sequence[RecoveredLog] = ()  # logs of an earlier recorder, completed first
    frames_lost: int = 0
    gaps: int = 0  # while the recorder was running
    models_refused: int = 0  # files that could not be used
    labels: int = 0  # frames with a label


@dataclass
class RecorderState:
    """State of a recorder, for a terminal; other threads may read it at any time."""

    sound: dict[str, Frames] = field(default_factory=dict)
    labels: dict[str, FrameLabels | None] = field(default_factory=dict)
    # fault by microphone; empty if there is none
    trouble: dict[str, str] = field(default_factory=dict)
    clip_frames: int = 0
    keeps: bool = False
    news: deque[str] = field(default_factory=lambda: deque(maxlen=100))


class RecordingSession:
    """A recording of sources by microphone: their log, the clips next to it, and the models.

    For audio files no log may exist already. `state` is updated with every event. Raise
    `ModelError` if the configured feature set is not installed; `ConfigurationError` if the model
    is for another feature set, or sound is to be kept and the model lacks a class that must not be
    kept.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        settings: Settings,
        sources: Mapping[str, SoundSource],
        models: Mapping[str, LabellingModels],
        lock: FolderLock | None = None,
        state: RecorderState | None = None,
        embedder: Embedder | None = None,
    ) -> None:
        self._settings = settings
        self._state = state
        self._streams = {
            name: MicrophoneStream(settings, name, source, models[name], embedder)
            for name, source in sources.items()
        }
        is_live = not any(isinstance(source, FileSource) for source in sources.values())
        is_read_ahead = any(
            isinstance(source, FileSource) and not source.realtime for source in sources.values()
        )
        self._finisher = None if is_read_ahead else LogFinisher()
        self._log = RollingLog(
            self._describe(),
            settings.max_bag_duration,
            settings.flush_seconds,
            settings.sync_seconds,
            live=is_live,
            file_bytes=settings.max_bag_size,
            finisher=self._finisher,
            lock=lock,
        )
        pipelines = [stream.pipeline for stream in self._streams.values()]
        self._clips = ClipRecorder(settings, pipelines, self._log.file_at)
        self._keeper = DiskKeeper(settings.keeping_rules()) if is_live else None
        self._machine = None if lock is None else MachineWatch(settings.output)
        self._journal = HealthJournal()
        self._now = 0  # time of the last event
        self.summary = RecordingSummary(self._log.finished)

    def report_missing_embeddings(self) -> None:
        """Print which models do not get the embeddings that they need."""
        for name, stream in self._streams.items():
            for labelling, (model, classifier) in stream.models.in_use.items():
                of_it = labelling == LIVE or is_by_names(model)
                if of_it and (why := classifier.lacking_embeddings(stream.pipeline.embedding)):
                    announce(f"{name}: model {model.name}: {why}")

    def add(self, microphone: str, event: Event) -> None:
        """Record an event of a source; for audio files raise `LogError` as `RollingLog.write`."""
        stream = self._streams[microphone]
        if self._log.is_full:
            self._log.write([])  # retries: the disk may accept data now
        for accepted in stream.accepted(event, log_is_full=self._log.is_full):
            self._record(stream, accepted)
        if isinstance(event, Frames):
            for report in stream.pipeline.last_reports:
                self._journal.add(microphone, report)
        if isinstance(event, SourceHealth):
            self._journal.add(microphone, stream.pipeline.judged(event))
            self._look_at_the_machine(stream, event.stamp)
        for notice in self._log.notices():
            announce(notice.text)
            self._log.write(stream.pipeline.notice_messages("disk", self._now, notice))
        if self._state is not None:
            self._update(self._state, microphone, event)

    def _update(self, state: RecorderState, microphone: str, event: Event) -> None:
        if isinstance(event, Frames):
            pipeline = self._streams[microphone].pipeline
            state.sound[microphone] = pipeline.last_frames or event
            state.labels[microphone] = pipeline.last_labels
            self._update_trouble(state, microphone, event.reports)
        elif isinstance(event, SourceHealth):
            self._update_trouble(state, microphone, [event])
        state.clip_frames = self._clips.kept_frames
        state.keeps = self._settings.keep_audio != "off"

    @staticmethod
    def _update_trouble(
        state: RecorderState, microphone: str, reports: Sequence[SourceHealth]
    ) -> None:
        for report in reports:
            is_well = report.level == OK and report.summary in {LISTENING, READING}
            state.trouble[microphone] = "" if is_well else report.summary

    def _record(self, stream: MicrophoneStream, event: Event) -> None:
        if isinstance(event, Gap) and not event.reason.startswith(_NOT_LOST):
            self.summary.gaps += 1
            self.summary.frames_lost += event.frames_lost
        if isinstance(event, Frames):
            self._look_for_models(stream, event)
        if stream.device_changes():
            self._log.begin_anew(self._describe(), stream.pipeline.flush())
            self._notify(f"{stream.pipeline.microphone}: the microphone is {stream.device} now")
        notices = self._clips.before(stream.pipeline.microphone, event)
        self._write(stream.pipeline.push(event), event)
        labels = stream.pipeline.last_labels
        if isinstance(event, Frames) and labels is not None:
            self.summary.labels += len(labels.frames)
        frames = stream.pipeline.last_frames if isinstance(event, Frames) else None
        notices += self._clips.after(stream.pipeline.microphone, frames or event, labels)
        self._now = event_time(event)
        self._log.write(self._clip_messages(stream, notices))
        self._look_after_the_disk(stream)

    def _write(self, messages: Sequence[EncodedMessage], event: Event) -> None:
        """Write messages of an event; the messages up to each health report form a chunk."""
        written = 0
        for report in event.reports if isinstance(event, Frames) else ():
            end = bisect_left(messages, report.stamp, written, key=attrgetter("log_time"))
            self._log.write(messages[written:end])
            written = end
        self._log.write(messages[written:])

    def _look_after_the_disk(self, stream: MicrophoneStream) -> None:
        if self._keeper is not None:
            messages, problems = self._keeper.tick(self._now)
            self._log.write(stream.pipeline.release(messages))
            for problem in problems:
                announce(problem)

    def _look_at_the_machine(self, stream: MicrophoneStream, stamp: int) -> None:
        """Log the health of the host, at most as often as that of the first microphone."""
        if self._machine is None:
            return
        if (health := self._machine.tick(stamp)) is not None:
            self._journal.add("machine", health)
            message = diagnostics(f"{self._settings.node} machine", health)
            self._log.write(stream.pipeline.release([message]))

    def finish(self) -> None:
        """Complete the log and its clips.

        Raise `LogError` if the log cannot be written; the written part remains and is completed at
        the next start.
        """
        last = [message for each in self._streams.values() for message in each.pipeline.finish()]
        stream = next(iter(self._streams.values()))
        notices = self._clips.finish()
        if self._keeper is not None:
            self._keeper.close()
        try:
            self._log.finish([*last, *self._clip_messages(stream, notices)])
        finally:
            if self._finisher is not None:
                self._finisher.close()

    def _clip_messages(
        self, stream: MicrophoneStream, notices: Sequence[Notice]
    ) -> list[EncodedMessage]:
        return [
            message
            for notice in notices
            for message in stream.pipeline.notice_messages("clips", self._now, notice)
        ]

    def _look_for_models(self, stream: MicrophoneStream, frames: Frames) -> None:
        """Report refused models, and switch to new models from these frames on."""
        stamp = int(frames.stamps[0])
        for reason in stream.models.refusals():
            self.summary.models_refused += 1
            self._log.write(
                stream.pipeline.notice_messages("model", stamp, Notice(WARNING, reason))
            )
        if stream.models.may_change() and self._log.may_begin(stamp):
            self._change_models(stream, frames)

    def _change_models(self, stream: MicrophoneStream, frames: Frames) -> None:
        """Switch the models of their microphones, for one microphone from these frames on.

        A new log begins, as class names belong to the channel, and the model card to the file.
        """
        before = stream.models.model
        changes = stream.models.change()
        for labelling, model, _ in changes:
            where = "" if labelling == LIVE else f" ({labelling.replace('/', ' ')})"
            after = f", after {before.name}" if labelling == LIVE and before is not None else ""
            if model is not None:
                self._notify(f"the labels are by {model.name} now{after}{where}")
        closing: list[EncodedMessage] = []
        opening: list[EncodedMessage] = []
        for each in self._streams.values():
            if each.models is not stream.models:
                continue
            last, first = each.change_models(
                changes, frames if each is stream else None, int(frames.stamps[0])
            )
            closing, opening = [*closing, *last], [*opening, *first]
        by_time = attrgetter("log_time")
        self._log.begin_anew(self._describe(), sorted(closing, key=by_time))
        self._log.write(sorted(opening, key=by_time))

    def _notify(self, text: str) -> None:
        if self._state is not None:
            self._state.news.append(text)

    def _describe(self) -> LogDescription:
        return join_descriptions([stream.describe() for stream in self._streams.values()])
