"""Enrolment of sounds in a home's training set: a log of features with one mark each."""

import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.export.merge import merge_logs
from hearthlog.analyzer.logs.layers import find_coverage, latest_records
from hearthlog.analyzer.logs.selection import array_names, select
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.models.classes import CLASS_NAME, SILENCE, class_name
from hearthlog.models.features import SILENCE_POWER
from hearthlog.recorder.config import MicrophoneSettings, load_settings
from hearthlog.recorder.events import Event, Frames, SoundSource
from hearthlog.recorder.pause_schedule import time_zone
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.file_times import GUESS, file_time
from hearthlog.recorder.sources.microphone import MicrophoneSource
from hearthlog.recorder.sources.open_audio import audio_seconds
from hearthlog.recorder.stream.sound_watch import ClipWatch, problem_of_file
from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import (
    CUT,
    ENROLLED,
    SUFFIX,
    find_logs,
    is_log,
    log_path,
    time_span,
)
from hearthlog.schemas.messages.topics import topic
from hearthlog.schemas.new_files import new_file, private_folder

SECONDS = 5.0  # default length of a microphone recording
LEAST_SECONDS, MOST_SECONDS = 1.0, 3600.0
_PATIENCE = 10.0  # seconds that a microphone may take to start
_STAMP = "header.stamp"
_ENERGY = "energy"


@dataclass(frozen=True)
class Enrolled:
    """A log in the training set of a home, with its length in seconds."""

    log: Path
    seconds: float
    warning: str = ""  # what is missing in the file, or wrong with the sound


def enrol_file(home: Path, label: str, audio: Path, seconds: float | None = None) -> list[Enrolled]:
    """Enrol an audio file, or its first seconds, at least 1.

    Frame times come from the file name or metadata, else they end now; earlier if needed, because
    enrolled logs of one class must not overlap.

    Raise `DataError` if the label is no valid class name, if there is less than a second of sound,
    or if the sound is only silence and the label is not; `SourceError` if the file is missing, is
    no audio, or is shorter than a frame; `LogError` if an enrolled log is damaged, or the new one
    cannot be written.
    """
    _check_label(label)
    length = audio_seconds(audio)
    if seconds is not None:
        length = min(length, seconds)
    moment = file_time(audio, time_zone(load_settings(None, {}, {}).timezone))
    end = time.time_ns()
    if moment.origin != GUESS:
        end = moment.start + int(length * NANOSECONDS)
    source = FileSource([audio], _free_start(home, label, length, end))
    enrolled, problem = _enrol(home, label, source, length, threading.Event())
    problems = [f"{audio}: {problem_of_file(problem)}"] if problem else []
    warning = "; ".join([*source.warnings, *problems])
    return [replace(each, warning=warning) for each in enrolled]


def enrol_microphone(
    home: Path,
    label: str,
    device: str,
    seconds: float = SECONDS,
    listening: Callable[[], None] = lambda: None,
) -> list[Enrolled]:
    """Enrol a live recording of at least a second from a microphone.

    The device is as listed by `hearthlog devices`; empty for the default device.

    Raise `DataError` if the label is no valid class name, if there is less than a second of sound,
    or if the sound is only silence and the label is not; `SourceError` if the microphone cannot be
    found or opened; `LogError` if the log cannot be written.
    """
    _check_label(label)
    with closing(MicrophoneSource(device, waits=False)) as source:
        listening()
        stop = threading.Event()
        timer = threading.Timer(seconds + _PATIENCE, stop.set)
        timer.start()
        try:
            enrolled, problem = _enrol(home, label, source, seconds, stop)
            return [replace(each, warning=problem) for each in enrolled]
        finally:
            timer.cancel()


def enrol_log(  # noqa: PLR0913, PLR0917
    home: Path, label: str, log: Path, start: int, end: int, microphone: str | None = None
) -> Enrolled:
    """Enrol a time span of a log, or of a folder of logs, by copying its feature messages.

    The frames are those from `start` on, before `end`, in nanoseconds of UTC; the microphone is by
    default the only one of the log.

    Raise `DataError` if the label is no valid class name, if the log has several microphones and
    none is named, if it has no features with an energy, if there is less than a second of sound, or
    if the sound is only silence and the label is not; `LogError` if there is no such log, if one is
    damaged, or if nothing can be written.
    """
    _check_label(label)
    microphone = microphone or _only_microphone(log)
    selection = select([log], start=start, end=end)
    stamps, energies = _frames(selection.logs, microphone, start, end)
    _check_sound(label, energies)
    path = cut_path(home, label, int(stamps[0]))
    private_folder(path.parent)
    topics = {topic(microphone, "features"), topic(microphone, "info")}
    merge_logs(selection.only(topics), path, latched=True)
    return _marked(path, microphone, label, stamps)


def cut_path(home: Path, label: str, start: int) -> Path:
    """Return the path of an enrolled span of a log; `start` is in nanoseconds of UTC."""
    path = log_path(home / ENROLLED, label, start)
    # Unlike the name of a recorder's log, because this log lacks some topics.
    return path.with_stem(f"{path.stem}{CUT}")


