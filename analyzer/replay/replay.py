"""Recorded logs once more through the pipeline, from their features or from their clips."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Event as Flag

import numpy as np

from hearthlog.analyzer.logs.clips import read_clips
from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.replay.clip_frames import ClipFramer
from hearthlog.analyzer.replay.log_set import LogSet
from hearthlog.analyzer.replay.options import Replay, ReplayOptions
from hearthlog.analyzer.replay.player import Player
from hearthlog.analyzer.replay.recorded import read_recorded
from hearthlog.models.classifiers.model import Model
from hearthlog.models.errors import ModelError
from hearthlog.models.modelfile.modelfile import SUFFIX, load_model
from hearthlog.recorder.events import Frames, Gap
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import topic

_WARM_UP = 60 * NANOSECONDS
_LONGEST_NAME = 200


def find_model(name: str, sha256: str, folders: Sequence[Path]) -> Model | None:
    """Look in some folders for the model that a log was recorded with.

    Parameters
    ----------
    name : str
        Name of the model, which is that of its file without the suffix.

    Returns
    -------
    Model or None
        None if no folder has it; files that cannot be read are passed over.
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

    From features, the model of the recording gives its labels and segments bit for bit. Where the
    replay starts later than the logs, the sound before it is run through as far as it matters, and
    nothing of that is logged.

    Parameters
    ----------
    progress : callable, optional
        Told the share that was replayed, 0 to 1.

    Raises
    ------
    LogError
        If a log is damaged, or the logs are of several microphones, or of another feature set, or
        hold nothing to replay, or if the new log cannot be written. What was replayed up to there
        is a complete log.
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
    """Return a player that has played enough before a time to be as if it had played everything."""
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
            goes_on = all(player.push(event) for event in batch.events)
            if compare:
                player.compare(batch)
            if not goes_on:
                return


def _play_clips(logs: LogSet, player: Player, end: int) -> None:
    infos = logs.between(logs.first, end)
    player.open(infos[0])
    for event in _clip_events(infos):
        if isinstance(event, Gap):
            goes_on = event.end < end and player.push(event)
        else:
            count = int(np.searchsorted(event.stamps, end))
            part = Frames(event.first, event.samples[:count], event.stamps[:count])
            goes_on = player.push(part) and count == len(event.stamps)
        if not goes_on:
            return


def _clip_events(infos: Sequence[RecorderInfo]) -> Iterator[Frames | Gap]:
    framer = ClipFramer()
    for info in infos:
        for start, rate, samples in read_clips(info.path, topic(info.microphone, "audio")):
            yield from framer.add(start, rate, samples)
    yield from framer.finish()
