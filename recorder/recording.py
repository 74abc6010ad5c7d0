"""Recorder: sound sources, a pipeline for each, and their log."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from threading import Event as Flag

from hearthlog.models.embedding.networks import Embedder
from hearthlog.models.starter import BY_FEATURES, NETWORK
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Event, Frames, Gap, SoundSource, merged_events
from hearthlog.recorder.host import ServiceManager, announce, keep_freed_blocks, keep_one_heap
from hearthlog.recorder.labelling.embedder_probe import (
    NO_NETWORK,
    check_network,
    likely_network,
    open_embedder,
)
from hearthlog.recorder.labelling.labelling_models import LabellingModels, open_models
from hearthlog.recorder.labelling.model_watch import ReloadRequests
from hearthlog.recorder.log.folder_lock import FolderLock, check_writable
from hearthlog.recorder.log.recovery import end_of_sound, recover_active
from hearthlog.recorder.pause_schedule import PauseSchedule
from hearthlog.recorder.recording_session import (
    NOT_RUNNING,
    RecorderState,
    RecordingSession,
    RecordingSummary,
)
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS


def record_files(
    settings: Settings,
    source: FileSource,
    stop: Flag,
    reload_requests: ReloadRequests | None = None,
    state: RecorderState | None = None,
) -> RecordingSummary:
    """Record audio files as if a microphone had captured them.

    Raise `SourceError` if a file is damaged, or all files together are shorter than a frame;
    `ModelError` if the model cannot be used, or the feature set is not installed;
    `ConfigurationError` if the model is for another feature set than the configured one, or sound
    is to be kept and the model lacks a class that must not be kept; `LogError` if another recorder
    of this name uses the folder, or the log cannot be written: then the written part remains and is
    completed at the next start.
    """
    keep_freed_blocks()
    with FolderLock(settings.output, settings.node):
        recovered = recover_active(settings.output, settings.node)
        sources = {settings.microphone[0].name: source}
        # Clip notices are stamped with their block, so blocks stay short if clips are kept.
        source.joins_blocks = not source.realtime and settings.keep_audio == "off"
        summary = _record(settings, sources, stop, reload_requests, state=state)
    summary.recovered = recovered
    return summary


def record_microphones(
    settings: Settings,
    stop: Flag,
    reload_requests: ReloadRequests | None = None,
    state: RecorderState | None = None,
) -> RecordingSummary:
    """Record the configured microphones until `stop` is set, regardless of their failures.

    Raise `SourceError` if this machine cannot capture microphones; `LogError` if another recorder
    of this name uses the folder, or the folder is unusable, and at the end, if the disk has not
    accepted the complete log; `ModelError` and `ConfigurationError` as `record_files`.
    """
    from hearthlog.recorder.sources.microphone import MicrophoneSource  # noqa: PLC0415  not for files

    keep_one_heap()
    with ExitStack() as stack:
        lock = stack.enter_context(FolderLock(settings.output, settings.node))
        rest = settings.rest()
        # Capture starts now, buffered in pipes, while older logs are completed.
        sources = {
            each.name: stack.enter_context(
                closing(
                    MicrophoneSource(
                        each.device,
                        fallback=each.fallback,
                        rest=rest,
                        channels=each.channels,
                        channel=each.channel,
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
        summary = _record(settings, resumed, stop, reload_requests, lock, state)
    summary.recovered = recovered
    return summary


def recording_problems(settings: Settings) -> list[HearthlogError]:
    """Return the errors of recording microphones with these settings, without side effects.

    They are a `LogError` if the log folder is not writable, a `SourceError` if a microphone's
    address is invalid, or needs ffmpeg and it is missing, and errors as of `record_files`.
    """
    from hearthlog.recorder.sources.microphone import check_device  # noqa: PLC0415  as above

    problems: dict[str, HearthlogError] = {}  # by message: microphones may share a model

    def check(step: Callable[[], object]) -> None:
        try:
            step()
        except HearthlogError as error:
            problems.setdefault(str(error), error)

    for device in (name for each in settings.microphone for name in (each.device, each.fallback)):
        check(partial(check_device, device))
    sources = {each.name: _NoSound(each.device) for each in settings.microphone}
    with ExitStack() as stack:
        for name in sources:
            check(partial(open_models, settings, [name], None, stack))
        if not problems:
            check(lambda: _check_session(settings, sources, stack))
    check(partial(check_network, settings.embedding, len(settings.microphone)))
    check(partial(check_writable, settings.output))
    return list(problems.values())


def _check_session(
    settings: Settings, sources: Mapping[str, SoundSource], stack: ExitStack
) -> None:
    models = open_models(settings, list(sources), None, stack)
    session = RecordingSession(settings, sources, models)
    if not likely_network(settings.embedding):  # a network that loads will provide the embeddings
        session.report_missing_embeddings()


@dataclass
class _NoSound:
    """A source without events."""

    device: str

    def events(self, stop: Flag) -> Iterator[Event]:
        del stop
        return iter(())


class _Resumed:
    """A source with a gap before its first frame, from the end of the last log."""

    def __init__(self, source: SoundSource, end: int, rest: PauseSchedule) -> None:
        self._source = source
        self._end = end
        resting = rest.reason()
        self._reason = f"{NOT_RUNNING}; {resting}" if resting else NOT_RUNNING

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

    Raise `SourceError` if the source does; `ModelError`, `ConfigurationError` and `LogError` as
    `record_files`.
    """
    return _record(settings, {settings.microphone[0].name: source}, stop, reload_requests)


