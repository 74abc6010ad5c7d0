"""The recorder: sources of sound, a pipeline for each, and the log that they write."""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from threading import Event as Flag

from hearthlog.models.errors import ModelError
from hearthlog.models.modelfile.modelfile import SUFFIX
from hearthlog.models.modelfile.registry import DEFAULT_FOLDER
from hearthlog.recorder.clips.clip_recorder import ClipRecorder
from hearthlog.recorder.config import NO_MODEL, Settings
from hearthlog.recorder.disk.keeper import DiskKeeper
from hearthlog.recorder.events import (
    WARNING,
    Event,
    Frames,
    Gap,
    Notice,
    SoundSource,
    SourceHealth,
    event_time,
)
from hearthlog.recorder.journal import HealthJournal, say
from hearthlog.recorder.labelling.candidate_watch import CandidateWatch
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import ModelWatch, ReloadRequests
from hearthlog.recorder.log.description import LogDescription, join_descriptions
from hearthlog.recorder.log.finishing import LogFinisher
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.log.live_log import LiveLog
from hearthlog.recorder.log.recovery import Recovered, end_of_sound, recover_active
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.machine import MachineWatch
from hearthlog.recorder.memory import keep_one_heap
from hearthlog.recorder.microphone_stream import MicrophoneStream
from hearthlog.recorder.rest import Rest
from hearthlog.recorder.service_manager import ServiceManager
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.merged import merged_events
from hearthlog.recorder.sources.microphone import MicrophoneSource, check_device
from hearthlog.recorder.stream.diagnostics import diagnostics
from hearthlog.recorder.stream.messages import EncodedMessage
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.messages.gaps import ON_PURPOSE

_NOT_RUNNING = "the recorder was not running"
_NOT_LOST = (_NOT_RUNNING, *ON_PURPOSE)  # with these the reasons of a gap begin


@dataclass
class RecordingSummary:
    """What was recorded."""

    logs: list[Path]  # finished ones
    recovered: Sequence[Recovered] = ()  # logs of an earlier recorder, completed first
    frames_lost: int = 0
    gaps: int = 0  # while it was running
    models_refused: int = 0  # files that could not be used


def record_files(
    settings: Settings,
    source: FileSource,
    stop: Flag,
    reload_requests: ReloadRequests | None = None,
) -> RecordingSummary:
    """Record audio files as if a microphone had captured them.

    Parameters
    ----------
    settings : Settings
    source : FileSource
    stop : threading.Event
        Once set, the log is completed.
    reload_requests : ReloadRequests or None
        Make the recorder check at once whether a model's file has been replaced.

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
        If another recorder of this name uses the folder. If the log cannot be written, in which
        case what was written stays, for the next start to complete.
    """
    with FolderLock(settings.output, settings.node):
        recovered = recover_active(settings.output, settings.node)
        summary = record(settings, source, stop, reload_requests)
    summary.recovered = recovered
    return summary


def record_microphones(
    settings: Settings, stop: Flag, reload_requests: ReloadRequests | None = None
) -> RecordingSummary:
    """Record the configured microphones until `stop` is set, whatever happens to them.

    Parameters
    ----------
    settings : Settings
    stop : threading.Event
        Once set, the log is completed.
    reload_requests : ReloadRequests or None
        Make the recorder check at once whether a model's file has been replaced.

    Raises
    ------
    SourceError
        If microphones cannot be captured on this machine.
    LogError
        If another recorder of this name uses the folder, or the folder cannot be used; at the end,
        if the disk has not taken all of the log.
    ModelError, ConfigurationError
        As `record_files`.
    """
    keep_one_heap()
    with ExitStack() as stack:
        lock = stack.enter_context(FolderLock(settings.output, settings.node))
        rest = settings.rest()
        # They capture, and their pipes hold, while older logs are completed.
        sources = {
            each.name: stack.enter_context(
                closing(
                    MicrophoneSource(
                        each.device, fallback=each.fallback, rest=rest, channels=each.channels
                    )
                )
            )
            for each in settings.microphone
        }
        recovered = recover_active(settings.output, settings.node)
        now = time.time_ns()
        resumed = {
            name: _Resumed(source, end_of_sound(settings.output, settings.node, name, now), rest)
            for name, source in sources.items()
        }
        summary = _record(settings, resumed, stop, reload_requests, lock)
    summary.recovered = recovered
    return summary


def check_recording(settings: Settings) -> None:
    """Check whether microphones could be recorded so, and leave no trace.

    Parameters
    ----------
    settings : Settings

    Raises
    ------
    LogError
        If the folder of the logs cannot be written to.
    SourceError
        If an address of a microphone cannot be one of sound, or ffmpeg is not there for it.
    ModelError, ConfigurationError
        As `record_files`.
    """
    sources = {each.name: _Unheard(each.device) for each in settings.microphone}
    for device in (name for each in settings.microphone for name in (each.device, each.fallback)):
        check_device(device)
    with ExitStack() as stack:
        models = _open_models(settings, list(sources), None, stack)
        RecordingSession(settings, sources, models)
    folder = settings.output.absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise LogError(f"{settings.output}: cannot be written ({there} does not allow it)")


