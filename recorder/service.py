"""The recorder: a source of sound, the pipeline, and the log it ends in."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from threading import Event as Flag
from typing import Protocol

from models.classifier import Classifier
from models.modelfile import Model, load_model
from recorder import features
from recorder.config import Settings
from recorder.log import LogDescription, RollingLog
from recorder.pipeline import Pipeline, stream_info
from recorder.recovery import Recovered, recover_active
from recorder.sources.microphone import MicrophoneSource
from recorder.sources.replayed import FileSource
from recorder.stream import FRAME_NANOSECONDS, Event, Frames, Gap
from schemas.topics import topics_of
from schemas.writer import Attachment


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
    recovered: Sequence[Recovered]
    frames_lost: int = 0
    gaps: int = 0


def record_files(settings: Settings, source: FileSource, stop: Flag) -> Recording:
    """Record audio files as if a microphone had heard them.

    Raises
    ------
    SourceError
        If one of them turns out to be damaged.
    ModelError
        If the model cannot be used.
    LogError
        If the log cannot be written; what was written stays, for the next start to complete.
    """
    recovered = recover_active(settings.output, settings.node)
    return record(settings, source, stop, recovered)


def record_microphone(settings: Settings, stop: Flag) -> Recording:
    """Record the microphone until `stop` is set, whatever happens to it.

    Raises
    ------
    SourceError
        If it cannot be heard at the start.
    ModelError, LogError
        As `record_files`.
    """
    source = MicrophoneSource(settings.microphone[0].device)
    with closing(source):  # it hears, and its pipe holds, while older logs are completed
        recovered = recover_active(settings.output, settings.node)
        end = max((log.end for log in recovered), default=0)
        return record(settings, _AfterKill(source, end) if end else source, stop, recovered)


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
    settings: Settings, source: Source, stop: Flag, recovered: Sequence[Recovered] = ()
) -> Recording:
    """Record a source until it ends or `stop` is set; raises as `record_files`."""
    model = None if settings.model is None else load_model(settings.model)
    microphone = settings.microphone[0].name
    pipeline = Pipeline(
        microphone, None if model is None else Classifier(model), settings.statistics_every
    )
    log = RollingLog(
        _describe(settings, source, model),
        settings.max_bag_duration,
        settings.flush_seconds,
        settings.sync_seconds,
    )
    recording = Recording(log.finished, recovered)
    try:
        for event in source.events(stop):
            if isinstance(event, Gap):
                recording.gaps += 1
                recording.frames_lost += event.frames_lost
            log.write(pipeline.push(event))
    finally:
        log.finish(pipeline.finish())
    return recording


def _describe(settings: Settings, source: Source, model: Model | None) -> LogDescription:
    microphone = settings.microphone[0].name
    configuration = settings.model_dump_json(indent=2, exclude={"output", "model"}).encode()
    attachments = [Attachment("configuration.json", "application/json", configuration)]
    if model is not None:
        attachments.append(Attachment("model_card.md", "text/markdown", model.card().encode()))
    classes = None if model is None else list(model.classes)
    info = stream_info(microphone, source.device, model)
    metadata = {
        "version": version("hearthlog"),
        "node": settings.node,
        "configuration_sha256": hashlib.sha256(configuration).hexdigest(),
        "feature_set": features.NAME,
        "model": info.model,
        "model_sha256": info.model_sha256,
    }
    return LogDescription(
        root=settings.output,
        node=settings.node,
        microphone=microphone,
        topics=topics_of(microphone, features.FEATURE_NAMES, classes),
        info=info,
        metadata=metadata,
        attachments=attachments,
    )
