"""Logs as the live recorder leaves them: unfinished, completed, and finished; and days of them."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from threading import Event as Flag
from typing import NamedTuple

from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Event, Frames, SoundSource
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.salvage.recover import recover_log

_MIDNIGHT = 1_772_323_200 * NANOSECONDS
_BLOCK = 10  # frames that the capture hands over at once


class LiveLogs(NamedTuple):
    """One recording in the three states of its file.

    Attributes
    ----------
    unfinished : Path
        As it is while it is written, with chunks of half a second.
    completed : Path
        The same with an index, as it stays where there is no room for a copy.
    finished : Path
        Written anew in chunks of ten seconds.
    """

    unfinished: Path
    completed: Path
    finished: Path


class _Blocks:
    """Sound of a file, handed over as that of a microphone is; in the end the log is copied."""

    def __init__(self, source: FileSource, logs: Path, copy: Path) -> None:
        self.device = source.device
        self._source = source
        self._logs = logs
        self._copy = copy

    def events(self, stop: Flag) -> Iterator[Event]:
        for event in self._source.events(stop):
            if not isinstance(event, Frames):
                yield event
                continue
            for start in range(0, len(event.stamps), _BLOCK):
                part = slice(start, start + _BLOCK)
                yield Frames(event.first + start, event.samples[part], event.stamps[part])
        (active,) = self._logs.rglob("*.active")
        self._copy.mkdir(parents=True)
        shutil.copy(active, self._copy)


def record_as_live(folder: Path, sound: Path, model: Path) -> LiveLogs:
    """Record a file of up to an hour as if a microphone had heard it.

    Parameters
    ----------
    folder : Path
        Where folders `unfinished`, `completed` and `finished` are made.
    sound, model : Path
        Files.
    """
    places = [folder / name for name in LiveLogs._fields]
    source = _Blocks(FileSource([sound], _MIDNIGHT), places[2], places[0])
    finished = _recorded(source, places[2], model)
    (unfinished,) = places[0].iterdir()
    completed = places[1] / finished.relative_to(places[2])
    completed.parent.mkdir(parents=True)
    recover_log(unfinished, completed, completed.name)
    return LiveLogs(unfinished, completed, finished)


def record_file(folder: Path, sound: Path, model: Path) -> Path:
    """Record a file of up to an hour, and return its finished log.

    Parameters
    ----------
    folder : Path
        Of the logs.
    sound, model : Path
        Files.
    """
    return _recorded(FileSource([sound], _MIDNIGHT), folder, model)


def _recorded(source: SoundSource, folder: Path, model: Path) -> Path:
    settings = Settings(output=folder, model=model, timezone="UTC")
    finished, *later = record(settings, source, Flag()).logs
    for log in later:  # the end of the last segment, if that is that of the hour
        log.unlink()
    return finished