def _only_microphone(log: Path) -> str:
    coverage = find_coverage(log)
    if len(coverage) > 1:
        names = ", ".join(sorted(coverage))
        raise DataError(
            f"{log}: is of several microphones ({names}); make a log of one of them first, with "
            "`hearthlog cut --topics '/NAME/*'`"
        )
    (microphone,) = coverage
    return microphone


class _First:
    """The first seconds of a source."""

    def __init__(self, source: SoundSource, seconds: float) -> None:
        self.device = source.device
        self._source = source
        self._left = round(seconds * NANOSECONDS / FRAME_NANOSECONDS)
        self.watch = ClipWatch()

    def events(self, stop: threading.Event) -> Iterator[Event]:
        for event in self._source.events(stop):
            if isinstance(event, Frames):
                samples, stamps = event.samples[: self._left], event.stamps[: self._left]
                self._left -= len(stamps)
                self.watch.add_samples(samples)
                yield Frames(event.first, samples, stamps)
            else:
                yield event
            if not self._left:
                return


def _enrol(
    home: Path, label: str, source: SoundSource, seconds: float, stop: threading.Event
) -> tuple[list[Enrolled], str]:
    """Record to a temporary folder, and copy the logs to the training set if they have sound.

    Return the enrolled logs, and a problem with the sound, if any.
    """
    microphone = MicrophoneSettings()
    with tempfile.TemporaryDirectory(prefix="hearthlog") as folder:
        options = {
            "node": label,
            "output": Path(folder),
            "model": None,
            "max_bag_duration": 86_400,
        } | _feature_set(home)
        settings = load_settings(None, options, microphone.model_dump())
        first = _First(source, seconds)
        logs = record(settings, first, stop).logs
        frames = {log: _frames([log], microphone.name) for log in logs}
        _check_sound(label, np.concatenate([np.empty(0), *(e for _, e in frames.values())]))
        enrolled = []
        for log, (stamps, _) in frames.items():
            if not len(stamps):
                continue
            path = home / ENROLLED / log.relative_to(folder)
            private_folder(path.parent)
            with new_file(path) as temporary:
                shutil.copyfile(log, temporary)
            enrolled.append(_marked(path, microphone.name, label, stamps))
    return enrolled, first.watch.problem()


def _feature_set(home: Path) -> dict[str, str]:
    """Return the feature set setting of the latest log, else of an enrolled sound."""
    try:
        logs = find_logs(home, enrolled=True)
    except LogError:
        return {}  # first sound of the home
    logs.sort(key=lambda log: ENROLLED not in log.relative_to(home).parts)
    key = "feature_set"
    return next(({key: each[key]} for each in latest_records(logs) if each.get(key)), {})


def _check_label(label: str) -> None:
    if not CLASS_NAME.fullmatch(label):
        raise DataError(
            f"{label[:64]!r} cannot be the name of a class: use lower-case letters, digits and '_'"
        )


def _check_sound(label: str, energies: NDArray[np.floating[Any]]) -> None:
    seconds = len(energies) * FRAME_NANOSECONDS / NANOSECONDS
    if seconds < LEAST_SECONDS:
        raise DataError(f"only {seconds:.2f} s of sound; enrol at least {LEAST_SECONDS:.0f} s")
    if class_name(label) != SILENCE and (energies < SILENCE_POWER).all():
        raise DataError(
            f"all of it is below -60 dBFS: this is silence, not {label}; is the microphone muted?"
        )


def _frames(
    logs: Sequence[Path], microphone: str, start: int | None = None, end: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.floating[Any]]]:
    """Read the times and energies of the frames of some logs."""
    name = topic(microphone, "features")
    columns = read_columns(logs, {name}, start, end, {_STAMP, "values"}).get(name)
    if columns is None:
        return np.empty(0, np.int64), np.empty(0)
    names = array_names(columns.metadata, "values")
    values = columns["values"]
    if _ENERGY not in names or values.shape[1:] != (len(names),):
        raise DataError(f"{logs[0]}: {name} has no energy; it was not recorded by hearthlog")
    return columns[_STAMP], values[:, names.index(_ENERGY)]


def _marked(path: Path, microphone: str, label: str, stamps: NDArray[np.int64]) -> Enrolled:
    """Mark a new log completely; delete the log on failure."""
    start, end = int(stamps[0]), int(stamps[-1]) + FRAME_NANOSECONDS
    try:
        write_marks(path, [Mark(microphone, start, end, label)])
    except HearthlogError:
        path.unlink()
        raise
    return Enrolled(path, len(stamps) * FRAME_NANOSECONDS / NANOSECONDS)


def _free_start(home: Path, label: str, seconds: float, end: int) -> int:
    """Return the start of the latest span that ends by `end` and overlaps no enrolled log."""
    length = int(seconds * NANOSECONDS)
    logs = filter(is_log, (home / ENROLLED).rglob(f"{label}_*{SUFFIX}"))
    spans = [span for log in logs if (span := time_span(log)) is not None]
    for first, last in sorted(spans, reverse=True):
        if first < end and last > end - length:
            end = first
    return max(end - length, 0)
