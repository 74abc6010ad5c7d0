"""The recorder: a source of sound, the pipeline, and the log that it writes."""

import hashlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from queue import SimpleQueue
from threading import Event as Flag
from typing import Any

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import DEFAULT, feature_set
from hearthlog.models.modelfile.card import model_attachments
from hearthlog.models.modelfile.modelfile import SUFFIX
from hearthlog.models.modelfile.registry import DEFAULT_FOLDER
from hearthlog.recorder.candidate_watch import CandidateWatch
from hearthlog.recorder.clips.clip_recorder import ClipRecorder
from hearthlog.recorder.config import NO_MODEL, MicrophoneSettings, Settings
from hearthlog.recorder.disk.keeper import DiskKeeper
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.events import WARNING, Event, Frames, Gap, Notice, SoundSource, event_time
from hearthlog.recorder.finishing import LogFinisher
from hearthlog.recorder.log import LogDescription, RollingLog
from hearthlog.recorder.model_watch import Loaded, ModelWatch
from hearthlog.recorder.pipeline import Pipeline
from hearthlog.recorder.recovery import Recovered, recover_active
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.microphone import MicrophoneSource
from hearthlog.recorder.stream_messages import EncodedMessage, stream_info
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.log_stream import Attachment
from hearthlog.schemas.logs.provenance import provenance
from hearthlog.schemas.messages.topics import CANDIDATE, topics_of


@dataclass
class RecordingSummary:
    """What was recorded."""

    logs: list[Path]  # finished ones
    recovered: Sequence[Recovered] = ()  # logs of an earlier recorder, completed first
    frames_lost: int = 0
    gaps: int = 0
    models_refused: int = 0  # files that could not be used


def record_files(
    settings: Settings,
    microphone: MicrophoneSettings,
    source: FileSource,
    stop: Flag,
    reload_requests: SimpleQueue[None] | None = None,
) -> RecordingSummary:
    """Record audio files as if a microphone had captured them.

    Parameters
    ----------
    settings : Settings
    microphone : MicrophoneSettings
        The one that they stand in for.
    source : FileSource
    stop : threading.Event
        Once set, the log is completed.
    reload_requests : SimpleQueue or None
        An item makes the recorder check at once whether the model's file has been replaced.

    Raises
    ------
    SourceError
        If one of the files turns out to be damaged, or all together are shorter than a frame.
    ModelError
        If the model cannot be used, or the configured feature set is not installed.
    ConfigurationError
        If the model is for another feature set than the configured one, or sound is to be kept
        and the model cannot tell what must not be.
    LogError
        If the log cannot be written, in which case what was written stays, for the next start to
        complete; or if an earlier log cannot be completed.
    """
    recovered = recover_active(settings.output, settings.node)
    summary = record(settings, microphone, source, stop, reload_requests)
    summary.recovered = recovered
    return summary


def record_microphone(
    settings: Settings,
    microphone: MicrophoneSettings,
    stop: Flag,
    reload_requests: SimpleQueue[None] | None = None,
) -> RecordingSummary:
    """Record a microphone until `stop` is set, whatever happens to it.

    Parameters
    ----------
    settings : Settings
    microphone : MicrophoneSettings
    stop : threading.Event
        Once set, the log is completed.
    reload_requests : SimpleQueue or None
        An item makes the recorder check at once whether the model's file has been replaced.

    Raises
    ------
    SourceError
        If the microphone cannot be opened at the start.
    ModelError, ConfigurationError, LogError
        As `record_files`.
    """
    source = MicrophoneSource(microphone.device)
    with closing(source):  # it captures, and its pipe holds, while older logs are completed
        recovered = recover_active(settings.output, settings.node)
        end = max((log.end for log in recovered), default=0)
        resumed = _GapAfterRestart(source, end) if end else source
        summary = record(settings, microphone, resumed, stop, reload_requests)
    summary.recovered = recovered
    return summary


class _GapAfterRestart:
    """A source with a gap before its first frame: from the end of the last log on."""

    def __init__(self, source: SoundSource, end: int) -> None:
        self.device = source.device
        self._source = source
        self._end = end

    def events(self, stop: Flag) -> Iterator[Event]:
        for event in self._source.events(stop):
            if isinstance(event, Frames) and self._end:
                start, self._end = self._end, 0
                now = int(event.stamps[0])
                lost = max(round((now - start) / FRAME_NANOSECONDS), 0)
                yield Gap(start, now, "the recorder was not running", lost)
            yield event


