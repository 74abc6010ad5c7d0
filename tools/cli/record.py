"""`hearthlog record`: a log from a microphone or audio files."""

import os
import signal
import sys
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import HearthlogError, Progress, ignore_progress
from hearthlog.tools.cli.options import (
    MaxBagFiles,
    MaxRecordSize,
    MinFreeSpace,
    RetentionDays,
    parse_time,
    scenario_files,
)
from hearthlog.tools.cli.terminal import number, print_notice, share_done, stopped_by, wrong_use

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from hearthlog.recorder.config import Settings
    from hearthlog.recorder.labelling.model_watch import ReloadRequests
    from hearthlog.recorder.recording_session import RecorderState, RecordingSummary
    from hearthlog.recorder.sources.audio_files import FileSource

_HIDDEN = {"owner": 0o077, "group": 0o027, "all": 0o022}  # umask by `readable_by`


def record(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Audio files, or folders of them, in time order; without any, the microphone."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder of logs.", show_default="logs")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Model file, or a link to one; general or bathroom, which come with hearthlog; "
            "none: no labels. A file that replaces it takes effect within about a second.",
            show_default="models/champion.safetensors if there is one, else general",
        ),
    ] = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE",
            help="Additional model with its own topics, such as "
            "speakers=models/speakers.safetensors; may be repeated.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            help="Microphone, as `hearthlog devices` lists it, or an address such as "
            "rtsp://camera/stream or ros2:///robot/audio."
        ),
    ] = None,
    channel: Annotated[
        int | None,
        typer.Option(
            help="Channel of several to record, from 1.",
            show_default="the first; of files the mean of all",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the microphone in the log.", show_default="mic")
    ] = None,
    node: Annotated[
        str | None, typer.Option(help="Name of this recorder.", show_default="home")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            help="Time of the first sample of the files, such as 2026-03-01T07:00:00 (UTC "
            "unless it has an offset).",
            show_default="from their names or metadata, else a guess",
        ),
    ] = None,
    start_pattern: Annotated[
        str | None,
        typer.Option(
            metavar="PATTERN",
            help="Time format in the file names, such as %d-%m-%Y_%Hh%M (as for strptime).",
            show_default="common ones, such as 20260301_070000",
        ),
    ] = None,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Play files at the pace of real time.")
    ] = False,
    max_bag_duration: Annotated[
        int | None,
        typer.Option("--max-bag-duration", "-d", help="Seconds per log.", show_default="3600"),
    ] = None,
    max_bag_size: Annotated[
        str | None,
        typer.Option(
            "--max-bag-size", "-b", help="Bytes per log, such as 10M.", show_default="any"
        ),
    ] = None,
    retention_days: RetentionDays = None,
    max_bag_files: MaxBagFiles = None,
    max_record_size: MaxRecordSize = None,
    min_free_space: MinFreeSpace = None,
    keep_audio: Annotated[
        str | None,
        typer.Option(
            help="Keep sound with the log: off, events, unsure (low confidence) or always; "
            "never speech.",
            show_default="off",
        ),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Configuration, a TOML file.")] = None,
) -> None:
    """Record sound to a labelled log, from a microphone or from files.

    SIGINT (Ctrl-C) and SIGTERM complete the log; SIGHUP restarts the recorder if the
    configuration has changed. Exit status 3: there were gaps; a file was damaged, left out,
    or overlapped the one before; a log of an earlier recorder was damaged; or a new model was
    refused.
    """
    from hearthlog.recorder.config import NO_MODEL, exposed_passwords, load_settings
    from hearthlog.recorder.recording import record_files, record_microphones

    given = {
        "output": output,
        "model": model,
        "scenarios": scenario_files(scenario) or None,
        "node": node,
        "max_bag_duration": max_bag_duration,
        "max_bag_size": max_bag_size,
        "retention_days": retention_days,
        "max_bag_files": max_bag_files,
        "max_record_size": max_record_size,
        "min_free_space": min_free_space,
        "keep_audio": keep_audio,
    }
    microphone = _given({"name": name, "device": device, "channel": channel})
    load = partial(load_settings, config, _given(given), microphone)
    configured = load()
    settings = with_model(configured)
    print_notice(*exposed_passwords(settings, config))
    if sys.stderr.isatty():
        _report_network(settings)
    os.umask(_HIDDEN[settings.readable_by])
    losses: list[str] = []
    stop = stopped_by(signal.SIGINT, signal.SIGTERM)
    reload_requests = _look_at_hangup(stop, load, configured)
    if files:
        if len(settings.microphone) > 1:
            wrong_use("files replace one microphone, but the configuration has several")
        lives = realtime and sys.stderr.isatty()  # live line for real time, else a progress bar
        with ExitStack() as shown:
            progress = ignore_progress if lives else shown.enter_context(share_done("recording"))
            source, doubts, refused = _open_files(
                files, start, start_pattern, settings, realtime, progress
            )
            state = shown.enter_context(_living_line(settings)) if lives else None
            recording = record_files(settings, source, stop, reload_requests, state)
        losses = [*refused, *source.warnings]
        if not recording.labels and settings.model != NO_MODEL:
            doubts.append("the sound is too short for a label; a model needs one second")
        print_notice(*doubts, *losses)
    elif start is not None or realtime or start_pattern is not None:
        wrong_use("--start, --start-pattern and --realtime go with files")
    else:
        with ExitStack() as shown:
            state = shown.enter_context(_living_line(settings)) if sys.stderr.isatty() else None
            recording = record_microphones(settings, stop, reload_requests, state)
        if reload_requests.restart:
            print_notice("the configuration has changed; restarting")
            os.execv(sys.executable, sys.orig_argv)  # noqa: S606  with the original arguments
    _report(recording, losses)