@dataclass
class _Unheard:
    """A source that gives nothing."""

    device: str

    def events(self, stop: Flag) -> Iterator[Event]:
        del stop
        return iter(())


class _Resumed:
    """A source with a gap before its first frame: from the end of the last log on."""

    def __init__(self, source: SoundSource, end: int, rest: Rest) -> None:
        self._source = source
        self._end = end
        resting = rest.reason()
        self._reason = f"{_NOT_RUNNING}; {resting}" if resting else _NOT_RUNNING

    @property
    def device(self) -> str:
        return self._source.device

    def events(self, stop: Flag) -> Iterator[Event]:
        for event in self._source.events(stop):
            if isinstance(event, Frames) and self._end:
                start, self._end = self._end, 0
                now = int(event.stamps[0])
                if start < now:
                    lost = round((now - start) / FRAME_NANOSECONDS)
                    yield Gap(start, now, self._reason, lost)
            yield event


def record(
    settings: Settings,
    source: SoundSource,
    stop: Flag,
    reload_requests: ReloadRequests | None = None,
) -> RecordingSummary:
    """Record a source, as the first microphone, until it ends or `stop` is set.

    Parameters
    ----------
    settings : Settings
    source : SoundSource
    stop : threading.Event
        Once set, the log is completed.
    reload_requests : ReloadRequests or None
        Make the recorder check at once whether a model's file has been replaced.

    Raises
    ------
    SourceError
        If the source raises it.
    ModelError, ConfigurationError, LogError
        As `record_files`.
    """
    return _record(settings, {settings.microphone[0].name: source}, stop, reload_requests)


def _record(
    settings: Settings,
    sources: Mapping[str, SoundSource],
    stop: Flag,
    reload_requests: ReloadRequests | None,
    lock: FolderLock | None = None,
) -> RecordingSummary:
    with ExitStack() as stack:
        # Who records for years goes on without a scenario that has become impossible.
        leaves_out = lock is not None
        models = _open_models(
            settings, list(sources), reload_requests, stack, leaves_out=leaves_out
        )
        session = RecordingSession(settings, sources, models, lock)
        manager = ServiceManager(sources)
        try:
            for microphone, event in merged_events(sources, stop):
                session.add(microphone, event)
                manager.add(microphone, event)
        finally:
            manager.stop(restarts=reload_requests is not None and reload_requests.restart)
            session.finish()
    return session.summary


def _open_models(
    settings: Settings,
    microphones: Sequence[str],
    reload_requests: ReloadRequests | None,
    stack: ExitStack,
    *,
    leaves_out: bool = False,
) -> dict[str, LabellingModels]:
    """Load the models of microphones, and watch their files; once for those that have the same.

    Scenarios that cannot label are left out, or an error.
    """
    reload_requests = reload_requests or ReloadRequests()
    chosen = {
        each.name: (each.model or settings.model or NO_MODEL, settings.scenarios_of(each))
        for each in settings.microphone
    }
    models: dict[str, LabellingModels] = {}
    for name in microphones:
        same = next((other for other in models if chosen[other] == chosen[name]), None)
        models[name] = (
            _watched_models(*chosen[name], reload_requests, stack, leaves_out=leaves_out)
            if same is None
            else models[same]
        )
    return models


def _watched_models(
    path: Path,
    scenarios: Mapping[str, Path],
    reload_requests: ReloadRequests,
    stack: ExitStack,
    *,
    leaves_out: bool,
) -> LabellingModels:
    watches = {}
    left_out: list[str] | None = [] if leaves_out else None
    for name, file in scenarios.items():
        try:
            watch = ModelWatch(file, reload_requests.queue(), name)
            watches[name] = stack.enter_context(closing(watch))
        except ModelError as error:
            if left_out is None:
                raise
            left_out.append(str(error))
    if path == NO_MODEL:
        return LabellingModels(scenarios=watches, left_out=left_out)
    watch = stack.enter_context(closing(ModelWatch(path, reload_requests.queue())))
    is_file = path.suffix == SUFFIX  # else the name of a starter
    folder = path.parent if is_file else DEFAULT_FOLDER
    candidates = CandidateWatch(folder, watch.first.classifier.feature_set)
    stack.enter_context(closing(candidates))
    return LabellingModels(watch, candidates, watches, left_out)


