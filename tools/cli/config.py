"""`hearthlog config`: what is configured, whether it can be used, and what could be."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.tools.cli.text import print_lines

if TYPE_CHECKING:
    from pydantic import BaseModel

    from hearthlog.recorder.config_origins import Key, Origins

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
    """Check a configuration before a recorder is started with it.

    Exit status 2: it is wrong; 1: its model, or its folder of logs, cannot be used.
    """
    from hearthlog.analyzer.bridge.settings import load_bridge_settings
    from hearthlog.recorder.recording import check_recording
    from hearthlog.tools.cli.record import with_model

    settings, _ = load_bridge_settings(file)
    check_recording(with_model(settings))
    print(f"{file}: can be used")


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
