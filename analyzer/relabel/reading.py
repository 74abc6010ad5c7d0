"""The features of a log and of the logs before it, as far as these can be read."""

import shutil
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from hearthlog.analyzer.logs.recorder_info import RecorderInfo, check_model, read_recorder_infos
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller
from hearthlog.analyzer.replay.recorded import Features, read_recorded
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.recorder.events import Gap
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import is_active
from hearthlog.schemas.salvage.recover import recover_log

_WARM_UP = 30 * NANOSECONDS
_FLOOR_WARM_UP = 150 * NANOSECONDS  # a minute, and the four seconds of steadiness behind it
_NEVER = (1 << 63) - 1
_FRAMES = 12_000  # ten minutes at once: their arrays stay in the memory of the process
_LONGEST_LOSS_TEXT = 1000  # characters


class UnreadableError(LogError):
    """A log, or a part of it, is damaged."""

    def __init__(self, log: Path, what: object) -> None:
        super().__init__(str(what))
        self.log = log

    def __reduce__(self) -> tuple[type["UnreadableError"], tuple[Path, str]]:
        return UnreadableError, (self.log, str(self))


def infos_for_model(
    path: Path, model: Model, log: Path
) -> tuple[list[RecorderInfo], dict[str, str]]:
    """Find the microphones of a log whose features a model is for.

    Returns
    -------
    infos : list of RecorderInfo
        At least one, in the order of the names of the microphones.

    Raises
    ------
    LogError
        If none has features of the model's set; an `UnreadableError` if the log is damaged.
    """
    infos = [info for info in _read_infos(path) if info.first_frame is not None]
    if not infos:
        raise LogError(f"{log}: has no features; there is nothing to label")
    suited, left_out, errors = [], {}, []
    for info in infos:
        try:
            check_model(replace(info, path=log), model)
            suited.append(info)
        except LogError as error:
            left_out[info.microphone] = info.feature_set
            errors.append(error)
    if not suited:
        raise errors[0]
    return suited, left_out


def read_sound(
    info: RecorderInfo, start: int, *, auxiliary: bool = False
) -> Iterator[Features | Gap]:
    """Read the features and gaps of a log from a time on.

    Parameters
    ----------
    start : int
        Log time, in nanoseconds of UTC.

    Raises
    ------
    UnreadableError
        If it is damaged, or not of a recorder, or its feature set is not installed.
    """
    try:
        sound = read_recorded(info, start, _NEVER, sound_only=True, auxiliary=auxiliary)
        for batch in sound:
            for event in batch.events:
                if isinstance(event, Gap):
                    yield event
                elif isinstance(event, Features):
                    for begin in range(0, len(event.stamps), _FRAMES):
                        yield event.part(slice(begin, begin + _FRAMES))
    except LogError as error:
        raise UnreadableError(info.path, error) from error


def recover_copy(log: Path, folder: Path) -> tuple[Path, str]:
    """Save the whole parts of a damaged log to a folder.

    Returns
    -------
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
    return copy, "; ".join(recovery.losses)[:_LONGEST_LOSS_TEXT]


def warm_up(
    info: RecorderInfo, earlier: Sequence[Path], classifier: Classifier, *, states_only: bool
) -> StreamLabeller:
    """Label as much of the sound before a log as its first labels depend on.

    Parameters
    ----------
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
    return StreamLabeller(classifier, microphone=info.microphone, embedding=info.embedding)


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
        other = None if path is None else _of_microphone(_read_infos(path), info.microphone)
        if other is None or other.first_frame is None or not _same_sound(other, info):
            break
        chosen.appendleft(other)
        if other.first_frame[1] < start:
            from_start = False
            break
    labeller = StreamLabeller(
        classifier, label_from, info.microphone, info.embedding, from_start=from_start
    )
    for other in chosen:
        for event in read_sound(other, start, auxiliary=labeller.takes_auxiliary):
            labeller.push(event)
        labeller.segments.clear()
    return labeller, from_start


def goes_on_in(labeller: StreamLabeller, info: RecorderInfo, next_log: Path) -> bool | None:
    """Tell whether the sound of a log goes on in the next log.

    Returns
    -------
    bool or None
        None while that is not decided: the next log is being written and has no frame.
    """
    other = None
    with suppress(LogError):
        other = _of_microphone(read_recorder_infos(next_log, "features"), info.microphone)
    if other is None or other.first_frame is None:
        return None if is_active(next_log) else False
    return _same_sound(other, info) and labeller.is_followed_by(other.first_frame)


def _read_infos(path: Path) -> list[RecorderInfo]:
    try:
        return read_recorder_infos(path, "features")
    except LogError as error:
        raise UnreadableError(path, error) from error


def _of_microphone(infos: Sequence[RecorderInfo], name: str) -> RecorderInfo | None:
    return next((info for info in infos if info.microphone == name), None)


def _same_sound(first: RecorderInfo, second: RecorderInfo) -> bool:
    one, other = (
        (info.node, info.microphone, info.feature_set, info.embedding) for info in (first, second)
    )
    return one == other