class RecordingSession:
    """The recording of some sources: their log, the clips beside it, and what labels them.

    Parameters
    ----------
    settings : Settings
    sources : mapping of str to SoundSource
        By the name of the microphone; of audio files no log may be there already.
    models : mapping of str to LabellingModels
        By the name of the microphone; several may have the same.
    lock : FolderLock or None
        Of the folder of the logs, where microphones are recorded into it.

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
        sources: Mapping[str, SoundSource],
        models: Mapping[str, LabellingModels],
        lock: FolderLock | None = None,
    ) -> None:
        self._settings = settings
        self._streams = {
            name: MicrophoneStream(settings, name, source, models[name])
            for name, source in sources.items()
        }
        is_live = not any(isinstance(source, FileSource) for source in sources.values())
        is_read_ahead = any(
            isinstance(source, FileSource) and not source.realtime for source in sources.values()
        )
        self._finisher = None if is_read_ahead else LogFinisher()
        log = RollingLog(
            self._describe(),
            settings.max_bag_duration,
            settings.flush_seconds,
            settings.sync_seconds,
            live=is_live,
            file_bytes=settings.max_bag_size,
            finisher=self._finisher,
        )
        self._log = LiveLog(log, settings.output, lock) if is_live else log
        pipelines = [stream.pipeline for stream in self._streams.values()]
        self._clips = ClipRecorder(settings, pipelines, self._log.file_at)
        self._keeper = DiskKeeper(settings.keeping_rules()) if is_live else None
        self._machine = None if lock is None else MachineWatch(settings.output)
        self._journal = HealthJournal()
        self._now = 0  # time of the last event
        self.summary = RecordingSummary(self._log.finished)

    def add(self, microphone: str, event: Event) -> None:
        """Record one event of a source.

        Parameters
        ----------
        microphone : str
            Name of the one whose event it is.
        event : Event

        Raises
        ------
        LogError
            As `RollingLog.write`, if audio files are recorded.
        """
        stream = self._streams[microphone]
        if self._log.is_full:
            self._log.write([])  # unless the disk takes it now
        for accepted in stream.accepted(event, log_is_full=self._log.is_full):
            self._record(stream, accepted)
        if isinstance(event, SourceHealth):
            self._journal.add(microphone, stream.pipeline.judged(event))
            self._look_at_the_machine(stream, event.stamp)
        for notice in self._log.notices():
            say(notice.text)
            self._log.write(stream.pipeline.report("disk", self._now, notice))

    def _record(self, stream: MicrophoneStream, event: Event) -> None:
        if isinstance(event, Gap) and not event.reason.startswith(_NOT_LOST):
            self.summary.gaps += 1
            self.summary.frames_lost += event.frames_lost
        if isinstance(event, Frames):
            self._look_for_models(stream, event)
        if stream.device_changes():
            self._log.begin_anew(self._describe(), stream.pipeline.flush())
        notices = self._clips.before(stream.pipeline.microphone, event)
        self._log.write(stream.pipeline.push(event))
        labels = stream.pipeline.last_labels
        notices += self._clips.after(stream.pipeline.microphone, event, labels)
        self._now = event_time(event)
        self._log.write(self._clip_messages(stream, notices))
        self._look_after_the_disk(stream)

    def _look_after_the_disk(self, stream: MicrophoneStream) -> None:
        if self._keeper is not None:
            messages, problems = self._keeper.tick(self._now)
            self._log.write(stream.pipeline.hold(messages))
            for problem in problems:
                say(problem)

    def _look_at_the_machine(self, stream: MicrophoneStream, stamp: int) -> None:
        """Tell how the machine is, as often as the first microphone tells how it is."""
        if self._machine is None:
            return
        if (health := self._machine.tick(stamp)) is not None:
            self._journal.add("machine", health)
            message = diagnostics(f"{self._settings.node} machine", health)
            self._log.write(stream.pipeline.hold([message]))

    def finish(self) -> None:
        """Complete the log and its clips.

        Raises
        ------
        LogError
            If the log cannot be written; what was written stays, for the next start to complete.
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
            for message in stream.pipeline.report("clips", self._now, notice)
        ]

    def _look_for_models(self, stream: MicrophoneStream, frames: Frames) -> None:
        """Report models that were refused, and let others label from these frames on."""
        stamp = int(frames.stamps[0])
        for reason in stream.models.refusals():
            self.summary.models_refused += 1
            self._log.write(stream.pipeline.report("model", stamp, Notice(WARNING, reason)))
        if stream.models.may_change() and self._log.may_begin(stamp):
            self._change_models(stream, frames)

    def _change_models(self, stream: MicrophoneStream, frames: Frames) -> None:
        """Let other models label their microphones, one of them from these frames on.

        Their labels begin a log of their own: the names of the classes belong to the channel, and
        the model card to the file.
        """
        changes = stream.models.change()
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

    def _describe(self) -> LogDescription:
        return join_descriptions([stream.describe() for stream in self._streams.values()])
