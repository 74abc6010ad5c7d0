"""What the recorder was asked to do: command line, then environment, then file, then defaults."""

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_settings import BaseSettings, InitSettingsSource, SettingsConfigDict
from pydantic_settings.sources import PydanticBaseSettingsSource

from hearthlog.recorder.clips import Keep
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.zone import check_time_zone, machine_zone
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.files import check_node_name
from hearthlog.schemas.regular import open_regular
from hearthlog.schemas.topics import check_microphone_name


def _checked(check: Any) -> AfterValidator:
    def validate(value: str) -> str:
        try:
            return str(check(value))
        except HearthlogError as error:
            raise ValueError(str(error)) from error

    return AfterValidator(validate)


class Microphone(BaseModel):
    """One microphone, or the audio files that stand in for it."""

    model_config = ConfigDict(extra="forbid")

    name: Annotated[str, _checked(check_microphone_name)] = "mic"
    device: str = ""  # as `hearthlog devices` lists it; empty: the default one


class Settings(BaseSettings):
    """Everything that can be configured; the field names are the keys of the TOML file."""

    model_config = SettingsConfigDict(
        extra="forbid", env_prefix="HEARTHLOG_", validate_default=True
    )

    node: Annotated[str, _checked(check_node_name)] = "home"
    output: Path = Path("logs")
    model: Path | None = None
    max_bag_duration: int = Field(default=3600, ge=1, le=86_400)  # seconds a file
    flush_seconds: float = Field(default=1.0, ge=1.0, le=3600)  # at most lost by a killed process
    sync_seconds: float = Field(default=5.0, ge=1.0, le=3600)  # at most lost by a power cut
    statistics_every: int = Field(default=1, ge=1)  # frames
    timezone: Annotated[str, _checked(check_time_zone)] = Field(default_factory=machine_zone)
    keep_audio: Keep = "off"
    never_keep: list[str] = ["speech"]  # classes
    clip_pre_roll_seconds: float = Field(default=2.0, ge=0.0, le=30.0)
    clip_minutes_a_day: int = Field(default=30, ge=1, le=1500)
    clip_retention_days: int = Field(default=30, ge=1, le=3650)
    clip_min_free_space: int = Field(default=500, ge=0)  # MB: with less, only the log goes on
    microphone: list[Microphone] = Field(default=[Microphone()], min_length=1, max_length=1)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Put the file, which arrives as one of the arguments, below the environment."""
        del dotenv_settings, file_secret_settings
        assert isinstance(init_settings, InitSettingsSource)
        file = init_settings.init_kwargs.pop("file", {})
        return init_settings, env_settings, InitSettingsSource(settings_cls, file)


def load_settings(
    file: Path | None, command_line: dict[str, Any], microphone: dict[str, Any]
) -> Settings:
    """Combine the sources of configuration.

    Parameters
    ----------
    file : Path or None
        The TOML file.
    command_line : dict
        What was given there, by field name.
    microphone : dict
        What was given there of the microphone.

    Raises
    ------
    ConfigurationError
        Naming the key that is unknown or whose value makes no sense.
    """
    content = {} if file is None else _read_toml(file)
    try:
        settings = Settings(file=content, **command_line)  # type: ignore[call-arg]
        merged = settings.microphone[0].model_dump() | microphone
        return settings.model_copy(update={"microphone": [Microphone(**merged)]})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise ConfigurationError(f"{file}: unknown key {key!r}") from error
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigurationError(f"configuration: {key}: {message}") from error


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with os.fdopen(open_regular(path), "rb") as stream:
            return tomllib.load(stream)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{path}: cannot be read as TOML ({error})") from error
