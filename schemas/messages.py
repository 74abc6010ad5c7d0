"""The messages of a log and their CDR encoding, on the typestore of rosbags."""

from functools import cache
from importlib.resources import files
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

PACKAGE = "hearthlog_msgs"
STREAM_INFO = f"{PACKAGE}/msg/AudioStreamInfo"
FEATURES = f"{PACKAGE}/msg/AudioFeatures"
STATISTICS = f"{PACKAGE}/msg/AudioStatistics"
LABEL = f"{PACKAGE}/msg/AudioLabel"
SEGMENT = f"{PACKAGE}/msg/AudioSegment"
MARK = f"{PACKAGE}/msg/AudioMark"
GAP = f"{PACKAGE}/msg/AudioGap"
RAW_AUDIO = "foxglove_msgs/msg/RawAudio"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
LOG = "rcl_interfaces/msg/Log"

_DEFINED_HERE = (STREAM_INFO, FEATURES, STATISTICS, LABEL, SEGMENT, MARK, GAP, RAW_AUDIO)
NANOSECONDS = 1_000_000_000


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 and those of `schemas/msg`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = files("hearthlog.schemas") / "msg"
    for name in _DEFINED_HERE:
        text = (folder / f"{name.rpartition('/')[2]}.msg").read_text()
        store.register(get_types_from_msg(text, name))
    return store


def message(typename: str, **fields: Any) -> Any:
    """Make a message of the given type."""
    return typestore().types[typename](**fields)


def header(stamp: int, frame_id: str) -> Any:
    """Make a `std_msgs/Header`; `stamp` in nanoseconds of UTC."""
    return message("std_msgs/msg/Header", stamp=time_message(stamp), frame_id=frame_id)


def time_message(nanoseconds: int) -> Any:
    """Make a `builtin_interfaces/Time`."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return message("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def duration_message(nanoseconds: int) -> Any:
    """Make a `builtin_interfaces/Duration`."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return message("builtin_interfaces/msg/Duration", sec=seconds, nanosec=rest)


def nanoseconds(stamp: Any) -> int:
    """Read a `builtin_interfaces` Time or Duration."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def encode(fields: Any) -> bytes:
    """Encode one message as little-endian CDR."""
    return bytes(typestore().serialize_cdr(fields, fields.__msgtype__, little_endian=True))


def decode(data: bytes | memoryview, typename: str) -> Any:
    """Decode one message."""
    return typestore().deserialize_cdr(data, typename)


@cache
def definition(typename: str) -> str:
    """Return a type's definition and those it builds on, as MCAP's `ros2msg` wants them."""
    return typestore().generate_msgdef(typename, ros_version=2)[0]


@cache
def type_hash(typename: str) -> str:
    """Return the type's RIHS01 hash, by which ROS 2 tells that two sides mean the same type."""
    return typestore().hash_rihs01(typename)
