"""One look at the disk by a recorder: what its limits ask for is done and told."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from hearthlog.recorder.disk.recorded import recorded_days, recorded_logs
from hearthlog.recorder.disk.retention import Limits, carry_out, disk_of, plan_retention
from hearthlog.recorder.disk.sizes import size_text
from hearthlog.recorder.events import OK, WARNING, Notice

_SHOWN = 300  # characters


class KeepingRules(NamedTuple):
    """What a recorder keeps of which logs.

    Attributes
    ----------
    root : str
        Folder of logs.
    node : str
        Name of the node.
    limits : Limits
    """

    root: str
    node: str
    limits: Limits


class DiskReport(NamedTuple):
    """What was found on the disk, and what was done.

    Attributes
    ----------
    done : str
        What was deleted; empty for nothing.
    problem : str
        What cannot be done; empty for nothing.
    values : mapping of str to str
        Figures by name.
    """

    done: str
    problem: str
    values: Mapping[str, str]

    def notices(self) -> list[Notice]:
        """Say what people should know: at most what was done, and the problem."""
        done = [Notice(OK, self.done)] if self.done else []
        return [*done, *([Notice(WARNING, self.problem)] if self.problem else [])]


def keep_disk(rules: KeepingRules) -> DiskReport:
    """Delete what the rules say, unless that would leave only the newest of several logs.

    Parameters
    ----------
    rules : KeepingRules

    Raises
    ------
    OSError
        If the disk cannot be measured.
    """
    root, failures = Path(rules.root), list[OSError]()
    logs = recorded_logs(root, rules.node, failures)
    days = recorded_days(root, rules.node)
    plan = plan_retention(logs, days, rules.limits, disk_of(root))
    problems = list(plan.problems)
    if plan.wipes:
        problems.insert(
            0,
            f"the limits would delete all but the newest of {len(logs)} logs "
            f"({plan.deletions[-1].why}): nothing is deleted; `hearthlog retain` does it, if that "
            "is meant",
        )
        deleted = []
    else:
        deleted = carry_out(plan, failures)
    problems += _failed(failures)
    freed = sum(log.size for log in deleted)
    done = ""
    if deleted:
        why = plan.deletions[0].why
        done = f"{len(deleted)} logs deleted, {size_text(freed)}: {why}"
    disk = disk_of(root)
    values = {
        "free_bytes": disk.free,
        "disk_bytes": disk.size,
        "logs": len(logs) - len(deleted),
        "log_bytes": sum(log.size for log in logs) - freed,
        "deleted_logs": len(deleted),
        "deleted_bytes": freed,
        "kept_logs": len(plan.kept),
    }
    texts = {name: str(value) for name, value in values.items()}
    return DiskReport(done, "; ".join(problems)[:_SHOWN], texts)


def _failed(failures: list[OSError]) -> list[str]:
    if not failures:
        return []
    more = f", and {len(failures) - 1} more" if len(failures) > 1 else ""
    first = failures[0]
    return [f"{first.filename}: cannot be looked through or deleted ({first.strerror}){more}"]
