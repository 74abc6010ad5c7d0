"""Recorder subcommands: `devices`, `config`, `pause`, `resume`, `retain` and `install-service`."""

import getpass
import json
import re
from collections.abc import Iterator
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.tools.cli.options import (
    Json,
    LogsFolder,
    MaxBagFiles,
    MaxRecordSize,
    MinFreeSpace,
    RecorderConfiguration,
    RetentionDays,
)
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    number,
    print_json,
    print_lines,
    print_notice,
    wrong_use,
)

if TYPE_CHECKING:
    from pydantic import BaseModel

    from hearthlog.recorder.config_problems import Key, Origins
    from hearthlog.recorder.disk_keeper import Thinned
    from hearthlog.recorder.retention import Deletion, KeepingRules


def devices(*, as_json: Json = False) -> None:
    """List the microphones by the names that `hearthlog record --device` accepts."""
    from hearthlog.recorder.sources.capture import closed_card
    from hearthlog.recorder.sources.process import query_devices

    microphones = query_devices()
    if as_json:
        print(json.dumps([asdict(device) for device in microphones], indent=2))
        return
    for device in microphones:
        default = "  (default)" if device.is_default else ""
        place = "".join(f", {each}" for each in (device.port, device.serial) if each)
        rate = f"{device.default_rate:.0f} Hz"
        print(f"{device.name}  {device.channels} channels, {rate}{place}{default}")
    if not microphones:
        print_notice(closed_card() or "no microphone found")
        raise typer.Exit(1)


config = typer.Typer(help="Show and check the configuration of the recorder.")


@config.callback(invoke_without_command=True)
def show(
    context: typer.Context,
    file: Annotated[
        Path | None, typer.Option("--config", help="Configuration, a TOML file.")
    ] = None,
) -> None:
    """Print the effective settings of a recorder, and the origin of each value."""
    from hearthlog.recorder.config import load_with_origins

    if context.invoked_subcommand is not None:
        return
    settings, origins = load_with_origins(file, {}, {})
    values = [name for name in type(settings).model_fields if name != "microphone"]
    print_lines(_value_lines(settings, values, (), origins))
    for place, microphone in enumerate(settings.microphone):
        print("\n[[microphone]]")
        fields = list(type(microphone).model_fields)
        print_lines(_value_lines(microphone, fields, ("microphone", place), origins))


@config.command()
def check(
    file: Annotated[Path, typer.Argument(help="Configuration, a TOML file.")],
) -> None:
    """Check a configuration before starting a recorder or a bridge with it.

    Exit status 2: it is invalid; 1: a model, a folder or a file in it cannot be used; 3:
    others may read its secrets, a file should be a credential of the service, nobody would
    read a text file, an alert can never notify, or something is deprecated.
    """
    errors, problems, warnings = findings(file)
    print_notice(*map(str, errors), *problems, *warnings)
    if errors or problems:
        raise typer.Exit(max([1, *(error.status for error in errors)]))
    print(f"{file}: valid")
    if warnings:
        raise typer.Exit(3)


def findings(file: Path) -> "tuple[list[HearthlogError], list[str], list[str]]":
    """Return the errors of the recorder, those of the bridge, and the warnings of both.

    Raise `ConfigurationError` if the configuration is invalid.
    """
    from hearthlog.analyzer.bridge.alerts.rule_checks import rule_doubts, unknown_class_problems
    from hearthlog.analyzer.bridge.bridge import exposed_files, output_problems
    from hearthlog.analyzer.bridge.settings import configured_microphones, load_bridge_settings
    from hearthlog.recorder.config import exposed_passwords
    from hearthlog.recorder.recording import recording_problems
    from hearthlog.tools.cli.record import with_model

    settings, bridge = load_bridge_settings(file)
    settings, microphones = with_model(settings), configured_microphones(settings)
    errors = recording_problems(settings)
    problems, warnings = output_problems(bridge)
    warnings += rule_doubts(bridge.alert, settings, microphones)
    warnings += unknown_class_problems(bridge.alert, settings, microphones)
    warnings += [*exposed_passwords(settings, file), *exposed_files(bridge, file, bridge.state)]
    return errors, problems, warnings


@config.command()
def schema() -> None:
    """Print the JSON schema of the configuration, for checks and completion in editors."""
    from hearthlog.analyzer.bridge.settings import file_schema

    print(json.dumps(file_schema(), indent=2))


