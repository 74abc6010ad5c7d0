"""Audio clips of selected events: layers next to the log, and their retention."""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, time, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.recorder.config import Keep, Settings
from hearthlog.recorder.events import OK, WARNING, Event, Frames, Gap, Notice, event_time
from hearthlog.recorder.pause_schedule import time_zone
from hearthlog.recorder.retention import recorded_days, start_of, walk
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.recorder.stream.privacy_filter import (
    PRIVATE_LIMIT,
    PRIVATE_LIMIT_ELSEWHERE,
    TOGETHER,
    PrivateFrames,
)
from hearthlog.schemas.arrays import Bool, Float32, Int16, Int64
from hearthlog.schemas.errors import ConfigurationError, LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.files import AUDIO_LAYER, AUDIO_SUFFIX, audio_path, log_name
from hearthlog.schemas.logs.metadata import provenance
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, message, time_message
from hearthlog.schemas.messages.topics import audio_topic

_UNSURE_CONFIDENCE = 0.5
_UNSURE_NOVELTY = 0.7
_AFTER_FRAMES = NANOSECONDS // FRAME_NANOSECONDS


class KeptSound(NamedTuple):
    """Successive frames of a clip."""

    stamps: Int64  # [shape=(n,)] starts of the frames in nanoseconds of UTC
    samples: Int16  # [shape=(n, 800)]


