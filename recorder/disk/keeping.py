"""One look at the disk by a recorder: what its limits ask for is done and told."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from hearthlog.recorder.disk.limits import KeepingRules, ThinningDays
from hearthlog.recorder.disk.recorded import (
    RecordedDays,
    RecordedLog,
    recorded_days,
    recorded_logs,
)
from hearthlog.recorder.disk.retention import (
    Plan,
    carry_out,
    disk_of,
    plan_retention,
)
from hearthlog.recorder.disk.sizes import size_text
from hearthlog.recorder.disk.thinning import plan_thinning, thin
from hearthlog.recorder.events import OK, WARNING, Notice
from hearthlog.schemas.errors import LogError

_SHOWN = 300  # characters
_AT_ONCE = 100  # logs that are thinned, so that nothing else waits for an hour


class DiskReport(NamedTuple):
    """What was found on the disk, and what was done.

    Attributes
    ----------
    done : str
        What was deleted and thinned; empty for nothing.
    problem : str
        What cannot be done; empty for nothing.
    """

    done: str
    problem: str
    values: Mapping[str, str]
    more: bool = False

    def notices(self) -> list[Notice]:
        """Say what people should know: at most what was done, and the problem."""
        done = [Notice(OK, self.done)] if self.done else []
        return [*done, *([Notice(WARNING, self.problem)] if self.problem else [])]


def keep_disk(rules: KeepingRules, *, may_thin: bool = True) -> DiskReport:
    """Delete what the rules say, unless that would leave only the newest of several logs, and thin.

    Raise `OSError` if the disk cannot be measured.
    """
    root, failures = Path(rules.root), list[OSError]()
    logs = recorded_logs(root, rules.node, failures)
    days = recorded_days(root, rules.node)
    plan = plan_retention(logs, days, rules.limits, disk_of(root))
    problems = list(plan.problems)
    deleted = []
    if plan.wipes:
        problems.insert(0, _wipes(plan, len(logs)))
    else:
        deleted = carry_out(plan, failures)
    left = [log for log in logs if log not in set(deleted)]
    thinned = _thin(left if may_thin else [], days, rules.thinning, problems)
    freed = sum(log.size for log in deleted)
    done = []
    if deleted:
        why = plan.deletions[0].why
        done.append(f"{len(deleted)} logs deleted, {size_text(freed)}: {why}")
    if thinned.logs:
        done.append(f"{thinned.logs} logs thinned, {size_text(thinned.freed)}")
    disk = disk_of(root)
    values = {
        "free_bytes": disk.free,
        "disk_bytes": disk.size,
        "logs": len(left),
        "log_bytes": sum(log.size for log in left) - thinned.freed,
        "deleted_logs": len(deleted),
        "deleted_bytes": freed,
        "kept_logs": len(plan.kept),
        "thinned_logs": thinned.logs,
        "thinned_bytes": thinned.freed,
    }
    problem = "; ".join([*problems, *_failed(failures)])[:_SHOWN]
    texts = {name: str(value) for name, value in values.items()}
    return DiskReport("; ".join(done), problem, texts, more=thinned.more)


def _wipes(plan: Plan, logs: int) -> str:
    return (
        f"the limits would delete all but the newest of {logs} logs ({plan.deletions[-1].why}): "
        "nothing is deleted; `hearthlog retain` does it, if that is meant"
    )


class _Thinnings(NamedTuple):
    logs: int = 0
    freed: int = 0
    more: bool = False


def _thin(
    logs: Sequence[RecordedLog], days: RecordedDays, limits: ThinningDays, problems: list[str]
) -> _Thinnings:
    """Thin some logs, and add to the problems the first of those that cannot be."""
    count = freed = 0
    failed: list[str] = []
    for log, step in plan_thinning(logs, days, limits):
        if count == _AT_ONCE:
            return _Thinnings(count, freed, more=True)
        try:
            before = log.path.stat().st_size
            if thin(log.path, step):
                count, freed = count + 1, freed + before - log.path.stat().st_size
        except LogError as error:
            failed.append(str(error))
        except OSError as error:  # no room for a copy: there is none for the others
            failed.append(f"{log.path}: cannot be thinned ({error.strerror or error})")
            break
    problems += failed[:1]
    return _Thinnings(count, freed)


def _failed(failures: list[OSError]) -> list[str]:
    if not failures:
        return []
    more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
    first = failures[0]
    return [f"{first.filename}: cannot be looked through or deleted ({first.strerror}){more}"]