def record(
    settings: Settings,
    microphone: MicrophoneSettings,
    source: SoundSource,
    stop: Flag,
    reload_requests: SimpleQueue[None] | None = None,
) -> RecordingSummary:
    """Record a source until it ends or `stop` is set.

    Parameters
    ----------
    settings : Settings
    microphone : MicrophoneSettings
    source : SoundSource
    stop : threading.Event
        Once set, the log is completed.
    reload_requests : SimpleQueue or None
        An item makes the recorder check at once whether the model's file has been replaced.

    Raises
    ------
    SourceError
        If the source raises it.
    ModelError, ConfigurationError, LogError
        As `record_files`.
    """
    with ExitStack() as stack:
        watch = candidates = None
        if settings.model is not None and settings.model != NO_MODEL:
            watch = ModelWatch(settings.model, reload_requests or SimpleQueue())
            stack.enter_context(closing(watch))
            is_file = settings.model.suffix == SUFFIX  # else the name of a starter
            candidates = CandidateWatch(
                settings.model.parent if is_file else DEFAULT_FOLDER,
                watch.first.classifier.feature_set,
            )
            stack.enter_context(closing(candidates))
        recording = RecordingSession(settings, microphone.name, source, watch, candidates)
        try:
            for event in source.events(stop):
                recording.add(event)
        finally:
            recording.finish()
    return recording.summary


class RecordingSession:
    """The recording of one source: its log, the clips beside it, and the models that label it.

    Parameters
    ----------
    settings : Settings
    microphone : str
        Its name.
    source : SoundSource
        What is recorded; of audio files no log may be there already.
    watch : ModelWatch or None
        Gives the models, one after the other; None for no labels.
    candidates : CandidateWatch or None
        Gives the models that label on trial beside them.

    Attributes
    ----------
    summary : RecordingSummary

    Raises
    ------
    ModelError
        If the configured feature set is not installed.
    ConfigurationError
        If the model is for another feature set than the configured one, or sound is to be kept
        and the model cannot tell what must not be.
    """

    def __init__(
        self,
        settings: Settings,
        microphone: str,
        source: SoundSource,
        watch: ModelWatch | None,
        candidates: CandidateWatch | None = None,
    ) -> None:
        self._settings = settings
        self._device = source.device
        self._watch = watch
        self._candidates = candidates
        self._model: Model | None
        self._model, classifier = (None, None) if watch is None else watch.first
        self._offered = None if candidates is None else candidates.first  # as a candidate
        self._candidate, candidate = self._other(self._offered)
        features = _configured_features(settings, classifier)
        self._pipeline = Pipeline(
            microphone, features, classifier, settings.statistics_every, candidate
        )
        read_ahead = isinstance(source, FileSource) and not source.realtime
        self._finisher = None if read_ahead else LogFinisher()
        self._log = RollingLog(
            self._describe(),
            settings.max_bag_duration,
            settings.flush_seconds,
            settings.sync_seconds,
            live=not isinstance(source, FileSource),
            finisher=self._finisher,
        )
        self._clips = ClipRecorder(settings, self._pipeline, self._log.file_at)
        is_live = not isinstance(source, FileSource)
        self._keeper = DiskKeeper(settings.keeping_rules()) if is_live else None
        self._now = 0  # time of the last event
        self.summary = RecordingSummary(self._log.finished)

    def add(self, event: Event) -> None:
        """Record one event of the source.

        Parameters
        ----------
        event : Event

        Raises
        ------
        LogError
            As `RollingLog.write`.
        """
        if isinstance(event, Gap):
            self.summary.gaps += 1
            self.summary.frames_lost += event.frames_lost
        if isinstance(event, Frames):
            self._look_for_models(event)
        notices = self._clips.before(event)
        self._log.write(self._pipeline.push(event))
        notices += self._clips.after(event, self._pipeline.last_labels)
        self._now = event_time(event)
        self._log.write(self._clip_messages(notices))
        if self._keeper is not None:
            messages, problems = self._keeper.tick(self._now)
            self._log.write(messages)
            for problem in problems:
                sys.stderr.write(f"hearthlog: {problem}\n")

    def finish(self) -> None:
        """Complete the log and its clips.

        Raises
        ------
        LogError
            If the log cannot be written; what was written stays, for the next start to complete.
        """
        notices = self._clips.finish()
        if self._keeper is not None:
            self._keeper.close()
        try:
            self._log.finish([*self._pipeline.finish(), *self._clip_messages(notices)])
        finally:
            if self._finisher is not None:
                self._finisher.close()

    def _clip_messages(self, notices: Sequence[Notice]) -> list[EncodedMessage]:
        return [
            message
            for notice in notices
            for message in self._pipeline.report("clips", self._now, notice)
        ]

    def _look_for_models(self, frames: Frames) -> None:
        """Report models that were refused, and let others label from these frames on."""
        stamp = int(frames.stamps[0])
        if self._watch is not None:
            self._report_refused(self._watch.refusals(), stamp)
        if self._candidates is not None:
            for candidate in self._candidates.news():
                self._offered = candidate
            self._report_refused(self._candidates.refusals(), stamp)
        ready = None if self._watch is None else self._watch.ready
        if (ready is not None or self._trial_changes()) and self._log.may_begin(stamp):
            self._change_models(ready, frames.first, stamp)

    def _change_models(self, ready: Loaded | None, frame: int, stamp: int) -> None:
        """Let the model that is ready label from a frame on, and the candidate that there is then.

        Their labels begin a log of their own: the names of the classes belong to the channel, and
        the model card to the file.
        """
        closing: list[EncodedMessage] = []
        opening: list[EncodedMessage] = []
        if ready is not None and self._watch is not None:
            self._model, self._watch.ready = ready.model, None
            last, first = self._pipeline.change_model(*ready, frame, stamp)
            closing, opening = [*closing, *last], [*opening, *first]
        if self._trial_changes():
            self._candidate, classifier = self._other(self._offered)
            last, first = self._pipeline.change_model(
                self._candidate, classifier, frame, stamp, CANDIDATE
            )
            closing, opening = [*closing, *last], [*opening, *first]
        closing.sort(key=attrgetter("log_time"))
        self._log.begin_anew(self._describe(), closing)
        self._log.write(opening)

    def _trial_changes(self) -> bool:
        model, _ = self._other(self._offered)
        return _identity(model) != _identity(self._candidate)

    def _report_refused(self, reasons: Iterable[str], stamp: int) -> None:
        for reason in reasons:
            self.summary.models_refused += 1
            self._log.write(self._pipeline.report("model", stamp, Notice(WARNING, reason)))

    def _other(self, candidate: Loaded | None) -> tuple[Model | None, Classifier | None]:
        """Return a candidate, unless it is the model in use."""
        in_use = "" if self._model is None else self._model.sha256
        return (None, None) if candidate is None or candidate.model.sha256 == in_use else candidate

    def _describe(self) -> LogDescription:
        features = self._pipeline.feature_set
        info = stream_info(self._pipeline.microphone, self._device, features, self._model)
        return describe_log(self._settings, info, features, self._model, self._candidate)