def _value_lines(
    settings: "BaseModel", names: list[str], table: "Key", origins: "Origins"
) -> Iterator[str]:
    for name in names:
        origin = origins.origin((*table, name))
        value = _toml(settings.model_dump(mode="json")[name])
        yield f"{name} = {value}  # {origin}" if value else f"# {name}: {origin}"


def _toml(value: Any) -> str:
    """Format a value as TOML; empty for None, which TOML lacks."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(each)}' for key, each in value.items())}}}"
    return "" if value is None else json.dumps(value, ensure_ascii=False)


_UNITS = {"m": "minutes", "h": "hours", "d": "days"}
_LONGEST = timedelta(days=366)


def pause(
    logs: LogsFolder,
    duration: Annotated[
        str | None,
        typer.Option("--for", help="How long, such as 30m, 2h or 1d.", show_default="until resume"),
    ] = None,
) -> None:
    """Close the microphones of the recorders of a folder; the log records when, and why."""
    from hearthlog.recorder import pause_schedule

    _check_folder(logs)
    pause_schedule.pause(logs, None if duration is None else _read_duration(duration))
    until = "until `hearthlog resume`" if duration is None else f"for {duration}, or until resume"
    print(f"{logs}: paused {until}; its recorders close the microphones within a second")


def resume(logs: LogsFolder) -> None:
    """End a pause."""
    from hearthlog.recorder import pause_schedule

    _check_folder(logs)
    was_paused = pause_schedule.resume(logs)
    print(f"{logs}: {'recording again' if was_paused else 'was not paused'}")


def _check_folder(logs: Path) -> None:
    from hearthlog.schemas.logs.files import check_allowed

    check_allowed(logs)
    if not logs.is_dir():
        wrong_use(f"{logs}: no such folder; name the folder that the recorder writes to")


def _read_duration(text: str) -> timedelta:
    match = re.fullmatch(r"(\d{1,6})([mhd])", text)
    if match is None:
        wrong_use(f"--for {text}: not a duration such as 30m, 2h or 1d")
    duration = timedelta(**{_UNITS[match[2]]: int(match[1])})
    if not timedelta() < duration <= _LONGEST:
        wrong_use(f"--for {text}: must be more than zero and at most a year")
    return duration


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
    config: RecorderConfiguration = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only show what would be deleted or thinned, and why.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Delete or thin the oldest logs of a recorder by its limits; a running one does so by itself.

    Never deleted: the newest log, and logs that are reviewed, locked by a file LOG.keep,
    unfinished, or of another node. Exit status 3: a limit cannot be met, or a log cannot be
    deleted.
    """
    from hearthlog.recorder.config import load_settings

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
    print_notice(
        f"{number(len(done.deleted), 'log')} {would}deleted, {freed}; {len(done.thinned)} thinned"
    )


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


_LINGER = Path("/var/lib/systemd/linger")


def install_service(
    *,
    user: Annotated[
        bool,
        typer.Option("--user", help="Install a user service, which records in the current folder."),
    ] = False,
    config: RecorderConfiguration = None,
    account: Annotated[
        str | None,
        typer.Option(
            help="Account that runs the system service.",
            show_default="hearthlog; a separate one for the bridge",
        ),
    ] = None,
    bridge: Annotated[
        bool,
        typer.Option("--bridge", help="Install the bridge instead of the recorder."),
    ] = False,
) -> None:
    """Install the recorder, or the bridge, as a systemd service that starts now and at every boot.

    What the service needs is checked first. Run again after an upgrade, the command rewrites
    the unit and restarts the recorder: the log is completed, and the next log records the
    gap.
    """
    from hearthlog.tools.service.unit import install_bridge, install_for_system, install_for_user

    if user and (bridge or account is not None):
        wrong_use("--account and --bridge are for the system service; --user runs as you")
    if bridge:
        if config is None:
            wrong_use("--bridge needs --config, with a table such as [bridge.mqtt]")
        installed = install_bridge(config, account)
    elif user:
        installed = install_for_user(config)
    else:
        installed = install_for_system(account or "hearthlog", config)
    print(installed.unit)
    if installed.started:
        what, name = ("running", "hearthlog-bridge") if bridge else ("recording", "hearthlog")
        manager = "systemctl --user" if user else "systemctl"
        print_notice(f"it is {what}: `{manager} status {name}` shows its state")
    else:
        print_notice("it is enabled, and starts with systemd")
    if user and not (_LINGER / getpass.getuser()).exists():
        print_notice("it ends when you log out; to keep it running: loginctl enable-linger")
