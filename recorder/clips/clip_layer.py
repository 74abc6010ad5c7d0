"""Clips on the disk: layers of sound beside the logs."""

import json
import shutil
from collections.abc import Callable, Sequence
from datetime import datetime, time, timedelta
from pathlib import Path

from hearthlog.recorder.clips.clip_choice import KeptSound
from hearthlog.recorder.clips.clip_retention import find_clips
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import OK, WARNING, Notice
from hearthlog.recorder.stream.private_frames import PRIVATE_LIMIT, PRIVATE_LIMIT_ELSEWHERE
from hearthlog.recorder.timezone import time_zone
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.files import audio_path
from hearthlog.schemas.logs.metadata import provenance
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, message, time_message
from hearthlog.schemas.messages.topics import audio_topic

_MESSAGE_FRAMES = NANOSECONDS // FRAME_NANOSECONDS
_SAMPLE_BYTES = 2
_FRAME_BYTES = FRAME_SAMPLES * _SAMPLE_BYTES
_MINUTE_FRAMES = 60 * NANOSECONDS // FRAME_NANOSECONDS
_MEGABYTE = 1_000_000
_LONGEST_FILE = 86_400 * NANOSECONDS
_LONGEST_HELD = 60 * NANOSECONDS  # a pre-roll, a second, a block of frames


CLIPS_AGAIN = Notice(OK, "clips are kept again")
_ALL_KEPT = "minutes of this day are kept already"


class ClipWriter:
    """Writes sound into layers, as long as the day's minutes and the disk allow.

    Whatever happens here, the logs go on: errors become notices and are not raised.

    Parameters
    ----------
    file_at : callable
        Told a time in nanoseconds of UTC; returns the log that contains it, and the end of that
        log; see `RollingLog.file_at`.
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
        self._rolled: int | None = None  # when the next log had begun
        self._broken = ""  # why the layer of this log cannot be written
        self._stopped = ""
        self._day = range(0)
        self._used = 0  # frames kept of the day
        self.kept_frames = 0

    def write(self, microphone: str, sounds: Sequence[KeptSound]) -> list[Notice]:
        """Append sound to the layers of the logs that contain its time.

        Returns
        -------
        list of Notice
            One when sound begins to be refused, and one when it is kept again.
        """
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
        """Complete the layer of a log that has ended, once no sound of it is held back."""
        if self._writer is None or self._file_at(now)[0] == self._log:
            self._rolled = None
        elif self._rolled is None:
            self._rolled = now
        elif abs(now - self._rolled) > _LONGEST_HELD:
            return self.finish()
        return []

    def finish(self) -> list[Notice]:
        """Complete the layer that is open."""
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
        """Report why no sound is kept (or that it is), if that is new."""
        if reason == self._stopped:
            return []
        self._stopped = reason
        if not reason:
            return [CLIPS_AGAIN]
        # What the configuration asks for is no trouble.
        return [Notice(OK if reason.endswith(_ALL_KEPT) else WARNING, f"no clips: {reason}")]

    def _append(self, log: Path, topic: str, sound: KeptSound) -> str:
        """Write one message; return why that failed, or an empty text."""
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
            self._used = minutes * _MINUTE_FRAMES  # so that no shorter sound is written either
            return f"{minutes} {_ALL_KEPT}"
        least = self._settings.clip_min_free_space
        try:
            free = shutil.disk_usage(self._settings.output).free
        except OSError as error:
            return f"{self._settings.output}: {error.strerror}"
        return f"less than {least} MB are free on the disk" if free < least * _MEGABYTE else ""

    def _begin_day(self, stamp: int) -> None:
        """Count the frames that are kept already of the home's day that contains a time."""
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
    """Count the frames of a layer between two times; none if it cannot be read."""
    try:
        with LogFile(layer) as file:
            chunks = file.chunks
    except LogError:
        return 0
    inside = (chunks["start"] >= start) & (chunks["start"] < end)
    return int(chunks["size"][inside].sum()) // _FRAME_BYTES