def _identity(model: Model | None) -> tuple[str, str] | None:
    return None if model is None else (model.name, model.sha256)


def _configured_features(settings: Settings, classifier: Classifier | None) -> FeatureSet:
    """Return the configured feature set, which must be that of the model, if there is one."""
    if classifier is None:
        return feature_set(settings.feature_set or DEFAULT.name)
    name = classifier.feature_set.name
    if settings.feature_set not in {"", name}:
        raise ConfigurationError(
            f"the model is for feature set {name}, not {settings.feature_set!r} as feature_set "
            "says; leave that out, or take another model"
        )
    return classifier.feature_set


def describe_log(
    settings: Settings,
    info: Any,
    features: FeatureSet,
    model: Model | None,
    candidate: Model | None = None,
) -> LogDescription:
    """Return the description of the logs of a recording.

    Parameters
    ----------
    settings : Settings
    info : message
        `AudioStreamInfo` of the logs.
    features : FeatureSet
    model : Model or None
        The model that labels the sound; None for no labels.
    candidate : Model or None
        A model on trial that labels beside it.
    """
    configuration = settings.model_dump_json(indent=2, exclude={"output", "model"}).encode()
    classes = None if model is None else list(model.classes)
    attachments = [Attachment("configuration.json", "application/json", configuration)]
    metadata = provenance(
        settings.node,
        configuration_sha256=hashlib.sha256(configuration).hexdigest(),
        feature_set=features.name,
        feature_set_version=str(features.version),
        model=info.model,
        model_sha256=info.model_sha256,
        timezone=settings.timezone,
    )
    if candidate is not None:
        metadata |= {"candidate": candidate.name, "candidate_sha256": candidate.sha256}
    return LogDescription(
        root=settings.output,
        node=settings.node,
        topics=topics_of(
            info.header.frame_id,
            features.feature_names,
            classes,
            None if candidate is None else list(candidate.classes),
        ),
        infos=[info],
        metadata=metadata,
        attachments=attachments if model is None else [*attachments, *model_attachments(model)],
    )
