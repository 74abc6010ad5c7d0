"""`hearthlog config`: what is configured, whether it can be used, and what could be."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.tools.cli.text import print_lines, tell

if TYPE_CHECKING:
    from pydantic import BaseModel

    from hearthlog.recorder.config_problems import Key, Origins

config = typer.Typer(help="Show the configuration of the recorder, and check it.")


@config.callback(invoke_without_command=True)
def show(
    context: typer.Context,
    file: Annotated[
        Path | None, typer.Option("--config", help="Configuration, a TOML file.")
    ] = None,
) -> None:
    """Print what a recorder would be started with, and where each value comes from."""
    from hearthlog.recorder.config import load_with_origins

    if context.invoked_subcommand is not None:
        return
    settings, origins = load_with_origins(file, {}, {})
    values = [name for name in type(settings).model_fields if name != "microphone"]
    print_lines(_value_lines(settings, values, (), origins))
    for number, microphone in enumerate(settings.microphone):
        print("\n[[microphone]]")
        fields = list(type(microphone).model_fields)
        print_lines(_value_lines(microphone, fields, ("microphone", number), origins))


@config.command()
def check(
    file: Annotated[Path, typer.Argument(help="Configuration, a TOML file.")],
) -> None:
    """Check a configuration before a recorder or a bridge is started with it.

    Exit status 2: it is wrong; 1: a model, a folder or a file that it names cannot be used; 3:
    others may read its secrets, a file may be a credential of the service, nobody would read a
    text file, or an alert cannot ring.
    """
    from hearthlog.analyzer.bridge.alerts.rule_doubts import rule_doubts
    from hearthlog.analyzer.bridge.alerts.unheard_classes import unheard_classes
    from hearthlog.analyzer.bridge.outputs import exposed_files, output_problems
    from hearthlog.analyzer.bridge.settings import configured_microphones, load_bridge_settings
    from hearthlog.recorder.config import exposed_passwords
    from hearthlog.recorder.recording import recording_problems
    from hearthlog.tools.cli.record import with_model

    settings, bridge = load_bridge_settings(file)
    settings, microphones = with_model(settings), configured_microphones(settings)
    errors = recording_problems(settings)
    problems, warnings = output_problems(bridge)
    warnings += rule_doubts(bridge.alert, settings, microphones)
    warnings += unheard_classes(bridge.alert, settings, microphones)
    warnings += [*exposed_passwords(settings, file), *exposed_files(bridge, file, bridge.state)]
    for line in [*map(str, errors), *problems, *warnings]:
        tell(line)
    if errors or problems:
        raise typer.Exit(max([1, *(error.status for error in errors)]))
    print(f"{file}: can be used")
    if warnings:
        raise typer.Exit(3)


@config.command()
def schema() -> None:
    """Print the JSON schema of the configuration, by which editors check and complete it."""
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
    """Write a value down as TOML; empty for None, which TOML does not have."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(each)}' for key, each in value.items())}}}"
    return "" if value is None else json.dumps(value, ensure_ascii=False)
