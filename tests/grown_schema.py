"""Definitions of ours that have grown, and logs as a version that has them would write them."""

import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from logreader import LogMessage
from mcap.records import Channel, Message, Metadata, Schema
from rewriting import Log

from hearthlog.schemas.logs.files import SUFFIX, is_layer
from hearthlog.schemas.logs.metadata import HEARTHLOG_METADATA, log_digest
from hearthlog.schemas.messages import fields as schema_fields
from hearthlog.schemas.messages import message_types, type_definitions
from hearthlog.schemas.messages.message_types import APPENDED, SCHEMA_VERSION, Appended

NEXT = SCHEMA_VERSION + 1


class Growth(NamedTuple):
    """What is appended to a type, what stands for it in older logs, and what newer ones say."""

    line: str
    default: float | str | None
    shown: Any  # the default as JSON has it
    value: Any

    @property
    def name(self) -> str:
        return self.line.split()[1]


_SPAN = {"header": {"stamp": 0.0, "frame_id": ""}, "duration": 0.0, "reason": "", "frames_lost": 0}
GROWN = {
    message_types.FEATURES: Growth("uint8 quality", 255, 255, 3),
    message_types.STATISTICS: Growth(
        "string formula", "of the paper", "of the paper", "in two passes"
    ),
    message_types.LABEL: Growth("float32[] embedding", None, [], np.arange(3, dtype=np.float32)),
    message_types.SEGMENT: Growth("float32 loudness", float("nan"), None, -12.5),
    message_types.MARK: Growth("string[] tags", None, [], ["sure", "from the next room"]),
    message_types.REVIEWED: Growth("float32 minutes", 0.0, 0.0, 2.5),
    message_types.GAP: Growth("builtin_interfaces/Time noticed", None, 0.0, None),
    message_types.STREAM_INFO: Growth(
        "hearthlog_msgs/AudioGap last_gap", None, {**_SPAN, "noticed": 0.0}, None
    ),
}


def value_of(typename: str) -> Any:
    """Return what a later version writes to the field that it appended."""
    if typename == message_types.GAP:
        return message_types.time_message(1_772_348_390_000_000_001)
    if typename == message_types.STREAM_INFO:
        return message_types.message(
            message_types.GAP,
            header=message_types.header(1_772_348_380_000_000_001, "hall"),
            duration=message_types.duration_message(2_000_000_000),
            reason="overrun",
            frames_lost=40,
            noticed=value_of(message_types.GAP),
        )
    return GROWN[typename].value


@contextmanager
def grown_definitions(folder: Path) -> Iterator[None]:
    """Let every type of ours have a field more, as in a later version of hearthlog."""
    shutil.copytree(Path(message_types.__file__).with_name("msg"), folder / "msg")
    for typename, growth in GROWN.items():
        with (folder / "msg" / f"{typename.rpartition('/')[2]}.msg").open("a") as text:
            text.write(f"{growth.line}\n")
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(message_types, "files", lambda _: folder)
            for typename, growth in GROWN.items():
                appended = {growth.name: Appended(NEXT, growth.default)}
                patch.setitem(APPENDED, typename, APPENDED.get(typename, {}) | appended)
            _forget()
            yield
    finally:
        _forget()


def _forget() -> None:
    """Let nothing be remembered of other definitions."""
    for remembered in (
        message_types.typestore,
        message_types.recorded_types,
        message_types.definition,
        message_types.type_hash,
        type_definitions.message_type,
        schema_fields.fields_of,
        schema_fields.missing_fields,
    ):
        remembered.cache_clear()


def write_as_later(source: Path, folder: Path) -> None:
    """Write golden files again as a version with `grown_definitions`, which are in force, would."""
    paths = sorted(path for path in source.rglob("*") if path.is_file())
    for path in sorted(paths, key=is_layer):
        target = folder / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        if SUFFIX in path.name:
            _write(path, target)
        else:
            shutil.copy(path, target)


def _write(path: Path, target: Path) -> None:
    log = Log(path)
    schemas = {record.id: record for record in log.records() if isinstance(record, Schema)}
    old = {number: replace(schema) for number, schema in schemas.items()}
    channels = {record.id: record for record in log.records() if isinstance(record, Channel)}
    for record in log.records():
        if isinstance(record, Message):
            schema = old[channels[record.channel_id].schema_id]
            if schema.name in GROWN:
                record.data = _with_value(record.data, schema)
    for record in log.records():
        if isinstance(record, Schema) and record.name in GROWN:
            record.data = message_types.definition(record.name).encode()
        elif isinstance(record, Channel):
            name = old[record.schema_id].name
            record.metadata["topic_type_hash"] = message_types.type_hash(name)
        elif isinstance(record, Metadata) and record.name == HEARTHLOG_METADATA:
            record.metadata["schema_version"] = str(NEXT)
            of = target.parent / record.metadata.get("log", "")
            if of.is_file():  # an enrolled sound is of a log elsewhere
                record.metadata["input_sha256"] = log_digest(of)
    log.write(target)


def _with_value(data: bytes, schema: Schema) -> bytes:
    """Encode a message of an older definition anew, with a value of what was appended to it."""
    content = LogMessage("", schema.name, 0, data, schema).decode()
    setattr(content, GROWN[schema.name].name, value_of(schema.name))
    return message_types.encode(content)


def plain(value: Any) -> Any:
    """Turn what a reader gives into what can be compared, NaN included."""
    if isinstance(value, np.ndarray) and value.dtype != object:
        return str(value.dtype), value.shape, value.tobytes()
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if hasattr(value, "_asdict"):
        value = value._asdict()
    elif is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(each) for each in (sorted(value) if isinstance(value, set) else value)]
    return "nan" if isinstance(value, float) and math.isnan(value) else value
