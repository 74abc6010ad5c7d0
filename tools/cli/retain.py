"""`hearthlog retain`: deletes and thins logs as the limits of a recorder ask, or says which."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from hearthlog.tools.cli.options import (
    Json,
    MaxBagFiles,
    MaxRecordSize,
    MinFreeSpace,
    RetentionDays,
)
from hearthlog.tools.cli.text import end_with_warnings, number, print_json, print_lines, tell

if TYPE_CHECKING:
    from hearthlog.recorder.disk_keeper import Thinned
    from hearthlog.recorder.retention import Deletion, KeepingRules


def retain(
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder of logs.", readable=False, show_default="logs"),
    ] = None,
    node: Annotated[
        str | None, typer.Option(help="Name of the recorder.", show_default="home")
    ] = None,
    *,
    retention_days: RetentionDays = None,
    max_bag_files: MaxBagFiles = None,
    max_record_size: MaxRecordSize = None,
    min_free_space: MinFreeSpace = None,
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the recorder, a TOML file.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what would be deleted or thinned, and why.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Delete or thin the oldest logs of a recorder, as its limits ask; it does so by itself.

    Never deleted: the newest log, and what is reviewed, locked by a file LOG.keep, unfinished, of
    another node or unknown. Exit status 3: a limit cannot be met, or a log cannot be deleted.
    """
    from hearthlog.recorder.config import load_settings
    from hearthlog.schemas.errors import LogError

    given = {
        "output": output,
        "node": node,
        "retention_days": retention_days,
        "max_bag_files": max_bag_files,
        "max_record_size": max_record_size,
        "min_free_space": min_free_space,
    }
    chosen = {key: value for key, value in given.items() if value is not None}
    settings = load_settings(config, chosen, {})
    if not settings.output.is_dir():
        raise LogError(f"{settings.output}: no such folder of logs")
    done = _retain(settings.keeping_rules(), dry_run=dry_run)
    if as_json:
        print_json(_as_json(done, dry_run=dry_run))
    else:
        _print(done, dry_run=dry_run)
    end_with_warnings(done.warnings)


class _Done(NamedTuple):
    deleted: "list[Deletion]"
    thinned: "list[Thinned]"
    kept: dict[Path, str]
    warnings: list[str]


def _retain(rules: "KeepingRules", *, dry_run: bool) -> _Done:
    from hearthlog.recorder.disk_keeper import plan_thinning, thin
    from hearthlog.recorder.host import disk_of
    from hearthlog.recorder.retention import carry_out, plan_retention, recorded_days, recorded_logs
    from hearthlog.schemas.errors import LogError

    root, failures = Path(rules.root), list[OSError]()
    logs = recorded_logs(root, rules.node, failures)
    days = recorded_days(root, rules.node)
    plan = plan_retention(logs, days, rules.limits, disk_of(root))
    gone = {log for log, _ in plan.deletions}
    if not dry_run:
        gone = set(carry_out(plan, failures))
    warnings = [*plan.problems, *(f"{error.filename}: {error.strerror}" for error in failures)]
    thinned = []
    for each in plan_thinning([log for log in logs if log not in gone], days, rules.thinning):
        try:
            if dry_run or thin(each.log.path, each.step):
                thinned.append(each)
        except (LogError, OSError) as error:
            warnings.append(f"{each.log.path}: is not thinned ({error})")
    return _Done(
        [each for each in plan.deletions if each.log in gone], thinned, plan.kept, warnings
    )


def _print(done: _Done, *, dry_run: bool) -> None:
    from hearthlog.recorder.retention import size_text
    from hearthlog.schemas.salvage.recover import STEPS

    would = "would be " if dry_run else ""
    print_lines(f"{log.path}: {why} ({size_text(log.size)})" for log, why in done.deleted)
    print_lines(f"{path}: is kept: {reason}" for path, reason in done.kept.items())
    print_lines(f"{log.path}: {would}thinned of {STEPS[step]}" for log, step in done.thinned)
    freed = size_text(sum(log.size for log, _ in done.deleted))
    tell(f"{number(len(done.deleted), 'log')} {would}deleted, {freed}; {len(done.thinned)} thinned")


def _as_json(done: _Done, *, dry_run: bool) -> dict[str, Any]:
    from hearthlog.schemas.salvage.recover import STEPS

    return {
        "dry_run": dry_run,
        "deleted": [
            {"log": str(log.path), "why": why, "bytes": log.size} for log, why in done.deleted
        ],
        "thinned": [{"log": str(log.path), "of": STEPS[step]} for log, step in done.thinned],
        "kept": {str(path): reason for path, reason in done.kept.items()},
        "warnings": done.warnings,
    }
