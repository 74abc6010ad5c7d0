"""What recorders write, as they write it."""

from contextlib import suppress
from pathlib import Path
from threading import Event

from hearthlog.analyzer.foxglove.publisher import Publisher
from hearthlog.analyzer.foxglove.recording import Damaged, channels_of
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import AUDIO_LAYER, log_name
from hearthlog.schemas.logs.follow import follow_messages
from hearthlog.schemas.mcap.raw_messages import in_order_of_time

_SUBSCRIBE_SECONDS = 0.5  # that viewers have to ask for a new topic before it speaks
_HEARD = ("", AUDIO_LAYER)  # layers; the others speak of what was heard before


def publish_live(folder: Path, publisher: Publisher, stop: Event, damaged: Damaged) -> None:
    """Publish what is written to the logs of a folder from now on.

    Parameters
    ----------
    damaged : callable
        Told the error of a log of which no more can be read.
    """
    known: set[Path] = set()
    for path, parts in follow_messages(folder, stop=stop, damaged=damaged, infos=True):
        if log_name(path).layer in _HEARD:
            if path not in known:
                known.add(path)
                if _advertise(path, publisher):
                    stop.wait(_SUBSCRIBE_SECONDS)
            for part, row in in_order_of_time(parts):
                publisher.publish(part, row)
        if stop.is_set():
            break


def _advertise(log: Path, publisher: Publisher) -> bool:
    """Tell of all topics of a log, also of those that speak rarely; tell whether one is new."""
    with suppress(LogError):  # it gets another name at this moment
        return sum(publisher.advertise(*channel) for channel in channels_of(log)) > 0
    return False
