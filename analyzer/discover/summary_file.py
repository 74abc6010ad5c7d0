"""The summary of the groups of a home: a small file beside theirs, for who only shows them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from hearthlog.analyzer.errors import DataError
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.frames import NANOSECONDS, read_time
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.new_files import replaced_file

SUMMARY: Final = "groups.safetensors.json"  # in a folder of logs, beside the file of groups
MOST_GROUPS = 1_000  # in a file
MOST_LABELS, MOST_MICROPHONES = 8, 64  # of a group
LONGEST_TEXT = 200  # characters
_FORMAT: Final = 1
_LARGEST = 4 << 20  # bytes
_MOST_COUNT = (1 << 31) - 1
_LATEST = (1 << 32) * NANOSECONDS  # beyond what messages can hold


def _is_time(text: str) -> str:
    if abs(read_time(text)) > _LATEST:
        raise ValueError("no time of a log")
    return text


_Count = Annotated[int, Field(ge=0, le=_MOST_COUNT)]
_Text = Annotated[str, Field(max_length=LONGEST_TEXT)]
_Time = Annotated[str, Field(max_length=40), AfterValidator(_is_time)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Example(_Part):
    """A sound that stands for its group; times in ISO 8601, of UTC."""

    log: Annotated[str, Field(max_length=4096)]
    microphone: _Text
    start: _Time
    end: _Time


class GroupSummary(_Part):
    """A group of sounds that are alike.

    Attributes
    ----------
    name : str
        The class that a person named it; empty where nobody did.
    days : int
        On how many days, at home.
    hours : list of int
        How many of them began in each hour of the day, at home.
    alike : float
        0: they differ as any sounds of the home do; 1: they are all the same.
    labels : dict of str to float
        What share of them each of their most frequent labels has, the most frequent first.
    """

    number: Annotated[int, Field(ge=1, le=_MOST_COUNT)]
    name: Annotated[str, Field(pattern=rf"^({CLASS_NAME.pattern})?$")]
    times: Annotated[int, Field(ge=1, le=_MOST_COUNT)]
    days: Annotated[int, Field(ge=1, le=_MOST_COUNT)]
    hours: Annotated[list[_Count], Field(min_length=24, max_length=24)]
    seconds: Annotated[float, Field(ge=0.0, le=1e6)]
    alike: _Share
    labels: Annotated[dict[_Text, _Share], Field(max_length=MOST_LABELS)]
    microphones: Annotated[list[_Text], Field(max_length=MOST_MICROPHONES)]
    examples: Annotated[list[Example], Field(min_length=1, max_length=3)]


class HomeSummary(_Part):
    """The groups of a home, the largest first, as they were found last."""

    format: Annotated[int, Field(ge=1, le=_FORMAT)] = _FORMAT
    id: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")]
    sounds: _Count
    timezone: _Text
    groups_file: Annotated[str, Field(max_length=4096)]
    groups: Annotated[list[GroupSummary], Field(max_length=MOST_GROUPS)]

    def named(self, names: Mapping[int, str]) -> "HomeSummary":
        """Return the same with other names for groups, by their numbers."""
        groups = [
            each.model_copy(update={"name": names.get(each.number, each.name)})
            for each in self.groups
        ]
        return self.model_copy(update={"groups": groups})


def summary_path(groups_file: Path) -> Path:
    """Return the file of the summary of groups; of `groups.safetensors` it is `SUMMARY`."""
    return groups_file.with_name(f"{groups_file.name}.json")


def save_summary(summary: HomeSummary, path: Path) -> None:
    """Write a summary, in place of the one that is there.

    Raise `LogError` if it cannot be written.
    """
    with replaced_file(path, readers=log_readers(path.parent)) as temporary:
        temporary.write_text(f"{json.dumps(summary.model_dump(), allow_nan=False)}\n", "utf-8")


def load_summary(path: Path) -> HomeSummary:
    """Read a summary.

    Raise `DataError` if there is none, or it is no such file, or damaged.
    """
    if not path.exists():
        raise DataError(f"{path}: no such summary of groups; `hearthlog discover` writes it")
    data = read_whole(path, "summary of groups", _LARGEST, DataError)
    try:
        return HomeSummary.model_validate_json(data)
    except ValidationError as error:
        raise DataError(
            f"{path}: is no summary of groups; `hearthlog discover` writes it anew"
        ) from error
