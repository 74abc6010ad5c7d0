"""Configuration of the recorder: command line, then environment, then file, then defaults."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_serializer,
    field_validator,
    model_validator,
)

from hearthlog.recorder.addresses import is_address, public_name
from hearthlog.recorder.config_problems import ENVIRONMENT, Origins, configuration_error, key_lines
from hearthlog.recorder.pause_schedule import (
    PauseSchedule,
    check_quiet_hours,
    check_time_zone,
    machine_zone,
    quiet_hours,
    time_zone,
)
from hearthlog.recorder.retention import KeepingRules, Limits, Size, ThinningDays
from hearthlog.recorder.stream import LOGGED_EVERY
from hearthlog.schemas.errors import ConfigurationError, HearthlogError
from hearthlog.schemas.files import exposed_secret, read_toml
from hearthlog.schemas.logs.files import check_node_name
from hearthlog.schemas.messages.topics import check_microphone_name, check_scenario_name

if TYPE_CHECKING:
    from hearthlog.recorder.stream.directions import ArrayGeometry

ReadableBy = Literal["owner", "group", "all"]
Keep = Literal["off", "events", "unsure", "always"]
NO_MODEL = Path("none")  # instead of a model file: no labels
BRIDGE = "bridge"  # table of the bridge, ignored by the recorder
_MOST_DAYS = 700_000
_MOST_FILES = 1 << 31
_MOST_FRAMES = 1 << 31
_MOST_MEGABYTES = 1_000_000_000
_LEAST_BAG_SIZE = 1_000_000  # no two files may begin in the same second


def _checked(check: Any) -> AfterValidator:
    def validate(value: str) -> str:
        try:
            return str(check(value))
        except HearthlogError as error:
            raise ValueError(str(error)) from error

    return AfterValidator(validate)


def _check_path(value: Any) -> Any:
    if isinstance(value, str) and not value.strip():
        raise ValueError("is empty; write a path, or leave the key out")
    if isinstance(value, str) and value.startswith(("~", "$")):
        raise ValueError(f"{value[:64]!r}: ~ and $ are not expanded; write the full path")
    if isinstance(value, str) and "\0" in value:
        raise ValueError(f"{value[:64]!r}: no path has the character \\x00; write another one")
    return value


PlainPath = Annotated[Path, BeforeValidator(_check_path)]


def _geometry(places: list[list[float]]) -> "ArrayGeometry":
    from hearthlog.recorder.stream.directions import geometry_of  # noqa: PLC0415  few have one

    return geometry_of(places)


def _checked_places(places: list[list[float]]) -> list[list[float]]:
    try:
        if places:
            _geometry(places)
    except ConfigurationError as error:
        raise ValueError(str(error)) from error
    return places


_MODELS: list[Any] = ["models/champion.safetensors"]
_SCENARIOS: list[Any] = [{"speakers": "models/speakers.safetensors"}]
Scenarios = Annotated[
    dict[Annotated[str, _checked(check_scenario_name)], PlainPath], Field(max_length=8)
]


class MicrophoneSettings(BaseModel):
    """One microphone, or the audio files that replace it."""

    model_config = ConfigDict(extra="forbid")

    name: Annotated[str, _checked(check_microphone_name)] = Field(
        default="mic", description="Begins the topics."
    )
    device: str = Field(
        default="",
        examples=["USB PnP Sound Device"],
        description="Name from `hearthlog devices`, or an address such as rtsp://camera/stream or "
        "ros2:///robot/audio; empty: the default device.",
    )
    fallback: str = Field(
        default="",
        examples=["USB PnP Sound Device"],
        description="Fallback device while the device is missing; empty: none.",
    )
    array: Annotated[list[list[float]], AfterValidator(_checked_places)] = Field(
        default=[],
        examples=[[[0.0, 0.0], [0.1, 0.0]]],
        description="Positions of the microphones of an array, [x, y] in metres for each "
        "channel; empty: no array.",
    )
    channel: int | None = Field(
        default=None,
        ge=1,
        le=64,
        description="Channel of several to record, from 1; by default the first, and of files "
        "and addresses the mean of all, or the best one if the mean hides it.",
    )
    model: PlainPath | None = Field(
        default=None,
        examples=_MODELS,
        description="Model of this microphone, in place of the recorder's; none: no labels.",
    )
    scenarios: Scenarios | None = Field(
        default=None,
        examples=_SCENARIOS,
        description="Scenarios of this microphone, in place of the recorder's; {}: none.",
    )

    @property
    def geometry(self) -> "ArrayGeometry | None":
        """Microphone positions of the array; None without an array."""
        return _geometry(self.array) if self.array else None

    @property
    def channels(self) -> int | None:
        """Number of channels of the array; None without an array."""
        return len(self.array) or None

    @model_validator(mode="after")
    def _check_array(self) -> Self:
        if self.array and is_address(self.device):
            raise ValueError("an address in the network gives one channel, and has no array")
        if self.array and self.channel is not None:
            raise ValueError("an array uses all of its channels; leave `channel` out")
        return self

    @field_serializer("device", "fallback", when_used="json")
    def _name_device(self, device: str) -> str:
        return public_name(device)  # logs have no passwords


class Settings(BaseModel):
    """Everything that can be configured; the field names are the keys of the TOML file."""

    model_config = ConfigDict(extra="forbid", validate_default=True)

    node: Annotated[str, _checked(check_node_name)] = Field(
        default="home",
        description="Name of this recorder, and first part of the names of its logs.",
    )
    output: PlainPath = Field(default=Path("logs"), description="Folder of the logs.")
    model: PlainPath | None = Field(
        default=None,
        examples=_MODELS,
        description="Model file, or a link to one; general or bathroom, which come with hearthlog; "
        "none: no labels. By default models/champion.safetensors if there is one, else general.",
    )
    scenarios: Scenarios = Field(
        default={},
        examples=_SCENARIOS,
        description="Additional models by scenario, such as "
        '{speakers = "models/speakers.safetensors"}; audioset: the names of the network.',
    )
    feature_set: str = Field(
        default="",
        examples=["home33"],
        description="Feature set; empty: the model's, or the default.",
    )
    embedding: str = Field(
        default="",
        max_length=64,
        examples=["yamnet"],
        description="Pretrained network, installed by `hearthlog models fetch`; none: no "
        "network; empty: yamnet if installed.",
    )
    microphone: list[MicrophoneSettings] = Field(
        default=[MicrophoneSettings()],
        min_length=1,
        max_length=16,
        description="One table for each microphone.",
    )
    max_bag_duration: int = Field(default=3600, ge=1, le=86_400, description="Seconds per log.")
    max_bag_size: Size = Field(
        default=0, examples=["50M"], description="Bytes per log, such as 50M; 0: no limit."
    )
    flush_seconds: float = Field(
        default=1.0,
        ge=1.0,
        le=3600,
        description="Maximum loss in seconds if the recorder is killed.",
    )
    sync_seconds: float = Field(
        default=5.0, ge=1.0, le=3600, description="Maximum loss in seconds if the power is cut."
    )
    statistics_every: int = Field(
        default=LOGGED_EVERY,
        ge=1,
        le=_MOST_FRAMES,
        description="Frames between messages of statistics.",
    )
    timezone: Annotated[str, _checked(check_time_zone)] = Field(
        default_factory=machine_zone,
        description="Time zone of the home, such as Europe/Berlin; by default the machine's.",
    )
    quiet_hours: list[Annotated[str, _checked(check_quiet_hours)]] = Field(
        default=[],
        examples=[["22:00-06:30"]],
        description='Daily hours without listening, such as ["22:00-06:30"].',
    )
    readable_by: ReadableBy = Field(
        default="owner", description="Accounts of this machine that may read new logs and folders."
    )
    privacy: list[str] = Field(
        default=[],
        examples=[["speech"]],
        description='Classes whose features are logged coarsely, such as ["speech"]: over a '
        "second.",
    )
    never_tell: list[str] = Field(
        default=[],
        examples=[["music"]],
        description='Classes that no page, alert, report or metric shows, such as ["music"].',
    )
    keep_audio: Keep = Field(default="off", description="Sound to keep as clips.")
    never_keep: list[str] = Field(
        default=["speech"],
        description="Classes whose sound is never in a clip, even with low confidence.",
    )
    clip_pre_roll_seconds: float = Field(
        default=2.0, ge=0.0, le=30.0, description="Part of a clip before its sound."
    )
    clip_minutes_a_day: int = Field(
        default=30, ge=1, le=1500, description="Maximum minutes of clips a day."
    )
    clip_retention_days: int = Field(
        default=30, ge=1, le=3650, description="Age at which clips are deleted."
    )
    clip_min_free_space: int = Field(
        default=500,
        ge=0,
        le=_MOST_MEGABYTES,
        description="MB that must be free for clips; the log continues with less.",
    )
    retention_days: int = Field(
        default=0, ge=0, le=_MOST_DAYS, description="Days with logs to keep; 0: no limit."
    )
    max_bag_files: int = Field(
        default=0, ge=0, le=_MOST_FILES, description="Finished logs to keep; 0: no limit."
    )
    max_record_size: Size = Field(
        default=0, examples=["20G"], description="Bytes of all logs, such as 20G; 0: no limit."
    )
    min_free_space: Size = Field(
        default=500_000_000,
        examples=["500M"],
        description="Bytes that logs leave free on the disk; 0: none.",
    )
    drop_statistics_days: int = Field(
        default=0,
        ge=0,
        le=_MOST_DAYS,
        description="Days with logs after which statistics are removed; 0: never.",
    )
    drop_features_days: int = Field(
        default=0, ge=0, le=_MOST_DAYS, description="The same for features and statistics."
    )
    labels_only_days: int = Field(
        default=0,
        ge=0,
        le=_MOST_DAYS,
        description="The same for everything but labels, segments and gaps.",
    )

    def keeping_rules(self) -> KeepingRules:
        """Return the retention and thinning rules."""
        limits = Limits(
            self.retention_days, self.max_bag_files, self.max_record_size, self.min_free_space
        )
        thinning = ThinningDays(
            self.drop_statistics_days, self.drop_features_days, self.labels_only_days
        )
        return KeepingRules(str(self.output), self.node, limits, thinning)

    def settings_of(self, microphone: str) -> MicrophoneSettings:
        """Return the settings of a microphone by name."""
        return next(each for each in self.microphone if each.name == microphone)

    def scenarios_of(self, microphone: MicrophoneSettings) -> dict[str, Path]:
        """Return the model files of a microphone's scenarios, by scenario name."""
        return self.scenarios if microphone.scenarios is None else microphone.scenarios

    def rest(self) -> PauseSchedule:
        """Return the pause schedule."""
        hours = [quiet_hours(text) for text in self.quiet_hours]
        return PauseSchedule(hours, time_zone(self.timezone), self.output)

    @field_validator("max_bag_size")
    @classmethod
    def _check_bag_size(cls, size: int) -> int:
        if 0 < size < _LEAST_BAG_SIZE:
            raise ValueError("at least 1M, which is some minutes; or 0, for any size")
        return size


