"""`hearthlog retain`: deletes the logs that the limits of a recorder ask for, or says which."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    from hearthlog.recorder.disk.recorded import RecordedLog
    from hearthlog.recorder.disk.retention import Plan


def retain(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder of logs.", show_default="logs")
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
        bool, typer.Option("--dry-run", help="Only say what would be deleted, and why.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Delete the oldest logs of a recorder, as its limits ask; the recorder does it by itself.

    Never deleted: the newest log, and what is reviewed, locked by a file LOG.keep, unfinished, of
    another node or unknown. Exit status 3: a limit cannot be met, or a log cannot be deleted.
    """
    from hearthlog.recorder.config import load_settings
    from hearthlog.recorder.disk.retention import carry_out, plan_for
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
    failures: list[OSError] = []
    plan = plan_for(settings.output, settings.node, settings.keeping_rules().limits, failures)
    logs = [log for log, _ in plan.deletions]
    if not dry_run:
        logs = carry_out(plan, failures)
    if as_json:
        print_json(_as_json(plan, logs, dry_run=dry_run))
    else:
        _print(plan, logs, dry_run=dry_run)
    end_with_warnings([*plan.problems, *(f"{e.filename}: {e.strerror}" for e in failures)])


def _print(plan: "Plan", logs: "list[RecordedLog]", *, dry_run: bool) -> None:
    from hearthlog.recorder.disk.sizes import size_text

    why = {log.path: reason for log, reason in plan.deletions}
    print_lines(f"{log.path}: {why[log.path]} ({size_text(log.size)})" for log in logs)
    print_lines(f"{path}: is kept: {reason}" for path, reason in plan.kept.items())
    done = "would be deleted" if dry_run else "deleted"
    tell(f"{number(len(logs), 'log')} {done}, {size_text(sum(log.size for log in logs))}")


def _as_json(plan: "Plan", logs: "list[RecordedLog]", *, dry_run: bool) -> dict[str, Any]:
    why = {log.path: reason for log, reason in plan.deletions}
    return {
        "dry_run": dry_run,
        "deleted": [
            {"log": str(log.path), "why": why[log.path], "bytes": log.size} for log in logs
        ],
        "kept": {str(path): reason for path, reason in plan.kept.items()},
        "problems": plan.problems,
    }