@contextmanager
def _living_line(settings: "Settings") -> "Iterator[RecorderState]":
    """Show a live line, from the state that is yielded."""
    from hearthlog.recorder.recording_session import RecorderState
    from hearthlog.tools.cli.live_display import living_line

    print_notice("press Ctrl-C to stop and complete the log")
    state = RecorderState()
    with living_line(state, settings):
        yield state


def with_model(settings: "Settings") -> "Settings":
    """Return settings with a model where none is configured."""
    from hearthlog.models.registry import DEFAULT_MODEL

    model = DEFAULT_MODEL if settings.model is None else settings.model
    if model == DEFAULT_MODEL and model.is_symlink() and not model.exists():
        print_notice(f"{model}: the model that it points to is gone; promote another one")
    return settings.model_copy(update={"model": model})


def _report_network(settings: "Settings") -> None:
    """Print the benefit of a network and how to get one, unless the configuration decides."""
    from hearthlog.analyzer.errors import remedy
    from hearthlog.models.embedding.networks import YAMNET, find_network, missing_modules
    from hearthlog.models.registry import DEFAULT_MODEL
    from hearthlog.models.starter import BY_FEATURES

    model = settings.model or DEFAULT_MODEL
    by_starter = str(model) in BY_FEATURES or model == DEFAULT_MODEL
    if settings.embedding or not by_starter or model.exists() or find_network(YAMNET.name):
        return
    absent = missing_modules(YAMNET.suffix)
    print_notice(
        "a network pretrained on two million clips makes labels in a new home more accurate: "
        f"hearthlog models fetch {YAMNET.name} (4 MB, once)"
        + (f"; it also needs LiteRT; {remedy(*absent)}" if absent else "")
    )


def _report(recording: "RecordingSummary", losses: list[str]) -> None:
    """Print the recording's summary; end with status 3 after losses or refusals."""
    for log in recording.logs:
        print(log)
    damaged = [old for old in recording.recovered if old.damage]
    for old in recording.recovered:
        if old.completed:
            print_notice(f"completed {old.path}, which was left unfinished")
    print_notice(*(old.damage for old in damaged))
    if recording.gaps:
        gaps, frames = number(recording.gaps, "gap"), number(recording.frames_lost, "frame")
        print_notice(f"{gaps}, {frames} lost")
    if damaged or recording.gaps or recording.models_refused or losses:
        raise typer.Exit(3)


def _look_at_hangup(
    stop: Flag, load: "Callable[[], Settings]", configured: "Settings"
) -> "ReloadRequests":
    """Reload models and configuration on SIGHUP; stop if the terminal was closed."""
    from hearthlog.recorder.labelling.model_watch import ReloadRequests

    reload_requests = ReloadRequests()
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # set by nohup
    at_terminal = sys.stderr.isatty() and not ignored

    def look_at_configuration() -> None:
        try:
            changed = load() != configured
        except HearthlogError as error:
            print_notice(f"{error}; the recorder keeps its present configuration")
            return
        if changed:
            reload_requests.restart = True
            stop.set()

    def handle(*_: object) -> None:
        if at_terminal and not sys.stderr.isatty():
            stop.set()
        reload_requests.request()
        Thread(target=look_at_configuration, daemon=True).start()

    signal.signal(signal.SIGHUP, handle)
    return reload_requests


def _given(options: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in options.items() if value is not None}


def _open_files(
    files: list[Path],
    start: str | None,
    pattern: str | None,
    settings: "Settings",
    realtime: bool,
    progress: "Progress",
) -> tuple["FileSource", list[str], list[str]]:
    """Open audio files in time order; return doubts about the order, and skipped files."""
    from hearthlog.recorder.pause_schedule import time_zone
    from hearthlog.recorder.sources.audio_files import FileSource, find_audio
    from hearthlog.recorder.sources.file_times import arrange, check_pattern, doubts, file_time

    if pattern is not None:
        check_pattern(pattern)
    begin = None if start is None else parse_time(start, "--start")
    zone = time_zone(settings.timezone)
    check = partial(file_time, zone=zone, pattern=pattern) if pattern else str
    paths, refused = find_audio(files, check)
    paths, times = arrange(paths, zone, pattern or "", begin)
    first = times[0]
    assert first is not None
    source = FileSource(
        paths,
        first.start,
        times=times,
        realtime=realtime,
        channels=settings.microphone[0].channels,
        channel=settings.microphone[0].channel,
        progress=progress,
    )
    return source, doubts(paths, times) if start is None else [], refused