_OTHERS: dict[str, type[BaseModel]] = {  # tables with keys to suggest
    "above the first table": Settings,
    "below [[microphone]]": MicrophoneSettings,
}


def load_settings(
    file: Path | None, command_line: dict[str, Any], microphone: dict[str, Any]
) -> Settings:
    """Load settings from the command line, the environment, the file (if any) and the defaults.

    Earlier sources take precedence. Raise `ConfigurationError` if the file is unreadable or not
    TOML, if an environment variable is unknown or not JSON, or if a key is unknown or its value
    invalid; the message names it.
    """
    return load_with_origins(file, command_line, microphone)[0]


def _without_scenarios(content: dict[str, Any]) -> dict[str, Any]:
    """Return the microphones of a file without their own scenarios."""
    microphones = content.get("microphone")
    if not isinstance(microphones, list):
        return {}
    return {
        "microphone": [
            {key: value for key, value in each.items() if key != "scenarios"}
            if isinstance(each, dict)
            else each
            for each in microphones
        ]
    }


def load_with_origins(
    file: Path | None, command_line: dict[str, Any], microphone: dict[str, Any]
) -> tuple[Settings, Origins]:
    """Load settings and their origins; raise `ConfigurationError` as `load_settings` does."""
    content = {} if file is None else read_toml(file, "configuration", ConfigurationError)
    content.pop(BRIDGE, None)
    lines = {} if file is None else key_lines(file.read_text("utf-8-sig"))
    origins = Origins(command_line, content, file, lines)
    given = _environment() | command_line
    if "scenarios" in given:
        content = content | _without_scenarios(content)
    try:
        settings = Settings(**(content | given))
        _check_microphones(settings.microphone, origins)
        if not microphone:
            return settings, origins
        if len(settings.microphone) > 1:
            raise ConfigurationError(
                f"{file}: has {len(settings.microphone)} microphones; put the setting into the "
                f"table of the microphone, not on the command line ({', '.join(microphone)})"
            )
        merged = settings.microphone[0].model_dump() | microphone
        update = {"microphone": [MicrophoneSettings(**merged)]}
        return settings.model_copy(update=update), origins
    except ValidationError as error:
        raise configuration_error(error, origins, Settings, (), _OTHERS) from error


