"""Audio files as a sound source."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path
from threading import Event as Flag
from typing import NamedTuple

import numpy as np

from hearthlog.recorder.events import (
    OK,
    READING,
    WARNING,
    Event,
    Frames,
    Gap,
    SourceHealth,
)
from hearthlog.recorder.sources.decoding import check_channels, read_audio
from hearthlog.recorder.sources.file_times import FileTime
from hearthlog.recorder.sources.framing import check_times, frames_of
from hearthlog.recorder.sources.open_audio import audio_seconds, is_audio
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import Progress, SourceError, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE

_REALTIME_FRAMES = 10
_HEALTH_FRAMES = 200  # every 10 s
_LONG_FRAMES = 6 * _HEALTH_FRAMES  # a block's overhead is a fifth of the cost of 10 s
_NAMED = 10  # damaged files listed
_NO_NUMBERS = "samples are not finite (NaN or infinity)"


class FileSource:
    """Several audio files in a row, as one stream of frames.

    Trailing samples that do not fill a frame are dropped.

    Raise `SourceError` if a file is missing, is not audio, is empty, has an unsupported sample
    rate, other channels than the array, or not the selected one; if the times are out of the range
    of a log.

    Parameters
    ----------
    start : int
        Time of the first sample in nanoseconds of UTC.
    times : sequence of (FileTime or None), optional
        Start of each file, from `arrange`; None, or no sequence: the end of the previous file. A
        later start makes a gap; an earlier one is ignored, and the file follows.
    realtime : bool
        Whether to yield frames in real time.
    channels : int or None
        Channels of an array, which the files must have; None: mixed to one, as by `read_audio`.
    channel : int or None
        Selected channel, counted from 1.
    progress : callable
        Called with the share of the sound read so far, 0 to 1.
    """

    def __init__(  # noqa: PLR0913
        self,
        paths: Sequence[Path],
        start: int,
        *,
        times: Sequence[FileTime | None] = (),
        realtime: bool = False,
        channels: int | None = None,
        channel: int | None = None,
        progress: Progress = ignore_progress,
    ) -> None:
        for path in paths:
            check_channels(path, channels, channel)
        lengths = [audio_seconds(path) for path in paths]
        self._seconds = sum(lengths)
        self._times = list(times) or [None] * len(paths)
        last = max((time.start for time in self._times if time), default=start)
        check_times(start, last + int(self._seconds * NANOSECONDS))
        self.device = _name(paths)
        self.frames = 0
        self._faults: list[str] = []
        self._overlaps: list[tuple[float, Path]] = []  # seconds, and the file with the early start
        self._choices: list[str] = []  # selected channels of files
        self._hole_seconds = 0.0
        self._paths = paths
        self._start = start
        self.realtime = realtime
        self.joins_blocks = False
        self._channels = channels
        self._channel = channel
        self._problem = ""
        self._changes: list[str] = []  # of the problem since it was reported
        self._progress = progress

    @property
    def warnings(self) -> list[str]:
        """Parts of the files that were skipped or shifted in time, so far."""
        lines = list(self._choices)
        if self._hole_seconds:
            lines.append(f"{self.device}: {self._hole_seconds:.2f} s are left out: {_NO_NUMBERS}")
        lines += [f"{fault}; the readable part was recorded" for fault in self._faults[:_NAMED]]
        if len(self._faults) > _NAMED:
            lines.append(f"{len(self._faults) - _NAMED:,} more files are damaged or cut short")
        if self._overlaps:
            count = len(self._overlaps)
            files = "1 file begins" if count == 1 else f"{count:,} files begin"
            lines.append(
                f"{files} before the end of the one before, up to {max(self._overlaps)[0]:.1f} s, "
                f"first {self._overlaps[0][1]}: logged behind each other, so that their times are "
                "later than they say"
            )
        return lines

    def events(self, stop: Flag) -> Iterator[Event]:
        """Yield frames, gaps between files, and health after every ten seconds of sound.

        With `joins_blocks`, as of `long_blocks`. Raise `SourceError` if a file cannot be opened any
        more, or if all files together are shorter than a frame.
        """
        events = self._events(stop)
        return long_blocks(events) if self.joins_blocks else events

    def _events(self, stop: Flag) -> Iterator[Event]:
        began = time.monotonic()
        next_frame, end, report = 0, self._start, 0
        for item in _finite_runs(takewhile(lambda _: not stop.is_set(), self._frames())):
            if isinstance(item, _Pause | _Hole):
                until = item.until if isinstance(item, _Pause) else end + item.nanoseconds
                lost = max(round((until - end) / FRAME_NANOSECONDS), 1)
                if isinstance(item, _Hole):
                    self._hole_seconds += item.nanoseconds / NANOSECONDS
                yield Gap(end, until, item.reason, lost)
                next_frame, end = next_frame + lost, until
                continue
            stamps = end + np.arange(len(item)) * FRAME_NANOSECONDS
            frames = frames_of(next_frame, item, stamps)
            if self.realtime:
                due = began + (self.frames + len(item)) * FRAME_NANOSECONDS / NANOSECONDS
                stop.wait(max(due - time.monotonic(), 0.0))
            if stop.is_set():
                return
            if self.frames >= report:
                for problem in self._changes or [self._problem]:
                    health = (WARNING, problem) if problem else (OK, READING)
                    yield SourceHealth(int(stamps[0]), *health, {"device": self.device})
                self._changes = []
                report = self.frames + _HEALTH_FRAMES
            yield frames
            next_frame += len(item)
            end += len(item) * FRAME_NANOSECONDS
            self.frames += len(item)
            self._progress(min(self.frames * FRAME_NANOSECONDS / NANOSECONDS / self._seconds, 1.0))
        if not self.frames and not stop.is_set():
            files = ", ".join(str(path) for path in self._paths)
            what = _NO_NUMBERS if self._hole_seconds else "shorter than one frame of 50 ms"
            raise SourceError("; ".join(self._faults) or f"{files}: {what}")

    def _frames(self) -> Iterator["Float32 | _Pause"]:
        """Yield blocks with a number of frames that divides the interval of the health reports."""
        size = (_REALTIME_FRAMES if self.realtime else _HEALTH_FRAMES) * FRAME_SAMPLES
        shape = () if self._channels is None else (self._channels,)
        held = np.empty((0, *shape), np.float32)
        samples, begin, before = 0, self._start, ""  # since the last gap
        for path, moment in zip(self._paths, self._times, strict=True):
            end = begin + samples * NANOSECONDS // SAMPLE_RATE
            if before and moment is not None and self._is_later(path, moment, end):
                rest = len(held) - len(held) % FRAME_SAMPLES
                if rest:
                    yield held[:rest].reshape(-1, FRAME_SAMPLES, *shape)
                yield _Pause(moment.start, f"between the files {before} and {_text(path)}")
                held, samples, begin = held[:0], 0, moment.start
            before = _text(path)
            self._problem = ""
            blocks = read_audio(
                path,
                channels=self._channels,
                channel=self._channel,
                incomplete=self._faults.append,
                chosen=partial(self._choose, path),
            )
            for block in blocks:
                samples += len(block)
                held = np.concatenate([held, block]) if len(held) else block
                full = len(held) - len(held) % size
                for start in range(0, full, size):
                    yield held[start : start + size].reshape(-1, FRAME_SAMPLES, *shape)
                held = held[full:]
        rest = len(held) - len(held) % FRAME_SAMPLES
        if rest:
            yield held[:rest].reshape(-1, FRAME_SAMPLES, *shape)

    def _choose(self, path: Path, sentence: str) -> None:
        """Record which channels of a file are selected; an empty text is the default."""
        self._problem = sentence
        self._changes.append(sentence)
        if sentence and (choice := f"{path}: {sentence}") not in self._choices:
            self._choices.append(choice)

    def _is_later(self, path: Path, moment: FileTime, end: int) -> bool:
        """Whether a file begins after the end of the previous files, by more than the time step."""
        late = moment.start - end
        step = max(moment.step, FRAME_NANOSECONDS)
        if late <= -step:
            self._overlaps.append((-late / NANOSECONDS, path))
        return late >= step


def long_blocks(events: Iterator[Event]) -> Iterator[Event]:
    """Join frames to blocks of a minute, with the reports between as `reports`.

    Pending events come before an error.
    """
    held = list[Frames | SourceHealth]()
    frames = 0
    try:
        for event in events:
            if isinstance(event, Frames):
                frames += len(event.stamps)
            elif isinstance(event, Gap) or not held:
                yield from _joined(held)
                held, frames = [], 0
                yield event
                continue
            held.append(event)
            if frames >= _LONG_FRAMES:
                yield from _joined(held)
                held, frames = [], 0
    except SourceError:
        yield from _joined(held)
        raise
    yield from _joined(held)


def _joined(events: Sequence[Frames | SourceHealth]) -> Iterator[Event]:
    """Yield frames as one block with the reports between them, then the reports after them."""
    blocks = [event for event in events if isinstance(event, Frames)]
    reports = [event for event in events if isinstance(event, SourceHealth)]
    if blocks:
        end = int(blocks[-1].stamps[-1])
        within = tuple(report for report in reports if report.stamp <= end)
        reports = reports[len(within) :]
        channels = [block.channels for block in blocks if block.channels is not None]
        yield Frames(
            blocks[0].first,
            np.concatenate([block.samples for block in blocks]),
            np.concatenate([block.stamps for block in blocks]),
            np.concatenate(channels) if channels else None,
            within,
        )
    yield from reports


class _Pause(NamedTuple):
    """Time between two files."""

    until: int  # in nanoseconds of UTC
    reason: str


class _Hole(NamedTuple):
    """Frames of a file with NaN or infinity."""

    nanoseconds: int
    reason: str = _NO_NUMBERS


def _finite_runs(blocks: Iterator[Float32 | _Pause]) -> Iterator[Float32 | _Pause | _Hole]:
    """Replace frames with NaN by holes."""
    lost = 0  # frames of a hole that may go on
    for block in blocks:
        for run in [block] if isinstance(block, _Pause) else _runs(block):
            if not isinstance(run, _Pause) and np.isnan(run).any():
                lost += len(run)
                continue
            if lost:
                yield _Hole(lost * FRAME_NANOSECONDS)
                lost = 0
            yield run
    if lost:
        yield _Hole(lost * FRAME_NANOSECONDS)


def _runs(block: Float32) -> list[Float32]:
    """Split frames at the borders of finite and other frames."""
    is_hole = np.isnan(block).reshape(len(block), -1).any(axis=1)
    return np.split(block, np.flatnonzero(np.diff(is_hole)) + 1) if is_hole.any() else [block]


def find_audio(
    paths: Sequence[Path], check: Callable[[Path], object] = str
) -> tuple[list[Path], list[str]]:
    """Replace folders by the audio files below them, in the order of names, without hidden ones.

    Raise `SourceError` if a folder has no readable audio.
    """
    found: list[Path] = []
    refused: list[str] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        inside = []
        for file in filter(lambda file: is_audio(file.name), files_below(path)):
            try:
                check_channels(file, None)
                check(file)
                inside.append(file)
            except SourceError as error:
                refused.append(f"left out: {error}")
        if not inside:
            more = f" ({refused[-1]})" if refused else ", such as a.wav or a.flac"
            raise SourceError(f"{path}: no readable audio file in this folder{more}")
        found += inside
    return found, refused


def files_below(folder: Path) -> Iterator[Path]:
    """Yield all files below a folder, following links, sorted by folder, without hidden folders."""
    seen: set[tuple[int, int]] = set()
    for parent, folders, names in os.walk(folder, followlinks=True):
        status = Path(parent).stat()
        if (status.st_dev, status.st_ino) in seen:  # a link that leads back
            folders.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (Path(parent, name) for name in sorted(names))


def _name(paths: Sequence[Path]) -> str:
    """Name the files briefly, as every diagnostic message repeats the name."""
    if len(paths) == 1:
        return _text(paths[0])
    return f"{_text(paths[0])} … {_text(paths[-1])} ({len(paths)} files)"


def _text(path: Path) -> str:
    """Return the name of a file as valid UTF-8 for the log."""
    return path.name.encode(errors="replace").decode()
