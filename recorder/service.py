"""The recorder: a source of sound, the pipeline, and the log it ends in."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Event as Flag
from typing import Any, Protocol

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import DEFAULT, feature_set
from hearthlog.models.modelfile.card import model_attachments
from hearthlog.recorder.clips.clip_recorder import ClipKeeper, time_of
from hearthlog.recorder.config import Microphone, Settings
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.events import Event, Frames, Gap
from hearthlog.recorder.log import LogDescription, RollingLog
from hearthlog.recorder.model_watch import ModelWatch
from hearthlog.recorder.pipeline import Pipeline, Record, stream_info
from hearthlog.recorder.recovery import Recovered, recover_active
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.microphone import MicrophoneSource
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.provenance import provenance
from hearthlog.schemas.logs.writer import Attachment
from hearthlog.schemas.messages.topics import topics_of


class Source(Protocol):
    """Where sound comes from."""

    device: str

    def events(self, stop: Flag) -> Iterator[Event]:
        """Hand on what is heard until it ends or `stop` is set."""


@dataclass
class Recording:
    """What was recorded: finished logs, and the gaps in them.

    `recovered` are the logs of an earlier recorder that were completed first.
    """

    logs: list[Path]
    recovered: Sequence[Recovered] = ()
    frames_lost: int = 0
    gaps: int = 0
    models_refused: int = 0


def record_files(
    settings: Settings,
    microphone: Microphone,
    source: FileSource,
    stop: Flag,
    asked: SimpleQueue[None] | None = None,
) -> Recording:
    """Record audio files as if a microphone had heard them.

    Parameters
    ----------
    settings : Settings
    microphone : Microphone
        The one that they stand in for.
    source : FileSource
    stop : threading.Event
        Once set, the log is completed.
    asked : SimpleQueue or None
        What is put into it makes the recorder look at once whether the model's file is another.

    Raises
    ------
    SourceError
        If one of them turns out to be damaged.
    ModelError
        If the model cannot be used.
    ConfigurationError
        If the model is for another feature set than the configured one, or sound is to be kept
        and the model cannot tell what must not be.
    LogError
        If the log cannot be written; what was written stays, for the next start to complete.
    """
    recovered = recover_active(settings.output, settings.node)
    recording = record(settings, microphone, source, stop, asked)
    recording.recovered = recovered
    return recording


def record_microphone(
    settings: Settings, microphone: Microphone, stop: Flag, asked: SimpleQueue[None] | None = None
) -> Recording:
    """Record a microphone until `stop` is set, whatever happens to it.

    Parameters are those of `record_files`.

    Raises
    ------
    SourceError
        If it cannot be heard at the start.
    ModelError, ConfigurationError, LogError
        As `record_files`.
    """
    source = MicrophoneSource(microphone.device)
    with closing(source):  # it hears, and its pipe holds, while older logs are completed
        recovered = recover_active(settings.output, settings.node)
        end = max((log.end for log in recovered), default=0)
        heard = _AfterKill(source, end) if end else source
        recording = record(settings, microphone, heard, stop, asked)
    recording.recovered = recovered
    return recording


class _AfterKill:
    """A source before whose first frame lies what was not heard since a recorder was killed."""

    def __init__(self, source: Source, end: int) -> None:
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
    microphone: Microphone,
    source: Source,
    stop: Flag,
    asked: SimpleQueue[None] | None = None,
) -> Recording:
    """Record a source until it ends or `stop` is set; raises as `record_files`."""
    with ExitStack() as stack:
        watch = None
        if settings.model is not None:
            watch = stack.enter_context(closing(ModelWatch(settings.model, asked or SimpleQueue())))
        model, classifier = (None, None) if watch is None else watch.first
        features = _features(settings, classifier)
        pipeline = Pipeline(microphone.name, features, classifier, settings.statistics_every)

        def describe(model: Model | None) -> LogDescription:
            info = stream_info(microphone.name, source.device, features, model)
            return describe_log(settings, info, features, model)

        log = RollingLog(
            describe(model),
            settings.max_bag_duration,
            settings.flush_seconds,
            settings.sync_seconds,
        )
        clips = ClipKeeper(settings, pipeline, log.file_at)
        recording = Recording(log.finished)
        now = 0
        try:
            for event in source.events(stop):
                if isinstance(event, Gap):
                    recording.gaps += 1
                    recording.frames_lost += event.frames_lost
                if isinstance(event, Frames) and watch is not None:
                    recording.models_refused += _attend(watch, event, pipeline, log, describe)
                said = clips.before(event)
                log.write(pipeline.push(event))
                said += clips.after(event, pipeline.labelled)
                now = time_of(event)
                log.write(_reports(pipeline, now, said))
        finally:
            said = clips.finish()
            log.finish([*pipeline.finish(), *_reports(pipeline, now, said)])
    return recording


def _reports(pipeline: Pipeline, now: int, said: Sequence[tuple[int, str]]) -> list[Record]:
    return [record for level, text in said for record in pipeline.report("clips", now, level, text)]


def _attend(
    watch: ModelWatch,
    coming: Frames,
    pipeline: Pipeline,
    log: RollingLog,
    describe: Callable[[Model | None], LogDescription],
) -> int:
    """Let a model that is ready speak from the coming frames on; return how many were refused.

    Its labels begin a log of their own: the names behind the probabilities are of the channel, and
    the card is of the file.
    """
    stamp = int(coming.stamps[0])
    refused = list(watch.refusals())
    for text in refused:
        log.write(pipeline.report("model", stamp, 1, text))
    if watch.ready is not None and log.may_begin(stamp):
        model, classifier = watch.ready
        watch.ready = None
        last, first = pipeline.change_model(model, classifier, coming.first, stamp)
        log.begin_anew(describe(model), last)
        log.write(first)
    return len(refused)


def _features(settings: Settings, classifier: Classifier | None) -> FeatureSet:
    """Return the feature set to compute: the one that is asked for, which must be the model's."""
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
    settings: Settings, info: Any, features: FeatureSet, model: Model | None
) -> LogDescription:
    """Say what every file of a recording says of itself; `info` is its `AudioStreamInfo`."""
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
    return LogDescription(
        root=settings.output,
        node=settings.node,
        topics=topics_of(info.header.frame_id, features.feature_names, classes),
        infos=[info],
        metadata=metadata,
        attachments=attachments if model is None else [*attachments, *model_attachments(model)],
    )
