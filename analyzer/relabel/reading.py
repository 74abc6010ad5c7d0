"""The features of a log and of the logs before it, as far as these can be read."""

import shutil
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from hearthlog.analyzer.logs.recorder_info import RecorderInfo, check_model, read_recorder_info
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller
from hearthlog.analyzer.replay.recorded import Features, read_recorded
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.recorder.events import Gap
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import is_active
from hearthlog.schemas.salvage.recover import recover_log
from hearthlog.schemas.storage.byte_ranges import is_local
from hearthlog.schemas.times import NANOSECONDS

_WARM_UP = 30 * NANOSECONDS
_FLOOR_WARM_UP = 150 * NANOSECONDS  # a minute, and the four seconds of steadiness behind it
_NEVER = (1 << 63) - 1
_LONGEST_LOSS_TEXT = 1000  # characters


class UnreadableError(LogError):
    """A log, or a part of it, is damaged."""

    def __init__(self, log: Path, what: object) -> None:
        super().__init__(str(what))
        self.log = log

    def __reduce__(self) -> tuple[type["UnreadableError"], tuple[Path, str]]:
        return UnreadableError, (self.log, str(self))


def recorder_info(path: Path) -> RecorderInfo | None:
    """Read what a log says of its recorder; None if it has no features.

    Raises
    ------
    UnreadableError
        If it is damaged, of more than one microphone, or says what cannot be.
    """
    try:
        return read_recorder_info(path, "features")
    except LogError as error:
        raise UnreadableError(path, error) from error


def info_for_model(path: Path, model: Model, log: Path) -> tuple[RecorderInfo, tuple[int, int]]:
    """Read what a log says of its recorder, and compare the feature set with that of a model.

    Parameters
    ----------
    path : Path
        The log, or a copy of it.
    model : Model
    log : Path
        What errors call it.

    Returns
    -------
    info : RecorderInfo
    first_frame : (int, int)
        Number and start of its first frame, in nanoseconds of UTC.

    Raises
    ------
    LogError
        If it has no features, or those of another set; an `UnreadableError` if it is damaged.
    """
    info = recorder_info(path)
    if info is None or info.first_frame is None:
        raise LogError(f"{log}: has no features; there is nothing to label")
    check_model(replace(info, path=log), model)
    return info, info.first_frame


def read_sound(info: RecorderInfo, start: int) -> Iterator[Features | Gap]:
    """Read the features and gaps of a log from a time on.

    Parameters
    ----------
    info : RecorderInfo
        Of the log.
    start : int
        Log time, in nanoseconds of UTC.

    Yields
    ------
    Features or Gap
        In the order of the log.

    Raises
    ------
    UnreadableError
        If it is damaged, or not of a recorder, or its feature set is not installed.
    """
    try:
        for batch in read_recorded(info, start, _NEVER, sound_only=True):
            yield from (event for event in batch.events if isinstance(event, Features | Gap))
    except LogError as error:
        raise UnreadableError(info.path, error) from error


def recover_copy(log: Path, folder: Path) -> tuple[Path, str]:
    """Save the whole parts of a damaged log to a folder.

    Parameters
    ----------
    log : Path
    folder : Path
        The copy has the name of the log there.

    Returns
    -------
    copy : Path
    loss : str
        What could not be saved; empty if nothing is lost.

    Raises
    ------
    LogError
        If nothing can be saved, or the copy cannot be written.
    """
    source, copy = log, folder / log.name
    if not is_local(log):
        source = folder / f"damaged-{log.name}"
        with log.open("rb") as stream, source.open("xb") as out:
            shutil.copyfileobj(stream, out)
    try:
        recovery = recover_log(source, copy, log.name)
    except OSError as error:
        raise LogError(f"{log}: what is whole cannot be copied ({error.strerror})") from error
    losses = [str(damage) for damage in recovery.damages if not damage.lossless]
    return copy, "; ".join(losses)[:_LONGEST_LOSS_TEXT]


def warm_up(
    info: RecorderInfo, earlier: Sequence[Path], classifier: Classifier, *, states_only: bool
) -> StreamLabeller:
    """Label as much of the sound before a log as its first labels depend on.

    Parameters
    ----------
    info : RecorderInfo
        Of the log.
    earlier : sequence of Path
        Logs before it, the last first.
    classifier : Classifier
    states_only : bool
        Whether it suffices that the states have converged: the open segment may then lack its
        beginning.

    Returns
    -------
    StreamLabeller
        Ready for the first frame of the log; without a past where the earlier logs do not lead up
        to it.
    """
    first, labels_back = info.first_frame, _WARM_UP
    floor_back = _FLOOR_WARM_UP if classifier.timing.needs_floor else labels_back
    while first is not None and earlier:
        back = max(floor_back, labels_back)
        starts = first[1] - back, first[1] - labels_back
        labeller, from_start = _label_earlier(earlier, info, starts, classifier)
        if not labeller.is_followed_by(first):
            break
        converged = labeller.states_converged and (states_only or labeller.segments_converged)
        if converged or (from_start and labels_back == back):
            return labeller
        if labeller.floor_converged:
            labels_back *= 4
        else:
            floor_back *= 4
    return StreamLabeller(classifier)


def _label_earlier(
    logs: Sequence[Path], info: RecorderInfo, starts: tuple[int, int], classifier: Classifier
) -> tuple[StreamLabeller, bool]:
    """Track the floor in earlier logs from a time on, and label them from another time on.

    The result tells also whether there is nothing before the first of these times.
    """
    copies: dict[Path, Path | None] = {}  # what could be saved of damaged logs
    with TemporaryDirectory(prefix="hearthlog") as folder:
        while True:
            try:
                return _label_readable(logs, copies, info, starts, classifier)
            except UnreadableError as error:
                copy = None
                if error.log not in copies.values():
                    with suppress(LogError):
                        copy, _ = recover_copy(error.log, Path(folder))
                copies[next(log for log in logs if log.name == error.log.name)] = copy


def _label_readable(
    logs: Sequence[Path],
    copies: Mapping[Path, Path | None],
    info: RecorderInfo,
    starts: tuple[int, int],
    classifier: Classifier,
) -> tuple[StreamLabeller, bool]:
    start, label_from = starts
    chosen: deque[RecorderInfo] = deque()
    from_start = True
    for log in logs:
        path = copies.get(log, log)
        other = None if path is None else recorder_info(path)
        if other is None or other.first_frame is None or not _same_sound(other, info):
            break
        chosen.appendleft(other)
        if other.first_frame[1] < start:
            from_start = False
            break
    labeller = StreamLabeller(classifier, label_from, from_start=from_start)
    for other in chosen:
        for event in read_sound(other, start):
            labeller.push(event)
        labeller.segments.clear()
    return labeller, from_start


def goes_on_in(labeller: StreamLabeller, info: RecorderInfo, next_log: Path) -> bool | None:
    """Tell whether the sound of a log goes on in the next log.

    Parameters
    ----------
    labeller : StreamLabeller
        That has labelled the log to its end.
    info : RecorderInfo
        Of the log.
    next_log : Path

    Returns
    -------
    bool or None
        None while that is not decided: the next log is being written and has no frame.
    """
    other = None
    with suppress(LogError):
        other = read_recorder_info(next_log, "features")
    if other is None or other.first_frame is None:
        return None if is_active(next_log) else False
    return _same_sound(other, info) and labeller.is_followed_by(other.first_frame)


def _same_sound(first: RecorderInfo, second: RecorderInfo) -> bool:
    one, other = ((info.node, info.microphone, info.feature_set) for info in (first, second))
    return one == other