def _embedder(settings: Settings, microphones: int) -> tuple[Embedder | None, str]:
    """Return the embedding network, or why there is none; print the reason if it failed to load."""
    embedder, why = open_embedder(settings.embedding, microphones)
    if why:
        announce(why)
        return embedder, "the network cannot be used"
    if embedder is not None:
        return embedder, f"it does not use the network {embedder.source.network}"
    if settings.embedding == NO_NETWORK:
        return embedder, "no network is wanted"
    return embedder, f"the network {NETWORK} is missing"


def _report_starters(
    models: Mapping[str, LabellingModels], embedder: Embedder | None, why: str
) -> None:
    """Print the starter models in use, and whether they use embeddings."""
    for name in dict.fromkeys(each.starter for each in models.values()):
        takes_embeddings = embedder is not None and embedder.source.network == NETWORK
        by = f"what the network {NETWORK} hears"
        if name in BY_FEATURES or not takes_embeddings:
            by = f"features alone, as {why}"
        if name:
            who = f"the starter model {name}, not trained on this home"
            announce(f"the labels are by {who}: by {by}")


def _record(  # noqa: PLR0913, PLR0917
    settings: Settings,
    sources: Mapping[str, SoundSource],
    stop: Flag,
    reload_requests: ReloadRequests | None,
    lock: FolderLock | None = None,
    state: RecorderState | None = None,
) -> RecordingSummary:
    with ExitStack() as stack:
        # A long-running recorder continues without a scenario that no longer works.
        leaves_out = lock is not None
        embedder, why = _embedder(settings, len(sources))
        network = "" if embedder is None else embedder.source.network
        models = open_models(
            settings,
            list(sources),
            reload_requests,
            stack,
            leaves_out=leaves_out,
            network=network,
        )
        _report_starters(models, embedder, why)
        session = RecordingSession(settings, sources, models, lock, state, embedder)
        session.report_missing_embeddings()
        manager = ServiceManager(sources)
        try:
            for microphone, event in merged_events(sources, stop):
                session.add(microphone, event)
                manager.add(microphone, event)
        finally:
            manager.stop(restarts=reload_requests is not None and reload_requests.restart)
            session.finish()
    return session.summary