class ClipFinder:
    """Buffers sound until it is decided whether to keep it: not private, and worth keeping.

    `PrivateFrames` decides which frames are private. `keep` is `events` (sound around every label
    other than silence), `unsure` (around labels of low confidence or high novelty) or `always`.
    `window_frames` is the length of a label's window, at least one second.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        keep: Keep,
        never: Sequence[str],
        pre_roll_frames: int,
        window_frames: int,
        late_frames: int = 0,
        most_ahead: int = 0,
    ) -> None:
        self._window = window_frames
        self._keep = keep
        self._guard = PrivateFrames(never, window_frames, most_ahead)
        # Frames kept before the frame of a label.
        self._before = 0 if keep == "always" else self._window - 1 + pre_roll_frames
        self._most_ahead = most_ahead
        self._ahead = max(self._before, self._window - 1 + late_frames) + most_ahead
        self._begin()

    def _begin(self) -> None:
        """Reset the buffers: `_private` covers the first buffered frames, `_worth` starts earlier.

        The frames of `_worth` before the buffer are decided; later frames are kept because of them.
        """
        self._next = -1
        self._samples: Int16 = np.empty((0, FRAME_SAMPLES), np.int16)
        self._stamps: Int64 = np.empty(0, np.int64)
        self._private: Bool = np.zeros(0, bool)
        self._worth: Bool = np.zeros(_AFTER_FRAMES, bool)

    def push(self, frames: Frames, labels: FrameLabels | None) -> list[KeptSound]:
        """Add frames and return the sound that is now certain to be kept.

        `labels` are those of the last of these frames; their classes include all that are never
        kept. Frames that do not follow the previous ones first decide these, as `close` does.
        """
        sounds = []
        if frames.first != self._next:
            sounds = self.close()
        self._next = frames.first + len(frames.samples)
        self._append(frames, labels)
        return [*sounds, *self._decide(len(self._samples) - self._ahead)]

    def close(self) -> list[KeptSound]:
        """Return the buffered sound to keep at the end of a stream, and reset."""
        self._private = np.append(self._private, self._guard.close())
        self._worth = np.append(self._worth, np.zeros(self._ahead, bool))
        sounds = self._decide(len(self._samples))
        self._begin()
        return sounds

    def _append(self, frames: Frames, labels: FrameLabels | None) -> None:
        count = len(frames.samples)
        self._worth = np.append(self._worth, np.zeros(count, bool))
        if labels is not None and len(labels.novelty):
            end = len(self._worth) - min(labels.ahead, self._most_ahead)
            self._worth[max(end - len(labels.novelty), 0) : end] = self._judge(labels)
        self._samples = np.concatenate([self._samples, _pcm(frames.samples)])
        self._stamps = np.append(self._stamps, frames.stamps)
        self._private = np.append(self._private, self._guard.push(count, labels))

    def _judge(self, labels: FrameLabels) -> Bool:
        """Return whether each window is worth keeping."""
        if self._keep == "unsure":
            unsure: Bool = labels.novelty > _UNSURE_NOVELTY
            if not labels.calibrated_elsewhere:
                unsure |= labels.probabilities.max(axis=1) < _UNSURE_CONFIDENCE
            return unsure
        loud = np.array([class_name(name) != SILENCE for name in labels.classes])
        return loud[labels.probabilities.argmax(axis=1)]

    def _decide(self, count: int) -> list[KeptSound]:
        """Decide on the first `count` buffered frames."""
        if count <= 0:
            return []
        kept = ~self._private[:count]
        if self._keep != "always":
            around = self._worth[: _AFTER_FRAMES + count + self._before]
            kept &= sliding_window_view(around, _AFTER_FRAMES + self._before + 1).any(axis=1)
        edges = np.flatnonzero(np.diff(kept, prepend=False, append=False))
        sounds = [
            KeptSound(self._stamps[start:end], self._samples[start:end])
            for start, end in edges.reshape(-1, 2).tolist()
        ]
        self._samples, self._stamps = self._samples[count:], self._stamps[count:]
        self._private, self._worth = self._private[count:], self._worth[count:]
        return sounds


def _pcm(samples: Float32) -> Int16:
    return np.clip(np.rint(samples * 32768.0), -32768, 32767).astype(np.int16)


_EVERY = 3600 * NANOSECONDS


class ClipRetention:
    """Deletes clips once an hour: layers older than `days`, counted in recorded days."""

    def __init__(self, root: Path, node: str, days: int) -> None:
        self._root = root
        self._node = node
        self._days = days
        self._last: int | None = None

    def tick(self, now: int) -> list[Notice]:
        """Delete old clips, at most once an hour; report their number and the first failure."""
        if self._last is not None and abs(now - self._last) < _EVERY:
            return []
        self._last = now
        deleted = 0
        failures: list[OSError] = []
        days = recorded_days(self._root, self._node)
        for layer, start in find_clips(self._root, self._node, failures):
            if days.since(start) >= self._days:
                try:
                    layer.unlink()
                    deleted += 1
                except OSError as error:
                    failures.append(error)
        notices = []
        if deleted:
            text = f"clips of {deleted} logs deleted: they were {self._days} days old"
            notices.append(Notice(OK, text))
        if failures:
            more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
            first = f"{failures[0].filename}: {failures[0].strerror}"
            text = f"clips cannot be listed or deleted: {first}{more}"
            notices.append(Notice(WARNING, text))
        return notices


def find_clips(root: Path, node: str, failures: list[OSError]) -> Iterator[tuple[Path, int]]:
    """Yield the audio layers of a node, also damaged ones, and starts in nanoseconds of UTC."""
    for folder, files in walk(root, failures):
        for file in files:
            name = file.removesuffix(".damaged")
            if not name.endswith(AUDIO_SUFFIX) or log_name(Path(name)).layer != AUDIO_LAYER:
                continue
            if (start := start_of(name, node)) is not None:
                yield folder / file, start


_MESSAGE_FRAMES = NANOSECONDS // FRAME_NANOSECONDS
_SAMPLE_BYTES = 2
_FRAME_BYTES = FRAME_SAMPLES * _SAMPLE_BYTES
_MINUTE_FRAMES = 60 * NANOSECONDS // FRAME_NANOSECONDS
_MEGABYTE = 1_000_000
_LONGEST_FILE = 86_400 * NANOSECONDS
_LONGEST_HELD = 60 * NANOSECONDS  # pre-roll, one second and a block of frames


CLIPS_AGAIN = Notice(OK, "clips are kept again")
_ALL_KEPT = "minutes of this day are kept already"


class ClipWriter:
    """Writes clips to layers, within the daily minutes and the free space of the disk.

    Errors become notices and are never raised, so that the logs continue. `file_at` maps a time in
    nanoseconds of UTC to its log and that log's end, as `RollingLog.file_at`.
    """

    def __init__(
        self,
        settings: Settings,
        microphones: Sequence[str],
        file_at: Callable[[int], tuple[Path, int]],
    ) -> None:
        self._settings = settings
        self._topics = {name: audio_topic(name) for name in microphones}
        self._file_at = file_at
        self._zone = time_zone(settings.timezone)
        self._log: Path | None = None
        self._writer: LogWriter | None = None
        self._rolled: int | None = None  # time at which the next log was noticed
        self._broken = ""  # why the layer of this log cannot be written
        self._stopped = ""
        self._day = range(0)
        self._used = 0  # frames kept of the day
        self.kept_frames = 0

    def write(self, microphone: str, sounds: Sequence[KeptSound]) -> list[Notice]:
        """Append sound to the layers of its logs; report when clips stop and continue."""
        notices = []
        for sound in sounds:
            first = 0
            while first < len(sound.stamps):
                log, until = self._file_at(int(sound.stamps[first]))
                split = int(sound.stamps.searchsorted(until))
                last = min(max(split, first + 1), first + _MESSAGE_FRAMES)
                part = KeptSound(sound.stamps[first:last], sound.samples[first:last])
                notices += self._write(log, microphone, part)
                first = last
        return notices

    def tick(self, now: int) -> list[Notice]:
        """Complete the layer of an ended log, once none of its sound is still buffered."""
        if self._writer is None or self._file_at(now)[0] == self._log:
            self._rolled = None
        elif self._rolled is None:
            self._rolled = now
        elif abs(now - self._rolled) > _LONGEST_HELD:
            return self.finish()
        return []

    def finish(self) -> list[Notice]:
        """Complete the open layer."""
        writer, self._writer = self._writer, None
        if writer is None:
            return []
        try:
            writer.finish()
        except OSError as error:
            writer.abandon()
            return self._report(f"their layer cannot be completed ({error.strerror or error})")
        return []

    def _write(self, log: Path, microphone: str, sound: KeptSound) -> list[Notice]:
        notices = []
        if log != self._log:
            notices = self.finish()
            self._log, self._broken = log, ""
        reason = self._broken or self._full(int(sound.stamps[0]), len(sound.stamps))
        if not reason:
            reason = self._broken = self._append(log, self._topics[microphone].name, sound)
        return [*notices, *self._report(reason)]

    def _report(self, reason: str) -> list[Notice]:
        """Report a change of the reason for writing no clips; an empty reason means recovery."""
        if reason == self._stopped:
            return []
        self._stopped = reason
        if not reason:
            return [CLIPS_AGAIN]
        # A configured limit is no fault.
        return [Notice(OK if reason.endswith(_ALL_KEPT) else WARNING, f"no clips: {reason}")]

    def _append(self, log: Path, topic: str, sound: KeptSound) -> str:
        """Write one message; return the reason for a failure, or an empty text."""
        start = int(sound.stamps[0])
        data = encode(
            message(
                message_types.RAW_AUDIO,
                timestamp=time_message(start),
                data=sound.samples.astype("<i2").reshape(-1).view("u1"),
                format="pcm-s16",
                sample_rate=SAMPLE_RATE,
                number_of_channels=1,
            )
        )
        try:
            if self._writer is None:
                self._writer = LogWriter(
                    audio_path(log), list(self._topics.values()), self._metadata(log)
                )
            self._writer.write(topic, start, data)
            self._writer.flush()
        except (OSError, LogError) as error:
            if self._writer is not None:
                self._writer.abandon()
                self._writer = None
            return f"{audio_path(log)} cannot be written ({getattr(error, 'strerror', 0) or error})"
        self._used += len(sound.stamps)
        self.kept_frames += len(sound.stamps)
        return ""

    def _metadata(self, log: Path) -> dict[str, str]:
        return provenance(
            self._settings.node,
            log=log.name,
            keep_audio=self._settings.keep_audio,
            never_keep=json.dumps(self._settings.never_keep),
            limit=str(PRIVATE_LIMIT),
            limit_elsewhere=str(PRIVATE_LIMIT_ELSEWHERE),
        )

    def _full(self, stamp: int, frames: int) -> str:
        """Return why so many frames may not be written now, or an empty text."""
        if stamp not in self._day:
            self._begin_day(stamp)
        minutes = self._settings.clip_minutes_a_day
        if self._used + frames > minutes * _MINUTE_FRAMES:
            self._used = minutes * _MINUTE_FRAMES  # refuse shorter sounds too
            return f"{minutes} {_ALL_KEPT}"
        least = self._settings.clip_min_free_space
        try:
            free = shutil.disk_usage(self._settings.output).free
        except OSError as error:
            return f"{self._settings.output}: {error.strerror}"
        return f"less than {least} MB are free on the disk" if free < least * _MEGABYTE else ""

    def _begin_day(self, stamp: int) -> None:
        """Count the frames already kept on the local day that contains a time."""
        day = datetime.fromtimestamp(stamp // NANOSECONDS, self._zone).date()
        begin, end = (
            int(datetime.combine(day + timedelta(days), time(), self._zone).timestamp())
            * NANOSECONDS
            for days in (0, 1)
        )
        self._day = range(begin, end)
        self._used = 0
        for layer, start in find_clips(self._settings.output, self._settings.node, []):
            if begin - _LONGEST_FILE < start < end:
                self._used += _frames_in(layer, begin, end)
        if self._writer is not None:
            self._used += _frames_in(self._writer.active_path, begin, end)


def _frames_in(layer: Path, start: int, end: int) -> int:
    """Count the frames of a layer between two times; 0 if the layer is unreadable."""
    try:
        with LogFile(layer) as file:
            chunks = file.chunks
    except LogError:
        return 0
    inside = (chunks["start"] >= start) & (chunks["start"] < end)
    return int(chunks["size"][inside].sum()) // _FRAME_BYTES


class ClipRecorder:
    """Writes the clips of a recording, if configured, and always deletes old clips.

    `file_at` is as in `ClipWriter`. Raise `ConfigurationError` if sound is to be kept and a model
    lacks a class that must not be kept.
    """

    def __init__(
        self,
        settings: Settings,
        pipelines: Sequence[Pipeline],
        file_at: Callable[[int], tuple[Path, int]],
    ) -> None:
        self._retention = ClipRetention(
            settings.output, settings.node, settings.clip_retention_days
        )
        names = [pipeline.microphone for pipeline in pipelines]
        self._writer = ClipWriter(settings, names, file_at)
        self._microphones = {
            pipeline.microphone: _MicrophoneClips(settings, pipeline, self._writer)
            for pipeline in pipelines
        }

    @property
    def kept_frames(self) -> int:
        """Number of frames kept."""
        return self._writer.kept_frames

    def before(self, microphone: str, event: Event) -> list[Notice]:
        """Prepare for an event about to be logged: a gap ends the sound before it."""
        return self._microphones[microphone].close() if isinstance(event, Gap) else []

    def after(self, microphone: str, event: Event, labels: FrameLabels | None) -> list[Notice]:
        """Keep the sound of a logged event, and delete old clips; report failures and deletions."""
        now = event_time(event)
        notices = [*self._retention.tick(now), *self._writer.tick(now)]
        if isinstance(event, Frames):
            notices += self._microphones[microphone].push(event, labels)
        return notices

    def finish(self) -> list[Notice]:
        """Write the remaining sound, and complete the layer."""
        notices = [notice for each in self._microphones.values() for notice in each.close()]
        return [*notices, *self._writer.finish()]


class _MicrophoneClips:
    """Selects the clips of one microphone."""

    def __init__(self, settings: Settings, pipeline: Pipeline, writer: ClipWriter) -> None:
        self._keep = settings.keep_audio
        self._never = settings.never_keep
        self._microphone = pipeline.microphone
        self._writer = writer
        frames = round(settings.clip_pre_roll_seconds * NANOSECONDS / FRAME_NANOSECONDS)
        self._finder = ClipFinder(
            self._keep,
            self._never,
            frames,
            pipeline.feature_set.window_frames,
            TOGETHER if settings.privacy else 0,
            pipeline.most_ahead,
        )
        self._classes: Sequence[str] | None = pipeline.classes
        self._refused = self._refusal()  # why no sound may be kept, or empty
        if self._refused:
            raise ConfigurationError(self._refused)

    def close(self) -> list[Notice]:
        """Write the buffered sound."""
        if self._refused or self._keep == "off":
            return []
        return self._writer.write(self._microphone, self._finder.close())

    def push(self, frames: Frames, labels: FrameLabels | None) -> list[Notice]:
        """Add frames and write the sound to keep."""
        if self._keep == "off":
            return []
        notices = []
        if labels is not None and labels.classes != self._classes:
            notices = self._change_classes(labels.classes)
        if not self._refused:
            notices += self._writer.write(self._microphone, self._finder.push(frames, labels))
        return notices

    def _change_classes(self, classes: Sequence[str]) -> list[Notice]:
        """Continue with another model; stop clips if it lacks a class that is never kept."""
        before, self._classes = self._refused, classes
        self._refused = self._refusal()
        if self._refused == before:
            return []
        if not self._refused:
            return [CLIPS_AGAIN]
        notices = self._writer.write(self._microphone, self._finder.close())
        return [*notices, Notice(WARNING, f"no clips: {self._refused}")]

    def _refusal(self) -> str:
        """Return why no sound may be kept, or an empty text."""
        if self._keep == "off":
            return ""
        problem = f'keep_audio = "{self._keep}" needs a model'
        classes = self._classes or ()
        missing = [name for name in self._never if name not in classes]
        if missing:
            names = ", ".join(repr(name) for name in missing)
            what = f"this one has the classes {', '.join(classes)}" if classes else "there is none"
            return (
                f"{problem} with the class {names}, which is never kept ({what}); use such a "
                "model, or set never_keep = [] to keep that too"
            )
        if not classes and self._keep != "always":
            return f"{problem} to select the sound; name one, or use keep_audio = always"
        return ""