def _environment() -> dict[str, Any]:
    """Parse the environment variables; reject unknown names and invalid JSON."""
    values: dict[str, Any] = {}
    for variable in (name for name in sorted(os.environ) if name.upper().startswith(ENVIRONMENT)):
        name = variable[len(ENVIRONMENT) :].lower()
        field = Settings.model_fields.get(name)
        if field is None:
            raise ConfigurationError(f"environment: unknown variable {variable[:64]!r}")
        values[name] = os.environ[variable]
        if get_origin(field.annotation) in {list, dict}:
            values[name] = _from_json(variable)
    return values


def _from_json(variable: str) -> Any:
    try:
        return json.loads(os.environ[variable])
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"environment: {variable} is not JSON ({error})") from error


def exposed_passwords(settings: Settings, file: Path | None) -> list[str]:
    """Return a warning line if everybody can read a file with a password, else no line."""
    devices = [name for each in settings.microphone for name in (each.device, each.fallback)]
    if file is None or all(public_name(device) == device for device in devices):
        return []
    line = exposed_secret(file)
    return [line] if line else []


def _check_microphones(microphones: list[MicrophoneSettings], origins: Origins) -> None:
    fallbacks = [each.fallback for each in microphones if each.fallback]
    for key, others in (("name", []), ("device", fallbacks)):
        values = [*(getattr(each, key) for each in microphones), *others]
        twice = next((value for value in values if values.count(value) > 1), None)
        if twice is not None:
            what = f"{key} {public_name(twice)!r}" if twice else "the default device"
            where = origins.place(("microphone", len(microphones) - 1))
            raise ConfigurationError(f"{where}: two microphones have {what}; give each its own")
