"""Replay of logs through the pipeline, from features or clips."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Event as Flag

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.clips import read_clips
from hearthlog.analyzer.logs.recorder_info import RecorderInfo, read_recorder_infos
from hearthlog.analyzer.relabel.player import Player, Replay, ReplayOptions
from hearthlog.analyzer.relabel.recorded import read_recorded
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile import SUFFIX, load_model
from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.sources.framing import FrameCutter
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import LogError, ModelError, Progress, ignore_progress, listed
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.merged_reading import time_spans
from hearthlog.schemas.messages.topics import topic

_NEVER = (1 << 63) - 1


class LogSet:
    """Logs of one microphone, in the order of their first messages.

    Layers and empty logs among the paths are skipped; the name of the microphone is None if there
    is only one. `first` and `last` are log times of messages, in nanoseconds of UTC. Raise
    `LogError` if the logs hold no message, or one is damaged.
    """

    def __init__(self, paths: Sequence[Path], kind: str, microphone: str | None = None) -> None:
        spans = time_spans(paths)
        if not spans:
            raise LogError(f"{paths[0]}: no messages, nothing to replay")
        self.kind = kind
        self.first, self.last = spans[0][0], max(last for _, last, _ in spans)
        self._spans = spans
        self._microphone = microphone
        self._infos: dict[Path, list[RecorderInfo]] = {}

    def span(self, options: ReplayOptions) -> tuple[int, int]:
        """Return the replayed span in log times (nanoseconds of UTC), the end excluded.

        The end is the largest 64-bit number without a duration.
        """
        start = self.first + round(options.start_offset * NANOSECONDS)
        if options.duration is None:
            return start, _NEVER
        return start, min(start + round(options.duration * NANOSECONDS), _NEVER)

    def chosen(self, options: ReplayOptions) -> list[RecorderInfo]:
        """Return the logs to replay, at least one, in the order of their first messages.

        Raise `LogError` if there is none, and as `between`.
        """
        infos = self.between(*self.span(options))
        if not infos:
            raise self.nothing()
        return infos

    def nothing(self) -> LogError:
        """Make the error for an empty replay."""
        what = "clips" if self.kind == "audio" else "features"
        there = sorted({info.microphone for infos in self._infos.values() for info in infos})
        if self._microphone is not None and there and self._microphone not in there:
            return LogError(
                f"no microphone is called {self._microphone!r} there; choose {listed(there)}"
            )
        seconds = (self.last - self.first) / NANOSECONDS
        return LogError(f"no {what} to replay there; the logs last {seconds:.1f} s")

    def between(self, start: int, end: int) -> list[RecorderInfo]:
        """Return the logs with messages in a span, in the order of their first messages.

        Logs that lack the replayed kind are left out. The span has log times in nanoseconds of UTC,
        the end excluded. Raise `LogError` if they are of several microphones or nodes, or one is
        damaged or listed twice.
        """
        infos: list[RecorderInfo] = []
        for first, last, path in self._spans:
            if first < end and last >= start:
                if path not in self._infos:
                    self._infos[path] = read_recorder_infos(path, self.kind)
                infos += self._infos[path]
        if self._microphone is not None:
            infos = [info for info in infos if info.microphone == self._microphone]
        names = sorted({f"{info.node}/{info.microphone}" for info in infos})
        if len(names) > 1:
            raise LogError(
                f"{infos[0].path}: these logs are of several microphones ({', '.join(names)}); "
                "replay one at a time, with --microphone or by naming only its logs"
            )
        by_frame: dict[tuple[int, int], RecorderInfo] = {}
        for info in infos:
            if info.first_frame is not None:
                same = by_frame.setdefault(info.first_frame, info)
                if same is not info:
                    raise LogError(f"{same.path} and {info.path} hold the same; leave out one")
        return infos


_JOINED = 10_000_000  # maximum nanoseconds between contiguous clips
_REASON = "no clip holds it"


class ClipFramer:
    """Cuts clips into frames; contiguous clips are one sound.

    After a hole the next frame begins with the first sample of a clip. Samples before a hole that
    do not fill a frame are dropped.
    """

    def __init__(self) -> None:
        self._next_frame = 0
        self._end: int | None = None  # end of the last frame, in nanoseconds of UTC
        self._rate = 0  # of the contiguous clips; 0 before the first one
        self._samples = 0  # number of their samples
        self._frames = 0  # number of frames cut from them
        self._cutter = FrameCutter()
        # Starts of clips, in nanoseconds of their sound, and their offsets to UTC.
        self._starts: list[int] = []
        self._offsets: list[int] = []

    def add(self, start: int, rate: int, samples: Float32) -> Iterator[Frames | Gap]:
        """Add a clip by the time of its first sample (ns of UTC) and its samples per second.

        Yield, in time order, the last frames before a hole, the gap, and the frames of this clip.
        """
        if rate != self._rate or abs(start - self._expected()) > _JOINED:
            yield from self.finish()
            self._rate, self._samples, self._frames = rate, 0, 0
            self._starts, self._offsets = [], []
            self._cutter = FrameCutter(rate)
        position = self._position()
        self._starts.append(position)
        self._offsets.append(start - position)
        self._samples += len(samples)
        yield from self._events(self._cutter.push(samples))

    def finish(self) -> Iterator[Frames | Gap]:
        """Yield the last frames of the contiguous clips, and a gap before them."""
        yield from self._events(self._cutter.push(np.empty(0, np.float32), last=True))
        self._cutter = FrameCutter()

    def _position(self) -> int:
        """Return the length of the current contiguous clips, in nanoseconds."""
        return self._samples * NANOSECONDS // self._rate

    def _expected(self) -> int:
        return self._position() + self._offsets[-1]

    def _events(self, frames: Float32) -> Iterator[Frames | Gap]:
        count = len(frames)
        if not count:
            return
        stamps = self._stamps(count)
        if self._frames == 0 and self._end is not None:
            start, end = self._end, int(stamps[0])
            lost = max(round((end - start) / FRAME_NANOSECONDS), 1)
            self._next_frame += lost
            yield Gap(start, end, _REASON, lost)
        yield Frames(self._next_frame, frames, stamps)
        self._next_frame += count
        self._frames += count
        self._end = int(stamps[-1]) + FRAME_NANOSECONDS

    def _stamps(self, count: int) -> NDArray[np.int64]:
        """Return the start times of the next frames, each by its clip."""
        positions = (self._frames + np.arange(count)) * FRAME_NANOSECONDS
        clips = np.searchsorted(self._starts, positions, side="right") - 1
        stamps = positions + np.array(self._offsets)[clips]
        self._starts, self._offsets = self._starts[clips[-1] :], self._offsets[clips[-1] :]
        return stamps


_WARM_UP = 60 * NANOSECONDS
_LONGEST_NAME = 200


def find_recorded_model(name: str, sha256: str, folders: Sequence[Path]) -> Model | None:
    """Search folders for the model of a recording by its name: a file name without the suffix.

    None if no folder has it; unreadable files are skipped.
    """
    for folder in folders:
        path = folder / (name + SUFFIX)
        if len(name) > _LONGEST_NAME or path.parent != folder or not path.is_file():
            continue
        try:
            model = load_model(path)
        except ModelError:
            continue
        if model.sha256 == sha256:
            return model
    return None


def replay(
    logs: LogSet, options: ReplayOptions, stop: Flag, progress: Progress = ignore_progress
) -> Replay:
    """Run logs through the pipeline again.

    From features, the model of the recording gives its labels and segments bit for bit. If the
    replay starts later than the logs, the sound before it is processed as far as it affects the
    result, without logging. `progress` receives the replayed share, 0 to 1. Raise `LogError` if a
    log is damaged, or the logs are of several microphones, or of another feature set, or hold
    nothing to replay, or if the new log cannot be written: the part replayed before the error is a
    complete log.
    """
    start, end = logs.span(options)
    chosen = logs.chosen(options)
    result = Replay(
        sources=[info.path for info in chosen],
        unfinished=[info.path for info in chosen if not info.complete],
    )

    def report(time: int) -> None:
        progress(min((time - start) / max(min(end, logs.last) - start, 1), 1.0))

    def new_player() -> Player:
        return Player(options, start, result, stop, report)

    while not stop.is_set():
        if logs.kind == "audio":
            player = new_player()  # frames are counted, and cut, from the first clip on
        else:
            player = _warmed_up(logs, start, new_player, result)
        try:
            if logs.kind == "audio":
                _play_clips(logs, player, end)
            else:
                _play_features(logs, player, start, end, compare=True)
        except BaseException as error:
            player.finish(cut=True)
            if isinstance(error, LogError) and result.logs:
                raise LogError(f"{error}; up to there it is in {options.output}") from error
            raise
        player.finish(cut=result.interrupted or end <= logs.last)
        if not (options.loop and result.frames):
            break
    result.interrupted = result.interrupted and not options.loop
    if not result.frames and not stop.is_set():
        raise logs.nothing()
    return result


def _warmed_up(
    logs: LogSet, start: int, new_player: Callable[[], Player], result: Replay
) -> Player:
    """Return a player whose state at a time is the same as after playing all earlier sound."""
    back = _WARM_UP
    while True:
        player = new_player()
        begin = max(start - back, logs.first)
        _play_features(logs, player, begin, start, compare=False)
        if begin == logs.first or player.converged:
            if player.missing_before and not player.converged:
                result.missing.append(start)
            return player
        back *= 2


def _play_features(logs: LogSet, player: Player, start: int, end: int, *, compare: bool) -> None:
    for info in logs.between(start, end):
        player.open(info)
        for batch in read_recorded(info, start, end):
            continues = all(player.push(event) for event in batch.events)
            if compare:
                player.compare(batch)
            if not continues:
                return


def _play_clips(logs: LogSet, player: Player, end: int) -> None:
    infos = logs.between(logs.first, end)
    player.open(infos[0])
    for event in _clip_events(infos):
        if isinstance(event, Gap):
            continues = event.end < end and player.push(event)
        else:
            count = int(np.searchsorted(event.stamps, end))
            part = Frames(event.first, event.samples[:count], event.stamps[:count])
            continues = player.push(part) and count == len(event.stamps)
        if not continues:
            return


def _clip_events(infos: Sequence[RecorderInfo]) -> Iterator[Frames | Gap]:
    framer = ClipFramer()
    for info in infos:
        for start, rate, samples in read_clips(info.path, topic(info.microphone, "audio")):
            yield from framer.add(start, rate, samples)
    yield from framer.finish()
