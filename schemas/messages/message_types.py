"""Message types of a log, their CDR encoding with the typestore of rosbags, and appended fields.

Fields are only ever appended to `msg/*.msg`, never renamed, moved, removed, or changed in type.
An appended field needs a higher `SCHEMA_VERSION` and an entry in `APPENDED`: see docs/log.md.
"""

from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from hearthlog.schemas.frames import NANOSECONDS

SCHEMA_VERSION = 3  # of messages and records written by this version


class Appended(NamedTuple):
    """Field that was appended to a message type.

    The default applies to messages without the field; None is a number of 0, no time, or an
    empty text or sequence.
    """

    since: int  # first schema version with the field
    default: float | str | None = None


# By type and field name.
APPENDED: dict[str, dict[str, Appended]] = {
    "hearthlog_msgs/msg/AudioMark": {"reason": Appended(since=3)},
}


PACKAGE = "hearthlog_msgs"
STREAM_INFO = f"{PACKAGE}/msg/AudioStreamInfo"
FEATURES = f"{PACKAGE}/msg/AudioFeatures"
STATISTICS = f"{PACKAGE}/msg/AudioStatistics"
LABEL = f"{PACKAGE}/msg/AudioLabel"
SEGMENT = f"{PACKAGE}/msg/AudioSegment"
MARK = f"{PACKAGE}/msg/AudioMark"
REVIEWED = f"{PACKAGE}/msg/AudioReview"
GAP = f"{PACKAGE}/msg/AudioGap"
DIRECTION = f"{PACKAGE}/msg/AudioDirection"
EMBEDDING = f"{PACKAGE}/msg/AudioEmbedding"
RAW_AUDIO = "foxglove_msgs/msg/RawAudio"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
LOG = "rcl_interfaces/msg/Log"

# Subset of ROS 2 Jazzy: importing all its types takes longer than all other imports together.
_OF_ROS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "diagnostic_msgs/msg/KeyValue": "string key\nstring value",
    "diagnostic_msgs/msg/DiagnosticStatus": """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values""",
    DIAGNOSTICS: "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    LOG: """\
uint8 DEBUG=10
uint8 INFO=20
uint8 WARN=30
uint8 ERROR=40
uint8 FATAL=50
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line""",
}


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 and of the folder `msg`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(_types_here())
    return store


@cache
def recorded_types() -> Typestore:
    """Return only the types that a recorder writes."""
    store = get_typestore(Stores.EMPTY)
    of_ros = (get_types_from_msg(text, name) for name, text in _OF_ROS.items())
    store.register({name: types for same in of_ros for name, types in same.items()} | _types_here())
    return store


def _types_here() -> dict[str, Any]:
    others = {RAW_AUDIO.rpartition("/")[2]: RAW_AUDIO}  # Foxglove's, which ROS 2 need not have
    types: dict[str, Any] = {}
    for file in (files("hearthlog.schemas.messages") / "msg").iterdir():
        name, _, suffix = file.name.partition(".")
        if suffix == "msg":
            types |= get_types_from_msg(file.read_text(), others.get(name, f"{PACKAGE}/msg/{name}"))
    return types


def store_of(typename: str) -> Typestore:
    """Return a typestore with a type; for types of a recorder, the small one."""
    recorded = recorded_types()
    return recorded if typename in recorded.fielddefs else typestore()


def message(typename: str, **fields: Any) -> Any:
    """Create a message from values by field, as in rosbags; appended fields have defaults."""
    absent = APPENDED.get(typename, {}).keys() - fields.keys()
    if absent:
        descriptions = dict(store_of(typename).fielddefs[typename][1])
        for name in absent:
            fields[name] = _default(descriptions[name], APPENDED[typename][name].default)
    return store_of(typename).types[typename](**fields)


def _default(description: tuple[Nodetype, Any], value: float | str | None = None) -> Any:
    """Return the default of a field in a message, as `default_rows` does for columns."""
    node, kind = description
    if node is Nodetype.BASE:
        return ("" if kind[0] == "string" else 0) if value is None else value
    if node is Nodetype.NAME:
        fields = [
            f for f in store_of(kind).fielddefs[kind][1] if f[0] not in APPENDED.get(kind, {})
        ]
        return message(kind, **{name: _default(described) for name, described in fields})
    (element, base), count = kind
    length = count if node is Nodetype.ARRAY else 0
    if element is Nodetype.BASE and base[0] != "string":
        return np.zeros(length, number_type(base[0]))
    return [_default((element, base)) for _ in range(length)]


def number_type(name: str) -> np.dtype[Any]:
    """Return the dtype of a number type in message definitions, such as "float32" or "byte"."""
    return np.dtype("uint8" if name in {"byte", "char"} else name)


def header(stamp: int, frame_id: str) -> Any:
    """Create a `std_msgs/Header`."""
    return message("std_msgs/msg/Header", stamp=time_message(stamp), frame_id=frame_id)


def time_message(nanoseconds: int) -> Any:
    """Create a `builtin_interfaces/Time` of nanoseconds of UTC since 1970."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return message("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def duration_message(nanoseconds: int) -> Any:
    """Create a `builtin_interfaces/Duration`."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return message("builtin_interfaces/msg/Duration", sec=seconds, nanosec=rest)


def nanoseconds(stamp: Any) -> int:
    """Convert a `builtin_interfaces` Time or Duration to nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def encode(fields: Any) -> bytes:
    """Encode one message as little-endian CDR."""
    store = store_of(fields.__msgtype__)
    return bytes(store.serialize_cdr(fields, fields.__msgtype__, little_endian=True))


def decode(data: bytes | memoryview, typename: str) -> Any:
    """Decode one message from CDR, in either byte order."""
    return store_of(typename).deserialize_cdr(data, typename)


@cache
def definition(typename: str) -> str:
    """Return the definitions of a type and its nested types, as MCAP's `ros2msg` text."""
    return store_of(typename).generate_msgdef(typename, ros_version=2)[0]


@cache
def type_hash(typename: str) -> str:
    """Return the RIHS01 hash of a type, which ROS 2 compares between publisher and subscriber."""
    return store_of(typename).hash_rihs01(typename)


_STATUS_PREFIX = "hearthlog: "


def status_name(subject: str) -> str:
    """Return the name of the diagnostic status of a subject, such as a microphone."""
    return _STATUS_PREFIX + subject


def status_subject(name: str, node: str = "") -> str:
    """Return the subject of a diagnostic status from its name; without the recorder's name."""
    subject = name.removeprefix(_STATUS_PREFIX)
    return subject.removeprefix(f"{node} ") if node else subject


LOG_DAMAGED = "the log was damaged"  # reason of gaps written by `recover`
CLOCK_SET = "the clock was set"  # part of the reason: the gap may have any length, even negative
QUIET_HOURS, PAUSED = ON_PURPOSE = "quiet hours", "paused"  # recording was disabled


def encode_gap(microphone: str, start: int, end: int, reason: str, frames_lost: int) -> bytes:
    """Encode an `AudioGap` as CDR."""
    return encode(
        message(
            GAP,
            header=header(start, microphone),
            duration=duration_message(end - start),
            reason=reason,
            frames_lost=frames_lost,
        )
    )
