"""What was heard in a log and before it, where it is whole."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from analyzer.relabel.stream import Stream
from analyzer.replay.origin import Origin, read_origin
from analyzer.replay.recorded import Features, read_recorded
from models.classifier import Classifier
from recorder.recovery import recover_log
from recorder.stream import Gap
from schemas.errors import LogError
from schemas.messages import NANOSECONDS
from schemas.ranges import is_local

_WARM_UP = 30 * NANOSECONDS
_EVER = (1 << 63) - 1
_LONGEST = 1000  # characters


class UnreadableError(LogError):
    """A log, or a part of it, is damaged."""


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
        raise UnreadableError(str(error)) from error


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
        raise UnreadableError(str(error)) from error


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
            stream.segments.clear()
            return stream
        back *= 4
    return Stream(classifier)


def _past(
    logs: tuple[Path, ...], origin: Origin, begin: int, classifier: Classifier
) -> tuple[Stream, bool]:
    """Run through logs from a time on; tell also whether there is nothing before it."""
    events: list[list[Features | Gap]] = []
    whole = True
    for log in logs:
        found, first = _heard_before(log, origin, begin)
        if first is None:
            break
        events.insert(0, found)
        if first < begin:
            whole = False
            break
    stream = Stream(classifier)
    for event in (event for found in events for event in found):
        stream.push(event)
    return stream, whole


def _heard_before(log: Path, origin: Origin, begin: int) -> tuple[list[Features | Gap], int | None]:
    """Read a log from a time on; return also when it begins, None if it is of no use."""
    with TemporaryDirectory(prefix="hearthlog") as folder, suppress(LogError):
        for path in _whole(log, Path(folder)):
            with suppress(UnreadableError):
                past = origin_of(path)
                if past is None or past.first_frame is None or _who(past) != _who(origin):
                    break
                return list(heard(past, begin)), past.first_frame[1]
    return [], None


def _whole(log: Path, folder: Path) -> Iterator[Path]:
    """Yield a log, and then what can be saved of it."""
    yield log
    yield recovered(log, folder)[0]


def is_followed(stream: Stream, origin: Origin, behind: Path | None) -> bool:
    """Tell whether the sound of a log goes on in the log behind it."""
    if behind is None:
        return False
    with suppress(LogError):
        other = read_origin(behind, "features")
        return (
            other is not None
            and _who(other) == _who(origin)
            and other.first_frame is not None
            and stream.is_followed_by(other.first_frame)
        )
    return False


def _who(origin: Origin) -> tuple[str, str]:
    return origin.node, origin.microphone
