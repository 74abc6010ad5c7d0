"""Make a smaller log of an old one: what its labels, segments and gaps do not need is dropped."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.digest import log_digest
from hearthlog.schemas.logs.log_stream import PROFILE
from hearthlog.schemas.logs.provenance import THINNED, THINNED_OF, provenance_records
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import LIVE, is_scenario, parse_topic
from hearthlog.schemas.progress import ignore_progress
from hearthlog.schemas.salvage.recover import check_copy
from hearthlog.schemas.salvage.salvage import Salvage
from hearthlog.schemas.salvage.salvaged_copy import SalvagedCopy
from hearthlog.schemas.storage.new_files import create_file
from hearthlog.schemas.times import NANOSECONDS

_CHUNK_SPAN = 10 * NANOSECONDS
_REST = "all but labels, segments and gaps"
STEPS = ("", "statistics", "statistics and features", _REST)  # what a log is thinned of
_SOUND = {"statistics", "features", "embedding"}
_DROPPED = (set[str](), {"statistics"}, _SOUND, _SOUND)
_KEPT = {"info", "label", "segment", "gap"}


class Thinning(NamedTuple):
    """A step of thinning."""

    step: int
    note: Mapping[str, str]

    def drops(self, topic: str) -> bool:
        """Tell whether the messages of a topic are dropped."""
        parts = parse_topic(topic)
        if STEPS[self.step] == _REST:
            if parts is None or parts.kind not in _KEPT:
                return True
            return parts.labelling != LIVE and not is_scenario(parts.labelling)
        return parts is not None and parts.kind in _DROPPED[self.step]


def dropped_kinds(text: str | None) -> set[str]:
    """Return which of a log's frame by frame messages were dropped."""
    return _DROPPED[STEPS.index(text)] if text in STEPS else set()


def thinned_step(log: Path) -> int:
    """Return how far a log was thinned already, a place in `STEPS`.

    Raise `LogError` if it cannot be read or is damaged, or a newer version has thinned it
    otherwise.
    """
    with LogFile(log) as file:
        texts = {record.get(THINNED, "") for record in provenance_records(file)}
    try:
        return max((STEPS.index(text) for text in texts), default=0)
    except ValueError as error:
        raise LogError(f"{log}: was thinned in a way that this version does not know") from error


def thin_log(source: Path, copy: Path, step: int) -> None:
    """Copy a log without what a step of thinning drops, and check the copy.

    All other messages stay as they are, in their order. Channels stay defined, without messages.

    Raise `LogError` if the log is damaged, or the copy does not hold what was written to it.
    Raise `OSError` if the copy cannot be written.
    """
    with LogFile(source) as file:
        before = [record.get(THINNED_OF, "") for record in provenance_records(file)]
    digests = " ".join([*filter(None, before), log_digest(source)])
    thinning = Thinning(step, {THINNED: STEPS[step], THINNED_OF: digests})
    copy.unlink(missing_ok=True)
    with Salvage(source) as salvage, create_file(copy, 0o666) as stream:
        thinned = SalvagedCopy(stream, salvage, PROFILE, _CHUNK_SPAN, thinning)
        thinned.write(source.name, ignore_progress)
    recovery = thinned.recovery()
    if recovery.damages or not recovery.complete:
        raise LogError(f"{source}: is damaged, and not thinned; `hearthlog recover` saves the rest")
    check_copy(copy, recovery.topics)
