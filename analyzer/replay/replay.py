"""Recorded logs once more through the pipeline, from their features or from their clips."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Event as Flag

import numpy as np

from hearthlog.analyzer.logs.clips import ClipFramer, read_clips
from hearthlog.analyzer.logs.recorder_info import RecorderInfo, read_recorder_info
from hearthlog.analyzer.replay.player import Player, Replay, ReplayOptions
from hearthlog.analyzer.replay.recorded import read_recorded
from hearthlog.models.classifiers.model import Model
from hearthlog.models.errors import ModelError
from hearthlog.models.modelfile.modelfile import SUFFIX, load_model
from hearthlog.recorder.events import Frames, Gap
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.merged_reading import time_spans
from hearthlog.schemas.messages.topics import topic
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.schemas.times import NANOSECONDS

_REWOUND = 60 * NANOSECONDS
_EVER = (1 << 63) - 1
_LONGEST_NAME = 200


def find_model(name: str, sha256: str, folders: Sequence[Path]) -> Model | None:
    """Look in some folders for the model that a log was recorded with."""
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


class LogSet:
    """Logs of one microphone, in the order of their first messages.

    Parameters
    ----------
    paths : sequence of Path
        Layers and empty logs among them are left out.
    kind : str
        What the sound is taken from: "features", or "audio" for clips.

    Attributes
    ----------
    first, last : int
        Log times of the first and the last message, in nanoseconds.

    Raises
    ------
    LogError
        If there is no message in them, or one is damaged.
    """

    def __init__(self, paths: Sequence[Path], kind: str) -> None:
        spans = time_spans(paths)
        if not spans:
            raise LogError(f"{paths[0]}: no messages, nothing to replay")
        self.kind = kind
        self.first, self.last = spans[0][0], max(last for _, last, _ in spans)
        self._spans = spans
        self._origins: dict[Path, RecorderInfo | None] = {}

    def span(self, wanted: ReplayOptions) -> tuple[int, int]:
        """Return the log times from which on, and before which, messages are wanted."""
        start = self.first + round(wanted.start_offset * NANOSECONDS)
        if wanted.duration is None:
            return start, _EVER
        return start, min(start + round(wanted.duration * NANOSECONDS), _EVER)

    def chosen(self, wanted: ReplayOptions) -> list[RecorderInfo]:
        """Return the logs that are wanted, at least one; raises as `between`."""
        found = self.between(*self.span(wanted))
        if not found:
            raise self.nothing()
        return found

    def nothing(self) -> LogError:
        """Make the error that says that there is nothing to replay."""
        what = "clips" if self.kind == "audio" else "features"
        seconds = (self.last - self.first) / NANOSECONDS
        return LogError(f"no {what} to replay there; the logs last {seconds:.1f} s")

    def between(self, start: int, end: int) -> list[RecorderInfo]:
        """Return the logs that have messages with start <= log time < end.

        Raises
        ------
        LogError
            If they are of several microphones or nodes, if one is damaged or is there twice.
        """
        found = []
        for first, last, path in self._spans:
            if first < end and last >= start:
                if path not in self._origins:
                    self._origins[path] = read_recorder_info(path, self.kind)
                if (origin := self._origins[path]) is not None:
                    found.append(origin)
        names = sorted({f"{origin.node}/{origin.microphone}" for origin in found})
        if len(names) > 1:
            raise LogError(
                f"{found[0].path} and others are of several microphones ({', '.join(names)}); "
                "replay the logs of one at a time"
            )
        heard: dict[tuple[int, int], RecorderInfo] = {}
        for origin in found:
            if origin.first_frame is not None:
                same = heard.setdefault(origin.first_frame, origin)
                if same is not origin:
                    raise LogError(f"{same.path} and {origin.path} hold the same; leave out one")
        return found


def replay(
    logs: LogSet,
    wanted: ReplayOptions,
    stop: Flag,
    progress: Progress = ignore_progress,
) -> Replay:
    """Run logs through the pipeline again.

    From features on, the model of the recording gives its labels and segments bit for bit. Where
    the replay starts later than the logs, what that takes is run through before, unseen.

    Parameters
    ----------
    logs : LogSet
        For the kind of sound that is wanted.
    wanted : ReplayOptions
    stop : threading.Event
        Once set, the replay ends, and the new log is completed.
    progress : callable
        Told the share that was replayed.

    Raises
    ------
    LogError
        If a log is damaged, or the logs are of several microphones, or of another feature set,
        or hold nothing to replay, or if the new log cannot be written. What was replayed up to
        there is a complete log.
    """
    start, end = logs.span(wanted)
    chosen = logs.chosen(wanted)
    result = Replay(
        sources=[origin.path for origin in chosen],
        unfinished=[origin.path for origin in chosen if not origin.complete],
    )

    def report(time: int) -> None:
        progress(min((time - start) / max(min(end, logs.last) - start, 1), 1.0))

    def new_player() -> Player:
        return Player(wanted, start, result, stop, report)

    while not stop.is_set():
        player = _rewound(logs, start, new_player)
        try:
            if logs.kind == "audio":
                _play_clips(logs, player, end)
            else:
                _play_features(logs, player, start, end)
        except BaseException as error:
            player.finish(cut=True)
            if isinstance(error, LogError) and result.logs:
                raise LogError(f"{error}; up to there it is in {wanted.output}") from error
            raise
        player.finish(cut=result.interrupted or end <= logs.last)
        if not (wanted.loop and result.frames):
            break
    result.interrupted = result.interrupted and not wanted.loop
    if not result.frames and not stop.is_set():
        raise logs.nothing()
    return result


def _rewound(logs: LogSet, start: int, new_player: Callable[[], Player]) -> Player:
    """Bring a player to a time, from so far before that it is as if it had played everything."""
    if logs.kind == "audio":
        return new_player()  # frames are counted, and cut, from the first clip on
    back = _REWOUND
    while True:
        player = new_player()
        begin = max(start - back, logs.first)
        _play_features(logs, player, begin, start)
        if begin == logs.first or player.converged:
            player.arrive()
            return player
        back *= 2


def _play_features(logs: LogSet, player: Player, start: int, end: int) -> None:
    for origin in logs.between(start, end):
        player.open(origin)
        for piece in read_recorded(origin, start, end):
            going_on = all(player.push(event) for event in piece.events)
            player.compare(piece)
            if not going_on:
                return


def _play_clips(logs: LogSet, player: Player, end: int) -> None:
    origins = logs.between(logs.first, end)
    player.open(origins[0])
    for event in _clip_events(origins):
        if isinstance(event, Gap):
            going_on = event.end < end and player.push(event)
        else:
            count = int(np.searchsorted(event.stamps, end))
            part = Frames(event.first, event.samples[:count], event.stamps[:count])
            going_on = player.push(part) and count == len(event.stamps)
        if not going_on:
            return


def _clip_events(origins: Sequence[RecorderInfo]) -> Iterator[Frames | Gap]:
    framer = ClipFramer()
    for origin in origins:
        for start, rate, samples in read_clips(origin.path, topic(origin.microphone, "audio")):
            yield from framer.add(start, rate, samples)
    yield from framer.finish()
