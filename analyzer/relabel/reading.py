"""What was heard in a log and before it, where it is whole."""

import shutil
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from hearthlog.analyzer.logs.recorder_info import Origin, read_origin
from hearthlog.analyzer.relabel.stream import Stream
from hearthlog.analyzer.replay.recorded import Features, read_recorded
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.recorder.events import Gap
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import is_active
from hearthlog.schemas.salvage.recover import recover_log
from hearthlog.schemas.storage.byte_ranges import is_local
from hearthlog.schemas.times import NANOSECONDS

_WARM_UP = 30 * NANOSECONDS
_EVER = (1 << 63) - 1
_LONGEST = 1000  # characters


class UnreadableError(LogError):
    """A log, or a part of it, is damaged.

    Attributes
    ----------
    log : Path
    """

    def __init__(self, log: Path, what: object) -> None:
        super().__init__(str(what))
        self.log = log

    def __reduce__(self) -> tuple[type["UnreadableError"], tuple[Path, str]]:
        return UnreadableError, (self.log, str(self))


def origin_of(path: Path) -> Origin | None:
    """Read what a log says of its recorder; None if it has no features.

    Raises
    ------
    UnreadableError
        If it is damaged.
    """
    try:
        return read_origin(path, "features")
    except LogError as error:
        raise UnreadableError(path, error) from error


def heard(origin: Origin, begin: int) -> Iterator[Features | Gap]:
    """Read what was heard in a log from a time on, in nanoseconds of UTC.

    Raises
    ------
    UnreadableError
        If it is damaged.
    """
    try:
        for piece in read_recorded(origin, begin, _EVER, heard_only=True):
            yield from (event for event in piece.events if isinstance(event, Features | Gap))
    except LogError as error:
        raise UnreadableError(origin.path, error) from error


def recovered(log: Path, folder: Path) -> tuple[Path, str]:
    """Save what is whole in a log to a folder; return also what is not.

    Raises
    ------
    LogError
        If nothing is, or it cannot be copied.
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
    lost = [str(damage) for damage in recovery.damages if not damage.lossless]
    return copy, "; ".join(lost)[:_LONGEST]


def warmed_up(
    origin: Origin, before: tuple[Path, ...], classifier: Classifier, *, states_only: bool
) -> Stream:
    """Run through what was heard before a log, as far back as it matters.

    Parameters
    ----------
    origin : Origin
        Of the log.
    before : tuple of Path
        Logs before it, the last first.
    classifier : Classifier
    states_only : bool
        Whether it is enough that the states to come are sure; otherwise the segment that is open
        is whole.
    """
    first, back = origin.first_frame, _WARM_UP
    while first is not None and before:
        stream, whole = _past(before, origin, first[1] - back, classifier)
        if not stream.is_followed_by(first):
            break
        if whole or (stream.sure and (states_only or stream.settled)):
            return stream
        back *= 4
    return Stream(classifier)


def _past(
    logs: tuple[Path, ...], origin: Origin, begin: int, classifier: Classifier
) -> tuple[Stream, bool]:
    """Run through logs from a time on; tell also whether there is nothing before it."""
    saved: dict[Path, Path | None] = {}  # what could be saved of logs that are damaged
    with TemporaryDirectory(prefix="hearthlog") as folder:
        while True:
            try:
                return _run_through(logs, saved, origin, begin, classifier)
            except UnreadableError as error:
                copy = None
                if error.log not in saved.values():
                    with suppress(LogError):
                        copy, _ = recovered(error.log, Path(folder))
                saved[next(log for log in logs if log.name == error.log.name)] = copy


def _run_through(
    logs: tuple[Path, ...],
    saved: Mapping[Path, Path | None],
    origin: Origin,
    begin: int,
    classifier: Classifier,
) -> tuple[Stream, bool]:
    past: deque[Origin] = deque()
    whole = True
    for log in logs:
        path = saved.get(log, log)
        other = None if path is None else origin_of(path)
        if other is None or other.first_frame is None or _who(other) != _who(origin):
            break
        past.appendleft(other)
        if other.first_frame[1] < begin:
            whole = False
            break
    stream = Stream(classifier)
    for other in past:
        for event in heard(other, begin):
            stream.push(event)
        stream.segments.clear()
    return stream, whole


def is_followed(stream: Stream, origin: Origin, behind: Path) -> bool | None:
    """Tell whether the sound of a log goes on in the log behind it; None if that is not known yet.

    It is not while the log behind is being written and has no frame.
    """
    other = None
    with suppress(LogError):
        other = read_origin(behind, "features")
    if other is None or other.first_frame is None:
        return None if is_active(behind) else False
    return _who(other) == _who(origin) and stream.is_followed_by(other.first_frame)


def _who(origin: Origin) -> tuple[str, str]:
    return origin.node, origin.microphone
